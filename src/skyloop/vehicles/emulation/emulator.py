"""Base classes of every emulator: firmware that can be switched on and off, and its state while it is on."""

from __future__ import annotations

import logging
import math
from abc import ABC, abstractmethod
from typing import Any, Final, Generic, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import UsageError
from skyloop.faults import Faults
from skyloop.sim.camera import CameraModel
from skyloop.sim.host import Report, SimHost
from skyloop.sim.reports import Occurrence
from skyloop.vehicles.emulation.datagrams import Loop
from skyloop.vehicles.emulation.video import VideoEncoding

_log = logging.getLogger(__name__)


class Closable(Protocol):
    """A port, or another place that pictures go to."""

    def close(self) -> None: ...


class RunningEmulator(ABC):
    """Firmware that is on from its making until :meth:`stop`. A constructor that fails half-way calls that too.

    What a kind of firmware adds belongs to the loop's thread. The host's threads only leave their reports and pictures,
    and read what is replaced as a whole.

    Args:
        host: The simulated world.
        drone: Its number in it.
        loop: Name of the loop's thread; or a loop that several share, which whoever made it starts after them and stops
            before them.
    """

    def __init__(self, host: SimHost, drone: int, loop: str | Loop) -> None:
        self._host, self._drone = host, drone
        self._own_loop = isinstance(loop, str)
        self._loop = Loop(loop) if isinstance(loop, str) else loop
        self._video: VideoEncoding[Any] | None = None
        self._open: list[Closable] = []
        self._report: Report | None = None  #: the newest
        self._posted = False

    def stop(self) -> None:
        """Switch it off. When this returns the ports are free."""
        self._host.detach(self._drone, self)
        if self._video is not None:
            self._video.stop()
        if self._own_loop:
            self._loop.stop()
        for port in self._open:
            port.close()

    @abstractmethod
    def _tick(self, report: Report) -> None:
        """Handle a new report. On the loop's thread."""

    def _handle_report(self) -> None:
        self._posted = False
        if self._report is not None:
            self._tick(self._report)

    # Called by the host, on its threads --------------------------------------------------------------------------

    def report(self, report: Report) -> None:
        """Keep what the drone believes now for the loop's thread; a report that was not handled yet is replaced."""
        self._report = report
        if not self._posted:
            self._posted = True
            self._loop.post(self._handle_report)

    def happened(self, occurrence: Occurrence) -> None:
        """Log a collision or the like; what comes of it shows in what the drone sends."""
        _log.info("drone %d: %s", occurrence.drone, occurrence.text)

    def wanted_fps(self, camera: str) -> float:
        """Return how many pictures a second of this camera would be sent: all or none."""
        return math.inf if self._video is not None and self._video.wants(camera) else 0.0

    def show(self, model: CameraModel, pixels: NDArray[np.uint8], captured_ns: int) -> None:
        """Encode a picture that is due: BGR, uint8, shape (height, width, 3), which must not change any more."""
        if self._video is not None:
            self._video.show(model.name, pixels, captured_ns)

    def failed(self, error: Exception) -> None:
        """Log an error of the simulation or the renderer.

        Without reports nothing is sent, as from a drone that is dead.
        """
        _log.error("the simulation of drone %d failed: %r", self._drone, error)


LONGEST_DELAY_S: Final = 10.0
NO_FAULTS: Final = Faults()

R = TypeVar("R", bound=RunningEmulator)


class Emulator(ABC, Generic[R]):
    """The firmware of one drone of a host's world; a context manager that is on within its block."""

    def __init__(self, host: SimHost, drone: int) -> None:
        self.host = host
        self.drone = drone
        self._running: R | None = None

    def start(self) -> None:
        """Switch it on: everything is reset, but at the ports that it had before."""
        if self._running is not None:
            raise UsageError("this firmware is started already")
        self._running = self._switched_on()

    def stop(self) -> None:
        """Switch it off, in the middle of whatever it does. Does nothing if it is not started.

        The vehicle goes on with its last command. When this returns the ports are free again.
        """
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
    """Return a delay [s] if it is from 0 to :data:`LONGEST_DELAY_S`."""
    if not 0 <= delay_s <= LONGEST_DELAY_S:
        raise UsageError(f"a delay is from 0 to {LONGEST_DELAY_S:g} s, not {delay_s!r}")
    return delay_s
