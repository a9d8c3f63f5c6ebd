"""Flight firmware as a child process: find it, start it in its own folder, monitor it, restart it and end it."""

from __future__ import annotations

import os
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Final

from skyloop.child_process import ChildProcess
from skyloop.errors import SkyloopError, UsageError
from skyloop.vehicles.sim.firmware.keeper import PROMPT
from skyloop.vehicles.sim.firmware.ports import Apart

RESTART_S: Final = 1.0  #: time from the firmware's end to its next start, doubled after each early end
LONGEST_RESTART_S: Final = 30.0
SOON_S: Final = 10.0  #: a process that ends within this time has ended early
AT_ONCE: Final = 5  #: number of consecutive failed starts that are retried without a pause
LOG: Final = "firmware.log"
_LAST_LINES: Final = 5
_LAST_BYTES: Final = 2000


class FirmwareEventKind(StrEnum):
    """Kinds of events that firmware causes."""

    STARTED = "started"  #: its process is running
    ANSWERS = "answers"  #: it is controlling the rotors, for the first time or again
    SILENT = "silent"  #: it has not replied for a while, so the rotors stop
    DIED = "died"  #: its process ended and is being restarted
    FAILED = "failed"  #: it could not be started; the start is retried
    DEAF = "deaf"  #: its process ran but did not reply; another one is started at once


class StartedInVainError(OSError):
    """Raised if the process is running but will never reply, so that it must be restarted at once."""


@dataclass(frozen=True, slots=True)
class FirmwareEvent:
    """An event caused by firmware. ``text`` is readable."""

    kind: FirmwareEventKind
    text: str


@dataclass(frozen=True, slots=True)
class Launch:
    """A firmware's command and environment."""

    command: Sequence[str]
    environment: Mapping[str, str] = field(default_factory=dict)  #: variables in addition to this process's environment
    prompt: bool = (
        False  #: whether it needs prompt wake-ups; see :func:`~skyloop.vehicles.sim.firmware.keeper.become_prompt`
    )
    apart: Apart | None = None  #: for running in a separate network

    def keep(self, folder: Path, log: str = LOG) -> ChildProcess:
        """Start the firmware in a folder, under a keeper."""
        descriptors = () if self.apart is None else self.apart.descriptors
        return ChildProcess(keeper_command(self, folder, log), inherited=descriptors)


