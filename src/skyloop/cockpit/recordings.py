"""Recordings on the page: start, stop, list and replay them, and create reports on them.

Recorders, reports and replays each run in their own process, so they neither disturb flights nor block the event loop;
a replay's process is a private proxy. All of these processes end when this process ends for any reason. The number of
each is limited, and they are started one at a time.
"""

from __future__ import annotations

import asyncio
import itertools
import os
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol, TypeVar
from urllib.parse import quote

import msgspec

from skyloop.child_process import on_parent_end
from skyloop.clock import seconds
from skyloop.cockpit import recording_files
from skyloop.cockpit.recording_files import Notes
from skyloop.cockpit.telemetry import flat_values, truth_values, vector
from skyloop.errors import (
    FileFormatError,
    LinkError,
    NoAnswerError,
    RefusedError,
    SkyloopError,
    UnknownNameError,
    UsageError,
)
from skyloop.messages import Event, EventKind, Feedback, LogEntry, Refusal, Severity
from skyloop.platform import lower_priority
from skyloop.recording.layout import Channel
from skyloop.recording.listing import ENDING, Described, describe, shown_name
from skyloop.recording.plain import TimeCourse

if TYPE_CHECKING:
    from skyloop.client import Drone
    from skyloop.recording import Status
    from skyloop.recording.reader import Recording


REPLAY_S: Final = 60.0  #: time limit for the start of a replay's proxy, which is slow on a busy computer


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
    """Record proxies to a new file in a folder."""
    from skyloop.recording import record

    return record(drones, folder)


def start_replay(path: Path, drone: str | None = None) -> Drone:
    """Start a private proxy that plays a file, and connect to it. ``drone``: whose recording; None for the first."""
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
    drone: Drone  #: the observer whose connection keeps the replay's proxy running
    path: Path
    recorded: str | None  #: the drone's name in the recording; None for the first drone


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

MAX_CHILDREN: Final = 8  #: maximum number of simultaneous recordings, and of replays; each one is a process
MOST_LISTED: Final = 500  #: maximum number of recordings listed, newest first
NOTE_SHOWN: Final = 200  #: maximum number of characters of a note that the list shows


class Recordings:
    """The recordings in one folder. Used on the event loop.

    ``folder``: created when needed. ``record``: starts a recorder; called on a thread. ``replay``: starts a replay;
    called on a thread.
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
        self._timelines = Reports(partial(_child, TIMELINE), "time line")
        self._made: dict[tuple[Path, float, str | None], str] = {}  # timelines, from oldest to newest
        self._starting = asyncio.Lock()  # held while a recording or replay starts
        self._changing = asyncio.Lock()  # held while files change; acquired after ``_starting`` if both are needed
        self._listing = asyncio.Lock()
        self._running: dict[str, Running] = {}
        self._numbers = itertools.count(1)
        self._known: dict[tuple[Path, int, int], Described] = {}  # descriptions of files, by path, size and time

    def drones(self) -> set[str]:
        """Return the names of the drones being recorded."""
        return {name for running in self._running.values() for name in running.drones}

    async def start(self, drones: Sequence[str]) -> Json:
        """Start recording.

        Raise ``UsageError`` if no drone was given or the folder can't be created, and ``RefusedError`` if
        :data:`MAX_CHILDREN` recordings are already running.
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
        """Stop a recording and wait until its file is closed; raise ``UnknownNameError`` if it is not running."""
        if number not in self._running:
            raise UnknownNameError("running recording", number, self._running)
        entry = self._entry(number)
        running = self._running.pop(number)
        await asyncio.to_thread(running.recorder.close)
        return {**entry, **progress(running.recorder.status)}

    async def listing(self) -> Json:
        """Return the running recordings and those in the folder, newest first."""
        running = [self._entry(number) for number in self._running]
        async with self._listing:  # simultaneous requests occupy one thread, and reuse each other's descriptions
            past = await asyncio.to_thread(self._past)
            trash = await asyncio.to_thread(recording_files.trash_of, self.folder)
        return {"folder": str(self.folder), "running": running, "past": past, "trash": trash}

    def mark(self, number: str, text: str) -> tuple[str, ...]:
        """Check a mark for a running recording and return the drones to which it applies.

        Raise ``UnknownNameError`` if no such recording is running, and ``UsageError`` if the text is too long.
        """
        if number not in self._running:
            raise UnknownNameError("running recording", number, self._running)
        recording_files.check_mark(text)
        return self._running[number].drones

    # Files -----------------------------------------------------------------------------------------------------

    async def path(self, name: str) -> Path:
        """Return the path of a recording; raise ``UnknownNameError`` if it does not exist or is being recorded."""
        return await asyncio.to_thread(self._path, name)

    async def move(self, name: str, change: Callable[[Path], str]) -> str:
        """Rename or delete a recording that is neither being written nor replayed; return the recording's new name.

        Raise ``UnknownNameError`` if the file does not exist, and ``RefusedError`` if the recording is in use or
        ``change`` refuses.
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
            recorded: The recorded drone to play, or None to play the first drone.

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
        """Return what the page's replay bar needs, as JSON values: the file's name, its :func:`timeline` and its notes.

        Raise ``UnknownNameError`` if no such replay was started here.
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
        """End a replay. Raise ``UnknownNameError`` if no such replay is running."""
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
        """Return the recordings in the folder, except for those being written here."""
        written = {
            Path(file).name for running in list(self._running.values()) for file in running.recorder.status.files
        }
        with suppress(FileNotFoundError, NotADirectoryError):
            return [path for path in self.folder.iterdir() if path.suffix == ENDING and path.name not in written]
        return []

    def _past(self) -> list[Json]:
        found = []
        for path in self._files():
            with suppress(OSError):  # the file has just been deleted
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
    """Return the beginning of a recording's notes, which is shown in the recording's row."""
    try:
        notes = recording_files.read_notes(path)
    except FileFormatError as error:
        return {"note": str(error), "marks": 0}
    return {"note": notes.text[:NOTE_SHOWN], "marks": len(notes.marks)}


