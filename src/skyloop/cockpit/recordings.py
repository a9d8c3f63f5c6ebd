"""Recordings from the page: started, stopped, listed, reported on and played again.

Each is done by a process of its own, and nothing of it on the event loop: the recorder is a child that the flight does
not feel, a report is made by ``skyloop log report``, and what is played again is a private proxy.
"""

from __future__ import annotations

import asyncio
import itertools
import sys
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol
from urllib.parse import quote

from skyloop.clock import NS_PER_S
from skyloop.errors import LinkError, SkyloopError, UnknownNameError, UsageError

if TYPE_CHECKING:
    from skyloop.client import Drone
    from skyloop.recording import Status

Json = dict[str, Any]

REPORT_S: Final = 300.0
REPLAY_S: Final = 20.0
MOST_LISTED: Final = 500
_ENDING: Final = ".mcap"


class Recorder(Protocol):
    """What records; :class:`skyloop.recording.Recorder` is one."""

    @property
    def status(self) -> Status: ...
    def close(self) -> None: ...


@dataclass(frozen=True, slots=True)
class Running:
    """A recording that goes on."""

    drones: tuple[str, ...]
    recorder: Recorder


def start_recorder(drones: Sequence[str], folder: Path) -> Recorder:
    """Record these proxies to a new file of the folder. Raises :class:`SkyloopError`."""
    from skyloop.recording import record

    return record(drones, folder)


def start_replay(path: Path) -> Drone:
    """A private proxy that plays a file, connected to. Raises :class:`SkyloopError`."""
    from skyloop.client import connect

    return connect(f"replay://{quote(str(path))}", access="observe", name="cockpit", timeout_s=REPLAY_S)


