"""The drivers' contract, checked against the emulated Betaflight: with its own sensors, and with poses."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from skyloop.drivers.base import Driver
from skyloop.drivers.suite import DriverSuite
from skyloop.drivers.uri import VehicleUri, parse_uri
from skyloop.vehicles.msp.emulator import BetaflightFirmware
from tests.support.betaflight import Cameras, SeenDriver, world


class TestBetaflight(DriverSuite):
    """With the vehicle's own barometer and GPS."""

    firmware: BetaflightFirmware
    uri = "msp://tcp:127.0.0.1:5761"
    connect_timeout_s = 20.0
    feedback_timeout_s = 10.0
    takeoff_timeout_s = 40.0
    land_timeout_s = 40.0
    motion_timeout_s = 20.0
    emergency_timeout_s = 10.0
    lost_timeout_s = 10.0

    @pytest.fixture(autouse=True)
    def _drone(self) -> Iterator[None]:
        self.firmware = BetaflightFirmware(world(), port=0)
        with self.firmware:
            self.address = self.firmware.address
            yield

    def new_driver(self) -> Driver:
        return self.make(parse_uri(self.address))

    def vehicle_disappears(self) -> None:
        self.firmware.stop()

    def vehicle_appears(self) -> None:
        self.firmware.start()


@pytest.mark.slow
class TestBetaflightSeenByCameras(TestBetaflight):
    """External poses provide height, climb and velocity."""

    cameras: Cameras

    @pytest.fixture(autouse=True)
    def _seen(self, _drone: None) -> Iterator[None]:
        self.cameras = Cameras(self.firmware)
        with self.cameras:
            yield
            self.cameras.listener = None

    def make(self, uri: VehicleUri) -> Driver:
        driver = SeenDriver(uri)
        self.cameras.listener = driver.external_pose
        return driver
