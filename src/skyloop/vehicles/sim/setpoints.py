"""Flight by set-points alone: lets the simulated drone stand in for vehicles without a take-off of their own."""

from __future__ import annotations

import threading
from typing import Final

from skyloop.messages import AnyAction, Attitude, FlightState, Land, Takeoff, Velocity
from skyloop.sim.reports import VehicleFeedback
from skyloop.sim.simulation import Simulation

LIFT_M_S: Final = 0.05  #: a climb of more than this starts the motors
DOWN_M: Final = 0.08  #: so low and still descending is landed


class SetpointController:
    """Starts the motors when a set-point climbs, and stops them on the ground when one descends.

    The simulated firmware takes set-points in the air only, so its own take-off to the least height stands in between.

    Args:
        simulation: Flies the drone.
        drone: Its number.
    """

    def __init__(self, simulation: Simulation, drone: int) -> None:
        self._simulation = simulation
        self._drone = drone
        self._lock = threading.Lock()
        self._setpoint: Attitude | Velocity | None = None

    def command(self, action: AnyAction) -> AnyAction:
        """Command the drone as :meth:`Simulation.command` does, but accept set-points in every state.

        Returns:
            What is applied.
        """
        with self._lock:
            if not isinstance(action, Attitude | Velocity):
                self._setpoint = None
                return self._simulation.command(self._drone, action)
            self._setpoint = action
            applied = self._follow(self._simulation.state(self._drone), self._simulation.feedback(self._drone))
        return action if applied is None else applied

    def on_feedback(self, believed: VehicleFeedback) -> None:
        """Apply the set-point in force to the state that the drone reports now."""
        with self._lock:
            if self._setpoint is not None:
                self._follow(believed.state, believed)

    def reported_state(self, state: FlightState) -> FlightState:
        """Return the state that such a vehicle reports: it knows neither hovering nor taking off nor landing."""
        return FlightState.FLYING if state.airborne else state

    def _follow(self, state: FlightState, believed: VehicleFeedback) -> AnyAction | None:
        setpoint = self._setpoint
        assert setpoint is not None
        climb = setpoint.climb if isinstance(setpoint, Attitude) else setpoint.up
        if state in (FlightState.LANDED, FlightState.LANDING):
            if climb > LIFT_M_S:
                self._simulation.command(self._drone, Takeoff())
            return None
        if state is FlightState.TAKING_OFF:
            return None
        if climb < 0 and believed.altitude_m < DOWN_M:
            self._simulation.command(self._drone, Land())
            return None
        return self._simulation.command(self._drone, setpoint)