class Recordings:
    """Those of one folder. On the event loop."""

    def __init__(
        self,
        folder: Path,
        record: Callable[[Sequence[str], Path], Recorder] = start_recorder,
        replay: Callable[[Path], Drone] = start_replay,
    ) -> None:
        self.folder = folder
        self.replays: dict[str, Drone] = {}  #: by the name of the proxy
        self._record = record
        self._replay = replay
        self._running: dict[str, Running] = {}
        self._numbers = itertools.count(1)
        self._known: dict[tuple[str, int, int], Json] = {}  # what is in a file, by its name, size and time

    def drones(self) -> set[str]:
        """Those that are being recorded."""
        return {name for running in self._running.values() for name in running.drones}

    async def start(self, drones: Sequence[str]) -> Json:
        """Raises what the recorder raises when it can't start."""
        if not drones:
            raise UsageError("no drone to record: name one at least")

        def start() -> Recorder:
            self._make_folder()
            return self._record(drones, self.folder)

        recorder = await asyncio.to_thread(start)
        number = str(next(self._numbers))
        self._running[number] = Running(tuple(drones), recorder)
        return self._told(number)

    async def stop(self, number: str) -> Json:
        """Raises :class:`UnknownNameError`."""
        if number not in self._running:
            raise UnknownNameError("running recording", number, self._running)
        told = self._told(number)
        running = self._running.pop(number)
        await asyncio.to_thread(running.recorder.close)
        return {**told, **_progress(running.recorder.status)}

    async def listing(self) -> Json:
        """Running ones, and those in the folder, the newest first."""
        running = [self._told(number) for number in self._running]
        return {"folder": str(self.folder), "running": running, "past": await asyncio.to_thread(self._past)}

    async def report(self, name: str, drone: str | None = None) -> str:
        """The page that ``skyloop log report`` makes. Raises :class:`UnknownNameError`, :class:`UsageError` with what
        that says, :class:`LinkError` if it takes too long."""
        path = self._path(name)
        with tempfile.TemporaryDirectory(prefix="skyloop-report-") as folder:
            target = Path(folder) / "report.html"
            words = [sys.executable, "-m", "skyloop", "log", "report", str(path.absolute()), "-o", str(target)]
            child = await asyncio.create_subprocess_exec(
                *words,
                *(["--drone", drone] if drone else []),
                stdin=asyncio.subprocess.DEVNULL,
                stdout=asyncio.subprocess.DEVNULL,
                stderr=asyncio.subprocess.PIPE,
            )
            try:
                _, said = await asyncio.wait_for(child.communicate(), REPORT_S)
            except TimeoutError:
                raise LinkError(f"the report of {name} was not made within {REPORT_S:g} s") from None
            finally:
                if child.returncode is None:
                    child.kill()
                    await child.wait()
            if child.returncode or not target.exists():
                lines = said.decode(errors="replace").strip().splitlines()
                raise UsageError(lines[-1] if lines else f"no report of {name} could be made")
            return target.read_text(encoding="utf-8")

    async def replay(self, name: str) -> str:
        """Play it again; the name of the proxy. Raises :class:`UnknownNameError`, and what connecting raises."""
        path = self._path(name).absolute()
        drone = await asyncio.to_thread(self._replay, path)
        self.replays[drone.name] = drone
        return drone.name

    async def end_replay(self, name: str) -> None:
        """Raises :class:`UnknownNameError`."""
        if name not in self.replays:
            raise UnknownNameError("replay", name, self.replays)
        await asyncio.to_thread(self.replays.pop(name).close)

    async def close(self) -> None:
        """Close all files and end all replays."""
        ends = [running.recorder.close for running in self._running.values()]
        ends += [drone.close for drone in self.replays.values()]
        self._running, self.replays = {}, {}
        await asyncio.gather(*(asyncio.to_thread(end) for end in ends), return_exceptions=True)

    # Inside ----------------------------------------------------------------------------------------------------

    def _told(self, number: str) -> Json:
        running = self._running[number]
        return {"id": number, "drones": list(running.drones), **_progress(running.recorder.status)}

    def _path(self, name: str) -> Path:
        known = {path.name: path for path in self._files()}
        if name not in known:
            raise UnknownNameError("recording", name, known)
        return known[name]

    def _files(self) -> list[Path]:
        """Those in the folder that nobody here is writing."""
        written = {Path(file).name for running in self._running.values() for file in running.recorder.status.files}
        with suppress(FileNotFoundError, NotADirectoryError):
            return [path for path in self.folder.iterdir() if path.suffix == _ENDING and path.name not in written]
        return []

    def _past(self) -> list[Json]:
        found = []
        for path in self._files():
            with suppress(OSError):  # deleted meanwhile
                status = path.stat()
                found.append((status.st_mtime_ns, path, status.st_size))
        newest = sorted(found, reverse=True)[:MOST_LISTED]
        known = {(path.name, size, at_ns): path for at_ns, path, size in newest}
        self._known = {key: self._known.get(key) or describe(path) for key, path in known.items()}
        return [{"name": name, "size": size, **told} for (name, size, _), told in self._known.items()]

    def _make_folder(self) -> None:
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UsageError(f"the folder of recordings {self.folder} can't be made: {error.strerror}") from None


def describe(path: Path) -> Json:
    """What is in a file: when it was started (Unix time [s]), which drones, for how long; or why it can't be told."""
    try:
        from skyloop.logfile.reader import Recording

        recording = Recording.open(path)
    except SkyloopError as error:
        return {"started": None, "drones": [], "seconds": None, "problem": str(error)}
    return {
        "started": recording.start.started_unix_ns / NS_PER_S,
        "drones": [drone.name for drone in recording.drones],
        "seconds": round(recording.seconds, 3),
        "problem": recording.cut,
    }


def _progress(status: Status) -> Json:
    return {
        "path": status.path,
        "state": str(status.state),
        "reason": status.reason,
        "seconds": round(status.seconds, 3),
        "bytes": status.bytes,
        "dropped": status.dropped,
        "missed": status.missed,
    }
