"""An emulated Betaflight, and a camera system that sends its poses to the driver under test."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from skyloop.drivers.base import ExternalPose
from skyloop.errors import DriverError
from skyloop.sim.host import SimHost
from skyloop.sim.options import SimOptions
from skyloop.vehicles.msp.driver import MspDriver
from skyloop.vehicles.msp.emulator import BetaflightFirmware, with_racers

POSE_S = 0.01


def world(**options: object) -> SimHost:
    settings = {"world": "empty", "seed": 4, "wind": 0.0, **options}
    return SimHost(with_racers(SimOptions(**settings)))  # type: ignore[arg-type]


class Cameras(threading.Thread):
    """Measures the drone's pose a hundred times a second, and passes it to its callbacks."""

    def __init__(self, firmware: BetaflightFirmware) -> None:
        super().__init__(daemon=True)
        self.firmware = firmware
        self.listener: Callable[[ExternalPose], None] | None = None
        self._ending = threading.Event()

    def __enter__(self) -> Cameras:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.set()
        self.join()

    def run(self) -> None:
        while not self._ending.wait(POSE_S):
            listener, simulation = self.listener, self.firmware.host.simulation
            if listener is None:
                continue
            truth = simulation.truth(self.firmware.drone)
            try:
                listener(ExternalPose(truth.position_m, truth.quaternion, time.monotonic_ns()))
            except DriverError:  # closed meanwhile
                continue


class SeenDriver(MspDriver):
    """A driver that gets the cameras' poses while it is open."""

    cameras: Cameras | None = None

    def external_pose(self, pose: ExternalPose) -> None:
        if self._link is not None:
            super().external_pose(pose)
