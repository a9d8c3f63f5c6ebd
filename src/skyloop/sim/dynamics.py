"""Dynamics of quadrotors: all drones at once, one array column each, in fixed steps."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from skyloop.sim.parameters import GRAVITY_M_S2, VehicleParameters
from skyloop.sim.streams import Floats

STEP_S = 0.004

_MOST_TILT_RAD = 1.2  # far from the singularity of Euler angles at π/2
_MOST_TILTING_AIRSPEED_M_S = 3.0  # the air tilts no further beyond: no recording is faster


def column(parameters: Sequence[VehicleParameters], value: Callable[[VehicleParameters], float]) -> Floats:
    """Return one value per drone, shape (drones,)."""
    return np.array([value(p) for p in parameters], dtype=np.float64)


class Bodies:
    """State and inputs of the bodies. Rows are axes, columns drones.

    Attributes:
        position: Of the body's centre, world axes, (3, n) [m].
        velocity: Of the body's centre, world axes, (3, n) [m/s].
        angles: Roll, pitch, yaw, (3, n) [rad]; yaw is not wrapped.
        rates: Derivatives of the angles.
        thrust: Per mass, (n,) [m/s²].
        attitude_command: Input: roll, pitch [rad] and yaw rate [rad/s], (3, n).
        thrust_command: Input: per mass, (n,).
        air: Input: velocity of the air, (3, n).
    """

    def __init__(self, parameters: Sequence[VehicleParameters], positions: Floats, yaws: Floats) -> None:
        n = len(parameters)
        self.position = positions.copy()
        self.velocity = np.zeros((3, n))
        self.velocity_before = np.zeros((3, n))
        self.angles = np.zeros((3, n))
        self.angles[2] = yaws
        self.rates = np.zeros((3, n))
        self.thrust = np.zeros(n)
        self.attitude_command = np.zeros((3, n))
        self.thrust_command = np.zeros(n)
        self.air = np.zeros((3, n))
        self.sin = np.sin(self.angles)
        self.cos = np.cos(self.angles)
        self._set_constants(parameters)
        self._a, self._b = np.empty((3, n)), np.empty((3, n))
        self._c, self._d = np.empty(n), np.empty(n)

    def _set_constants(self, parameters: Sequence[VehicleParameters]) -> None:
        frequency = column(parameters, lambda p: p.attitude_frequency_rad_s)
        damping = column(parameters, lambda p: p.attitude_damping)
        yaw_rate = 1.0 / column(parameters, lambda p: p.yaw_time_constant_s)
        ones, zeros = np.ones_like(frequency), np.zeros_like(frequency)
        # One formula for all three axes: change of rate = stiffness (command - held · angle) - damping · rate. In yaw
        # the angle isn't held, and the command is a rate.
        self._held = np.array([ones, ones, zeros])
        self._stiff = np.array([frequency**2, frequency**2, yaw_rate]) * STEP_S
        self._damp = np.array([2 * damping * frequency, 2 * damping * frequency, yaw_rate]) * STEP_S
        self._stiff_running = self._stiff.copy()
        self._most_change = np.tile(column(parameters, lambda p: p.most_angular_acceleration_rad_s2), (3, 1)) * STEP_S
        self._least_change = -self._most_change
        self._motor_share = 1.0 - np.exp(-STEP_S / column(parameters, lambda p: p.motor_time_constant_s))
        linear = column(parameters, lambda p: p.linear_drag_per_s)
        quadratic = column(parameters, lambda p: p.quadratic_drag_per_m)
        self._linear = np.array([linear, linear, column(parameters, lambda p: p.vertical_linear_drag_per_s)])
        self._quadratic = np.array(
            [quadratic, quadratic, column(parameters, lambda p: p.vertical_quadratic_drag_per_m)]
        )
        self._airspeed_tilt = column(parameters, lambda p: p.airspeed_tilt_rad_s2_per_m2)
        self._any_airspeed_tilt = bool(self._airspeed_tilt.any())
        self._rotor_height = column(parameters, lambda p: p.rotor_height_m)
        self._rotor_offset = column(parameters, lambda p: p.rotor_height_m - p.half_height_m)
        self._ground_effect = column(parameters, lambda p: p.ground_effect**0.5 * p.rotor_radius_m / 4)

    def cut(self, drone: int) -> None:
        """Stop the motors: nothing holds the attitude any more."""
        self._stiff[:, drone] = 0.0
        self.attitude_command[:, drone] = 0.0
        self.thrust_command[drone] = 0.0

    def steady(self, drone: int) -> None:
        """Hold the attitude again, by running motors or by legs on the ground."""
        self._stiff[:, drone] = self._stiff_running[:, drone]

    def put(self, drone: int, position_m: Floats, yaw_rad: float, thrust: float) -> None:
        """Move a body, level and at rest; ``position_m`` has shape (3,), ``thrust`` is an acceleration [m/s²]."""
        self.position[:, drone] = position_m
        for still in (self.velocity, self.velocity_before, self.angles, self.rates):
            still[:, drone] = 0.0
        self.angles[2, drone] = yaw_rad
        self.thrust[drone] = self.thrust_command[drone] = thrust
        np.sin(self.angles, out=self.sin)
        np.cos(self.angles, out=self.cos)

    def step(self) -> None:
        """Advance by :data:`STEP_S`, without collisions."""
        self._turn()
        acceleration = self._accelerate()
        np.copyto(self.velocity_before, self.velocity)
        np.multiply(acceleration, STEP_S, out=acceleration)
        np.add(self.velocity, acceleration, out=self.velocity)
        np.multiply(self.velocity, STEP_S, out=acceleration)
        np.add(self.position, acceleration, out=self.position)

    def _turn(self) -> None:
        change, other = self._a, self._b
        np.multiply(self._held, self.angles, out=change)
        np.subtract(self.attitude_command, change, out=change)
        if self._any_airspeed_tilt:
            change[:2] += self._tilt_by_airspeed()
        np.multiply(change, self._stiff, out=change)
        np.multiply(self.rates, self._damp, out=other)
        np.subtract(change, other, out=change)
        np.minimum(change, self._most_change, out=change)
        np.maximum(change, self._least_change, out=change)
        np.add(self.rates, change, out=self.rates)
        np.multiply(self.rates, STEP_S, out=other)
        np.add(self.angles, other, out=self.angles)
        tilts = self.angles[:2]
        np.minimum(tilts, _MOST_TILT_RAD, out=tilts)
        np.maximum(tilts, -_MOST_TILT_RAD, out=tilts)
        np.sin(self.angles, out=self.sin)
        np.cos(self.angles, out=self.cos)

    def _tilt_by_airspeed(self) -> Floats:
        """Roll and pitch that the air adds to what is commanded, shape (2, n): the leading side goes up."""
        east, north = self.velocity[:2] - self.air[:2]
        sin_yaw, cos_yaw = self.sin[2], self.cos[2]
        forward, left = cos_yaw * east + sin_yaw * north, cos_yaw * north - sin_yaw * east
        speed = np.hypot(east, north)
        slowed = np.minimum(speed, _MOST_TILTING_AIRSPEED_M_S) ** 2 / np.maximum(speed, 1e-9)
        tilt: Floats = np.array([left, -forward]) * (self._airspeed_tilt * slowed)
        return tilt

    def _accelerate(self) -> Floats:
        lift = self._lift()
        total, drag = self._a, self._b
        sin_roll, sin_pitch, sin_yaw = self.sin
        cos_roll, cos_pitch, cos_yaw = self.cos
        x, y, z = total
        # The third column of Rz(yaw) Ry(pitch) Rx(roll).
        forward, side = self._d, drag[0]
        np.multiply(sin_pitch, cos_roll, out=forward)
        np.multiply(cos_yaw, forward, out=x)
        np.multiply(sin_yaw, sin_roll, out=side)
        np.add(x, side, out=x)
        np.multiply(sin_yaw, forward, out=y)
        np.multiply(cos_yaw, sin_roll, out=side)
        np.subtract(y, side, out=y)
        np.multiply(cos_pitch, cos_roll, out=z)
        np.multiply(total, lift, out=total)
        np.subtract(z, GRAVITY_M_S2, out=z)

        np.subtract(self.velocity, self.air, out=drag)
        squares = drag * drag
        airspeed = np.sqrt(squares[0] + squares[1] + squares[2])
        np.multiply(self._quadratic, airspeed, out=squares)
        np.add(squares, self._linear, out=squares)
        np.multiply(drag, squares, out=drag)
        np.subtract(total, drag, out=total)
        return total

    def _lift(self) -> Floats:
        """Thrust with the motors' lag, raised near the floor by 1 / (1 - (R / 4h)²): Cheeseman and Bennett 1955."""
        lift, shortfall = self._c, self._d
        np.subtract(self.thrust_command, self.thrust, out=lift)
        np.multiply(lift, self._motor_share, out=lift)
        np.add(self.thrust, lift, out=self.thrust)
        np.add(self.position[2], self._rotor_offset, out=shortfall)
        np.maximum(shortfall, self._rotor_height, out=shortfall)
        np.divide(self._ground_effect, shortfall, out=shortfall)
        np.multiply(shortfall, shortfall, out=shortfall)
        np.subtract(1.0, shortfall, out=shortfall)
        return np.divide(self.thrust, shortfall, out=lift)


