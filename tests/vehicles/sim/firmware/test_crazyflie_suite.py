"""A real Crazyflie's firmware in the simulator passes the driver suite, if it is installed.

``SKYLOOP_CRAZYFLIE`` is the program's path; see ``docs/autopilots.md``.
"""

from __future__ import annotations

import os
import signal
import time

import pytest

from skyloop.drivers.base import Driver
from skyloop.drivers.suite import DriverSuite, Flight
from skyloop.drivers.uri import VehicleUri
from skyloop.messages import EmergencyStop, FlightState, Hover, LinkState, ResetEmergency
from skyloop.vehicles.sim.driver import SimDriver
from skyloop.vehicles.sim.firmware.crazyflie import VARIABLE


@pytest.mark.process
@pytest.mark.flight
@pytest.mark.timeout(400)
@pytest.mark.skipif(not os.environ.get(VARIABLE), reason=f"{VARIABLE} must be the program's path (docs/autopilots.md)")
class TestCrazyflieInTheSimulator(DriverSuite):
    untouched_parameters = frozenset({"sim.link", "sim.battery"})  # one disconnects the suite, the other drains
    uri = "sim://?autopilot=crazyflie&world=empty&seed=4&wind=0&cameras=bottom&fps=10"
    connect_timeout_s = 40.0
    feedback_timeout_s = 10.0
    frame_timeout_s = 10.0
    takeoff_timeout_s = 40.0
    land_timeout_s = 40.0
    motion_timeout_s = 20.0
    emergency_timeout_s = 10.0
    lost_timeout_s = 10.0

    @pytest.fixture(autouse=True)
    def _cache(self, monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> None:
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "crazyflie"))

    def make(self, uri: VehicleUri) -> Driver:
        self.driver = super().make(uri)
        return self.driver

    def vehicle_disappears(self) -> None:
        self.driver.set_parameter("sim.link", False)

    def vehicle_appears(self) -> None:
        self.driver.set_parameter("sim.link", True)

    def test_emergency_stop_and_reset(self) -> None:
        """As in the suite, but a locked Crazyflie has to be switched off and on before the reset."""
        with self.opened(watch=set()) as (driver, sink):
            flight = Flight(self, driver, sink)
            driver.apply(EmergencyStop())
            flight.until(lambda f: f.state is FlightState.EMERGENCY, self.emergency_timeout_s, "in emergency")
            driver.apply(Hover())
            time.sleep(0.2)
            flight.until(lambda f: f.state is FlightState.EMERGENCY, 1.0, "still in emergency after hover")
            assert isinstance(driver, SimDriver)
            assert driver.firmware is not None
            assert driver.firmware.firmware is not None
            os.kill(driver.firmware.firmware.program.pid, signal.SIGKILL)
            assert sink.wait(lambda: sink.link_state is LinkState.LOST, self.lost_timeout_s)
            assert sink.wait(lambda: sink.link_state is LinkState.UP, self.connect_timeout_s)
            driver.apply(ResetEmergency())
            flight.until(lambda f: f.state is FlightState.LANDED, self.emergency_timeout_s, "landed after the reset")
