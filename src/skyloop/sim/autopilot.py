"""The drones' flight logic, which applies commands, follows a table of states and controls the loops' set-points.

Each :class:`Happening` changes a state. An event that :data:`TRANSITIONS` does not list for the current state is
ignored, as in firmware. Some events depend on the charge of the :class:`Batteries`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from enum import Enum, auto

import numpy as np

from skyloop.messages import (
    AnyAction,
    Attitude,
    EmergencyStop,
    FlightState,
    Hover,
    Idle,
    Land,
    ResetEmergency,
    Takeoff,
    Velocity,
)
from skyloop.messages.geometry import clamped
from skyloop.sim.collisions import Contacts
from skyloop.sim.control_loops import ControlLoops, Sensors
from skyloop.sim.dynamics import column
from skyloop.sim.parameters import Limits, VehicleParameters
from skyloop.sim.reports import Occurrence, OccurrenceKind
from skyloop.sim.rotors import RotorBodies
from skyloop.sim.streams import Floats


class Happening(Enum):
    """Causes of state changes: first the pilot's commands, then what the vehicle itself observes."""

    TAKEOFF = auto()
    LAND = auto()
    HOVER = auto()
    SET_POINT = auto()
    STOP = auto()
    RESET = auto()  # allowed only on the ground, which the caller checks
    HEIGHT_REACHED = auto()
    TOUCHED_GROUND = auto()
    CRASHED = auto()
    BATTERY_LOW = auto()
    BATTERY_EMPTY = auto()


_S, _H = FlightState, Happening
_IN_FLIGHT = {
    _H.HOVER: _S.HOVERING,
    _H.SET_POINT: _S.FLYING,
    _H.LAND: _S.LANDING,
    _H.STOP: _S.EMERGENCY,
    _H.CRASHED: _S.EMERGENCY,
    _H.BATTERY_LOW: _S.LANDING,
    _H.BATTERY_EMPTY: _S.EMERGENCY,
}

TRANSITIONS: dict[FlightState, dict[Happening, FlightState]] = {
    _S.LANDED: {_H.TAKEOFF: _S.TAKING_OFF, _H.STOP: _S.EMERGENCY},
    _S.TAKING_OFF: {
        _H.HEIGHT_REACHED: _S.HOVERING,
        _H.LAND: _S.LANDING,
        _H.STOP: _S.EMERGENCY,
        _H.CRASHED: _S.EMERGENCY,
        _H.BATTERY_LOW: _S.LANDING,
        _H.BATTERY_EMPTY: _S.EMERGENCY,
    },
    _S.HOVERING: _IN_FLIGHT,
    _S.FLYING: _IN_FLIGHT,
    _S.LANDING: {
        _H.HOVER: _S.HOVERING,  # aborts the landing, as real autopilots do
        _H.TAKEOFF: _S.TAKING_OFF,
        _H.TOUCHED_GROUND: _S.LANDED,
        _H.STOP: _S.EMERGENCY,
        _H.CRASHED: _S.EMERGENCY,
        _H.BATTERY_EMPTY: _S.EMERGENCY,
    },
    _S.EMERGENCY: {_H.RESET: _S.LANDED},
}


def next_state(state: FlightState, happening: Happening) -> FlightState | None:
    """Return the next state, or None if the event is ignored."""
    return TRANSITIONS[state].get(happening)


class Batteries:
    """The drones' batteries."""

    def __init__(self, parameters: Sequence[VehicleParameters], charge: Floats) -> None:
        self.charge = charge.copy()  #: remaining charge, 0 to 1, (n,)
        self._capacity = column(parameters, lambda p: p.battery_charge_c)
        self._full = column(parameters, lambda p: p.battery_full_v)
        self._empty = column(parameters, lambda p: p.battery_empty_v)
        self._resistance = column(parameters, lambda p: p.battery_resistance_ohm)
        self.voltage = self.open_voltage()  #: voltage at the terminals, (n,) [V]

    def drain(self, power: Floats, period_s: float) -> None:
        """Discharge the batteries by ``power``, (n,) [W], over a period."""
        current = power / np.maximum(self.voltage, 1.0)
        np.maximum(self.charge - current * period_s / self._capacity, 0.0, out=self.charge)
        self.voltage = self.open_voltage() - current * self._resistance

    def strength(self) -> Floats:
        """Return the available fraction of a full battery's thrust, (n,): thrust grows with the voltage squared."""
        share: Floats = np.clip(self.voltage / self._full, 0.0, 1.0) ** 2
        return share

    def open_voltage(self) -> Floats:
        """Return the open-circuit voltage, (n,) [V]."""
        voltage: Floats = self._empty + (self._full - self._empty) * self.charge
        return voltage


LOW_BATTERY = 0.03  # charge below which the vehicle lands, as a fraction from 0 to 1
_HEIGHT_TOLERANCE_M = 0.08  # a take-off counts as finished at this distance below its target height
_STANDING_S = 0.05  # a drone counts as standing for this long after its last contact with the ground
_KEPT_OCCURRENCES = 1000  # maximum number of occurrences kept until they are taken


