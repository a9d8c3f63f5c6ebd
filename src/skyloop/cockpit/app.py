"""The cockpit's routes: one page, questions and orders in JSON, WebSockets for what moves. ``docs/cockpit.md`` has all.

======================================  ==================================================================
``/``, ``/static/…``                    the page
``/api/…``                              see :mod:`skyloop.cockpit.api`
``/ws/overview``                        to the page: all drones, twice a second
``/ws/drones/NAME/telemetry``           to the page: ``vehicle``, then ``state`` with new events, as JSON
``/ws/drones/NAME/video/CAMERA``        to the page: frames (binary) and drawings (JSON); back: ``{"ack": n}``
``/ws/drones/NAME/control``             from the page: orders; to the page: what became of them, who has control
======================================  ==================================================================
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Final

from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket

from skyloop.cockpit.access import Gate
from skyloop.cockpit.api import Api
from skyloop.cockpit.control import ControlSession
from skyloop.cockpit.fleet import Fleet
from skyloop.cockpit.overview import Overview
from skyloop.cockpit.recordings import Recordings
from skyloop.cockpit.security import NOT_ALLOWED, Guard, Names, person_of
from skyloop.cockpit.station import Station
from skyloop.cockpit.stream import UNKNOWN, BeatSender, PageCounts, TelemetrySender, VideoSender
from skyloop.messages import Role

STATIC = Path(__file__).with_name("static")
_THREADS: Final = 32  # for what waits: proxies that answer late, recorders that end


class Cockpit:
    """Answers what is no question in JSON."""

    def __init__(self, fleet: Fleet, recordings: Recordings, static: Path) -> None:
        self.counts = PageCounts()
        self._page = static / "index.html"
        self._fleet = fleet
        self._recordings = recordings
        self._overview = Overview(fleet, recordings)

    @asynccontextmanager
    async def lifespan(self, _: Starlette) -> AsyncIterator[None]:
        asyncio.get_running_loop().set_default_executor(ThreadPoolExecutor(_THREADS, "cockpit"))
        await self._fleet.start()
        try:
            yield
        finally:
            self._overview.beat.end()
            await self._recordings.close()
            await self._fleet.close()

    async def page(self, _: Request) -> Response:
        if not self._page.is_file():
            return PlainTextResponse(f"The page is not built: there is no {self._page}. Run make in the sources.", 503)
        return FileResponse(self._page)

    async def overview(self, socket: WebSocket) -> None:
        await socket.accept()
        await BeatSender(socket, self._overview.beat).run()

    async def telemetry(self, socket: WebSocket) -> None:
        station = await self._accept(socket)
        if station is None:
            return
        self.counts.pages += 1
        try:
            await TelemetrySender(socket, station).run()
        finally:
            self.counts.pages -= 1

    async def video(self, socket: WebSocket) -> None:
        station = await self._accept(socket)
        if station is None:
            return
        feed = station.camera(socket.path_params["camera"])
        if feed is None:
            await socket.close(UNKNOWN, "no such camera")
            return
        await VideoSender(socket, feed, station.news, self.counts).run()

    async def control(self, socket: WebSocket) -> None:
        station = await self._accept(socket)
        if station is None:
            return
        person = person_of(socket.scope)
        if person is None or not person.may(Role.PILOT):
            await socket.close(NOT_ALLOWED, "this needs a pilot")
            return
        await ControlSession(socket, station, person.name).run()

    async def _accept(self, socket: WebSocket) -> Station | None:
        """The drone that is asked for; None, and told, if there is none of that name."""
        station = self._fleet.stations.get(socket.path_params["name"])
        await socket.accept()
        if station is None:
            await socket.close(UNKNOWN, "no such drone")
        return station


def create_app(fleet: Fleet, recordings: Recordings, names: Names, gate: Gate, *, static: Path = STATIC) -> Starlette:
    """The cockpit over these drones, answering to these names only, and to whom the gate lets in.

    ``static`` is the folder of the page.
    """
    cockpit = Cockpit(fleet, recordings, static)
    api = Api(fleet, recordings, gate, cockpit.counts, names.scheme)
    return Starlette(
        routes=[
            Route("/", cockpit.page),
            *api.routes(),
            WebSocketRoute("/ws/overview", cockpit.overview),
            WebSocketRoute("/ws/drones/{name}/telemetry", cockpit.telemetry),
            WebSocketRoute("/ws/drones/{name}/video/{camera}", cockpit.video),
            WebSocketRoute("/ws/drones/{name}/control", cockpit.control),
            Mount("/static", StaticFiles(directory=static, check_dir=False)),
        ],
        middleware=[Middleware(Guard, names=names, gate=gate)],
        lifespan=cockpit.lifespan,
    )
