"""Emulated firmware that is switched on and off."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Final, Generic, Self, TypeVar

from skyloop.errors import UsageError
from skyloop.sim.firmware.running import Running
from skyloop.sim.host import SimHost
from skyloop.transport.faults import Faults

LONGEST_DELAY_S: Final = 10.0
NO_FAULTS: Final = Faults()

R = TypeVar("R", bound=Running)


class Firmware(ABC, Generic[R]):
    """The firmware of one drone of a host's world; a context manager that is on within its block."""

    def __init__(self, host: SimHost, drone: int) -> None:
        self.host = host
        self.drone = drone
        self._running: R | None = None

    def start(self) -> None:
        """Switch it on: everything begins anew, but at the ports that it had before.

        Raises :class:`skyloop.errors.LinkError` if a port is taken, and :class:`UsageError` if it is started already
        or somebody else has this drone.
        """
        if self._running is not None:
            raise UsageError("this firmware is started already")
        self._running = self._switched_on()

    def stop(self) -> None:
        """Switch it off, in the middle of whatever it does; the vehicle goes on with what it was told last. When this
        returns the ports are free again. Does nothing if it is not started."""
        running, self._running = self._running, None
        if running is not None:
            running.stop()

    @abstractmethod
    def _switched_on(self) -> R: ...

    @property
    def _started(self) -> R:
        if self._running is None:
            raise UsageError("firmware that is not started has no ports and no state: call start() first")
        return self._running

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


def checked_delay(delay_s: float) -> float:
    """Raises :class:`UsageError`."""
    if not 0 <= delay_s <= LONGEST_DELAY_S:
        raise UsageError(f"a delay is from 0 to {LONGEST_DELAY_S:g} s, not {delay_s!r}")
    return delay_s
