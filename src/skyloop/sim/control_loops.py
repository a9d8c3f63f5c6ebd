"""The firmware's state estimates, and its outer loops, which turn set-points and estimates into attitude and thrust.

Estimates are the truth with noise and slowly wandering biases. The loops' formulas work both for the numbers of one
drone and for arrays of all drones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from skyloop.sim.dynamics import ARRAYS, NUMBERS, BodyTable, Fields, N, Operations, column, columns, few
from skyloop.sim.parameters import GRAVITY_M_S2, Limits, VehicleParameters
from skyloop.sim.streams import Floats, NormalBlocks, Purpose, stream

_Value = Callable[[VehicleParameters], float]

# Rows of the biases: gyro 0-2, accelerometer 3-5, roll, pitch, yaw 6-8, altitude 9, velocity 10-12.
_BIASES: tuple[_Value, ...] = (
    *[lambda p: p.gyro_bias_rad_s] * 3,
    *[lambda p: p.accelerometer_bias_m_s2] * 3,
    *[lambda p: p.tilt_bias_rad] * 2,
    lambda p: p.yaw_bias_rad,
    lambda p: p.altitude_bias_m,
    *[lambda p: p.velocity_bias_m_s] * 3,
)
_INERTIAL_NOISE: tuple[_Value, ...] = (
    *[lambda p: p.gyro_noise_rad_s] * 3,
    *[lambda p: p.accelerometer_noise_m_s2] * 3,
    *[lambda p: p.tilt_noise_rad] * 2,
    lambda p: p.yaw_noise_rad,
)
_ESTIMATE_NOISE: tuple[_Value, ...] = (lambda p: p.altitude_noise_m, *[lambda p: p.velocity_noise_m_s] * 3)


class Sensors:
    """The sensors of all drones."""

    def __init__(
        self, parameters: Sequence[VehicleParameters], bodies: BodyTable, seed: int, bias_period_s: float
    ) -> None:
        n = len(parameters)
        self._bodies = bodies
        self._seed = seed
        self._half_height = column(parameters, lambda p: p.half_height_m)
        self._inertial_noise = _rows(parameters, _INERTIAL_NOISE)
        self._estimate_noise = _rows(parameters, _ESTIMATE_NOISE)
        self._normals = NormalBlocks(seed, Purpose.ESTIMATES, 4, n)
        deviation = _rows(parameters, _BIASES)
        self._bias_normals = NormalBlocks(seed, Purpose.BIASES, len(_BIASES), n, ahead=16)
        self._bias_keep = np.exp(-bias_period_s / column(parameters, lambda p: p.bias_time_constant_s))
        self._bias_fresh = deviation * np.sqrt(1.0 - self._bias_keep**2)
        self._bias: Floats = deviation * self._bias_normals.take()
        self._inertial = np.empty((9, n))
        self._inertial_step = -1
        self._estimate = columns(4, n)
        self.altitude: Floats = self._estimate[0]  #: height of the feet above the floor, (n,) [m]
        self.velocity: Floats = self._estimate[1:]  #: velocity forward, left, up in levelled axes, (3, n) [m/s]
        self._few = few(n)
        if self._few:
            self.numbers = Fields(self._estimate, 0, 4)  #: altitude and velocity, used if there are few drones
            self._each = list(enumerate(self._half_height.tolist()))
        self.estimate()

    def wander(self) -> None:
        """Advance the biases by one period."""
        np.multiply(self._bias, self._bias_keep, out=self._bias)
        np.add(self._bias, self._bias_fresh * self._bias_normals.take(), out=self._bias)

    def estimate(self) -> None:
        """Measure the altitude and velocity."""
        bodies = self._bodies
        if self._few:
            for drone, half_height in self._each:
                sin_yaw, _, _, cos_yaw = bodies.turned.read[drone]()
                z, *velocity = bodies.moved.read[drone]()
                self.numbers.write[drone](z - half_height, *_levelled(velocity, sin_yaw, cos_yaw))
        else:
            np.subtract(bodies.position[2], self._half_height, out=self.altitude)
            for row, values in zip(
                self.velocity, _levelled(bodies.velocity, bodies.sin[2], bodies.cos[2]), strict=True
            ):
                row[:] = values
        np.add(self._estimate, self._bias[9:], out=self._estimate)
        np.add(self._estimate, self._estimate_noise * self._normals.take(), out=self._estimate)

    def put(self, drone: int) -> None:
        """Replace a drone's estimate after it was moved and put at rest: the old one is for another position."""
        height = self._bodies.position[2, drone] - self._half_height[drone]
        self._estimate[:, drone] = self._bias[9:, drone]
        self._estimate[0, drone] += height

    def inertial(self, step: int) -> Floats:
        """Return the inertial sensors' values at the end of a step, shape (9, n).

        Rows are gyro [rad/s] and accelerometer [m/s²] in body axes, and roll, pitch, yaw [rad] (yaw is not wrapped).
        They are computed once per step for all drones.
        """
        if step != self._inertial_step:
            bodies = self._bodies
            # Draw for one drone after another, so that adding drones doesn't change the noise of the earlier ones.
            normals = stream(self._seed, Purpose.INERTIAL, step).standard_normal(self._inertial_noise.shape[::-1]).T
            truth = np.concatenate([bodies.body_rates(), bodies.specific_force(), bodies.angles])
            self._inertial = truth + self._bias[:9] + self._inertial_noise * normals
            self._inertial_step = step
        return self._inertial


