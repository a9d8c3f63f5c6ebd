"""Flight firmware as a child process: find, start, monitor, restart and end it, and couple it to a simulation."""

from __future__ import annotations

import os
import shutil
import signal
import sys
import tempfile
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import ClassVar, Final

from skyloop.child_process import ChildProcess
from skyloop.errors import SkyloopError, UsageError
from skyloop.sim.instruments import Readings
from skyloop.vehicles.sim.firmware.keeper import REAL_TIME, raise_priority, restore_priority
from skyloop.vehicles.sim.firmware.ports import SeparateNetwork

RESTART_S: Final = 1.0  #: time from the firmware's exit to its next start, doubled after each early exit
LONGEST_RESTART_S: Final = 30.0  #: limit of RESTART_S
SOON_S: Final = 10.0  #: run time below which an exit counts as early
AT_ONCE: Final = 5  #: number of consecutive failed starts that are retried without a pause
LOG: Final = "firmware.log"
_LAST_LINES, _LAST_BYTES = 5, 2000  # maximum length of the output quoted when the firmware ends


class FirmwareEventKind(StrEnum):
    """Kinds of events that firmware causes."""

    STARTED = "started"  #: the process is running
    ANSWERS = "answers"  #: the firmware is controlling the rotors, for the first time or again
    SILENT = "silent"  #: the firmware has not replied for a while, so the rotors stop
    DIED = "died"  #: the process ended and is being restarted
    FAILED = "failed"  #: the process could not be started; the start is retried
    DEAF = "deaf"  #: the process ran but did not reply; another process is started at once


class UnresponsiveError(OSError):
    """Raised if the process is running but will never reply, so that it must be restarted at once."""


@dataclass(frozen=True, slots=True)
class FirmwareEvent:
    """An event caused by firmware. ``text`` is human-readable."""

    kind: FirmwareEventKind
    text: str


@dataclass(frozen=True, slots=True)
class Launch:
    """A firmware's command and environment."""

    command: Sequence[str]
    environment: Mapping[str, str] = field(default_factory=dict)  #: variables in addition to this process's environment
    real_time: bool = False  #: whether it must be woken up on time; see ``request_real_time`` in ``keeper.py``
    network: SeparateNetwork | None = None  #: the network to run in; None for the computer's own

    def keep(self, folder: Path, log: str = LOG) -> ChildProcess:
        """Start the firmware in a folder, under a keeper."""
        descriptors = () if self.network is None else self.network.descriptors
        return ChildProcess(keeper_command(self, folder, log), inherited=descriptors)


class Program:
    """A firmware process that is restarted whenever it ends, until :meth:`close`.

    ``starts`` counts the starts; ``pid`` is the process id, or 0 while the process is not running.
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
        :class:`UnresponsiveError` to do that at once. Without a ``folder``, a new one is used and later removed.
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
        unresponsive = 0
        while not self._ending.is_set():
            begun_s = time.monotonic()
            try:
                ended = self._run_once(folder)
            except UnresponsiveError as error:
                self._report(FirmwareEvent(FirmwareEventKind.DEAF, f"{self.name} is started again: {error}"))
                unresponsive += 1
                if unresponsive <= AT_ONCE:
                    continue
            except (SkyloopError, OSError) as error:
                self._report(FirmwareEvent(FirmwareEventKind.FAILED, f"{self.name} can't be started: {error}"))
            else:
                unresponsive = 0
                if not self._ending.is_set():
                    self._report(FirmwareEvent(FirmwareEventKind.DIED, f"{self.name} {ended}{_output_tail(folder)}"))
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
            except UnresponsiveError:
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
    settings = [REAL_TIME] if launch.real_time else []
    settings += [launch.network.option] if launch.network is not None else []
    settings += [f"{name}={value}" for name, value in launch.environment.items()]
    keeper = [sys.executable, "-m", "skyloop.vehicles.sim.firmware.keeper", str(folder), str(folder / log)]
    return [*keeper, *settings, "--", *launch.command]


def find_program(variable: str, names: Sequence[str], what: str, where: str) -> str:
    """Return the path of the firmware's program, given by the variable or found by name on the search path."""
    given = os.environ.get(variable)
    if given:
        path = Path(given).expanduser()
        if not (path.is_file() and os.access(path, os.X_OK)):
            raise UsageError(f"{variable} is {given!r}, which is not a program: give the path of {what}'s program")
        return str(path.resolve())
    for name in names:
        found = shutil.which(name)
        if found is not None:
            return found
    raise UsageError(f"{what}'s program was not found: set {variable} to its path. {where}")


def _ending(code: int | None) -> str:
    with suppress(ValueError, TypeError):  # an exit code such as 255 stands for no signal
        return f"was killed by {signal.Signals((code or 0) - 128).name}"
    return f"ended with exit code {code}"


def _output_tail(folder: Path) -> str:
    try:
        with (folder / LOG).open("rb") as log:
            log.seek(max(0, log.seek(0, os.SEEK_END) - _LAST_BYTES))
            lines = log.read().decode(errors="replace").split("\n")
    except OSError:
        return ""
    text = "\n".join(line.rstrip() for line in lines if line.strip())
    return "; its output ends with:\n" + "\n".join(text.split("\n")[-_LAST_LINES:]) if text else ""


# Coupled to a simulation ---------------------------------------------------------------------------------------------

