"""Questions and orders over HTTP, answered in JSON. Who may was decided before (:mod:`skyloop.cockpit.security`)."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from functools import wraps
from typing import TYPE_CHECKING, Annotated, Any, Final, TypeVar

import msgspec
from starlette.requests import ClientDisconnect, Request
from starlette.responses import HTMLResponse, Response
from starlette.routing import Route

from skyloop.cockpit.access import SESSION_S, Gate, TokenGate
from skyloop.cockpit.security import person_of
from skyloop.cockpit.telemetry import encode_json
from skyloop.cockpit.values import number
from skyloop.errors import MissingExtraError, RefusedError, SkyloopError, UnknownNameError, UnsupportedError, UsageError
from skyloop.messages import Parameter, Value

if TYPE_CHECKING:
    from skyloop.cockpit.fleet import Fleet
    from skyloop.cockpit.recordings import Recordings
    from skyloop.cockpit.station import Station
    from skyloop.cockpit.stream import PageCounts

LARGEST_BODY: Final = 65_536  #: bytes
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
    """A request that makes no sense; ``status`` says how."""

    def __init__(self, status: int, why: str) -> None:
        super().__init__(why)
        self.status = status


def answered(handler: Handler) -> Handler:
    """What a handler raises becomes an answer with a status and ``{"error": why}``."""

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
    """The routes below ``/api``."""

    def __init__(self, fleet: Fleet, recordings: Recordings, gate: Gate, counts: PageCounts, scheme: str) -> None:
        self._fleet = fleet
        self._recordings = recordings
        self._gate = gate
        self._counts = counts
        self._scheme = scheme

    def routes(self) -> list[Route]:
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
        """The role of who asks; null for nobody known, with what to do about it."""
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
        gate = self._gate
        if not isinstance(gate, TokenGate):
            raise BadRequest(404, "this cockpit asks for no token")
        person = gate.known((await _body(request, _Login)).token)
        if person is None:
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
        answer = _json({"role": None})
        if isinstance(self._gate, TokenGate):
            self._gate.end(request.scope)
            answer.delete_cookie(self._gate.cookie, httponly=True, samesite="strict")
        return answer

    # Drones ----------------------------------------------------------------------------------------------------

    async def drones(self, _: Request) -> Response:
        return _json(
            [
                {"name": name, "uri": one.drone.uri, "cameras": [c.name for c in one.drone.capabilities.cameras]}
                for name, one in self._fleet.stations.items()
            ]
        )

    @answered
    async def parameters(self, request: Request) -> Response:
        station = self._station(request.path_params["name"])
        found = await asyncio.to_thread(station.drone.config.parameters)
        return _json([parameter_values(parameter) for parameter in found])

    async def statistics(self, _: Request) -> Response:
        """What pages were sent: see :class:`skyloop.cockpit.stream.PageCounts`; encoded: by the cameras there now."""
        counts = self._counts
        feeds = [feed for station in self._fleet.stations.values() for feed in station.cameras.values()]
        return _json(
            {
                "pages": counts.pages,
                "frames_sent": counts.frames_sent,
                "frames_acknowledged": counts.frames_acknowledged,
                "frames_skipped": counts.frames_skipped,
                "frames_encoded": sum(feed.encoded for feed in feeds),
                "sources": sorted(counts.sources),
            }
        )

    # Recordings ------------------------------------------------------------------------------------------------

    @answered
    async def recordings(self, _: Request) -> Response:
        return _json(await self._recordings.listing())

    @answered
    async def record(self, request: Request) -> Response:
        wanted = await _body(request, _Wanted)
        for name in wanted.drones:
            self._station(name)
        return _json(await self._recordings.start(wanted.drones), 201)

    @answered
    async def stop(self, request: Request) -> Response:
        _check_json(request)
        return _json(await self._recordings.stop(request.path_params["number"]))

    @answered
    async def report(self, request: Request) -> Response:
        page = await self._recordings.report(request.path_params["name"], request.query_params.get("drone"))
        return HTMLResponse(page, headers={"content-security-policy": _REPORT_POLICY})

    @answered
    async def replay(self, request: Request) -> Response:
        _check_json(request)
        name = await self._recordings.replay(request.path_params["name"])
        self._fleet.want(name)
        await self._fleet.look()
        return _json({"drone": name}, 201)

    @answered
    async def end_replay(self, request: Request) -> Response:
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
    """A parameter with all that is needed to edit it."""
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
    """As it is; numbers that are not finite become null by the encoder."""
    return list(value) if isinstance(value, tuple) else value


def _json(values: Any, status: int = 200) -> Response:
    return Response(encode_json(values), status, media_type=_JSON)


def _check_json(request: Request) -> None:
    """A page from elsewhere can't send this kind without asking first, which is refused."""
    if request.headers.get("content-type", "").partition(";")[0].strip().lower() != _JSON:
        raise BadRequest(415, f"the content type must be {_JSON}")


async def _body(request: Request, kind: type[T]) -> T:
    _check_json(request)
    data = b""
    async for part in request.stream():
        data += part
        if len(data) > LARGEST_BODY:
            raise BadRequest(413, f"at most {LARGEST_BODY} bytes are taken")
    try:
        return msgspec.json.decode(data, type=kind)
    except msgspec.DecodeError as error:
        raise BadRequest(400, f"not understood: {error}") from None
