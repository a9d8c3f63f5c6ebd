"""Real Betaflight in the simulator passes the driver suite, if it is installed."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from skyloop.drivers.base import Driver
from skyloop.drivers.suite import DriverSuite
from skyloop.drivers.uri import VehicleUri
from tests.vehicles.sim.firmware.real_betaflight import real_betaflight


@pytest.mark.process
@pytest.mark.flight
@pytest.mark.timeout(400)
class TestBetaflightInTheSimulator(DriverSuite):
    untouched_parameters = frozenset({"sim.link", "sim.battery"})  # one disconnects the suite, the other drains
    uri = "sim://?autopilot=betaflight&world=empty&seed=4&wind=0&cameras=bottom&fps=10"
    connect_timeout_s = 30.0
    feedback_timeout_s = 10.0
    frame_timeout_s = 10.0
    takeoff_timeout_s = 40.0
    land_timeout_s = 40.0
    motion_timeout_s = 20.0
    emergency_timeout_s = 10.0
    lost_timeout_s = 10.0

    @pytest.fixture(autouse=True)
    def _alone(self, tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
        folder = tmp_path_factory.getbasetemp() / "betaflight"  # its settings are written once
        with real_betaflight():
            self.uri = f"{type(self).uri}&autopilot_folder={folder}"  # type: ignore[misc]
            yield

    def make(self, uri: VehicleUri) -> Driver:
        self.driver = super().make(uri)
        return self.driver

    def vehicle_disappears(self) -> None:
        self.driver.set_parameter("sim.link", False)

    def vehicle_appears(self) -> None:
        self.driver.set_parameter("sim.link", True)