WAIT_S: Final = 0.3  #: longest wait for a reply; after a time-out, steps don't wait until the firmware has replied
STOP_S: Final = 0.5  #: simulated time without a reply after which the rotors stop, as with real speed controllers
SILENT_S: Final = 1.0  #: simulated time without a reply after which an event reports the silence
STOPPED: Final = (0.0, 0.0, 0.0, 0.0)
LEAST_SPACING_S: Final = 0.0009  #: minimum time between two steps in real time, slightly less than a step's duration

Commands = Sequence[float]


class Pace:
    """Spaces the steps of firmware on the computer's clock, whose simulation therefore needs priority meanwhile.

    After a late step, the next ones follow at once, until they have caught up on at most ``burst_s``.
    """

    def __init__(self, burst_s: float = 0.0) -> None:
        self._burst_s = burst_s
        self._due_s = 0.0
        self._has_priority = False

    def open(self) -> None:
        """Raise this process's priority: the simulation has to keep pace with firmware that doesn't wait."""
        if not self._has_priority:
            self._has_priority = True
            raise_priority()

    def close(self) -> None:
        """Restore the priority. Idempotent."""
        if self._has_priority:
            self._has_priority = False
            restore_priority()

    def keep(self) -> None:
        """Wait for slightly less than a step since the last step, so that late steps can catch up."""
        wait_s = self._due_s - time.monotonic()
        if wait_s > 0.0:
            time.sleep(wait_s)
        self._due_s = max(self._due_s, time.monotonic() - self._burst_s) + LEAST_SPACING_S


class CoupledFirmware(ABC):
    """Flies a simulation's drone with real firmware that runs as a separate process.

    It is a :class:`~skyloop.sim.instruments.Firmware`: pass it to :meth:`~skyloop.sim.simulation.Simulation.fly_by`.
    The simulation's thread waits up to :data:`WAIT_S` for a reply; after a time-out it does not wait again until the
    firmware has replied. The rotors stop if the firmware stops replying or exits; firmware that exits is restarted.
    """

    NAME: ClassVar[str]  #: the firmware's name in messages

    def __init__(self, on_event: Callable[[FirmwareEvent], None], *, folder: Path | None = None) -> None:
        """Prepare to run the firmware, without starting anything.

        ``on_event`` is called on the simulation's or the program's thread and must return quickly. ``folder`` is where
        the firmware keeps its settings; None for a new folder that is removed at the end.
        """
        self.program = Program(self.NAME, self._prepare, on_event, verify=self._verify, folder=folder)
        self.keeps_folder = folder is not None
        self._on_event = on_event
        self._starts = 0  # which start of the firmware created the coupled process
        self._owed = False  # whether the last readings need a reply
        self._patient = False  # whether to wait for replies
        self._answered_s: float | None = None  # simulated time of this process's last reply
        self._reported_silent = False

    @property
    @abstractmethod
    def address(self) -> str: ...

    def start(self) -> None:
        """Start the firmware. The firmware may take a while to reply."""
        self._open()
        self.program.start()

    def close(self) -> None:
        """End the firmware. Do not call this method while a simulation calls :meth:`exchange`. Idempotent."""
        self.program.close()
        self._close()

    def exchange(self, readings: Readings) -> Commands | None:
        if not self.program.running:
            return STOPPED
        if self.program.starts != self._starts:
            self._starts = self.program.starts
            self._owed, self._patient, self._answered_s = False, False, None
            self._begin()
            return STOPPED  # report STOPPED for at least one step, even if the exit was noticed late
        commands = self._receive(WAIT_S if self._owed and self._patient else 0.0)
        if commands is not None:
            self._on_answer(readings.time_s)
        elif self._owed:
            self._patient = False
        self._send(readings)
        if commands is None and self._is_silent(readings.time_s):
            return STOPPED
        return commands

    def _on_answer(self, time_s: float) -> None:
        if self._answered_s is None or self._reported_silent:
            again = " again" if self._reported_silent else ""
            self._reported_silent = False
            self._emit(FirmwareEventKind.ANSWERS, f"{self.NAME} controls the rotors{again}")
        self._owed, self._patient, self._answered_s = False, True, time_s

    def _is_silent(self, time_s: float) -> bool:
        """Return whether the rotors must stop because there has been no reply for a long time."""
        if self._answered_s is None:
            return True
        silent_s = time_s - self._answered_s
        if silent_s > SILENT_S and not self._reported_silent:
            self._reported_silent = True
            self._emit(FirmwareEventKind.SILENT, f"{self.NAME} does not answer: its rotors are stopped until it does")
        return silent_s > STOP_S

    def _emit(self, kind: FirmwareEventKind, text: str) -> None:
        self._on_event(FirmwareEvent(kind, text))

    @abstractmethod
    def _open(self) -> None:
        """Find the program and open sockets for it."""

    @abstractmethod
    def _close(self) -> None:
        """Close everything that :meth:`_open` opened. Idempotent."""

    @abstractmethod
    def _prepare(self, folder: Path) -> Launch:
        """Write the firmware's startup files and return how to start it. Runs on the program's thread."""

    def _verify(self) -> None:  # noqa: B027  most firmware either starts properly or exits
        """Return once the process has started properly, or raise OSError to have it started again."""

    @abstractmethod
    def _begin(self) -> None:
        """Reset the exchange for a new process."""

    @abstractmethod
    def _receive(self, wait_s: float) -> Commands | None:
        """Return the newest rotor commands in the simulation's order; None if none arrive within ``wait_s`` [s]."""

    @abstractmethod
    def _send(self, readings: Readings) -> None:
        """Send the readings if they are due, and set ``_owed`` to whether they need a reply. Must not wait."""
