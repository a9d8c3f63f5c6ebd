"""A vehicle that flies by set-points alone: what lets the simulated one stand in for vehicles without a take-off."""

from __future__ import annotations

import threading
from typing import Final

from skyloop.messages import AnyAction, Attitude, FlightState, Land, Takeoff, Velocity
from skyloop.sim.reports import VehicleFeedback
from skyloop.sim.simulation import Simulation

LIFT_M_S: Final = 0.05  #: a climb of more than this starts the motors
DOWN_M: Final = 0.08  #: so low and still descending is landed


class SetPointFlight:
    """Starts when a set-point climbs, and stops on the ground when one descends.

    The simulated firmware takes set-points in the air only, so its own take-off to the least height stands in between.
    """

    def __init__(self, simulation: Simulation, drone: int) -> None:
        self._simulation = simulation
        self._drone = drone
        self._lock = threading.Lock()
        self._wanted: Attitude | Velocity | None = None

    def command(self, action: AnyAction) -> AnyAction:
        """As :meth:`Simulation.command`, but set-points are taken in every state."""
        with self._lock:
            if not isinstance(action, Attitude | Velocity):
                self._wanted = None
                return self._simulation.command(self._drone, action)
            self._wanted = action
            applied = self._follow(self._simulation.state(self._drone), self._simulation.feedback(self._drone))
        return action if applied is None else applied

    def supervise(self, believed: VehicleFeedback) -> None:
        """To be called with each feedback: a set-point lasts, while the state goes on."""
        with self._lock:
            if self._wanted is not None:
                self._follow(believed.state, believed)

    def told_state(self, state: FlightState) -> FlightState:
        """Such a vehicle knows nothing of hovering, taking off and landing."""
        return FlightState.FLYING if state.airborne else state

    def _follow(self, state: FlightState, believed: VehicleFeedback) -> AnyAction | None:
        wanted = self._wanted
        assert wanted is not None
        climb = wanted.climb if isinstance(wanted, Attitude) else wanted.up
        if state in (FlightState.LANDED, FlightState.LANDING):
            if climb > LIFT_M_S:
                self._simulation.command(self._drone, Takeoff())
            return None
        if state is FlightState.TAKING_OFF:
            return None
        if climb < 0 and believed.altitude_m < DOWN_M:
            self._simulation.command(self._drone, Land())
            return None
        return self._simulation.command(self._drone, wanted)
