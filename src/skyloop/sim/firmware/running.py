"""Emulated firmware from the moment it is switched on: a passenger of a world's host, with a thread and ports."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from skyloop.sim.camera import CameraModel
from skyloop.sim.firmware.loop import Loop
from skyloop.sim.firmware.video import VideoEncoding
from skyloop.sim.host import Report, SimHost
from skyloop.sim.reports import Occurrence

_log = logging.getLogger(__name__)


class Closable(Protocol):
    """A port, or where pictures go."""

    def close(self) -> None: ...


class Running(ABC):
    """On from its making until :meth:`stop`. A constructor that fails half-way calls that too.

    What a kind of firmware adds belongs to the loop's thread; the host's threads only leave their reports and
    pictures, and look at what is replaced as a whole.
    """

    def __init__(self, host: SimHost, drone: int, loop: str) -> None:
        self._host, self._drone = host, drone
        self._loop = Loop(loop)
        self._video: VideoEncoding[Any] | None = None
        self._open: list[Closable] = []
        self._report: Report | None = None  #: the newest
        self._posted = False

    def stop(self) -> None:
        """When this returns the ports are free."""
        self._host.leave(self._drone, self)
        if self._video is not None:
            self._video.stop()
        self._loop.stop()
        for port in self._open:
            port.close()

    @abstractmethod
    def _tick(self, report: Report) -> None:
        """There is a new report. On the loop's thread."""

    def _look_at_report(self) -> None:
        self._posted = False
        if self._report is not None:
            self._tick(self._report)

    # Called by the host, on its threads --------------------------------------------------------------------------

    def report(self, report: Report) -> None:
        """What the drone believes now; what was not looked at yet is overtaken."""
        self._report = report
        if not self._posted:
            self._posted = True
            self._loop.post(self._look_at_report)

    def happened(self, occurrence: Occurrence) -> None:
        """What the drone sends shows what comes of it."""
        _log.info("drone %d: %s", occurrence.drone, occurrence.text)

    def wants(self, camera: str) -> bool:
        """Whether a picture of this camera would be sent."""
        return self._video is not None and self._video.wants(camera)

    def show(self, model: CameraModel, pixels: NDArray[np.uint8], captured_ns: int) -> None:
        """A picture is due."""
        if self._video is not None:
            self._video.show(model.name, pixels, captured_ns)

    def failed(self, error: Exception) -> None:
        """The simulation or the drawing raised. Without reports nothing goes out, as from a drone that is dead."""
        _log.error("the simulation of drone %d failed: %r", self._drone, error)
