"""Requests over HTTP, answered in JSON; :mod:`skyloop.cockpit.security` has decided before who may ask."""

from __future__ import annotations

import asyncio
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any, Final

import msgspec
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from skyloop.cockpit.access import SESSION_S, Gate, TokenGate
from skyloop.cockpit.answers import BadRequest, answer_json, answered, body_of
from skyloop.cockpit.security import gone_within, person_of
from skyloop.cockpit.values import number
from skyloop.errors import UnknownNameError
from skyloop.messages import Parameter, Value

if TYPE_CHECKING:
    from skyloop.cockpit.admission import Admission
    from skyloop.cockpit.fleet import Fleet
    from skyloop.cockpit.station import Station
    from skyloop.cockpit.stream import PageCounts

MAX_ASKING: Final = 4  #: proxies that are asked for parameters at one time; each may take its thread for seconds


class _Login(msgspec.Struct):
    token: Annotated[str, msgspec.Meta(max_length=256)]


class Api:
    """The routes below ``/api``.

    Args:
        fleet: The drones.
        gate: Who is let in.
        counts: What pages were sent.
        scheme: ``http`` or ``https``.
        admission: The connections.
        authority: Certificate of the authority that certified this server, PEM; None where it made none.
    """

    def __init__(
        self,
        fleet: Fleet,
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
        """Return the routes."""
        return [
            Route("/api/session", self.session),
            Route("/api/login", self.login, methods=["POST"]),
            Route("/api/logout", self.logout, methods=["POST"]),
            Route("/api/authority", self.authority),
            Route("/api/drones", self.drones),
            Route("/api/drones/{name}/parameters", self.parameters),
            Route("/api/statistics", self.statistics),
        ]

    # Who asks --------------------------------------------------------------------------------------------------

    async def session(self, request: Request) -> Response:
        """Answer with the role of who asks; null for nobody known, with what to do about it."""
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
        """Exchange a token for a session's cookie; the answer to a wrong token waits."""
        gate = self._gate
        if not isinstance(gate, TokenGate):
            raise BadRequest(404, "this cockpit asks for no token")
        token = (await body_of(request, _Login)).token
        person = gate.logged_in(token, request.scope)
        if person is None:
            await gone_within(request.receive, gate.wrong_token_s(request.scope))
            raise BadRequest(
                401,
                "this token is not known here"
                if gate.pairing is None
                else "this code was used, or is too old: take the newest one",
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
        """End the session of the request's cookie."""
        answer = answer_json({"role": None})
        if isinstance(self._gate, TokenGate):
            self._gate.end(request.scope)
            answer.delete_cookie(self._gate.cookie, httponly=True, samesite="strict")
        return answer

    @answered
    async def authority(self, _: Request) -> Response:
        """Answer with the certificate that browsers are to trust, as a file."""
        if self._authority is None:
            raise BadRequest(404, "this cockpit made no certificate: start it with --https")
        answer = Response(self._authority, media_type="application/x-x509-ca-cert")
        answer.headers["content-disposition"] = 'attachment; filename="skyloop-pages.crt"'
        return answer

    # Drones ----------------------------------------------------------------------------------------------------

    async def drones(self, _: Request) -> Response:
        """Answer with the drones that are connected."""
        return answer_json(
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
        return answer_json([parameter_values(parameter) for parameter in found])

    async def statistics(self, _: Request) -> Response:
        """Answer with what pages were sent.

        See :class:`skyloop.cockpit.stream.PageCounts`; ``frames_encoded`` counts the cameras that are there now.
        """
        counts = self._counts
        feeds = [feed for station in self._fleet.stations.values() for feed in station.feeds]
        return answer_json(
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
        "momentary": parameter.momentary,
        "description": parameter.description,
    }


def _value(value: Value) -> Any:
    """Return a value for JSON; the encoder makes numbers that are not finite null."""
    return list(value) if isinstance(value, tuple) else value
