"""Requests about routes: observers read, pilots check, save and delete."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

import msgspec
from starlette.requests import Request
from starlette.responses import Response
from starlette.routing import Route

from skyloop.cockpit.answers import answer_json, answered, body_of, check_json
from skyloop.control.route import check_for, parse_route
from skyloop.errors import UnknownNameError

if TYPE_CHECKING:
    from skyloop.cockpit.fleet import Fleet
    from skyloop.cockpit.routes import RouteFiles

MOST_CHECKS: Final = 4  #: at one time: each asks a proxy, and may take its thread for seconds


class RoutesApi:
    """The routes below ``/api/routes``, and the check of one for a drone.

    Args:
        fleet: The drones.
        files: The routes that are kept.
    """

    def __init__(self, fleet: Fleet, files: RouteFiles) -> None:
        self._fleet = fleet
        self._files = files
        self._checking = asyncio.Semaphore(MOST_CHECKS)

    def routes(self) -> list[Route]:
        """Return the routes."""
        return [
            Route("/api/drones/{name}/route/check", self.check, methods=["POST"]),
            Route("/api/routes", self.listing),
            Route("/api/routes/{name}", self.load, methods=["GET"]),
            Route("/api/routes/{name}", self.save, methods=["POST"]),
            Route("/api/routes/{name}/delete", self.delete, methods=["POST"]),
        ]

    @answered
    async def check(self, request: Request) -> Response:
        """Answer with what speaks against a route for a drone, and the ``id`` by which it is flown."""
        name, stations = request.path_params["name"], self._fleet.stations
        if name not in stations:
            raise UnknownNameError("drone", name, stations)
        station = stations[name]
        route = parse_route(bytes(await body_of(request, msgspec.Raw)))
        async with self._checking:
            check = await asyncio.to_thread(check_for, station.drone, route, wait_s=0.0)
        return answer_json(station.routes.add(route, check))

    @answered
    async def listing(self, _: Request) -> Response:
        """Answer with the routes that are kept here."""
        return answer_json(await asyncio.to_thread(self._files.listing))

    @answered
    async def load(self, request: Request) -> Response:
        """Answer with a route, as its file is."""
        route = await asyncio.to_thread(self._files.load, request.path_params["name"])
        return Response(route.to_json(), media_type="application/json")

    @answered
    async def save(self, request: Request) -> Response:
        """Keep a route under a name."""
        name, route = request.path_params["name"], parse_route(bytes(await body_of(request, msgspec.Raw)))
        await asyncio.to_thread(self._files.save, name, route)
        return answer_json({"name": name}, 201)

    @answered
    async def delete(self, request: Request) -> Response:
        """Delete a route."""
        check_json(request)
        name = request.path_params["name"]
        await asyncio.to_thread(self._files.delete, name)
        return answer_json({"name": name})
