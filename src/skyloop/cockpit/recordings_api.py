"""Requests about recordings and replays. Observers may read, watch and download; pilots may also change things."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import msgspec
from starlette.requests import Request
from starlette.responses import FileResponse, HTMLResponse, Response
from starlette.routing import Route

from skyloop.cockpit import recording_files
from skyloop.cockpit.api import answer_json, answered, body_of, check_json, while_wanted
from skyloop.cockpit.recordings import MARK, Recordings
from skyloop.errors import UsageError

if TYPE_CHECKING:
    from skyloop.cockpit.fleet import CockpitFleet
    from skyloop.cockpit.recording_files import Notes

#: A report is a complete page with an inline script; it runs without this page's permissions.
_REPORT_POLICY: Final = (
    "sandbox allow-scripts; default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
    "img-src data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
#: A replay's parameters, as listed in ``docs/replay.md``. The driver itself is imported only where a replay runs.
PAUSED, POSITION, SPEED = "replay.paused", "replay.position_s", "replay.speed"
_MOST_CHARACTERS: Final = 16_384  #: maximum length of a text in a request; lower limits are checked at the point of use
_Text = Annotated[str, msgspec.Meta(max_length=_MOST_CHARACTERS)]


class _Wanted(msgspec.Struct):
    drones: Annotated[list[str], msgspec.Meta(max_length=64)]


class _Name(msgspec.Struct):
    name: _Text


class _Words(msgspec.Struct):
    text: _Text


class _Replay(msgspec.Struct):
    drone: _Text | None = None


class _Playback(msgspec.Struct):
    position_s: float | None = None
    speed: float | None = None
    paused: bool | None = None


class RecordingsApi:
    """The routes below ``/api/recordings`` and ``/api/replays``."""

    def __init__(self, fleet: CockpitFleet, recordings: Recordings) -> None:
        self._fleet = fleet
        self._recordings = recordings

    def routes(self) -> list[Route]:
        one = "/api/recordings/{name}"
        return [
            Route("/api/recordings", self.recordings, methods=["GET"]),
            Route("/api/recordings", self.record, methods=["POST"]),
            Route("/api/recordings/{number}/stop", self.stop, methods=["POST"]),
            Route("/api/recordings/{number}/mark", self.mark, methods=["POST"]),
            Route(f"{one}/file", self.file),
            Route(f"{one}/report", self.report),
            Route(f"{one}/notes", self.notes, methods=["GET"]),
            Route(f"{one}/notes", self.write_note, methods=["POST"]),
            Route(f"{one}/marks", self.add_mark, methods=["POST"]),
            Route(f"{one}/marks/remove", self.remove_mark, methods=["POST"]),
            Route(f"{one}/rename", self.rename, methods=["POST"]),
            Route(f"{one}/delete", self.delete, methods=["POST"]),
            Route(f"{one}/replay", self.replay, methods=["POST"]),
            Route("/api/trash/{name}/restore", self.restore, methods=["POST"]),
            Route("/api/trash/empty", self.empty_trash, methods=["POST"]),
            Route("/api/replays/{name}", self.replayed, methods=["GET"]),
            Route("/api/replays/{name}", self.play, methods=["POST"]),
            Route("/api/replays/{name}/stop", self.end_replay, methods=["POST"]),
        ]

    # Recording -------------------------------------------------------------------------------------------------

    @answered
    async def recordings(self, _: Request) -> Response:
        return answer_json(await self._recordings.listing())

    @answered
    async def record(self, request: Request) -> Response:
        wanted = await body_of(request, _Wanted)
        for name in wanted.drones:
            self._fleet.station(name)
        return answer_json(await self._recordings.start(wanted.drones), 201)

    @answered
    async def stop(self, request: Request) -> Response:
        check_json(request)
        return answer_json(await self._recordings.stop(request.path_params["number"]))

    @answered
    async def mark(self, request: Request) -> Response:
        """Add a mark to a running recording, as a log entry for each of its drones."""
        text = (await body_of(request, _Words)).text
        drones = self._recordings.mark(request.path_params["number"], text)
        for name in drones:
            if name in self._fleet.stations:
                self._fleet.stations[name].drone.log.text(text.strip() or MARK, name=MARK)
        return answer_json({"drones": drones})

    # Files -----------------------------------------------------------------------------------------------------

    @answered
    async def file(self, request: Request) -> Response:
        """Respond with a recording's file, or with the requested range of that file."""
        path = await self._recordings.path(request.path_params["name"])
        return FileResponse(path, filename=path.name, media_type="application/octet-stream")

    @answered
    async def report(self, request: Request) -> Response:
        """Respond with the report on a recording, as an HTML page."""
        path = await self._recordings.path(request.path_params["name"])
        page = await while_wanted(request, self._recordings.reports.make(path, request.query_params.get("drone")))
        return HTMLResponse(page, headers={"content-security-policy": _REPORT_POLICY})

    @answered
    async def notes(self, request: Request) -> Response:
        path = await self._recordings.path(request.path_params["name"])
        return answer_json(await asyncio.to_thread(recording_files.read_notes, path))

    @answered
    async def write_note(self, request: Request) -> Response:
        text = (await body_of(request, _Words)).text
        return await self._annotate(request, lambda path: recording_files.write_text(path, text))

    @answered
    async def add_mark(self, request: Request) -> Response:
        mark = await body_of(request, recording_files.Mark)
        return await self._annotate(request, lambda path: recording_files.add_mark(path, mark.at_s, mark.text), 201)

    @answered
    async def remove_mark(self, request: Request) -> Response:
        mark = await body_of(request, recording_files.Mark)
        return await self._annotate(request, lambda path: recording_files.remove_mark(path, mark))

    @answered
    async def rename(self, request: Request) -> Response:
        new = (await body_of(request, _Name)).name
        recording_files.check_name(new)
        return await self._move(request, lambda path: recording_files.rename(path, new))

    @answered
    async def delete(self, request: Request) -> Response:
        """Move a recording to the trash."""
        check_json(request)
        return await self._move(request, recording_files.throw_away)

    @answered
    async def restore(self, request: Request) -> Response:
        """Restore a recording from the trash."""
        check_json(request)
        name = request.path_params["name"]
        back = await self._recordings.in_trash(lambda folder: recording_files.bring_back(folder, name))
        return answer_json({"name": back})

    @answered
    async def empty_trash(self, request: Request) -> Response:
        check_json(request)
        await self._recordings.in_trash(recording_files.empty_trash)
        return answer_json({})

    # Replays ---------------------------------------------------------------------------------------------------

    @answered
    async def replay(self, request: Request) -> Response:
        wanted = await body_of(request, _Replay)
        name = await self._recordings.replay(request.path_params["name"], wanted.drone)
        self._fleet.finder.add_name(name)
        await self._fleet.search()
        return answer_json({"drone": name}, 201)

    @answered
    async def replayed(self, request: Request) -> Response:
        """Respond with the timeline and notes of a replay's recording."""
        return answer_json(await while_wanted(request, self._recordings.replayed(request.path_params["name"])))

    @answered
    async def play(self, request: Request) -> Response:
        """Pause or resume a replay, or change its position or speed; answer once the replay has accepted the change."""
        wanted = await body_of(request, _Playback)
        name = request.path_params["name"]
        station = self._fleet.station(name)
        if not station.drone.uri.startswith("replay:"):
            raise UsageError(f"{name} is not a replay: only replays can be paused or repositioned")
        values: dict[str, Any] = {SPEED: wanted.speed, POSITION: wanted.position_s}
        # Pause before changing the position and resume after it; otherwise it continues from the old position.
        values = {PAUSED: True, **values} if wanted.paused else {**values, PAUSED: wanted.paused}
        pilot = await station.stopper()  # a connection for a pilot, used here without authority
        for parameter, value in values.items():
            if value is not None:
                await asyncio.to_thread(pilot.config.__setitem__, parameter, value)
        return answer_json({"drone": name})

    @answered
    async def end_replay(self, request: Request) -> Response:
        check_json(request)
        name = request.path_params["name"]
        await self._recordings.end_replay(name)
        self._fleet.let_go(name, ending=True)
        return answer_json({"drone": name})

    async def _annotate(self, request: Request, write: Callable[[Path], Notes], status: int = 200) -> Response:
        return answer_json(await self._recordings.annotate(request.path_params["name"], write), status)

    async def _move(self, request: Request, change: Callable[[Path], str]) -> Response:
        return answer_json({"name": await self._recordings.move(request.path_params["name"], change)})
