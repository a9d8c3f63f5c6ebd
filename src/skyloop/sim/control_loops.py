"""The firmware's outer loops: from set-points and estimates to attitude and thrust, for all drones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from skyloop.sim.dynamics import Bodies, column
from skyloop.sim.parameters import GRAVITY_M_S2, Limits, VehicleParameters
from skyloop.sim.sensors import Sensors
from skyloop.sim.streams import Floats

_REFERENCE_LEAD_M = 0.5  # the altitude reference waits for a vehicle that can't follow
_HELD_M = 0.25  # so far behind its descent, a landing drone counts as held
_HELD_CLIMB_M_S = 0.15  # what climbs faster isn't held, but on its way
_HELD_EASE_PER_S2 = 8.0  # of thrust, for each metre further behind
_HELD_REGAIN = 4.0  # how much faster it counts as free again, or it would drop when nothing holds it any more
_INTEGRATED_ERROR_M_S = 0.25  # larger errors count as this: braking from speed must not wind the integral up
_MOST_INTEGRAL_M_S2 = 3.0  # a drone that is held by a wall stops learning here


class ControlLoops:
    """Set-points and state of the loops, one column per drone. Written by the flight logic between updates."""

    def __init__(
        self, parameters: Sequence[VehicleParameters], limits: Sequence[Limits], bodies: Bodies, period_s: float
    ) -> None:
        n = len(parameters)
        self._bodies = bodies
        self._period_s = period_s
        self._set_point = np.zeros((4, n))  # forward and left, or roll and pitch; climb; yaw rate
        self._by_velocity = np.ones(n, dtype=np.bool_)
        self._running = np.zeros(n)
        self._reference = np.zeros(n)
        self._ceiling = np.zeros(n)
        self._integral = np.zeros((2, n))
        self._landing = np.zeros(n, dtype=np.bool_)
        self._behind = np.zeros(n)  # how far a landing drone is above where its descent should have brought it
        self._velocity_gain = column(parameters, lambda p: p.velocity_gain_per_s)
        self._integral_gain = column(parameters, lambda p: p.velocity_integral_per_s2) * period_s
        self._level_brake = column(parameters, lambda p: p.level_brake_per_m) / GRAVITY_M_S2
        self._any_level_brake = bool(self._level_brake.any())
        self._altitude_gain = column(parameters, lambda p: p.altitude_gain_per_s)
        self._climb_gain = column(parameters, lambda p: p.climb_gain_per_s)
        self._least_thrust = column(parameters, lambda p: p.least_thrust) * GRAVITY_M_S2
        self._full_thrust = column(parameters, lambda p: p.most_thrust) * GRAVITY_M_S2
        self.most_thrust = self._full_thrust.copy()
        self._tilt_limit = np.zeros(n)
        self._climb_limit = np.zeros(n)
        for drone, limit in enumerate(limits):
            self.set_limits(drone, limit)
            self.set_ceiling(drone, limit.altitude_m)

    def set_limits(self, drone: int, limits: Limits) -> None:
        """Change a drone's limits."""
        self._tilt_limit[drone] = limits.tilt_rad
        self._climb_limit[drone] = limits.climb_m_s

    def set_ceiling(self, drone: int, altitude_m: float) -> None:
        """Set the greatest altitude of the reference [m]."""
        self._ceiling[drone] = altitude_m

    def set_strength(self, share: Floats) -> None:
        """Set the share of the full thrust that is left, (n,)."""
        np.multiply(self._full_thrust, share, out=self.most_thrust)

    def follow_velocity(self, drone: int, forward: float, left: float, climb: float, yaw_rate: float) -> None:
        """Follow a velocity: levelled body axes [m/s], yaw rate [rad/s]."""
        self._set_point[:, drone] = (forward, left, climb, yaw_rate)
        self._by_velocity[drone] = True
        self._landing[drone] = False

    def follow_attitude(self, drone: int, roll: float, pitch: float, climb: float, yaw_rate: float) -> None:
        """Follow an attitude: roll right side down, pitch nose down [rad], climb [m/s], yaw rate [rad/s]."""
        self._set_point[:, drone] = (roll, pitch, climb, yaw_rate)
        self._by_velocity[drone] = False
        self._landing[drone] = False

    def land(self, drone: int, descent_m_s: float) -> None:
        """Descend on the spot, whatever set-point was in force."""
        self.follow_velocity(drone, 0.0, 0.0, -descent_m_s, 0.0)
        self._landing[drone] = True
        self._behind[drone] = 0.0

    def start(self, drone: int, altitude_m: float) -> None:
        """Start the motors, with the altitude reference at ``altitude_m``, the estimated altitude."""
        self._running[drone] = 1.0
        self._reference[drone] = altitude_m
        self._integral[:, drone] = 0.0
        self._bodies.steady(drone)

    def stop(self, drone: int) -> None:
        """Stop the motors."""
        self._running[drone] = 0.0
        self._landing[drone] = False
        self._bodies.cut(drone)

    def rest(self, drone: int) -> None:
        """Rest on the legs, which hold the body level."""
        self._bodies.steady(drone)

    def update(self, sensors: Sensors) -> None:
        """Compute the commands of the attitude loops and motors for one period."""
        command = self._bodies.attitude_command
        roll, pitch = self._level_tilts(sensors.velocity)
        np.copyto(command[:2], self._set_point[:2])
        if self._any_level_brake:
            command[:2] += self._level_brakes(sensors.velocity)
        np.copyto(command[0], roll, where=self._by_velocity)
        np.copyto(command[1], pitch, where=self._by_velocity)
        np.copyto(command[2], self._set_point[3])
        np.multiply(command, self._running, out=command)
        self._lift(sensors)

    def _level_tilts(self, velocity: Floats) -> tuple[Floats, Floats]:
        """Roll and pitch that bring the horizontal velocity to the set-point."""
        sin_yaw, cos_yaw = self._bodies.sin[2], self._bodies.cos[2]
        forward, left = self._set_point[:2] - velocity[:2]
        east, north = self._integral
        learn = self._integral_gain * self._running * self._by_velocity
        limit = _INTEGRATED_ERROR_M_S
        east += learn * np.minimum(np.maximum(cos_yaw * forward - sin_yaw * left, -limit), limit)
        north += learn * np.minimum(np.maximum(sin_yaw * forward + cos_yaw * left, -limit), limit)
        np.minimum(self._integral, _MOST_INTEGRAL_M_S2, out=self._integral)
        np.maximum(self._integral, -_MOST_INTEGRAL_M_S2, out=self._integral)
        ahead = self._velocity_gain * forward + cos_yaw * east + sin_yaw * north
        aside = self._velocity_gain * left - sin_yaw * east + cos_yaw * north
        most = self._tilt_limit
        pitch = np.minimum(np.maximum(ahead / GRAVITY_M_S2, -most), most)
        roll = np.minimum(np.maximum(aside / -GRAVITY_M_S2, -most), most)
        return roll, pitch

    def _level_brakes(self, velocity: Floats) -> Floats:
        """Roll and pitch against the speed, to be added to the set-points of drones that fly by attitude."""
        forward, left = velocity[:2]
        lean = np.array([left, -forward]) * (self._level_brake * np.hypot(forward, left))
        most = self._tilt_limit
        share = np.maximum(1.0 - np.abs(self._set_point[:2]) / most, 0.0)
        braked: Floats = np.minimum(np.maximum(lean, -most), most) * share
        return braked

    def _lift(self, sensors: Sensors) -> None:
        altitude, climbing = sensors.altitude, sensors.velocity[2]
        climb = self._set_point[2]
        reference = self._reference
        reference += climb * self._period_s
        np.minimum(reference, altitude + _REFERENCE_LEAD_M, out=reference)
        np.maximum(reference, altitude - _REFERENCE_LEAD_M, out=reference)
        np.minimum(reference, self._ceiling, out=reference)
        wanted = climb * (reference < self._ceiling) + self._altitude_gain * (reference - altitude)
        wanted = np.minimum(np.maximum(wanted, -self._climb_limit), self._climb_limit)
        upward = GRAVITY_M_S2 + self._climb_gain * (wanted - climbing)
        if self._landing.any():
            upward -= self._ease(climbing)
        thrust = upward / (self._bodies.cos[0] * self._bodies.cos[1])
        thrust = np.minimum(np.maximum(thrust, self._least_thrust), self.most_thrust)
        np.multiply(thrust, self._running, out=self._bodies.thrust_command)

    def _ease(self, climbing: Floats) -> Floats:
        """How much less thrust a landing drone takes that does not get down [m/s²]."""
        error = climbing - np.maximum(self._set_point[2], -self._climb_limit)
        change = np.where(error > 0, error * (climbing < _HELD_CLIMB_M_S), _HELD_REGAIN * error)
        most = _HELD_M + GRAVITY_M_S2 / _HELD_EASE_PER_S2
        behind = np.minimum(np.maximum(self._behind + change * self._period_s, 0.0), most)
        np.multiply(behind, self._landing, out=self._behind)
        eased: Floats = _HELD_EASE_PER_S2 * np.maximum(self._behind - _HELD_M, 0.0)
        return eased
