"""HTTP requests answered in JSON, either completely or not at all; :mod:`.security` decides who may send them."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Coroutine
from dataclasses import asdict
from functools import wraps
from typing import TYPE_CHECKING, Annotated, Any, Final, TypeVar

import msgspec
from starlette.requests import ClientDisconnect, Request
from starlette.responses import Response
from starlette.routing import Route

from skyloop.cockpit.access import MAX_TOKEN, SESSION_S, Gate, TokenGate
from skyloop.cockpit.security import gone_within, person_of
from skyloop.cockpit.telemetry import encode_json, number
from skyloop.control.route import check_for, parse_route
from skyloop.errors import (
    ClosedError,
    MissingExtraError,
    RefusedError,
    SkyloopError,
    UnknownNameError,
    UnsupportedError,
    UsageError,
)
from skyloop.messages import Parameter, Value

if TYPE_CHECKING:
    from skyloop.cockpit.fleet import CockpitFleet
    from skyloop.cockpit.listening import Admission
    from skyloop.cockpit.routes import RouteFiles
    from skyloop.cockpit.stream import PageCounts

LARGEST_BODY: Final = 65_536  #: maximum size of a request's body [bytes]
BODY_S: Final = 10.0  #: time limit for receiving a request's body
_JSON: Final = "application/json"

_STATUS: Final = (
    (UnknownNameError, 404),
    (ClosedError, 404),  # the replay has just ended
    (UsageError, 400),
    (RefusedError, 409),
    (UnsupportedError, 409),
    (MissingExtraError, 501),
)

T = TypeVar("T")
Handler = Callable[[Any, Request], Awaitable[Response]]
MAX_ASKING: Final = 4  #: maximum number of parallel requests for parameters; each may block its thread for seconds
MOST_CHECKS: Final = 4  #: maximum number of parallel route checks; each may block its thread for seconds


class BadRequest(Exception):  # noqa: N818  (HTTP's name for it)
    """An invalid request; ``status`` is the HTTP status of the response."""

    def __init__(self, status: int, why: str) -> None:
        super().__init__(why)
        self.status = status


def answered(handler: Handler) -> Handler:
    """Convert a handler's exceptions into a response with a status and ``{"error": why}``."""

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
    """Do work for a request, but cancel the work if the client disconnects."""
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
    return Response(encode_json(values), status, media_type=_JSON)


def check_json(request: Request) -> None:
    """Check the content type; browsers let other sites send this type only with the server's permission."""
    if request.headers.get("content-type", "").partition(";")[0].strip().lower() != _JSON:
        raise BadRequest(415, f"the content type must be {_JSON}")


async def body_of(request: Request, kind: type[T]) -> T:
    """Read and decode a body; raise ``BadRequest`` if it is not JSON, too large, too late, or of the wrong type."""
    check_json(request)
    data = b""
    try:
        async with asyncio.timeout(BODY_S):
            async for part in request.stream():
                data += part
                if len(data) > LARGEST_BODY:
                    raise BadRequest(413, f"at most {LARGEST_BODY} bytes are accepted")
    except TimeoutError:
        raise BadRequest(408, f"the request was incomplete after {BODY_S:g} s") from None
    try:
        return msgspec.json.decode(data, type=kind)
    except msgspec.DecodeError as error:
        raise BadRequest(400, f"not understood: {error}") from None


class _Login(msgspec.Struct):
    token: Annotated[str, msgspec.Meta(max_length=MAX_TOKEN)]


