"""The driver passes the driver suite against the emulated firmware of a Tello."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from skyloop.drivers.base import Driver
from skyloop.drivers.suite import DriverSuite
from skyloop.drivers.uri import parse_uri
from skyloop.sim.host import SimHost
from skyloop.sim.options import SimOptions
from skyloop.vehicles.tello.emulator import TelloFirmware, with_tellos
from tests.support.tello_addresses import Addresses


class TestTello(DriverSuite):
    """One drone for each test, at its own address of this machine, with a Tello's usual ports."""

    firmware: TelloFirmware
    uri = "tello://127.0.0.1"
    untouched_parameters = frozenset({"tello.flip"})  # refused on the ground
    connect_timeout_s = 20.0
    feedback_timeout_s = 10.0
    frame_timeout_s = 40.0  # the emulated drone creates its renderer with the first picture
    takeoff_timeout_s = 30.0
    emergency_timeout_s = 10.0
    lost_timeout_s = 10.0

    @pytest.fixture(autouse=True)
    def _drone(self) -> Iterator[None]:
        pytest.importorskip("av")
        world = SimHost(with_tellos(SimOptions(world="empty", seed=4, wind=0.0, speed=2.0)))
        self.addresses = Addresses.free()
        self.firmware = TelloFirmware(world, bind=self.addresses.drone)
        with self.firmware:
            yield

    def new_driver(self) -> Driver:
        return self.make(parse_uri(self.addresses.uri()))

    def test_gives_threads_and_descriptors_back(self) -> None:
        with self.opened() as (_, sink):  # the emulated drone starts a thread with its first picture
            assert sink.wait(lambda: sink.frame_counts["front"] > 0, self.frame_timeout_s)
        super().test_gives_threads_and_descriptors_back()

    def vehicle_disappears(self) -> None:
        self.firmware.stop()

    def vehicle_appears(self) -> None:
        self.firmware.start()
