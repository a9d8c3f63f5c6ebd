"""The coupling of a firmware's process to a simulation, as far as it is the same for all kinds of firmware."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import ClassVar, Final

from skyloop.sim.instruments import Readings
from skyloop.vehicles.sim.firmware.program import FirmwareEvent, FirmwareEventKind, Launch, Program

WAIT_S: Final = 0.3  #: longest wait for a reply; after a time-out there is no more waiting until it replies
STOP_S: Final = 0.5  #: simulated time without a reply after which the rotors stop, as with real speed controllers
SILENT_S: Final = 1.0  #: simulated time without a reply after which an event reports the silence
STOPPED: Final = (0.0, 0.0, 0.0, 0.0)

Commands = Sequence[float]


class CoupledFirmware(ABC):
    """Flies a simulation's drone with real firmware that runs as a separate process.

    It is a :class:`~skyloop.sim.instruments.Firmware`: pass it to :meth:`~skyloop.sim.simulation.Simulation.fly_by`.
    The simulation's thread waits up to :data:`WAIT_S` for a reply; after a time-out it does not wait again until the
    firmware has replied. The rotors stop if the firmware is silent or its process ends; in that case it is restarted.
    """

    NAME: ClassVar[str]  #: the firmware's name in messages

    def __init__(self, on_event: Callable[[FirmwareEvent], None], *, folder: Path | None = None) -> None:
        """Prepare without starting anything.

        ``on_event`` is called on the simulation's or the program's thread and must return quickly. ``folder`` is where
        the firmware keeps its settings; None for a new one that is removed at the end.
        """
        self.program = Program(self.NAME, self._prepare, on_event, verify=self._verify, folder=folder)
        self.keeps_folder = folder is not None
        self._on_event = on_event
        self._starts = 0  # number of the start that created the coupled process
        self._owed = False  # whether the last readings need a reply
        self._patient = False  # whether to wait for replies
        self._answered_s: float | None = None  # simulated time of this process's last reply
        self._reported_silent = False

    @property
    @abstractmethod
    def address(self) -> str: ...

    def start(self) -> None:
        """Start the firmware. It may take a while to reply."""
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
            return STOPPED  # for at least one step, even if its end was noticed late
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

    def _verify(self) -> None:  # noqa: B027  most firmware either starts well or ends
        """Return once its process has started properly, on the program's thread; raise OSError to repeat the start."""

    @abstractmethod
    def _begin(self) -> None:
        """Reset the exchange for a new process."""

    @abstractmethod
    def _receive(self, wait_s: float) -> Commands | None:
        """Return the newest rotor commands in the simulation's order; None if none arrive within ``wait_s`` [s]."""

    @abstractmethod
    def _send(self, readings: Readings) -> None:
        """Send the readings if they are due, and set ``_owed`` to whether they need a reply. Must not wait."""