class Api:
    """The routes below ``/api``.

    ``authority``: PEM certificate of the authority that signed the server's; None if the cockpit created none.
    """

    def __init__(
        self,
        fleet: CockpitFleet,
        gate: Gate,
        counts: PageCounts,
        scheme: str,
        admission: Admission,
        authority: bytes | None = None,
    ) -> None:
        self._authority = authority
        self._admission = admission
        self._asking = asyncio.Semaphore(MAX_ASKING)
        self._fleet = fleet
        self._gate = gate
        self._counts = counts
        self._scheme = scheme

    def routes(self) -> list[Route]:
        return [
            Route("/api/session", self.session),
            Route("/api/login", self.login, methods=["POST"]),
            Route("/api/logout", self.logout, methods=["POST"]),
            Route("/api/authority", self.authority),
            Route("/api/drones", self.drones),
            Route("/api/drones/{name}/parameters", self.parameters),
            Route("/api/statistics", self.statistics),
        ]

    # Sessions --------------------------------------------------------------------------------------------------

    async def session(self, request: Request) -> Response:
        """Respond with the client's role and name or, for strangers, with a null role and a hint on how to log in."""
        person = person_of(request.scope)
        return answer_json(
            {
                "role": None if person is None else person.role,
                "name": "" if person is None else person.name,
                "login": self._gate.takes_tokens,
                "hint": self._gate.hint if person is None else "",
            }
        )

    @answered
    async def login(self, request: Request) -> Response:
        """Exchange a token for a session cookie; delay the response if the token is wrong."""
        gate = self._gate
        if not isinstance(gate, TokenGate):
            raise BadRequest(404, "this cockpit uses no tokens")
        token = (await body_of(request, _Login)).token
        person = gate.logged_in(token, request.scope)
        if person is None:
            await gone_within(request.receive, gate.wrong_token_s(request.scope))
            raise BadRequest(
                401,
                "this token is unknown here"
                if gate.pairing is None
                else "this code was already used or has expired: use the newest one",
            )
        answer = answer_json({"role": person.role, "name": person.name})
        answer.set_cookie(
            gate.cookie,
            gate.begin(person, token),
            max_age=int(SESSION_S),
            httponly=True,
            samesite="strict",
            secure=self._scheme == "https",
        )
        return answer

    @answered
    async def logout(self, request: Request) -> Response:
        answer = answer_json({"role": None})
        if isinstance(self._gate, TokenGate):
            self._gate.end(request.scope)
            answer.delete_cookie(self._gate.cookie, httponly=True, samesite="strict")
        return answer

    @answered
    async def authority(self, _: Request) -> Response:
        """Respond with the certificate that browsers should trust, as a file."""
        if self._authority is None:
            raise BadRequest(404, "this cockpit made no certificate: start it with --https")
        answer = Response(self._authority, media_type="application/x-x509-ca-cert")
        answer.headers["content-disposition"] = 'attachment; filename="skyloop-pages.crt"'
        return answer

    # Drones ----------------------------------------------------------------------------------------------------

    async def drones(self, _: Request) -> Response:
        return answer_json(
            [
                {"name": name, "uri": one.drone.uri, "cameras": [c.name for c in one.drone.capabilities.cameras]}
                for name, one in self._fleet.stations.items()
            ]
        )

    @answered
    async def parameters(self, request: Request) -> Response:
        station = self._fleet.station(request.path_params["name"])
        async with self._asking:
            found = await asyncio.to_thread(station.drone.config.parameters)
        return answer_json([parameter_values(parameter) for parameter in found])

    async def statistics(self, _: Request) -> Response:
        """Respond with the server's :class:`.PageCounts`; ``frames_encoded`` covers only the current cameras."""
        feeds = [feed for station in self._fleet.stations.values() for feed in station.feeds]
        return answer_json(
            {
                **asdict(self._counts),
                "sources": sorted(self._counts.sources),
                "frames_encoded": sum(feed.encoded for feed in feeds),
                "left_out": {
                    "drawings": sum(station.event_feed.drawings.refused for station in self._fleet.stations.values()),
                    "series": sum(station.log_feed.refused for station in self._fleet.stations.values()),
                },
                "connections": {
                    "known": self._admission.known,
                    "anonymous": self._admission.anonymous,
                    **asdict(self._admission.counts),
                },
                "wrong_tokens": self._gate.wrong.count if isinstance(self._gate, TokenGate) else 0,
            }
        )


def parameter_values(parameter: Parameter) -> dict[str, Any]:
    """Return a parameter as JSON values, with everything needed to edit it."""
    return {
        "name": parameter.name,
        "type": str(parameter.type),
        "value": _value(parameter.value),
        "unit": parameter.unit,
        "minimum": number(parameter.minimum),
        "maximum": number(parameter.maximum),
        "default": None if parameter.default is None else _value(parameter.default),
        "choices": [_value(choice) for choice in parameter.choices],
        "read_only": parameter.read_only,
        "momentary": parameter.momentary,
        "description": parameter.description,
    }


def _value(value: Value) -> Any:
    """Return a value as JSON; the encoder converts numbers that are not finite to null."""
    return list(value) if isinstance(value, tuple) else value


class RoutesApi:
    """The routes below ``/api/routes``, including the check of a flight route for one drone."""

    def __init__(self, fleet: CockpitFleet, files: RouteFiles) -> None:
        self._fleet = fleet
        self._files = files
        self._checking = asyncio.Semaphore(MOST_CHECKS)

    def routes(self) -> list[Route]:
        return [
            Route("/api/drones/{name}/route/check", self.check, methods=["POST"]),
            Route("/api/routes", self.listing),
            Route("/api/routes/{name}", self.load, methods=["GET"]),
            Route("/api/routes/{name}", self.save, methods=["POST"]),
            Route("/api/routes/{name}/delete", self.delete, methods=["POST"]),
        ]

    @answered
    async def check(self, request: Request) -> Response:
        """Respond with any problems that a drone's route has, and the ``id`` used to fly that route."""
        station = self._fleet.station(request.path_params["name"])
        route = parse_route(bytes(await body_of(request, msgspec.Raw)))
        async with self._checking:
            check = await asyncio.to_thread(check_for, station.drone, route, wait_s=0.0)
        return answer_json(station.routes.add(route, check))

    @answered
    async def listing(self, _: Request) -> Response:
        return answer_json(await asyncio.to_thread(self._files.listing))

    @answered
    async def load(self, request: Request) -> Response:
        route = await asyncio.to_thread(self._files.load, request.path_params["name"])
        return Response(route.to_json(), media_type=_JSON)

    @answered
    async def save(self, request: Request) -> Response:
        name, route = request.path_params["name"], parse_route(bytes(await body_of(request, msgspec.Raw)))
        await asyncio.to_thread(self._files.save, name, route)
        return answer_json({"name": name}, 201)

    @answered
    async def delete(self, request: Request) -> Response:
        check_json(request)
        name = request.path_params["name"]
        await asyncio.to_thread(self._files.delete, name)
        return answer_json({"name": name})