def _levelled(velocity: N, sin_yaw: N, cos_yaw: N) -> tuple[N, N, N]:
    """Convert a velocity from world axes to forward, left, up."""
    vx, vy, vz = velocity
    return cos_yaw * vx + sin_yaw * vy, cos_yaw * vy - sin_yaw * vx, vz


def _rows(parameters: Sequence[VehicleParameters], values: Sequence[_Value]) -> Floats:
    return np.array([column(parameters, value) for value in values])


_REFERENCE_LEAD_M = 0.5  # maximum lead of the altitude reference over the vehicle
_HELD_M = 0.25  # minimum distance above its expected descent at which a landing drone is considered held up
_HELD_CLIMB_M_S = 0.15  # maximum climb rate at which a drone counts as held up; a faster drone is simply still rising
_HELD_EASE_PER_S2 = 8.0  # reduction of thrust per metre that the drone is further behind
_HELD_REGAIN = 4.0  # the lag shrinks this many times as fast, so that the drone doesn't drop when it is released
_INTEGRATED_ERROR_M_S = 0.25  # limit for the integrated error, so that braking does not wind up the integral
_MOST_INTEGRAL_M_S2 = 3.0  # limit of the integral, which applies when a wall holds the drone back


_ROWS = 15  # rows of the table: set-points, limits and the loops' state
_STATE = 11  # first row of the loops' state
_LANDING = 10  # index of the row whose values are greater than 0 while landing


@dataclass(frozen=True, slots=True)
class _Gains:
    """Gains of one drone or of all drones."""

    velocity: N
    integral: N
    level_brake: N
    altitude: N
    climb: N
    least_thrust: N


