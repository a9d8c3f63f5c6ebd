"""Base classes of the emulators: firmware that can be switched on and off, and the state of running firmware."""

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
    """A port or another recipient of images that can be closed."""

    def close(self) -> None: ...


class RunningEmulator(ABC):
    """Firmware that runs from its construction to :meth:`stop`, which a constructor that fails half-way calls too.

    State added by subclasses belongs to the loop's thread. The host's threads only store their reports and images, and
    read values that are replaced as a whole. ``loop`` is the name for the loop's thread, or a shared loop, which its
    creator starts after the firmware and stops before it.
    """

    def __init__(self, host: SimHost, drone: int, loop: str | Loop) -> None:
        self._host, self._drone = host, drone
        self._own_loop = isinstance(loop, str)
        self._loop = Loop(loop) if isinstance(loop, str) else loop
        self._video: VideoEncoding[Any] | None = None
        self._open: list[Closable] = []
        self._report: Report | None = None  #: the newest report
        self._posted = False

    def stop(self) -> None:
        """Switch the firmware off. Its ports are free when this returns."""
        self._host.detach(self._drone, self)
        if self._video is not None:
            self._video.stop()
        if self._own_loop:
            self._loop.stop()
        for port in self._open:
            port.close()

    @abstractmethod
    def _tick(self, report: Report) -> None:
        """Handle a new report. Runs on the loop's thread."""

    def _handle_report(self) -> None:
        self._posted = False
        if self._report is not None:
            self._tick(self._report)

    # Called by the host on its threads ---------------------------------------------------------------------------

    def report(self, report: Report) -> None:
        """Store the drone's newest estimate for the loop's thread, replacing one not yet handled."""
        self._report = report
        if not self._posted:
            self._posted = True
            self._loop.post(self._handle_report)

    def happened(self, occurrence: Occurrence) -> None:
        """Log an event such as a collision; its effect appears in the drone's own data."""
        _log.info("drone %d: %s", occurrence.drone, occurrence.text)

    def wanted_fps(self, camera: str) -> float:
        """Return the frame rate to render this camera at: its full rate or 0."""
        return math.inf if self._video is not None and self._video.wants(camera) else 0.0

    def show(self, model: CameraModel, pixels: NDArray[np.uint8], captured_ns: int) -> None:
        """Encode an image: BGR, uint8, shape (height, width, 3). The array must not be modified afterwards."""
        if self._video is not None:
            self._video.show(model.name, pixels, captured_ns)

    def failed(self, error: Exception) -> None:
        """Log an error in the simulation or the renderer.

        Once reports stop, the firmware sends nothing, like a dead drone.
        """
        _log.error("the simulation of drone %d failed: %r", self._drone, error)


LONGEST_DELAY_S: Final = 10.0  #: greatest delay that can be configured for datagrams
NO_FAULTS: Final = Faults()

R = TypeVar("R", bound=RunningEmulator)


class Emulator(ABC, Generic[R]):
    """The firmware of one drone in a host's world. As a context manager, it is switched on within the block."""

    def __init__(self, host: SimHost, drone: int) -> None:
        self.host = host
        self.drone = drone
        self._running: R | None = None

    def start(self) -> None:
        """Switch the firmware on. Everything except its ports is reset."""
        if self._running is not None:
            raise UsageError("this firmware is started already")
        self._running = self._switched_on()

    def stop(self) -> None:
        """Switch the firmware off at once, even during an activity. Does nothing if it is already off.

        The vehicle continues to follow its last command. The ports are free when this returns.
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
    """Return the delay [s]; raise :class:`UsageError` unless it is from 0 to :data:`LONGEST_DELAY_S`."""
    if not 0 <= delay_s <= LONGEST_DELAY_S:
        raise UsageError(f"a delay is from 0 to {LONGEST_DELAY_S:g} s, not {delay_s!r}")
    return delay_s
