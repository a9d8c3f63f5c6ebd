"""The cockpit's routes. One page, a few questions answered in JSON, two WebSockets per drone and page.

======================================  ==================================================================
``/``, ``/static/…``                    the page
``/api/drones``                         names of the drones and of their cameras
``/api/statistics``                     what pages were sent: see :class:`skyloop.cockpit.stream.PageCounts`
``/ws/drones/NAME/telemetry``           to the page: ``vehicle`` once, then ``state`` with new events, as JSON
``/ws/drones/NAME/video/CAMERA``        to the page: frames (binary) and drawings (JSON); back: ``{"ack": n}``
======================================  ==================================================================
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import StaticFiles
from starlette.websockets import WebSocket

from skyloop.cockpit.feeds import CameraFeed, NewsFeed
from skyloop.cockpit.security import Guard
from skyloop.cockpit.stream import PageCounts, TelemetrySender, VideoSender
from skyloop.cockpit.telemetry import TelemetryView

if TYPE_CHECKING:
    from skyloop.client import Drone

STATIC = Path(__file__).with_name("static")
_UNKNOWN = 4404  # close code: no such drone or camera


class Station:
    """One drone with what all its pages share. Made and closed on the event loop."""

    def __init__(self, drone: Drone) -> None:
        self.drone = drone
        self.news = NewsFeed(drone)
        self.view = TelemetryView(drone)
        self.cameras = {info.name: CameraFeed(drone, info.name) for info in drone.capabilities.cameras}

    def close(self) -> None:
        self.news.close()
        for feed in self.cameras.values():
            feed.close()


class Cockpit:
    """Answers the requests."""

    def __init__(self, drones: Mapping[str, Drone]) -> None:
        self._drones = drones
        self._stations: dict[str, Station] = {}
        self.counts = PageCounts()

    @asynccontextmanager
    async def lifespan(self, _: Starlette) -> AsyncIterator[None]:
        self._stations = {name: Station(drone) for name, drone in self._drones.items()}
        try:
            yield
        finally:
            for station in self._stations.values():
                station.close()

    async def page(self, _: Request) -> FileResponse:
        return FileResponse(STATIC / "index.html")

    async def drones(self, _: Request) -> JSONResponse:
        return JSONResponse(
            [{"name": name, "uri": s.drone.uri, "cameras": list(s.cameras)} for name, s in self._stations.items()]
        )

    async def statistics(self, _: Request) -> JSONResponse:
        counts = self.counts
        return JSONResponse(
            {
                "pages": counts.pages,
                "frames_sent": counts.frames_sent,
                "frames_acknowledged": counts.frames_acknowledged,
                "frames_skipped": counts.frames_skipped,
                "sources": sorted(counts.sources),
            }
        )

    async def telemetry(self, socket: WebSocket) -> None:
        station = self._stations.get(socket.path_params["name"])
        await socket.accept()
        if station is None:
            await socket.close(_UNKNOWN, "no such drone")
            return
        self.counts.pages += 1
        try:
            await TelemetrySender(socket, station.view, station.news).run()
        finally:
            self.counts.pages -= 1

    async def video(self, socket: WebSocket) -> None:
        station = self._stations.get(socket.path_params["name"])
        feed = station.cameras.get(socket.path_params["camera"]) if station is not None else None
        await socket.accept()
        if station is None or feed is None:
            await socket.close(_UNKNOWN, "no such camera")
            return
        await VideoSender(socket, feed, station.news, self.counts).run()


def create_app(drones: Mapping[str, Drone], names: frozenset[str]) -> Starlette:
    """The cockpit over these drones (each connected as an observer), answering to these values of ``Host`` only."""
    cockpit = Cockpit(drones)
    return Starlette(
        routes=[
            Route("/", cockpit.page),
            Route("/api/drones", cockpit.drones),
            Route("/api/statistics", cockpit.statistics),
            WebSocketRoute("/ws/drones/{name}/telemetry", cockpit.telemetry),
            WebSocketRoute("/ws/drones/{name}/video/{camera}", cockpit.video),
            Mount("/static", StaticFiles(directory=STATIC)),
        ],
        middleware=[Middleware(Guard, names=names)],
        lifespan=cockpit.lifespan,
    )
