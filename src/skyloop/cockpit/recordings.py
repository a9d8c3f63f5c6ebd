"""Recordings on the page: start, stop, list, replay and report on them.

Recorders, reports and replays each run in their own process, and nothing blocks the event loop. A recorder is a child
process that does not disturb the flight, as is a process that creates a report; a replay is a private proxy. All of
them end when this process ends for any reason. The number of each is limited, and they start one at a time.
"""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol, TypeVar
from urllib.parse import quote

import msgspec

from skyloop.cockpit import recording_files
from skyloop.cockpit.recording_files import Notes
from skyloop.cockpit.reports import Reports, timeline_command
from skyloop.errors import FileFormatError, NoAnswerError, RefusedError, UnknownNameError, UsageError
from skyloop.messages import Refusal
from skyloop.recording.reader import ENDING, Described, describe, shown_name

if TYPE_CHECKING:
    from skyloop.client import Drone
    from skyloop.recording import Status

REPLAY_S: Final = 60.0  #: for a replay's proxy to answer, which is slow on a busy computer, as the page explains


class Recorder(Protocol):
    """A recorder, such as :class:`skyloop.recording.Recorder`."""

    @property
    def status(self) -> Status: ...
    def close(self) -> None: ...


@dataclass(frozen=True, slots=True)
class Running:
    """A recording in progress."""

    drones: tuple[str, ...]
    recorder: Recorder


def start_recorder(drones: Sequence[str], folder: Path) -> Recorder:
    """Record proxies to a new file in a folder.

    Raises:
        SkyloopError: It can't start.
    """
    from skyloop.recording import record

    return record(drones, folder)


def start_replay(path: Path, drone: str | None = None) -> Drone:
    """Start a private proxy that plays a file, and connect to it.

    Args:
        path: The file.
        drone: The recorded drone to play; None for the first.

    Raises:
        SkyloopError: It can't start.
    """
    from skyloop.client import connect

    which = "" if drone is None else f"?drone={quote(drone)}"
    try:
        return connect(f"replay://{quote(str(path))}{which}", access="observe", name="cockpit", timeout_s=REPLAY_S)
    except NoAnswerError as error:
        raise NoAnswerError(
            f"the replay of {path.name} has not started within {REPLAY_S:g} s: this computer is too busy. "
            "End other replays and programs, and try again"
        ) from error


@dataclass(frozen=True, slots=True)
class Replay:
    """A running replay."""

    drone: Drone  #: the observer whose connection keeps the replay's proxy running
    path: Path
    recorded: str | None  #: the drone's name in the recording; None: the first one


def progress(status: Status) -> dict[str, Any]:
    """Return a recording's progress as JSON values."""
    return {
        "path": status.path,
        "state": str(status.state),
        "reason": status.reason,
        "seconds": round(status.seconds, 3),
        "bytes": status.bytes,
        "dropped": status.dropped,
        "missed": status.missed,
    }


Json = dict[str, Any]
T = TypeVar("T")

MAX_CHILDREN: Final = 8  #: maximum number of simultaneous recordings, and of replays; each is a process
MOST_LISTED: Final = 500
NOTE_SHOWN: Final = 200  #: number of characters of a note shown in the list


