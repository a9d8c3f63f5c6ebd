"""How requests over HTTP are read and answered: in JSON, whole or not at all, errors with a status."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Coroutine
from functools import wraps
from typing import Any, Final, TypeVar

import msgspec
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response

from skyloop.cockpit.telemetry import encode_json
from skyloop.errors import MissingExtraError, RefusedError, SkyloopError, UnknownNameError, UnsupportedError, UsageError

LARGEST_BODY: Final = 65_536  #: bytes
BODY_S: Final = 10.0  #: within which a request's body must have come
_JSON: Final = "application/json"

_STATUS: Final = (
    (UnknownNameError, 404),
    (UsageError, 400),
    (RefusedError, 409),
    (UnsupportedError, 409),
    (MissingExtraError, 501),
)

T = TypeVar("T")
Handler = Callable[[Any, Request], Awaitable[Response]]


class BadRequest(Exception):  # noqa: N818  (as HTTP calls it)
    """A request that is not valid; ``status`` is the HTTP status of the answer."""

    def __init__(self, status: int, why: str) -> None:
        super().__init__(why)
        self.status = status


def answered(handler: Handler) -> Handler:
    """Turn what a handler raises into an answer with a status and ``{"error": why}``."""

    @wraps(handler)
    async def answer(self: Any, request: Request) -> Response:
        try:
            return await handler(self, request)
        except BadRequest as error:
            return answer_json({"error": str(error)}, error.status)
        except SkyloopError as error:
            status = next((status for kind, status in _STATUS if isinstance(error, kind)), 502)
            return answer_json({"error": str(error)}, status)
        except ClientDisconnect:
            return Response(status_code=400)

    return answer


async def while_wanted(request: Request, work: Coroutine[Any, Any, T]) -> T:
    """Run work for a request, and cancel it as soon as who asked is gone.

    Args:
        request: The request.
        work: The work.

    Returns:
        What ``work`` returns.

    Raises:
        ClientDisconnect: Who asked is gone.
    """
    task, gone = asyncio.create_task(work), asyncio.create_task(_gone(request))
    try:
        await asyncio.wait((task, gone), return_when=asyncio.FIRST_COMPLETED)
        if not task.done():
            raise ClientDisconnect
        return task.result()
    finally:
        task.cancel()
        gone.cancel()
        await asyncio.gather(task, gone, return_exceptions=True)


async def _gone(request: Request) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass


def answer_json(values: Any, status: int = 200) -> Response:
    """Make an answer."""
    return Response(encode_json(values), status, media_type=_JSON)


def check_json(request: Request) -> None:
    """Check the content type: another site's page can't send this one without asking first, which is refused."""
    if request.headers.get("content-type", "").partition(";")[0].strip().lower() != _JSON:
        raise BadRequest(415, f"the content type must be {_JSON}")


async def body_of(request: Request, kind: type[T]) -> T:
    """Read a request's body.

    Args:
        request: The request.
        kind: What the body is to be.

    Raises:
        BadRequest: It is no JSON, too large, not whole in time, or something else.
    """
    check_json(request)
    data = b""
    try:
        async with asyncio.timeout(BODY_S):
            async for part in request.stream():
                data += part
                if len(data) > LARGEST_BODY:
                    raise BadRequest(413, f"at most {LARGEST_BODY} bytes are taken")
    except TimeoutError:
        raise BadRequest(408, f"the request was not whole within {BODY_S:g} s") from None
    try:
        return msgspec.json.decode(data, type=kind)
    except msgspec.DecodeError as error:
        raise BadRequest(400, f"not understood: {error}") from None
