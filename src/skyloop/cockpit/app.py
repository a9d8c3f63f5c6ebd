"""The cockpit's routes: one page, JSON requests, and WebSockets for live data. ``docs/cockpit.md`` describes them.

======================================  ==================================================================
``/``, ``/static/…``                    the page
``/api/…``                              see :mod:`skyloop.cockpit.api` and :mod:`skyloop.cockpit.recordings_api`
``/ws/overview``                        to the page: all drones, twice a second
``/ws/control``                         from the page: commands to all drones; to the page: their outcome
``/ws/video``                           to the page: small frames of the cameras it asks for; back: ``show``, ``ack``, …
``/ws/drones/NAME/telemetry``           to the page: ``vehicle``, then ``state`` with new events, in JSON
``/ws/drones/NAME/video/CAMERA``        to the page: frames (binary) and drawings (JSON); back: ``{"ack": n}``
``/ws/drones/NAME/control``             from the page: commands; to the page: their outcome, the pilot
======================================  ==================================================================
"""

from __future__ import annotations

import asyncio
import gzip
import hashlib
import mimetypes
import os
import re
import stat
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from starlette.applications import Starlette
from starlette.datastructures import Headers
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response
from starlette.routing import Mount, Route, WebSocketRoute
from starlette.staticfiles import NotModifiedResponse, StaticFiles
from starlette.types import Scope
from starlette.websockets import WebSocket

from skyloop.cockpit.access import Gate
from skyloop.cockpit.api import Api, RoutesApi
from skyloop.cockpit.control_session import ControlSession
from skyloop.cockpit.fleet import CockpitFleet, FleetOverview, FleetSession
from skyloop.cockpit.follow_session import FollowerFactory
from skyloop.cockpit.listening import Admission
from skyloop.cockpit.recordings import Recordings
from skyloop.cockpit.recordings_api import RecordingsApi
from skyloop.cockpit.routes import RouteFiles
from skyloop.cockpit.security import NOT_ALLOWED, Guard, Names, person_of
from skyloop.cockpit.small_video import SmallVideoSender
from skyloop.cockpit.station import Station
from skyloop.cockpit.stream import UNKNOWN, BroadcastSender, PageCounts, TelemetrySender, VideoSender
from skyloop.cockpit.world import WorldApi
from skyloop.control.target_follower import TargetFollower
from skyloop.messages import Role
from skyloop.messages.parameter import WorldGeometry

SMALLEST_PACKED: Final = 1000  #: minimum size of a response worth compressing [bytes]
_KINDS: Final = mimetypes.MimeTypes()  # without what this computer says, which may be wrong on Windows
_PACKED: Final = re.compile(r"text/.*|application/(javascript|json)|image/svg\+xml")  # media types to compress
_NAMED_BY_HASH: Final = re.compile(r".+-[A-Z0-9]{8}\.\w+")  # esbuild's names of chunks (chunkNames in build.mjs)
_REFERENCE: Final = re.compile(r'"/static/([\w.-]+)"')
_FOR_GOOD: Final = "private, max-age=31536000, immutable"  # for a year: the address changes with the content


@dataclass(frozen=True, slots=True)
class _File:
    """A file's content; ``stamp`` is used to detect whether the file has changed since it was read."""

    stamp: tuple[int, int]
    kind: str
    hash: str
    plain: bytes
    packed: bytes | None  #: None if the file is sent uncompressed


class PageFiles(StaticFiles):
    """Serves the folder that contains the page; the folder need not exist."""

    def __init__(self, folder: Path) -> None:
        super().__init__(directory=folder, check_dir=False)
        self._index = folder / "index.html"
        self._files: dict[str, _File] = {}

    async def get_response(self, path: str, scope: Scope) -> Response:
        """Return a file, compressed if the browser accepts compression."""
        try:
            full, found = self.lookup_path(path)
        except (OSError, ValueError):
            full, found = "", None
        if scope["method"] not in ("GET", "HEAD") or found is None or not stat.S_ISREG(found.st_mode):
            return await super().get_response(path, scope)
        file = await self._read(full, found)
        version = scope["query_string"].decode("latin-1").partition("=")[2]
        for_good = version == file.hash or _NAMED_BY_HASH.fullmatch(path) is not None
        return self._answer(file, Headers(scope=scope), _FOR_GOOD if for_good else "no-cache")

    async def page(self) -> Response:
        """Return the page, in which references to files carry a hash of their content."""
        try:
            text = self._index.read_text("utf-8")
        except OSError:
            return PlainTextResponse(f"The page is not built: there is no {self._index}. Run make in the sources.", 503)
        hashes: dict[str, str] = {}
        for name in set(_REFERENCE.findall(text)):
            full, found = self.lookup_path(name)
            if found is not None and stat.S_ISREG(found.st_mode):
                hashes[name] = (await self._read(full, found)).hash

        def named(reference: re.Match[str]) -> str:
            name = reference[1]
            return f'"/static/{name}?v={hashes[name]}"' if name in hashes else reference[0]

        return Response(_REFERENCE.sub(named, text), media_type="text/html")

    def _answer(self, file: _File, headers: Headers, cache: str) -> Response:
        packs = file.packed is not None and "gzip" in headers.get("accept-encoding", "")
        answer = Response(file.packed if packs else file.plain, media_type=file.kind)
        answer.headers["cache-control"] = cache
        answer.headers["etag"] = f'"{file.hash}{"-gz" if packs else ""}"'
        answer.headers["vary"] = "Accept-Encoding"
        if packs:
            answer.headers["content-encoding"] = "gzip"
        return NotModifiedResponse(answer.headers) if self.is_not_modified(answer.headers, headers) else answer

    async def _read(self, full: str, found: os.stat_result) -> _File:
        stamp = (found.st_mtime_ns, found.st_size)
        file = self._files.get(full)
        if file is None or file.stamp != stamp:
            # Use a thread: compressing the 3-D view takes about 30 ms, and pilots' commands must not wait for it.
            file = self._files[full] = await asyncio.to_thread(_read, full, stamp)
        return file


