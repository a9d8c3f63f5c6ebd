"""A firmware's process coupled to a simulation: what all kinds of firmware share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import ClassVar, Final

from skyloop.sim.instruments import Readings
from skyloop.vehicles.sim.firmware.program import FirmwareEvent, FirmwareEventKind, Launch, Program

WAIT_S: Final = 0.3  #: longest wait for an answer; after one in vain there is none until it answers
STOP_S: Final = 0.5  #: of simulated time without an answer until the rotors stop, as speed controllers stop them
SILENT_S: Final = 1.0  #: of simulated time without an answer until that is an event
STOPPED: Final = (0.0, 0.0, 0.0, 0.0)

Commands = Sequence[float]


class CoupledFirmware(ABC):
    """Flies a drone of a simulation by a real firmware, which runs as a process of its own.

    It is a :class:`~skyloop.sim.instruments.Firmware`: give it to :meth:`~skyloop.sim.simulation.Simulation.fly_by`.
    The simulation's thread never waits long: for an answer up to :data:`WAIT_S`, and once there was none, not at all
    until the firmware answers again. Silence and death stop the rotors; a firmware that died is started again.
    """

    NAME: ClassVar[str]  #: for people

    def __init__(self, on_event: Callable[[FirmwareEvent], None], *, folder: Path | None = None) -> None:
        """Prepare without starting anything.

        Args:
            on_event: Called with each event, on the simulation's thread or one of the program; must return quickly.
            folder: Where the firmware runs and keeps its settings; None: a new one, removed at the end.
        """
        self.program = Program(self.NAME, self._prepare, on_event, verify=self._verify, folder=folder)
        self.keeps_folder = folder is not None
        self._on_event = on_event
        self._starts = 0  # of the process that is coupled now
        self._owed = False  # whether the firmware is to answer what it was sent last
        self._patient = False  # whether an answer is waited for
        self._answered_s: float | None = None  # simulated time of the last answer of this process
        self._reported_silent = False

    @property
    @abstractmethod
    def address(self) -> str: ...

    def start(self) -> None:
        """Start the firmware. It may take a while until it answers."""
        self._open()
        self.program.start()

    def close(self) -> None:
        """End the firmware. Not while a simulation calls :meth:`exchange`. Idempotent."""
        self.program.close()
        self._close()

    def exchange(self, readings: Readings) -> Commands | None:
        """See :meth:`~skyloop.sim.instruments.Firmware.exchange`."""
        if not self.program.running:
            return STOPPED
        if self.program.starts != self._starts:
            self._starts = self.program.starts
            self._owed, self._patient, self._answered_s = False, False, None
            self._begin()
            return STOPPED  # for a step at least, also where its end was not noticed in time
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
        """Return whether the rotors must stand, for there has been no answer for long."""
        if self._answered_s is None:
            return True
        silent_s = time_s - self._answered_s
        if silent_s > SILENT_S and not self._reported_silent:
            self._reported_silent = True
            self._emit(FirmwareEventKind.SILENT, f"{self.NAME} does not answer: its rotors stand until it does")
        return silent_s > STOP_S

    def _emit(self, kind: FirmwareEventKind, text: str) -> None:
        self._on_event(FirmwareEvent(kind, text))

    @abstractmethod
    def _open(self) -> None:
        """Find the program, and open what it will be spoken to by."""

    @abstractmethod
    def _close(self) -> None:
        """Close what :meth:`_open` opened. Idempotent."""

    @abstractmethod
    def _prepare(self, folder: Path) -> Launch:
        """Write what the firmware reads when it starts, and return how it is started. On the program's thread."""

    def _verify(self) -> None:  # noqa: B027  most firmware starts well or not at all
        """Return when its process has started well. On the program's thread.

        Raises:
            OSError: It was started in vain, and is to be started again.
        """

    @abstractmethod
    def _begin(self) -> None:
        """Forget what was said to the process before: there is another."""

    @abstractmethod
    def _receive(self, wait_s: float) -> Commands | None:
        """Return the newest commands of the rotors in the simulation's order; None: none came in ``wait_s`` [s]."""

    @abstractmethod
    def _send(self, readings: Readings) -> None:
        """Send readings if they are due, and set ``_owed`` to whether they will be answered. Must not wait."""
