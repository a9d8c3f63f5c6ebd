"""The driver suite for real firmware in the simulator, and where its process is."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from skyloop.drivers.base import Driver
from skyloop.drivers.suite import DriverSuite
from skyloop.drivers.uri import VehicleUri


class FirmwareSuite(DriverSuite):
    untouched_parameters = frozenset({"sim.link", "sim.battery"})  # one disconnects the suite, the other drains
    connect_timeout_s = 30.0
    feedback_timeout_s = 10.0
    frame_timeout_s = 10.0
    takeoff_timeout_s = 40.0
    land_timeout_s = 40.0
    motion_timeout_s = 20.0
    emergency_timeout_s = 10.0
    lost_timeout_s = 10.0

    def make(self, uri: VehicleUri) -> Driver:
        self.driver = super().make(uri)
        return self.driver

    def vehicle_disappears(self) -> None:
        self.driver.set_parameter("sim.link", False)

    def vehicle_appears(self) -> None:
        self.driver.set_parameter("sim.link", True)


def process_in(folder: Path, program: str) -> int:
    """Return the process id of the firmware that runs in a folder, or 0."""
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if (process / "cwd").readlink() == folder and str((process / "exe").readlink()) == program:
                return int(process.name)
    return 0
