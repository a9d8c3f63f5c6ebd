"""The driver keeps the drivers' contract, against both emulated autopilots."""

from __future__ import annotations

from collections.abc import Iterator
from typing import ClassVar

import pytest

from skyloop.drivers.base import Driver
from skyloop.drivers.suite import DriverSuite
from skyloop.drivers.uri import parse_uri
from skyloop.sim.host import SimHost
from skyloop.sim.options import SimOptions
from skyloop.vehicles.mavlink.emulator import Kind, MavlinkFirmware, Ports, with_multirotors


class MavlinkSuite(DriverSuite):
    """One vehicle for each test, in a world that goes faster than real time."""

    uri = "mavlink://udpin:127.0.0.1:14540"
    kind: ClassVar[Kind]
    takeoff_timeout_s = 20.0

    @pytest.fixture(autouse=True)
    def _drone(self) -> Iterator[None]:
        world = SimHost(with_multirotors(SimOptions(world="empty", seed=4, wind=0.0, speed=3.0)))
        self.firmware = MavlinkFirmware(world, kind=self.kind, ports=Ports.free(self.kind), boot_s=0.5)
        with self.firmware:
            yield

    def new_driver(self) -> Driver:
        return self.make(parse_uri(self.firmware.address))

    def vehicle_disappears(self) -> None:
        self.firmware.stop()

    def vehicle_appears(self) -> None:
        self.firmware.start()


class TestArduCopter(MavlinkSuite):
    kind = Kind.ARDUCOPTER


class TestPx4(MavlinkSuite):
    kind = Kind.PX4


del MavlinkSuite
