"""The driver passes the driver suite against the emulated firmware of a Crazyflie."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from skyloop.drivers.base import Driver
from skyloop.drivers.suite import RecordingSink
from skyloop.drivers.uri import parse_uri
from skyloop.sim.host import SimHost
from skyloop.sim.options import SimOptions
from skyloop.vehicles.crazyflie.driver import CrazyflieDriver
from skyloop.vehicles.crazyflie.emulator import CrazyflieFirmware, with_crazyflies
from tests.vehicles.crazyflie.suite import CrazyflieSuite


class TestCrazyflie(CrazyflieSuite):
    uri = "crazyflie://udp:127.0.0.1"
    connect_timeout_s = 20.0
    feedback_timeout_s = 10.0
    takeoff_timeout_s = 30.0
    emergency_timeout_s = 10.0
    lost_timeout_s = 10.0
    motion_timeout_s = 12.0

    @pytest.fixture(autouse=True)
    def _vehicle(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
        world = SimHost(with_crazyflies(SimOptions(world="empty", seed=4, wind=0.0)))
        self.firmware = CrazyflieFirmware(world, port=0)
        with self.firmware:
            yield

    def new_driver(self) -> Driver:
        return self.make(parse_uri(self.firmware.address))

    def vehicle_disappears(self) -> None:
        self.firmware.stop()

    def vehicle_appears(self) -> None:
        self.firmware.start()

    def switch_off(self) -> None:
        self.firmware.stop()

    def switch_on(self) -> None:
        self.firmware.start()


def test_esp_drones_dialect(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """ESP-Drone and LiteWing end each packet with a checksum."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    world = SimHost(with_crazyflies(SimOptions(world="empty", seed=4, wind=0.0)))
    sink = RecordingSink()
    with CrazyflieFirmware(world, port=0, checksum=True) as firmware:
        driver = CrazyflieDriver(parse_uri(firmware.address))
        assert driver.options.checksum
        driver.open(sink)
        try:
            assert sink.wait(lambda: sink.feedback_count > 5, 30.0), sink.links
        finally:
            driver.close()
    assert not sink.problems
