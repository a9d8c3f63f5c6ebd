"""Requests about what is around a drone, and whether it is ready to fly: all of them only read."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, Final

from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from skyloop.client import Level, PreflightFinding
from skyloop.cockpit.answers import BadRequest, answer_json, answered
from skyloop.cockpit.world import way_values, world_values
from skyloop.errors import UnknownNameError

if TYPE_CHECKING:
    from skyloop.client import Drone
    from skyloop.cockpit.fleet import Fleet
    from skyloop.cockpit.recordings import Recordings
    from skyloop.messages.world import WorldGeometry

_OURS: Final = PreflightFinding("control", Level.OK, "a page of this cockpit has control")
MAX_ASKING: Final = 4  #: drones that are asked at one time; each may take its thread for seconds


class WorldApi:
    """The routes ``world``, ``way`` and ``preflight`` of each drone.

    Args:
        fleet: The drones.
        recordings: Where they are recorded to.
        given: What stands around drones that don't know it themselves.
    """

    def __init__(self, fleet: Fleet, recordings: Recordings, given: WorldGeometry | None) -> None:
        self._fleet = fleet
        self._recordings = recordings
        self._given = given
        self._asking = asyncio.Semaphore(MAX_ASKING)

    def routes(self) -> list[Route]:
        """Return the routes."""
        return [
            Route("/api/drones/{name}/world", self.world),
            Route("/api/drones/{name}/way", self.way),
            Route("/api/drones/{name}/preflight", self.preflight),
        ]

    @answered
    async def world(self, request: Request) -> Response:
        """Answer with what maps show around a drone."""
        return await self._ask(request, lambda drone: world_values(drone, self._given))

    @answered
    async def way(self, request: Request) -> Response:
        """Answer with what speaks against flying straight to a place, ``?to=X,Y,Z``."""
        place = _place(request.query_params.get("to", ""))
        return await self._ask(request, lambda drone: way_values(drone, place))

    @answered
    async def preflight(self, request: Request) -> Response:
        """Answer with the checklist before a flight."""
        folder = self._recordings.folder
        station = self._fleet.stations.get(request.path_params["name"])
        ours = station is not None and bool(station.view.overview()["me"])

        def check(drone: Drone) -> list[Any]:
            findings = drone.preflight(folder=folder)
            return [asdict(_OURS if ours and one.check == "control" else one) for one in findings]

        return await self._ask(request, check)

    async def _ask(self, request: Request, question: Callable[[Drone], Any]) -> Response:
        """Ask a drone on a thread, as its answer may take a while."""
        name, stations = request.path_params["name"], self._fleet.stations
        if name not in stations:
            raise UnknownNameError("drone", name, stations)
        async with self._asking:
            return answer_json(await asyncio.to_thread(question, stations[name].drone))


def _place(text: str) -> tuple[float, float, float]:
    try:
        x, y, z = map(float, text.split(","))
    except ValueError:
        x = y = z = math.nan
    if not all(map(math.isfinite, (x, y, z))):
        raise BadRequest(400, f"to must be three finite numbers in metres, as 1.5,0,1, not {text!r:.60}")
    return x, y, z