class Program:
    """A firmware process that is restarted whenever it ends, until :meth:`close`.

    ``starts`` counts the starts; ``pid`` is the process id, 0 while it is not running.
    """

    def __init__(
        self,
        name: str,
        prepare: Callable[[Path], Launch],
        report: Callable[[FirmwareEvent], None],
        *,
        verify: Callable[[], None] | None = None,
        folder: Path | None = None,
        restart_s: float = RESTART_S,
    ) -> None:
        """Store the arguments; :meth:`start` starts the process.

        ``prepare`` is called before each start with the working folder and writes the files that the firmware reads
        there; it raises :class:`~skyloop.errors.SkyloopError` or ``OSError`` if the firmware can't be started now.
        ``report`` is called with each event, on one of this object's threads. ``verify`` is called once the process is
        running, before the start is reported; it raises ``OSError`` to have the process ended and restarted, or
        :class:`StartedInVainError` to do that at once. Without a ``folder``, a new one is used and removed at the end.
        """
        self.name = name
        self.starts = 0
        self.pid = 0
        self._prepare = prepare
        self._report = report
        self._verify = verify
        self._folder = folder
        self._restart_s = restart_s
        self._lock = threading.Lock()
        self._ending = threading.Event()
        self._child: ChildProcess | None = None
        self._thread: threading.Thread | None = None

    @property
    def running(self) -> bool:
        """Whether the process is running."""
        return self.pid != 0

    def start(self) -> None:
        """Start the process on a thread that then monitors it."""
        self._thread = threading.Thread(target=self._run, name="skyloop-firmware", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the process. Idempotent."""
        with self._lock:
            self._ending.set()
            child = self._child
        if child is not None:
            child.end()
        if self._thread is not None:
            self._thread.join()

    def _run(self) -> None:
        if self._folder is not None:
            self._folder.mkdir(parents=True, exist_ok=True)
            self._watch(self._folder)
            return
        with tempfile.TemporaryDirectory(prefix="skyloop-firmware-", ignore_cleanup_errors=True) as folder:
            self._watch(Path(folder))

    def _watch(self, folder: Path) -> None:
        pause_s = self._restart_s
        in_vain = 0
        while not self._ending.is_set():
            begun_s = time.monotonic()
            try:
                ended = self._run_once(folder)
            except StartedInVainError as error:
                self._report(FirmwareEvent(FirmwareEventKind.DEAF, f"{self.name} is started again: {error}"))
                in_vain += 1
                if in_vain <= AT_ONCE:
                    continue
            except (SkyloopError, OSError) as error:
                self._report(FirmwareEvent(FirmwareEventKind.FAILED, f"{self.name} can't be started: {error}"))
            else:
                in_vain = 0
                if not self._ending.is_set():
                    self._report(FirmwareEvent(FirmwareEventKind.DIED, f"{self.name} {ended}{_last_words(folder)}"))
            soon = time.monotonic() - begun_s < SOON_S
            self._ending.wait(pause_s)
            pause_s = min(2 * pause_s, LONGEST_RESTART_S) if soon else self._restart_s

    def _run_once(self, folder: Path) -> str:
        """Run the process until it ends; return a description of how it ended."""
        launch = self._prepare(folder)
        with self._lock:
            if self._ending.is_set():
                return ""
            child = self._child = launch.keep(folder)
        try:
            number = child.stdout.readline()
            if not number:
                child.wait()
                raise UsageError(f"its process could not be started{child.quoted_output}")
            self.starts += 1
            self.pid = int(number)
            try:
                if self._verify is not None:
                    self._verify()
            except StartedInVainError:
                if child.code is None:
                    raise  # otherwise the process died, which is reported with its output
            self._report(FirmwareEvent(FirmwareEventKind.STARTED, f"{self.name} runs as process {self.pid}"))
            child.wait()
            return _ending(child.code)
        finally:
            self.pid = 0
            with self._lock:
                self._child = None
            child.close()


def keeper_command(launch: Launch, folder: Path, log: str = LOG) -> list[str]:
    """Return the command that runs a firmware in a folder, for a :class:`~skyloop.child_process.ChildProcess`."""
    settings = [PROMPT] if launch.prompt else []
    settings += [launch.apart.option] if launch.apart is not None else []
    settings += [f"{name}={value}" for name, value in launch.environment.items()]
    keeper = [sys.executable, "-m", "skyloop.vehicles.sim.firmware.keeper", str(folder), str(folder / log)]
    return [*keeper, *settings, "--", *launch.command]


def find_program(variable: str, names: Sequence[str], what: str, where: str) -> str:
    """Return the path of the firmware's program, from the variable or by one of these names on the search path."""
    given = os.environ.get(variable)
    if given:
        path = Path(given).expanduser()
        if not (path.is_file() and os.access(path, os.X_OK)):
            raise UsageError(f"{variable} is {given!r}, which is not a program: it must be the path of {what}'s")
        return str(path.resolve())
    for name in names:
        found = shutil.which(name)
        if found is not None:
            return found
    raise UsageError(f"{what}'s program is not here: set {variable} to its path. {where}")


def _ending(code: int | None) -> str:
    with suppress(ValueError, TypeError):  # like -1, 255 is the program's own exit code
        return f"was killed by {signal.Signals((code or 0) - 128).name}"
    return f"ended with exit code {code}"


def _last_words(folder: Path) -> str:
    try:
        with (folder / LOG).open("rb") as log:
            log.seek(max(0, log.seek(0, os.SEEK_END) - _LAST_BYTES))
            lines = log.read().decode(errors="replace").split("\n")
    except OSError:
        return ""
    text = "\n".join(line.rstrip() for line in lines if line.strip())
    return "; its output ends with:\n" + "\n".join(text.split("\n")[-_LAST_LINES:]) if text else ""
