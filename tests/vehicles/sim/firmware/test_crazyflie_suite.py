"""A real Crazyflie's firmware in the simulator passes the driver suite, if it is installed.

``SKYLOOP_CRAZYFLIE`` is the program's path; see ``docs/autopilots.md``.
"""

from __future__ import annotations

import os
import signal

import pytest

from skyloop.vehicles.sim.driver import SimDriver
from skyloop.vehicles.sim.firmware.crazyflie import VARIABLE
from tests.vehicles.crazyflie.suite import CrazyflieSuite
from tests.vehicles.sim.firmware.suite import FirmwareSuite


@pytest.mark.process
@pytest.mark.flight
@pytest.mark.timeout(400)
@pytest.mark.skipif(not os.environ.get(VARIABLE), reason=f"{VARIABLE} must be the program's path (docs/autopilots.md)")
class TestCrazyflieInTheSimulator(FirmwareSuite, CrazyflieSuite):
    uri = "sim://?autopilot=crazyflie&world=empty&seed=4&wind=0&cameras=bottom&fps=10"
    connect_timeout_s = 40.0

    @pytest.fixture(autouse=True)
    def _cache(self, monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> None:
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "crazyflie"))

    def switch_off(self) -> None:
        """Kill its process; another one is started."""
        assert isinstance(self.driver, SimDriver)
        assert self.driver.firmware is not None
        assert self.driver.firmware.firmware is not None
        os.kill(self.driver.firmware.firmware.program.pid, signal.SIGKILL)
