"""The simulated drone passes the driver suite, with all native actions and with fewer."""

from __future__ import annotations

from skyloop.drivers.base import Driver
from skyloop.drivers.suite import DriverSuite
from skyloop.drivers.uri import VehicleUri


class SimSuite(DriverSuite):
    untouched_parameters = frozenset({"sim.link", "sim.battery"})  # one disconnects the suite, the other drains

    def make(self, uri: VehicleUri) -> Driver:
        self.driver = super().make(uri)
        return self.driver

    def vehicle_disappears(self) -> None:
        self.driver.set_parameter("sim.link", False)

    def vehicle_appears(self) -> None:
        self.driver.set_parameter("sim.link", True)


class TestSim(SimSuite):
    uri = "sim://?seed=4&speed=10&rate=100"


class TestSimThatTakesAttitudesOnly(SimSuite):
    uri = "sim://?world=empty&seed=4&speed=10&rate=100&native=attitude&cameras=none&wind=0"


class TestSimThatKnowsItsPlace(SimSuite):
    uri = "sim://?seed=4&speed=10&rate=100&cameras=bottom&native=takeoff,land,velocity"


class TestSimWithRotors(SimSuite):
    uri = "sim://?world=empty&seed=4&speed=4&rate=100&cameras=bottom&vehicle=iris"
