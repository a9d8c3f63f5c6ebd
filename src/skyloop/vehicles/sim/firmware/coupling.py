"""A firmware's process coupled to a simulation: the part shared by all kinds of firmware."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import ClassVar, Final

from skyloop.sim.instruments import Readings
from skyloop.vehicles.sim.firmware.program import FirmwareEvent, FirmwareEventKind, Launch, Program

WAIT_S: Final = 0.3  #: longest wait for an answer; after a time-out no further wait until it answers
STOP_S: Final = 0.5  #: of simulated time without an answer until the rotors stop, like real speed controllers
SILENT_S: Final = 1.0  #: of simulated time without an answer until an event reports it
STOPPED: Final = (0.0, 0.0, 0.0, 0.0)

Commands = Sequence[float]


class CoupledFirmware(ABC):
    """Flies a drone of a simulation with real firmware, which runs as a separate process.

    It is a :class:`~skyloop.sim.instruments.Firmware`: pass it to :meth:`~skyloop.sim.simulation.Simulation.fly_by`.
    The simulation's thread waits up to :data:`WAIT_S` for an answer; after a time-out it does not wait again until the
    firmware answers. Silence and the process's end stop the rotors; firmware that ended is restarted.
    """

    NAME: ClassVar[str]  #: for messages

    def __init__(self, on_event: Callable[[FirmwareEvent], None], *, folder: Path | None = None) -> None:
        """Prepare without starting anything.

        Args:
            on_event: Called with each event, on the simulation's or the program's thread; must return quickly.
            folder: Working folder with the firmware's settings; None: a new one, removed at the end.
        """
        self.program = Program(self.NAME, self._prepare, on_event, verify=self._verify, folder=folder)
        self.keeps_folder = folder is not None
        self._on_event = on_event
        self._starts = 0  # start number of the coupled process
        self._owed = False  # whether the last readings need an answer
        self._patient = False  # whether to wait for answers
        self._answered_s: float | None = None  # simulated time of this process's last answer
        self._reported_silent = False

    @property
    @abstractmethod
    def address(self) -> str: ...

    def start(self) -> None:
        """Start the firmware. It may take a while to answer."""
        self._open()
        self.program.start()

    def close(self) -> None:
        """End the firmware. Do not call it while a simulation calls :meth:`exchange`. Idempotent."""
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
            return STOPPED  # for at least a step, even if its end was noticed late
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
        """Return whether the rotors must stop after a long time without an answer."""
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
        """Find the program, and open the sockets for it."""

    @abstractmethod
    def _close(self) -> None:
        """Close everything that :meth:`_open` opened. Idempotent."""

    @abstractmethod
    def _prepare(self, folder: Path) -> Launch:
        """Write the firmware's startup files, and return how to start it. On the program's thread."""

    def _verify(self) -> None:  # noqa: B027  most firmware either starts well or ends
        """Return once its process has started well. On the program's thread.

        Raises:
            OSError: The start failed; start it again.
        """

    @abstractmethod
    def _begin(self) -> None:
        """Reset the exchange for a new process."""

    @abstractmethod
    def _receive(self, wait_s: float) -> Commands | None:
        """Return the newest rotor commands in the simulation's order; None if none arrive within ``wait_s`` [s]."""

    @abstractmethod
    def _send(self, readings: Readings) -> None:
        """Send readings if due, and set ``_owed`` to whether they need an answer. Must not wait."""