def _check_number(what: str, end: str, running: int) -> None:
    if running >= MAX_CHILDREN:
        raise RefusedError(f"{running} {what}, the maximum at one time: {end} one first", code=Refusal.BUSY)


# Reports and time lines ------------------------------------------------------------------------------------------


REPORT: Final = "report"
TIMELINE: Final = "timeline"
REPORT_S: Final = 120.0  #: time limit for creating one report
MAX_WAITING: Final = 4  #: maximum number of waiting requests; a longer queue would take minutes to process
NICENESS: Final = 10  #: niceness of the child: pages and flights have priority over reports
_TAKEN: Final = 4096  # number of bytes kept from a child's error output

#: Function that returns the command line for a report on a file, given the file, the target and optionally one drone.
Command = Callable[[Path, Path, str | None], Sequence[str]]


def child_command(file: Path, target: Path, drone: str | None) -> Sequence[str]:
    """Return the command line of the child process that creates a report."""
    return _child(REPORT, file, target, drone)


def _child(what: str, file: Path, target: Path, drone: str | None) -> Sequence[str]:
    """Return a command line that runs this module as a program."""
    return [
        sys.executable,
        "-m",
        "skyloop.cockpit.recordings",
        what,
        str(file),
        str(target),
        *([drone] if drone else []),
    ]


class Reports:
    """Creates reports and other products of recordings in child processes. Used on the event loop.

    A report keeps a CPU core busy for seconds, and any observer may request one. Requests therefore wait in a short
    queue and are refused when it is full. If a client disconnects, its request is removed from the queue or its child
    is ended. ``command``: returns the child's command line; by default :func:`child_command`. ``what``: name of the
    child's output in error messages.
    """

    def __init__(self, command: Command | None = None, what: str = "report") -> None:
        self._command = command or child_command
        self._what = what
        self._turn = asyncio.Lock()
        self._wanted = 0  # number of reports in progress or queued

    async def make(self, file: Path, drone: str | None = None) -> str:
        """Create a report; if this is cancelled, leave nothing behind.

        Args:
            file: The recording.
            drone: The recorded drone, or None if there is only one.

        Returns:
            The child's output, which is a page like that of ``skyloop log report``.

        Raises:
            RefusedError: The queue is full.
            UsageError: The child failed; the error contains its message.
            LinkError: Creating the report took longer than :data:`REPORT_S`.
        """
        if self._wanted > MAX_WAITING:
            raise RefusedError(
                f"a {self._what} is being made and {self._wanted - 1} are waiting, the maximum: try again later",
                code=Refusal.BUSY,
            )
        self._wanted += 1
        try:
            async with self._turn:
                return await self._made(file, drone)
        finally:
            self._wanted -= 1

    async def _made(self, file: Path, drone: str | None) -> str:
        with tempfile.TemporaryDirectory(prefix="skyloop-report-") as folder:
            target = Path(folder) / "report.html"
            child = await asyncio.create_subprocess_exec(
                *self._command(file.absolute(), target, drone),
                stdin=asyncio.subprocess.PIPE,  # closed when this process ends, which ends the child
                stdout=asyncio.subprocess.DEVNULL,
                stderr=asyncio.subprocess.PIPE,
            )
            assert child.stderr is not None
            try:
                async with asyncio.timeout(REPORT_S):
                    errors = await child.stderr.read(_TAKEN)
                    while await child.stderr.read(_TAKEN):
                        pass
                    await child.wait()
            except TimeoutError:
                raise LinkError(f"the {self._what} of {file.name} took longer than {REPORT_S:g} s") from None
            finally:
                if child.returncode is None:
                    child.kill()
                    await asyncio.shield(child.wait())
            if child.returncode or not target.exists():
                lines = errors.decode(errors="replace").strip().splitlines()
                raise UsageError(lines[-1] if lines else f"no {self._what} of {file.name} could be made")
            return await asyncio.to_thread(target.read_text, encoding="utf-8")


