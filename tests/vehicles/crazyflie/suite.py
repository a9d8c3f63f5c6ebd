"""What the driver suite needs for a Crazyflie, real or emulated."""

from __future__ import annotations

import time
from abc import abstractmethod

from skyloop.drivers.suite import DriverSuite, Flight
from skyloop.messages import EmergencyStop, FlightState, Hover, LinkState, ResetEmergency


class CrazyflieSuite(DriverSuite):
    @abstractmethod
    def switch_off(self) -> None:
        """Switch the vehicle off."""

    def switch_on(self) -> None:
        """Switch it on again, unless it starts by itself."""

    def test_emergency_stop_and_reset(self) -> None:
        """As in the suite, but a locked Crazyflie has to be switched off and on before the reset."""
        with self.opened(watch=set()) as (driver, sink):
            flight = Flight(self, driver, sink)
            driver.apply(EmergencyStop())
            flight.until(lambda f: f.state is FlightState.EMERGENCY, self.emergency_timeout_s, "in emergency")
            driver.apply(Hover())
            time.sleep(0.2)
            flight.until(lambda f: f.state is FlightState.EMERGENCY, 1.0, "still in emergency after hover")
            self.switch_off()
            assert sink.wait(lambda: sink.link_state is LinkState.LOST, self.lost_timeout_s)
            self.switch_on()
            assert sink.wait(lambda: sink.link_state is LinkState.UP, self.connect_timeout_s)
            driver.apply(ResetEmergency())
            flight.until(lambda f: f.state is FlightState.LANDED, self.emergency_timeout_s, "landed after the reset")
