"""Requests over HTTP, answered in JSON; :mod:`skyloop.cockpit.security` has decided before who may ask."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Coroutine
from dataclasses import asdict
from functools import wraps
from typing import TYPE_CHECKING, Annotated, Any, Final, TypeVar

import msgspec
from starlette.requests import ClientDisconnect, Request
from starlette.responses import HTMLResponse, Response
from starlette.routing import Route

from skyloop.cockpit.access import SESSION_S, Gate, TokenGate
from skyloop.cockpit.security import gone_within, person_of
from skyloop.cockpit.telemetry import encode_json
from skyloop.cockpit.values import number
from skyloop.errors import MissingExtraError, RefusedError, SkyloopError, UnknownNameError, UnsupportedError, UsageError
from skyloop.messages import Parameter, Value

if TYPE_CHECKING:
    from skyloop.cockpit.admission import Admission
    from skyloop.cockpit.fleet import Fleet
    from skyloop.cockpit.recordings import Recordings
    from skyloop.cockpit.station import Station
    from skyloop.cockpit.stream import PageCounts

LARGEST_BODY: Final = 65_536  #: bytes
MAX_ASKING: Final = 4  #: proxies that are asked for parameters at one time; each may take its thread for seconds
BODY_S: Final = 10.0  #: within which a request's body must have come
_JSON: Final = "application/json"

#: A report is a page of its own, with its script in it: it runs without this page's rights.
_REPORT_POLICY: Final = (
    "sandbox allow-scripts; default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
    "img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_STATUS: Final = (
    (UnknownNameError, 404),
    (UsageError, 400),
    (RefusedError, 409),
    (UnsupportedError, 409),
    (MissingExtraError, 501),
)

T = TypeVar("T")
Handler = Callable[[Any, Request], Awaitable[Response]]


class _Login(msgspec.Struct):
    token: Annotated[str, msgspec.Meta(max_length=256)]


class _Wanted(msgspec.Struct):
    drones: Annotated[list[str], msgspec.Meta(max_length=64)]


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
            return _json({"error": str(error)}, error.status)
        except SkyloopError as error:
            status = next((status for kind, status in _STATUS if isinstance(error, kind)), 502)
            return _json({"error": str(error)}, status)
        except ClientDisconnect:
            return Response(status_code=400)

    return answer


class Api:
    """The routes below ``/api``.

    Args:
        fleet: The drones.
        recordings: Of the same drones.
        gate: Who is let in.
        counts: What pages were sent.
        scheme: ``http`` or ``https``.
        admission: The connections.
    """

    def __init__(
        self,
        fleet: Fleet,
        recordings: Recordings,
        gate: Gate,
        counts: PageCounts,
        scheme: str,
        admission: Admission,
    ) -> None:
        self._admission = admission
        self._asking = asyncio.Semaphore(MAX_ASKING)
        self._fleet = fleet
        self._recordings = recordings
        self._gate = gate
        self._counts = counts
        self._scheme = scheme

    def routes(self) -> list[Route]:
        """Return the routes."""
        return [
            Route("/api/session", self.session),
            Route("/api/login", self.login, methods=["POST"]),
            Route("/api/logout", self.logout, methods=["POST"]),
            Route("/api/drones", self.drones),
            Route("/api/drones/{name}/parameters", self.parameters),
            Route("/api/statistics", self.statistics),
            Route("/api/recordings", self.recordings, methods=["GET"]),
            Route("/api/recordings", self.record, methods=["POST"]),
            Route("/api/recordings/{number}/stop", self.stop, methods=["POST"]),
            Route("/api/recordings/{name}/report", self.report),
            Route("/api/recordings/{name}/replay", self.replay, methods=["POST"]),
            Route("/api/replays/{name}/stop", self.end_replay, methods=["POST"]),
        ]

    # Who asks --------------------------------------------------------------------------------------------------

    async def session(self, request: Request) -> Response:
        """Answer with the role of who asks; null for nobody known, with what to do about it."""
        person = person_of(request.scope)
        return _json(
            {
                "role": None if person is None else person.role,
                "name": "" if person is None else person.name,
                "login": self._gate.takes_tokens,
                "hint": self._gate.hint if person is None else "",
            }
        )

    @answered
    async def login(self, request: Request) -> Response:
        """Exchange a token for a session's cookie; the answer to a wrong token waits."""
        gate = self._gate
        if not isinstance(gate, TokenGate):
            raise BadRequest(404, "this cockpit asks for no token")
        person = gate.known((await _body(request, _Login)).token)
        if person is None:
            await gone_within(request.receive, gate.wrong_token_s(request.scope))
            raise BadRequest(401, "this token is not known here")
        answer = _json({"role": person.role, "name": person.name})
        answer.set_cookie(
            gate.cookie,
            gate.begin(person),
            max_age=int(SESSION_S),
            httponly=True,
            samesite="strict",
            secure=self._scheme == "https",
        )
        return answer

    @answered
    async def logout(self, request: Request) -> Response:
        """End the session of the request's cookie."""
        answer = _json({"role": None})
        if isinstance(self._gate, TokenGate):
            self._gate.end(request.scope)
            answer.delete_cookie(self._gate.cookie, httponly=True, samesite="strict")
        return answer

    # Drones ----------------------------------------------------------------------------------------------------

    async def drones(self, _: Request) -> Response:
        """Answer with the drones that are connected."""
        return _json(
            [
                {"name": name, "uri": one.drone.uri, "cameras": [c.name for c in one.drone.capabilities.cameras]}
                for name, one in self._fleet.stations.items()
            ]
        )

    @answered
    async def parameters(self, request: Request) -> Response:
        """Answer with a drone's parameters."""
        station = self._station(request.path_params["name"])
        async with self._asking:
            found = await asyncio.to_thread(station.drone.config.parameters)
        return _json([parameter_values(parameter) for parameter in found])

    async def statistics(self, _: Request) -> Response:
        """Answer with what pages were sent.

        See :class:`skyloop.cockpit.stream.PageCounts`; ``frames_encoded`` counts the cameras that are there now.
        """
        counts = self._counts
        feeds = [feed for station in self._fleet.stations.values() for feed in station.feeds]
        return _json(
            {
                "pages": counts.pages,
                "frames_sent": counts.frames_sent,
                "frames_acknowledged": counts.frames_acknowledged,
                "frames_skipped": counts.frames_skipped,
                "frames_encoded": sum(feed.encoded for feed in feeds),
                "sources": sorted(counts.sources),
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

    # Recordings ------------------------------------------------------------------------------------------------

    @answered
    async def recordings(self, _: Request) -> Response:
        """Answer with the recordings, running and past."""
        return _json(await self._recordings.listing())

    @answered
    async def record(self, request: Request) -> Response:
        """Start a recording."""
        wanted = await _body(request, _Wanted)
        for name in wanted.drones:
            self._station(name)
        return _json(await self._recordings.start(wanted.drones), 201)

    @answered
    async def stop(self, request: Request) -> Response:
        """Stop a recording."""
        _check_json(request)
        return _json(await self._recordings.stop(request.path_params["number"]))

    @answered
    async def report(self, request: Request) -> Response:
        """Answer with the report on a recording, as a page."""
        report = self._recordings.report(request.path_params["name"], request.query_params.get("drone"))
        page = await while_wanted(request, report)
        return HTMLResponse(page, headers={"content-security-policy": _REPORT_POLICY})

    @answered
    async def replay(self, request: Request) -> Response:
        """Play a recording again."""
        _check_json(request)
        name = await self._recordings.replay(request.path_params["name"])
        self._fleet.want(name)
        await self._fleet.look()
        return _json({"drone": name}, 201)

    @answered
    async def end_replay(self, request: Request) -> Response:
        """End a replay."""
        _check_json(request)
        name = request.path_params["name"]
        await self._recordings.end_replay(name)
        self._fleet.let_go(name)
        return _json({"drone": name})

    def _station(self, name: str) -> Station:
        stations = self._fleet.stations
        if name not in stations:
            raise UnknownNameError("drone", name, stations)
        return stations[name]


def parameter_values(parameter: Parameter) -> dict[str, Any]:
    """Return a parameter as JSON values, with all that is needed to edit it."""
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
        "description": parameter.description,
    }


def _value(value: Value) -> Any:
    """Return a value for JSON; the encoder makes numbers that are not finite null."""
    return list(value) if isinstance(value, tuple) else value


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


def _json(values: Any, status: int = 200) -> Response:
    return Response(encode_json(values), status, media_type=_JSON)


def _check_json(request: Request) -> None:
    """Check the content type: another site's page can't send this one without asking first, which is refused."""
    if request.headers.get("content-type", "").partition(";")[0].strip().lower() != _JSON:
        raise BadRequest(415, f"the content type must be {_JSON}")


async def _body(request: Request, kind: type[T]) -> T:
    _check_json(request)
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