class SimAutopilot:
    """Flight states and set-points of all drones. Times are in simulation time."""

    def __init__(
        self,
        parameters: Sequence[VehicleParameters],
        limits: Sequence[Limits],
        loops: ControlLoops,
        sensors: Sensors,
        batteries: Batteries,
    ) -> None:
        self._parameters = parameters
        self.limits = list(limits)
        self._loops = loops
        self._sensors = sensors
        self._batteries = batteries
        self.states = [FlightState.LANDED for _ in parameters]
        self.reasons = ["" for _ in parameters]
        self.occurrences: deque[Occurrence] = deque(maxlen=_KEPT_OCCURRENCES)
        self._stood_s = [0.0 for _ in parameters]  # time at which each drone was last supported from below
        self._rising: dict[int, float] = {}  # drones that are taking off, with the altitude at which the take-off ends
        self._warned: set[int] = set()
        self.handed_over: set[int] = set()  #: numbers of drones flown by firmware

    def set_limits(self, drone: int, limits: Limits) -> None:
        """Change a drone's limits.

        A set-point in force is not clamped until it is sent again. The limits on climb, on altitude and on the tilt for
        a velocity take effect immediately, because the control loops enforce them.
        """
        self.limits[drone] = limits
        self._loops.set_limits(drone, limits)
        if drone not in self._rising:
            self._loops.set_ceiling(drone, limits.altitude_m)

    def command(self, drone: int, action: AnyAction, time_s: float) -> AnyAction:
        """Apply a command and return the applied action, which is :class:`Idle` if the command was ignored."""
        if isinstance(action, Takeoff):
            if self._batteries.charge[drone] <= LOW_BATTERY:
                return Idle()
            return self._advance(drone, Happening.TAKEOFF, action, time_s)
        if isinstance(action, Land):
            return self._advance(drone, Happening.LAND, action, time_s)
        if isinstance(action, Hover):
            return self._advance(drone, Happening.HOVER, action, time_s)
        if isinstance(action, EmergencyStop):
            return self._advance(drone, Happening.STOP, action, time_s, "stopped by command")
        if isinstance(action, ResetEmergency):
            if time_s - self._stood_s[drone] > _STANDING_S:
                return Idle()
            return self._advance(drone, Happening.RESET, action, time_s)
        if isinstance(action, Attitude | Velocity):
            clamped = clamp(action, self.limits[drone])
            return self._advance(drone, Happening.SET_POINT, clamped, time_s)
        return Idle()

    def hover_here(self, drone: int, altitude_m: float, time_s: float) -> None:
        """Make a flying drone hover at its new position, and reset its estimate of the wind."""
        self._loops.start(drone, altitude_m)
        self._advance(drone, Happening.HOVER, Hover(), time_s)

    def grounded(self, drone: int, time_s: float) -> bool:
        """Return whether a drone is on the ground, either landed or after falling in an emergency."""
        fallen = time_s - self._stood_s[drone] <= _STANDING_S
        return self.states[drone] is FlightState.LANDED or (self.states[drone] is FlightState.EMERGENCY and fallen)

    def hand_over(self, drone: int) -> None:
        """Hand a drone on the ground over to firmware."""
        if self.states[drone] is FlightState.EMERGENCY:
            self._loops.stop(drone)
        self.states[drone], self.reasons[drone] = FlightState.LANDED, ""
        self.handed_over.add(drone)

    def take_back(self, drone: int, time_s: float) -> None:
        """Take back control of a drone whose rotors have been stopped."""
        self.handed_over.discard(drone)
        flew, self.states[drone] = self.states[drone].airborne, FlightState.LANDED
        if flew:
            self._advance(drone, Happening.STOP, EmergencyStop(), time_s, "taken from its firmware in the air")

    def watch_firmware(self, rotors: RotorBodies, time_s: float) -> None:
        """Update the states of drones flown by firmware. Called once per step."""
        for drone in self.handed_over:
            stands = time_s - self._stood_s[drone] <= _STANDING_S and rotors.idles(drone)
            self.states[drone] = FlightState.LANDED if stands else FlightState.FLYING

    def supervise(self, time_s: float) -> None:
        """End the take-off of each drone that has reached its target height. Called once per period of the loops."""
        for drone, height in list(self._rising.items()):
            if self._sensors.altitude[drone] >= height - _HEIGHT_TOLERANCE_M:
                self._advance(drone, Happening.HEIGHT_REACHED, Hover(), time_s)

    def watch_batteries(self, time_s: float) -> None:
        """Land drones whose battery is low, and stop drones whose battery is empty. Called periodically."""
        self._loops.set_strength(self._batteries.strength())
        low = (self._batteries.charge <= LOW_BATTERY).nonzero()[0].tolist()
        self._warned.intersection_update(low)  # warn again once the battery has been changed
        for drone in low:
            if drone not in self._warned:
                self._warned.add(drone)
                left = self._batteries.charge[drone]
                self._note(OccurrenceKind.BATTERY_LOW, drone, time_s, f"battery at {left:.0%}")
            if self._batteries.charge[drone] <= 0:
                self._advance(drone, Happening.BATTERY_EMPTY, Idle(), time_s, "battery empty")
            else:
                self._advance(drone, Happening.BATTERY_LOW, Land(), time_s)

    def feel(self, contacts: Contacts, time_s: float) -> None:
        """Handle the contacts that occurred in a step."""
        for drone, speed, what in contacts.impacts:
            text = f"hit {what} at {speed:.1f} m/s"
            self._note(OccurrenceKind.COLLISION, drone, time_s, text, speed)
            if speed > self._parameters[drone].crash_speed_m_s:
                self._advance(drone, Happening.CRASHED, Idle(), time_s, text)
        for drone in contacts.standing:
            self._stand(drone, time_s)
        for drone, below in contacts.upon:
            if not self.states[below].airborne and time_s - self._stood_s[below] <= _STANDING_S:
                self._stand(drone, time_s)

    def _stand(self, drone: int, time_s: float) -> None:
        self._stood_s[drone] = time_s
        state = self.states[drone]
        if state is FlightState.LANDING:
            self._advance(drone, Happening.TOUCHED_GROUND, Idle(), time_s)
        elif state is FlightState.EMERGENCY:
            self._loops.rest(drone)

    def _advance(
        self, drone: int, happening: Happening, action: AnyAction, time_s: float, reason: str = ""
    ) -> AnyAction:
        state = next_state(self.states[drone], happening)
        if state is None or drone in self.handed_over:
            return Idle()
        before, self.states[drone] = self.states[drone], state
        if state is not before or not state.airborne or isinstance(action, Attitude | Velocity):
            self._enter(drone, state, before, action)
        self.reasons[drone] = reason if state is FlightState.EMERGENCY else ""
        if state is FlightState.EMERGENCY and before is not state:
            self._note(OccurrenceKind.EMERGENCY, drone, time_s, reason)
        return action

    def _enter(self, drone: int, state: FlightState, before: FlightState, action: AnyAction) -> None:
        """Set up the control loops for a flight state."""
        parameters, loops = self._parameters[drone], self._loops
        if state is not FlightState.TAKING_OFF and self._rising.pop(drone, None) is not None:
            loops.set_ceiling(drone, self.limits[drone].altitude_m)
        if state is FlightState.TAKING_OFF:
            self._start(drone, before)
        elif state is FlightState.HOVERING:
            loops.follow_velocity(drone, 0.0, 0.0, 0.0, 0.0)
        elif state is FlightState.LANDING:
            loops.land(drone, parameters.landing_descent_m_s)
        elif isinstance(action, Attitude):
            loops.follow_attitude(drone, action.roll, action.pitch, action.climb, action.yaw_rate)
        elif isinstance(action, Velocity):
            loops.follow_velocity(drone, action.forward, action.left, action.up, action.yaw_rate)
        elif state is FlightState.EMERGENCY:
            loops.stop(drone)
        else:  # landed
            loops.stop(drone)
            loops.rest(drone)

    def _start(self, drone: int, before: FlightState) -> None:
        limits, altitude = self.limits[drone], float(self._sensors.altitude[drone])
        # A drone may start from a platform. In the air, what is below it is unknown, so take the floor.
        ground = altitude if before is FlightState.LANDED else 0.0
        height = min(ground + limits.takeoff_altitude_m, max(limits.altitude_m, altitude))
        self._rising[drone] = height
        self._loops.set_ceiling(drone, height)
        self._loops.follow_velocity(drone, 0.0, 0.0, self._parameters[drone].takeoff_climb_m_s, 0.0)
        if before is FlightState.LANDED:
            self._loops.start(drone, altitude)

    def _note(self, kind: OccurrenceKind, drone: int, time_s: float, text: str, speed: float = 0.0) -> None:
        self.occurrences.append(Occurrence(kind, drone, time_s, text, speed))


def clamp(action: Attitude | Velocity, limits: Limits) -> Attitude | Velocity:
    """Limit a set-point. The horizontal velocity keeps its direction."""
    yaw_rate = clamped(action.yaw_rate, limits.yaw_rate_rad_s)
    if isinstance(action, Attitude):
        roll, pitch = clamped(action.roll, limits.tilt_rad), clamped(action.pitch, limits.tilt_rad)
        return Attitude(roll, pitch, clamped(action.climb, limits.climb_m_s), yaw_rate)
    speed = (action.forward**2 + action.left**2) ** 0.5
    share = min(1.0, limits.speed_m_s / speed) if speed > 0 else 1.0
    return Velocity(action.forward * share, action.left * share, clamped(action.up, limits.climb_m_s), yaw_rate)