class Recordings:
    """The recordings in one folder. On the event loop.

    Args:
        folder: Created when needed.
        record: Starts a recorder; called on a thread.
        replay: Starts a replay; called on a thread.
    """

    def __init__(
        self,
        folder: Path,
        record: Callable[[Sequence[str], Path], Recorder] = start_recorder,
        replay: Callable[[Path, str | None], Drone] = start_replay,
    ) -> None:
        self.folder = folder
        self.replays: dict[str, Replay] = {}  #: keyed by the proxy's name
        self._record = record
        self._replay = replay
        self.reports = Reports()
        self._timelines = Reports(timeline_command, "time line")
        self._made: dict[tuple[Path, float, str | None], str] = {}  # timelines, newest last
        self._changing = asyncio.Lock()
        self._starting = asyncio.Lock()
        self._looking = asyncio.Lock()
        self._running: dict[str, Running] = {}
        self._numbers = itertools.count(1)
        self._known: dict[tuple[Path, int, int], Described] = {}  # descriptions of files, by path, size and time

    def drones(self) -> set[str]:
        """Return the names of the drones being recorded."""
        return {name for running in self._running.values() for name in running.drones}

    async def start(self, drones: Sequence[str]) -> Json:
        """Start recording.

        Args:
            drones: The names of the drones.

        Returns:
            The recording, as JSON values.

        Raises:
            UsageError: No drone was given, or the folder can't be created.
            RefusedError: :data:`MAX_CHILDREN` recordings are already running.
            SkyloopError: The recorder can't start.
        """
        if not drones:
            raise UsageError("no drone to record: name at least one")

        def start() -> Recorder:
            self._make_folder()
            return self._record(drones, self.folder)

        async with self._starting:
            _check_number("recordings run", "stop", len(self._running))
            recorder = await asyncio.to_thread(start)
            number = str(next(self._numbers))
            self._running[number] = Running(tuple(drones), recorder)
            return self._entry(number)

    async def stop(self, number: str) -> Json:
        """Stop a recording and wait until its file is closed.

        Returns:
            The recording, as JSON values.

        Raises:
            UnknownNameError: No such recording is running.
        """
        if number not in self._running:
            raise UnknownNameError("running recording", number, self._running)
        entry = self._entry(number)
        running = self._running.pop(number)
        await asyncio.to_thread(running.recorder.close)
        return {**entry, **progress(running.recorder.status)}

    async def listing(self) -> Json:
        """Return the running recordings and those in the folder, newest first."""
        running = [self._entry(number) for number in self._running]
        async with self._looking:  # simultaneous requests cost no more than one
            past = await asyncio.to_thread(self._past)
            trash = await asyncio.to_thread(recording_files.trash_of, self.folder)
        return {"folder": str(self.folder), "running": running, "past": past, "trash": trash}

    def mark(self, number: str, text: str) -> tuple[str, ...]:
        """Check a mark for a running recording and return the drones it applies to.

        Raises:
            UnknownNameError: No such recording is running.
            UsageError: The text is too long.
        """
        if number not in self._running:
            raise UnknownNameError("running recording", number, self._running)
        recording_files.check_mark(text)
        return self._running[number].drones

    # Files -----------------------------------------------------------------------------------------------------

    async def path(self, name: str) -> Path:
        """Return the path of a recording.

        Raises:
            UnknownNameError: The file does not exist, or is being recorded.
        """
        return await asyncio.to_thread(self._path, name)

    async def move(self, name: str, change: Callable[[Path], str]) -> str:
        """Rename or delete a recording that is neither being written nor replayed; return its new name.

        Raises:
            UnknownNameError: The file does not exist.
            RefusedError: The recording is in use, or ``change`` refuses.
        """
        async with self._starting, self._changing:
            for running in self._running.values():
                if name in (Path(file).name for file in running.recorder.status.files):
                    raise RefusedError(f"{name} is being recorded: stop the recording first", code=Refusal.BUSY)
            path = (await self.path(name)).absolute()
            for played, replay in self.replays.items():
                if replay.path == path:
                    raise RefusedError(f"{name} is being replayed as {played}: end the replay first", code=Refusal.BUSY)
            return await asyncio.to_thread(change, path)

    async def annotate(self, name: str, write: Callable[[Path], Notes]) -> Notes:
        """Change a recording's notes; raise :class:`UnknownNameError` if there is no such file."""
        async with self._changing:
            return await asyncio.to_thread(write, await self.path(name))

    async def in_trash(self, work: Callable[[Path], T]) -> T:
        """Restore something from the trash, or empty the trash."""
        async with self._changing:
            return await asyncio.to_thread(work, self.folder)

    # Replays ---------------------------------------------------------------------------------------------------

    async def replay(self, name: str, recorded: str | None = None) -> str:
        """Replay a recording.

        Args:
            name: The file's name in the folder.
            recorded: The recorded drone to play; None for the first.

        Returns:
            The name of the replay's proxy.

        Raises:
            UnknownNameError: The file does not exist.
            RefusedError: :data:`MAX_CHILDREN` replays are already running.
            SkyloopError: The replay can't start.
        """
        path = (await self.path(name)).absolute()
        async with self._starting:
            _check_number("replays run", "end", len(self.replays))
            drone = await asyncio.to_thread(self._replay, path, recorded)
            self.replays[drone.name] = Replay(drone, path, recorded)
            return drone.name

    async def replayed(self, name: str) -> Json:
        """Return the recording's data for the page's replay bar.

        Returns:
            The file's name, the result of :func:`skyloop.cockpit.reports.timeline`, and the notes, as JSON values.

        Raises:
            UnknownNameError: No such replay was started here.
            SkyloopError: Any error from :meth:`skyloop.cockpit.reports.Reports.make`.
        """
        if name not in self.replays:
            raise UnknownNameError("replay", name, self.replays)
        replay = self.replays[name]
        key = replay.path, replay.path.stat().st_mtime, replay.recorded
        if key not in self._made:
            made = await self._timelines.make(replay.path, replay.recorded)
            self._made = {**dict(list(self._made.items())[1 - MAX_CHILDREN :]), key: made}
        notes = await asyncio.to_thread(recording_files.read_notes, replay.path)
        return {"recording": shown_name(replay.path), "notes": notes, "timeline": msgspec.Raw(self._made[key].encode())}

    async def end_replay(self, name: str) -> None:
        """End a replay.

        Raises:
            UnknownNameError: No such replay is running.
        """
        if name not in self.replays:
            raise UnknownNameError("replay", name, self.replays)
        await asyncio.to_thread(self.replays.pop(name).drone.close)

    async def close(self) -> None:
        """Close all files and end all replays."""
        ends = [running.recorder.close for running in self._running.values()]
        ends += [replay.drone.close for replay in self.replays.values()]
        self._running, self.replays = {}, {}
        await asyncio.gather(*(asyncio.to_thread(end) for end in ends), return_exceptions=True)

    # Inside ----------------------------------------------------------------------------------------------------

    def _entry(self, number: str) -> Json:
        running = self._running[number]
        return {"id": number, "drones": list(running.drones), **progress(running.recorder.status)}

    def _path(self, name: str) -> Path:
        known = {shown_name(path): path for path in self._files()}
        if name not in known:
            raise UnknownNameError("recording", name, known)
        return known[name]

    def _files(self) -> list[Path]:
        """Return the recordings in the folder, except those being written here."""
        written = {
            Path(file).name for running in list(self._running.values()) for file in running.recorder.status.files
        }
        with suppress(FileNotFoundError, NotADirectoryError):
            return [path for path in self.folder.iterdir() if path.suffix == ENDING and path.name not in written]
        return []

    def _past(self) -> list[Json]:
        found = []
        for path in self._files():
            with suppress(OSError):  # deleted in the meantime
                status = path.stat()
                found.append((status.st_mtime_ns, path, status.st_size))
        newest = sorted(found, reverse=True)[:MOST_LISTED]
        keys = [(path, size, at_ns) for at_ns, path, size in newest]
        self._known = {key: self._known.get(key) or describe(key[0]) for key in keys}
        return [
            {"name": shown_name(path), "size": size, **msgspec.structs.asdict(entry), **_noted(path)}
            for (path, size, _), entry in self._known.items()
        ]

    def _make_folder(self) -> None:
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UsageError(f"the folder of recordings {self.folder} can't be created: {error.strerror}") from None


def _noted(path: Path) -> Json:
    """Return the beginning of a recording's notes, to show in its row."""
    try:
        notes = recording_files.read_notes(path)
    except FileFormatError as error:
        return {"note": str(error), "marks": 0}
    return {"note": notes.text[:NOTE_SHOWN], "marks": len(notes.marks)}


def _check_number(what: str, end: str, running: int) -> None:
    if running >= MAX_CHILDREN:
        raise RefusedError(f"{running} {what}, the maximum at one time: {end} one first", code=Refusal.BUSY)
