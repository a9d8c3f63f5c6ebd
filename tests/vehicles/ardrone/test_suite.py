"""The driver passes the driver suite against the emulated firmware of an AR.Drone 2."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from skyloop.drivers.base import Driver
from skyloop.drivers.suite import DriverSuite
from skyloop.drivers.uri import VehicleUri, parse_uri
from skyloop.sim.host import SimHost
from skyloop.sim.options import SimOptions
from skyloop.vehicles.ardrone.emulator import ArdroneFirmware, Ports


class TestArdrone2(DriverSuite):
    """One drone for each test, in the full mode, which acknowledges parameters at once."""

    firmware: ArdroneFirmware
    uri = "ardrone://127.0.0.1"
    #: Parameters that the drone refuses on the ground.
    untouched_parameters = frozenset({"ardrone.calibrate_magnetometer", "ardrone.flight_animation"})

    @pytest.fixture(autouse=True)
    def _drone(self) -> Iterator[None]:
        world = SimHost(SimOptions(world="empty", seed=4, wind=0.0, speed=3.0, rate_hz=125.0, cameras=()))
        self.firmware = ArdroneFirmware(world, ports=Ports.free())
        with self.firmware:
            self.ports = self.firmware.ports
            yield

    def new_driver(self) -> Driver:
        return self.make(self._address())

    def _address(self) -> VehicleUri:
        ports = self.ports
        return parse_uri(
            f"ardrone://127.0.0.1?navdata_port={ports.navdata}&at_port={ports.at}&video_port={ports.video}"
            f"&control_port={ports.control}&navdata=full"
        )

    def test_gives_threads_and_descriptors_back(self) -> None:
        with self.opened() as (_, sink):  # the emulated drone starts a thread with its first picture
            assert sink.wait(lambda: sink.frame_counts["front"] > 0, self.frame_timeout_s)
        super().test_gives_threads_and_descriptors_back()

    def vehicle_disappears(self) -> None:
        self.firmware.stop()

    def vehicle_appears(self) -> None:
        self.firmware.start()