def specific_force(bodies: Bodies) -> Floats:
    """Return what ideal accelerometers on the drones measure, body axes, shape (3, n) [m/s²]: at rest, +g along z."""
    change = (bodies.velocity - bodies.velocity_before) / STEP_S
    change[2] += GRAVITY_M_S2
    force: Floats = np.einsum("nji,jn->in", rotations(bodies.sin, bodies.cos), change)
    return force


def body_rates(bodies: Bodies) -> Floats:
    """Return angular velocities about the bodies' axes, shape (3, n) [rad/s], from the rates of the Euler angles."""
    roll_rate, pitch_rate, yaw_rate = bodies.rates
    sin_roll, sin_pitch, _ = bodies.sin
    cos_roll, cos_pitch, _ = bodies.cos
    return np.array(
        [
            roll_rate - yaw_rate * sin_pitch,
            pitch_rate * cos_roll + yaw_rate * sin_roll * cos_pitch,
            -pitch_rate * sin_roll + yaw_rate * cos_roll * cos_pitch,
        ]
    )


def rotations(sin: Floats, cos: Floats) -> Floats:
    """Return world-from-body rotations, (n, 3, 3), from sines and cosines of roll, pitch, yaw, each (3, n)."""
    sr, sp, sy = sin
    cr, cp, cy = cos
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), 2, 0)