class ControlLoops:
    """Set-points and state of the loops, one column per drone. The flight logic writes these between updates."""

    def __init__(
        self, parameters: Sequence[VehicleParameters], limits: Sequence[Limits], bodies: BodyTable, period_s: float
    ) -> None:
        n = len(parameters)
        self._bodies = bodies
        self._period_s = period_s
        table = columns(_ROWS, n)
        self._set_point = table[:4]  # forward and left, or roll and pitch; then climb and yaw rate
        self._tilt_limit, self._climb_limit, self._ceiling, self.most_thrust = table[4:8]
        self._running, self._by_velocity, self._landing = table[8:11]  # 1 or 0
        # The last row is the height of a landing drone above its expected descent.
        self._reference, self._integral, self._behind = table[11], table[12:14], table[14]
        self._rows = tuple(table)
        self._by_velocity[:] = 1.0
        brake = column(parameters, lambda p: p.level_brake_per_s) / GRAVITY_M_S2
        self._any_level_brake = bool(brake.any())
        self._gains = _Gains(
            velocity=column(parameters, lambda p: p.velocity_gain_per_s),
            integral=column(parameters, lambda p: p.velocity_integral_per_s2) * period_s,
            level_brake=brake,
            altitude=column(parameters, lambda p: p.altitude_gain_per_s),
            climb=column(parameters, lambda p: p.climb_gain_per_s),
            least_thrust=column(parameters, lambda p: p.least_thrust) * GRAVITY_M_S2,
        )
        self._full_thrust = column(parameters, lambda p: p.most_thrust) * GRAVITY_M_S2
        self.most_thrust[:] = self._full_thrust
        for drone, limit in enumerate(limits):
            self.set_limits(drone, limit)
            self.set_ceiling(drone, limit.altitude_m)
        self._few = few(n)
        if self._few:
            gains = self._gains
            rows = (gains.velocity, gains.integral, gains.level_brake, gains.altitude, gains.climb, gains.least_thrust)
            self._each = [(drone, _Gains(*one)) for drone, one in enumerate(np.array(rows).T.tolist())]
            self._inputs, self._state = Fields(table, 0, _ROWS), Fields(table, _STATE, _ROWS - _STATE)

    def set_limits(self, drone: int, limits: Limits) -> None:
        """Change a drone's limits."""
        self._tilt_limit[drone] = limits.tilt_rad
        self._climb_limit[drone] = limits.climb_m_s

    def set_ceiling(self, drone: int, altitude_m: float) -> None:
        """Set the maximum altitude of the reference [m]."""
        self._ceiling[drone] = altitude_m

    def set_strength(self, share: Floats) -> None:
        """Set the available fraction of the full thrust, (n,)."""
        np.multiply(self._full_thrust, share, out=self.most_thrust)

    def follow_velocity(self, drone: int, forward: float, left: float, climb: float, yaw_rate: float) -> None:
        """Follow a velocity in levelled body axes [m/s], with a yaw rate [rad/s]."""
        self._set_point[:, drone] = (forward, left, climb, yaw_rate)
        self._by_velocity[drone] = 1.0
        self._landing[drone] = 0.0

    def follow_attitude(self, drone: int, roll: float, pitch: float, climb: float, yaw_rate: float) -> None:
        """Follow an attitude: roll (right side down) and pitch (nose down) [rad], climb [m/s], yaw rate [rad/s]."""
        self._set_point[:, drone] = (roll, pitch, climb, yaw_rate)
        self._by_velocity[drone] = 0.0
        self._landing[drone] = 0.0

    def land(self, drone: int, descent_m_s: float) -> None:
        """Descend on the spot, regardless of the set-point in force."""
        self.follow_velocity(drone, 0.0, 0.0, -descent_m_s, 0.0)
        self._landing[drone] = 1.0
        self._behind[drone] = 0.0

    def start(self, drone: int, altitude_m: float) -> None:
        """Start the motors, with the altitude reference set to ``altitude_m``, the estimated altitude."""
        self._running[drone] = 1.0
        self._reference[drone] = altitude_m
        self._integral[:, drone] = 0.0
        self._bodies.steady(drone)

    def stop(self, drone: int) -> None:
        """Stop the motors."""
        self._running[drone] = 0.0
        self._landing[drone] = 0.0
        self._bodies.cut(drone)

    def rest(self, drone: int) -> None:
        """Rest on the legs, which keep the body level."""
        self._bodies.steady(drone)

    def update(self, sensors: Sensors) -> None:
        """Compute the inputs to the attitude loops and motors for one period."""
        bodies = self._bodies
        turned: Sequence[N]
        estimate: Sequence[N]
        if self._few:
            for drone, gains in self._each:
                inputs = self._inputs.read[drone]()
                turned, estimate = bodies.turned.read[drone](), sensors.numbers.read[drone]()
                commands, state = self._commands(NUMBERS, gains, inputs, turned, estimate, inputs[_LANDING] > 0.0)
                bodies.commands.write[drone](*commands)
                self._state.write[drone](*state)
        else:
            turned, estimate = (bodies.sin[2], *bodies.cos), (sensors.altitude, *sensors.velocity)
            landing = bool(self._landing.any())
            commands, state = self._commands(ARRAYS, self._gains, self._rows, turned, estimate, landing)
            for row, values in zip((*bodies.attitude_command, bodies.thrust_command), commands, strict=True):
                row[:] = values
            for row, values in zip(self._rows[_STATE:], state, strict=True):
                row[:] = values

    def _commands(
        self,
        do: Operations,
        gains: _Gains,
        inputs: Sequence[N],
        turned: Sequence[N],
        estimate: Sequence[N],
        landing: bool,
    ) -> tuple[tuple[N, N, N, N], tuple[N, N, N, N]]:
        """Return roll, pitch, yaw rate, thrust and the loops' state after the period."""
        first, second, climb, yaw_rate, tilt_limit, climb_limit, *rest = inputs
        ceiling, most_thrust, running, by_velocity, held, reference, east, north, behind = rest
        sin_yaw, cos_roll, cos_pitch, cos_yaw = turned
        altitude, forward, left, climbing = estimate
        period, least_tilt = self._period_s, -tilt_limit

        # Compute roll and pitch from the velocity error. The integral is in world axes, where yaw does not affect wind.
        ahead, aside = first - forward, second - left
        learn = gains.integral * running * by_velocity
        most, limit = _MOST_INTEGRAL_M_S2, _INTEGRATED_ERROR_M_S
        east = east + learn * do.least(do.most(cos_yaw * ahead - sin_yaw * aside, -limit), limit)
        north = north + learn * do.least(do.most(sin_yaw * ahead + cos_yaw * aside, -limit), limit)
        east, north = do.most(do.least(east, most), -most), do.most(do.least(north, most), -most)
        lean = gains.velocity * ahead + cos_yaw * east + sin_yaw * north
        pitch = do.least(do.most(lean / GRAVITY_M_S2, least_tilt), tilt_limit)
        lean = gains.velocity * aside - sin_yaw * east + cos_yaw * north
        roll = do.least(do.most(lean / -GRAVITY_M_S2, least_tilt), tilt_limit)
        if self._any_level_brake:  # drones under attitude control lean against their direction of motion
            brake = gains.level_brake
            first = first + _brake(do, left * brake, first, tilt_limit)
            second = second + _brake(do, -forward * brake, second, tilt_limit)
        flies = by_velocity > 0.0
        roll, pitch = do.choose(flies, roll, first), do.choose(flies, pitch, second)

        reference = do.least(reference + climb * period, altitude + _REFERENCE_LEAD_M)
        reference = do.least(do.most(reference, altitude - _REFERENCE_LEAD_M), ceiling)
        wanted = climb * (reference < ceiling) + gains.altitude * (reference - altitude)
        wanted = do.least(do.most(wanted, -climb_limit), climb_limit)
        upward = GRAVITY_M_S2 + gains.climb * (wanted - climbing)
        if landing:
            behind = self._fall_behind(do, climbing, do.most(climb, -climb_limit), behind) * held
            upward = upward - _HELD_EASE_PER_S2 * do.most(behind - _HELD_M, 0.0)
        thrust = do.least(do.most(upward / (cos_roll * cos_pitch), gains.least_thrust), most_thrust)
        commands = roll * running, pitch * running, yaw_rate * running, thrust * running
        return commands, (reference, east, north, behind)

    def _fall_behind(self, do: Operations, climbing: N, descent: N, behind: N) -> N:
        """Return how far a landing drone that is held up lags behind its descent [m]; this lag reduces its thrust."""
        error = climbing - descent
        held = do.choose(error > 0, error * (climbing < _HELD_CLIMB_M_S), _HELD_REGAIN * error)
        most = _HELD_M + GRAVITY_M_S2 / _HELD_EASE_PER_S2
        return do.least(do.most(behind + held * self._period_s, 0.0), most)


def _brake(do: Operations, lean: N, set_point: N, tilt_limit: N) -> N:
    """Return the additional lean against the motion on one axis, beyond the set-point."""
    share = do.most(1.0 - abs(set_point) / tilt_limit, 0.0)
    return do.least(do.most(lean, -tilt_limit), tilt_limit) * share