def run_child(arguments: Sequence[str]) -> int:
    """Write a report or timeline, unless standard input closes first, which means that the requester has exited.

    ``arguments``: ``report`` or ``timeline``, then FILE TARGET [DRONE], from the command line. Return the exit code: 0,
    or 2 after printing a line of explanation.
    """
    lower_priority(NICENESS)
    on_parent_end(partial(os._exit, 1))
    from skyloop.recording.reader import Recording

    what, file, target, *drone = arguments
    make = _report if what == REPORT else _write_timeline
    try:
        recording = Recording.open(Path(file))
        make(recording, recording.drone(drone[0] if drone else None).name, Path(target))
    except SkyloopError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


def _report(recording: Recording, drone: str, target: Path) -> None:
    from skyloop.recording.review.report import write_report

    write_report(recording, drone, target, pictures=8)


MARK: Final = "mark"  #: name under which marks are logged
MAX_EVENTS: Final = 300  #: if there are more events, the most severe are kept
MAX_MARKS: Final = 300  #: maximum number of marks; the first ones are kept
MAX_SAMPLES: Final = 1200  #: maximum number of samples; a long recording is sampled less often
PERIOD_S: Final = 0.1  #: minimum time between samples
MAX_TEXT: Final = 200  #: maximum length of a text [characters]
_SEVERITIES: Final = (Severity.ERROR, Severity.WARNING)
#: Events that are irrelevant to the flight.
_LEFT_OUT: Final = frozenset({EventKind.PARAMETER_CHANGED})


def timeline(recording: Recording, drone: str) -> dict[str, Any]:
    """Return a recording's events and course as JSON values, with positions like ``replay.position_s``."""
    course = TimeCourse()
    events: list[dict[str, Any]] = []
    marks: list[dict[str, Any]] = []
    times: list[float] = []
    track: list[Any] = []
    values: dict[str, list[float | None]] = {}
    period_s = max(PERIOD_S, recording.seconds / MAX_SAMPLES)
    channels = (Channel.FEEDBACK, Channel.FRAMES, Channel.EVENTS, Channel.COMMANDS, Channel.LOGS)
    for item in recording.items(drone, channels):
        if isinstance(item.value, LogEntry) and course.first_ns is None:
            continue  # a replay does not play logs, so it starts at the first other item
        at_s = round(seconds(course.follow(item.value, item.entry.log_ns) - (course.first_ns or 0)), 3)
        value = item.value
        if isinstance(value, Event) and value.kind not in _LEFT_OUT:
            text = value.text[:MAX_TEXT]
            events.append({"at_s": at_s, "kind": value.kind, "severity": value.severity, "text": text})
        elif isinstance(value, LogEntry) and value.name == MARK and value.text is not None:
            marks.append({"at_s": at_s, "text": value.text[:MAX_TEXT]})
        elif isinstance(value, Feedback) and (not times or at_s >= times[-1] + period_s):
            for name, one in flat_values(msgspec.structs.replace(value, native=None), {}, None).items():
                values.setdefault(name, [None] * len(times)).append(None if one is None else float(f"{one:.5g}"))
            times.append(at_s)
            for column in values.values():
                column += [None] * (len(times) - len(column))
            truth = truth_values(value.native)
            place = vector(value.position_m) or (truth and truth["position"])
            track.append(place)
    events.sort(key=lambda event: event["severity"] not in _SEVERITIES)
    shown = sorted(events[:MAX_EVENTS], key=lambda event: float(event["at_s"]))
    return {"events": shown, "marks": marks[:MAX_MARKS], "times": times, "track": track, "values": values}


def _write_timeline(recording: Recording, drone: str, target: Path) -> None:
    target.write_bytes(msgspec.json.encode(timeline(recording, drone)))


if __name__ == "__main__":
    sys.exit(run_child(sys.argv[1:]))
