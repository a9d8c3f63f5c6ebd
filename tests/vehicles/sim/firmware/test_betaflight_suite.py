"""Real Betaflight in the simulator passes the driver suite, if it is installed."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.vehicles.sim.firmware.real_betaflight import real_betaflight
from tests.vehicles.sim.firmware.suite import FirmwareSuite


@pytest.mark.process
@pytest.mark.flight
@pytest.mark.timeout(400)
class TestBetaflightInTheSimulator(FirmwareSuite):
    uri = "sim://?autopilot=betaflight&world=empty&seed=4&wind=0&cameras=bottom&fps=10"

    @pytest.fixture(autouse=True)
    def _alone(self, tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
        folder = tmp_path_factory.getbasetemp() / "betaflight"  # its settings are written once
        with real_betaflight():
            self.uri = f"{type(self).uri}&autopilot_folder={folder}"  # type: ignore[misc]
            yield