def _read(full: str, stamp: tuple[int, int]) -> _File:
    plain = Path(full).read_bytes()
    kind = _KINDS.guess_type(full)[0] or "application/octet-stream"
    packs = len(plain) >= SMALLEST_PACKED and _PACKED.fullmatch(kind) is not None
    packed = gzip.compress(plain, 9, mtime=0) if packs else None
    return _File(stamp, kind, hashlib.sha256(plain).hexdigest()[:16], plain, packed)


STATIC = Path(__file__).with_name("static")
_THREADS: Final = 32  # number of threads for blocking work, such as waiting for proxies and recorders


class Cockpit:
    """Serves the page and the WebSockets. ``follower``: creates a follower for each target marked on a page."""

    def __init__(self, fleet: CockpitFleet, recordings: Recordings, static: Path, follower: FollowerFactory) -> None:
        self.counts = PageCounts()
        self.files = PageFiles(static)
        self._fleet = fleet
        self._recordings = recordings
        self._overview = FleetOverview(fleet, recordings)
        self._follower = follower

    @asynccontextmanager
    async def lifespan(self, _: Starlette) -> AsyncIterator[None]:
        asyncio.get_running_loop().set_default_executor(ThreadPoolExecutor(_THREADS, "cockpit"))
        await self._fleet.start()
        try:
            yield
        finally:
            self._overview.broadcast.close()
            await self._recordings.close()
            await self._fleet.close()

    async def page(self, _: Request) -> Response:
        return await self.files.page()

    async def overview(self, socket: WebSocket) -> None:
        await socket.accept()
        await BroadcastSender(socket, self._overview.broadcast).run()

    async def small_video(self, socket: WebSocket) -> None:
        await socket.accept()
        await SmallVideoSender(socket, self._fleet.stations, self.counts).run()

    async def all_drones(self, socket: WebSocket) -> None:
        """Accept a pilot's commands that apply to all drones."""
        await socket.accept()
        person = person_of(socket.scope)
        if person is None or not person.may(Role.PILOT):
            await socket.close(NOT_ALLOWED, "only a pilot may do this")
            return
        await FleetSession(socket, self._fleet, person.name).run()

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
        await VideoSender(socket, station, feed, self.counts).run()

    async def control(self, socket: WebSocket) -> None:
        """Accept a pilot's commands for one drone."""
        station = await self._accept(socket)
        if station is None:
            return
        person = person_of(socket.scope)
        if person is None or not person.may(Role.PILOT):
            await socket.close(NOT_ALLOWED, "only a pilot may do this")
            return
        photos = self._recordings.folder / "photos"
        name = person.display_name(socket.query_params.get("name", ""))
        await ControlSession(socket, station, name, photos=photos, follower=self._follower).run()

    async def _accept(self, socket: WebSocket) -> Station | None:
        """Return the station of the requested drone; if there is none, close the socket and return None."""
        station = self._fleet.stations.get(socket.path_params["name"])
        await socket.accept()
        if station is None:
            await socket.close(UNKNOWN, "no such drone")
        return station


def create_app(
    fleet: CockpitFleet,
    recordings: Recordings,
    names: Names,
    gate: Gate,
    *,
    static: Path = STATIC,
    admission: Admission | None = None,
    world: WorldGeometry | None = None,
    follower: FollowerFactory = TargetFollower,
    page_authority: bytes | None = None,
) -> Starlette:
    """Create the cockpit's application.

    Args:
        fleet: The drones.
        recordings: The recordings of the same drones.
        names: The only host names that the server answers to.
        gate: Decides who is admitted.
        static: The page's folder.
        admission: Counts the connections.
        world: The surroundings to show for drones that report none.
        follower: Creates a follower for each target marked on a page.
        page_authority: PEM certificate of the authority that signed the server's certificate, for browsers to trust.
    """
    cockpit = Cockpit(fleet, recordings, static, follower)
    api = Api(fleet, gate, cockpit.counts, names.scheme, admission or Admission(), page_authority)
    return Starlette(
        routes=[
            Route("/", cockpit.page),
            *api.routes(),
            *RecordingsApi(fleet, recordings).routes(),
            *WorldApi(fleet, recordings, world).routes(),
            *RoutesApi(fleet, RouteFiles(recordings.folder / "routes")).routes(),
            WebSocketRoute("/ws/overview", cockpit.overview),
            WebSocketRoute("/ws/video", cockpit.small_video),
            WebSocketRoute("/ws/control", cockpit.all_drones),
            WebSocketRoute("/ws/drones/{name}/telemetry", cockpit.telemetry),
            WebSocketRoute("/ws/drones/{name}/video/{camera}", cockpit.video),
            WebSocketRoute("/ws/drones/{name}/control", cockpit.control),
            Mount("/static", cockpit.files),
        ],
        middleware=[Middleware(Guard, names=names, gate=gate)],
        lifespan=cockpit.lifespan,
    )
