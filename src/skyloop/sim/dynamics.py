"""Dynamics of quadrotors and wind in fixed steps: arrays for many drones at once, or plain numbers for a few.

NumPy takes as long for three numbers as it takes for three hundred. A few drones are therefore faster one at a time in
plain floats, and many drones are faster together in arrays. Both ways give the same bits, because they perform the same
operations in the same order and both use NumPy's sines and cosines; ``tests/sim/test_columns.py`` checks this.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from struct import Struct
from typing import Any, Final, TypeAlias

import numpy as np

from skyloop.sim.parameters import GRAVITY_M_S2, VehicleParameters
from skyloop.sim.streams import Floats, NormalBlocks, Purpose
from skyloop.sim.world import Wind

N: TypeAlias = Any  #: a number for one drone, or an array with one number per drone
FEW = 3  #: maximum number of drones that are computed one at a time


def few(drones: int) -> bool:
    """Return whether this number of drones is computed one at a time."""
    return drones <= FEW


def columns(rows: int, drones: int) -> Floats:
    """Return zeros of shape (rows, drones), in the memory layout for this number of drones."""
    return np.zeros((drones, rows)).T if few(drones) else np.zeros((rows, drones))


class Fields:
    """Plain floats in consecutive rows of an array made by :func:`columns` for a few drones."""

    def __init__(self, table: Floats, first: int, count: int) -> None:
        rows, drones = table.shape
        memory = memoryview(table.T).cast("B")  # type: ignore[arg-type]
        offsets = [(drone * rows + first) * table.itemsize for drone in range(drones)]
        numbers = Struct(f"{count}d")
        #: one function per drone that returns the drone's numbers
        self.read: list[Callable[[], tuple[float, ...]]] = [partial(numbers.unpack_from, memory, at) for at in offsets]
        #: one function per drone, which replaces its numbers with the same number of values
        self.write: list[Callable[..., None]] = [partial(numbers.pack_into, memory, at) for at in offsets]


@dataclass(frozen=True, slots=True)
class Operations:
    """Operations that differ between numbers and arrays, so that one formula can be used for both."""

    least: Callable[[N, N], N]  #: the smaller of two values
    most: Callable[[N, N], N]  #: the larger of two values
    root: Callable[[N], N]  #: the square root
    choose: Callable[[N, N, N], N]  #: the second value where the first one is true, and the third value elsewhere


NUMBERS: Final = Operations(min, max, math.sqrt, lambda condition, one, other: one if condition else other)
ARRAYS: Final = Operations(np.minimum, np.maximum, np.sqrt, np.where)


STEP_S = 0.004  # time step of the simulation (250 Hz)

# Stored as arrays because NumPy computes faster with arrays than with Python numbers.
_STEP, _GRAVITY, _ONE = np.array(STEP_S), np.array(GRAVITY_M_S2), np.array(1.0)
_ROWS = 32  # number of rows in the table of a body's state and inputs
_MOST_TILT_RAD = 1.2  # far from the singularity of Euler angles at π/2
_MOST_TILTING_AIRSPEED_M_S = 3.0  # the additional tilt stays constant above this airspeed, which no recording exceeds


def column(parameters: Sequence[VehicleParameters], value: Callable[[VehicleParameters], float]) -> Floats:
    """Return one value per drone, shape (drones,)."""
    return np.array([value(p) for p in parameters], dtype=np.float64)


class BodyTable(ABC):
    """State and inputs of the bodies, common to all kinds of dynamics. Rows are axes, columns are drones."""

    #: Upper bound of every body's acceleration, excluding collisions.
    most_acceleration_m_s2 = 60.0  # more than thrust, gravity and drag in a headwind of 10 m/s combined

    def __init__(self, positions: Floats, yaws: Floats) -> None:
        n = len(yaws)
        table = columns(_ROWS, n)
        self._table = table
        #: Roll, pitch, yaw, (3, n) [rad], yaw not wrapped; derivatives; input: roll, pitch [rad], yaw rate [rad/s].
        self.angles, self.rates, self._stiff, self.attitude_command = (table[row : row + 3] for row in (0, 3, 6, 9))
        #: Input and actual value: thrust divided by mass, (n,) [m/s²].
        self.thrust_command, self.thrust = table[12], table[22]
        #: Sines and cosines of the angles; as an input, the velocity of the air, (3, n) [m/s].
        self.sin, self.cos, self.air = (table[row : row + 3] for row in (13, 16, 19))
        #: Position and velocity of the body's centre in world axes, (3, n) [m, m/s]; velocity before the last step.
        self.position, self.velocity, self.velocity_before = (table[row : row + 3] for row in (23, 26, 29))
        self.position[:] = positions
        self.angles[2] = yaws
        np.sin(self.angles, out=self.sin)
        np.cos(self.angles, out=self.cos)
        self._few = few(n)
        if self._few:
            #: Inputs attitude_command, thrust_command; sine of yaw, cosines of roll, pitch, yaw; height, velocity.
            self.commands, self.turned, self.moved = Fields(table, 9, 4), Fields(table, 15, 4), Fields(table, 25, 4)

    @abstractmethod
    def cut(self, drone: int) -> None:
        """Stop the motors, so that the attitude is no longer controlled."""

    @abstractmethod
    def steady(self, drone: int) -> None:
        """Hold the attitude again, because the motors are running or the legs are on the ground."""

    @abstractmethod
    def step(self) -> None:
        """Advance by :data:`STEP_S`, without collisions."""

    @abstractmethod
    def turn(self, drone: int, change_rad_s: float) -> None:
        """Change a body's turn rate about the vertical, counter-clockwise from above, starting with this step."""

    @abstractmethod
    def power(self) -> Floats:
        """Return each drone's current battery power, (n,) [W]."""

    def put(self, drone: int, position_m: Floats, yaw_rad: float, thrust: float) -> None:
        """Move a body, level and at rest; ``position_m`` has shape (3,), and ``thrust`` is an acceleration [m/s²]."""
        self.position[:, drone] = position_m
        for still in (self.velocity, self.velocity_before, self.angles, self.rates):
            still[:, drone] = 0.0
        self.angles[2, drone] = yaw_rad
        self.thrust[drone] = self.thrust_command[drone] = thrust
        np.sin(self.angles, out=self.sin)
        np.cos(self.angles, out=self.cos)

    def body_rates(self) -> Floats:
        """Return the angular velocities about the bodies' axes, (3, n) [rad/s]."""
        return np.array(body_rates(self.rates, self.sin, self.cos))

    def body_rates_of(self, drone: int) -> tuple[float, float, float]:
        """Return a drone's angular velocity about its body's axes [rad/s]."""
        p, q, r = body_rates(*(rows[:, drone].tolist() for rows in (self.rates, self.sin, self.cos)))
        return p, q, r

    def rotations(self) -> Floats:
        """Return world-from-body rotations, (n, 3, 3)."""
        return rotations(self.sin, self.cos)

    def specific_force(self) -> Floats:
        """Return the readings of ideal accelerometers in body axes, (3, n) [m/s²]: +g along z at rest."""
        change = (self.velocity - self.velocity_before) / STEP_S
        change[2] += GRAVITY_M_S2
        force: Floats = np.einsum("nji,jn->in", self.rotations(), change)
        return force


class Bodies(BodyTable):
    """Bodies whose attitude follows the command as a second-order response, with Euler angles as the state."""

    def __init__(self, parameters: Sequence[VehicleParameters], positions: Floats, yaws: Floats) -> None:
        super().__init__(positions, yaws)
        n, table = len(parameters), self._table
        self._set_constants(parameters)
        if self._few:
            self._turning, self._turned = Fields(table, 0, 12), Fields(table, 0, 6)
            self._moving, self._moved = Fields(table, 12, 17), Fields(table, 22, 10)
            self._each = list(enumerate(self._constants()))
        else:
            # Create a step's views and constants only once, because creating them takes as long as computing with them.
            self._a, self._b, self._squares = (np.empty((3, n)) for _ in range(3))
            self._a_rows, self._b_rows, self._square_rows = tuple(self._a), tuple(self._b), tuple(self._squares)
            self._c, self._d = np.empty(n), np.empty(n)
            self._tilts = self.angles[:2]
            self._most_tilt, self._least_tilt = np.full((2, n), _MOST_TILT_RAD), np.full((2, n), -_MOST_TILT_RAD)
            self._sines_and_cosines = (*self.sin, *self.cos)

    def _set_constants(self, parameters: Sequence[VehicleParameters]) -> None:
        frequency = column(parameters, lambda p: p.attitude_frequency_rad_s)
        damping = column(parameters, lambda p: p.attitude_damping)
        yaw_rate = 1.0 / column(parameters, lambda p: p.yaw_time_constant_s)
        ones, zeros = np.ones_like(frequency), np.zeros_like(frequency)
        # One formula serves all three axes: change of rate = stiffness (command - held · angle) - damping · rate. Yaw
        # is different: its angle is not held, and its command is a rate.
        self._held = np.array([ones, ones, zeros])
        self._stiff_running = np.array([frequency**2, frequency**2, yaw_rate]) * STEP_S
        self._stiff[:] = self._stiff_running
        self._damp = np.array([2 * damping * frequency, 2 * damping * frequency, yaw_rate]) * STEP_S
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
        self._hover_power = column(parameters, lambda p: p.hover_power_w)
        self._electronics_power = column(parameters, lambda p: p.electronics_power_w)

    def _constants(self) -> list[tuple[tuple[float, ...], tuple[float, ...]]]:
        """Return each drone's constants for rotation and translation as plain floats."""
        turning = [*self._damp[1:], *self._most_change[1:], self._airspeed_tilt]
        moving = [self._motor_share, self._rotor_offset, self._rotor_height, self._ground_effect]
        moving += [*self._linear[1:], *self._quadratic[1:]]
        rows = (np.array(constants).T.tolist() for constants in (turning, moving))
        return [(tuple(one), tuple(other)) for one, other in zip(*rows, strict=True)]

    def cut(self, drone: int) -> None:
        self._stiff[:, drone] = 0.0
        self.attitude_command[:, drone] = 0.0
        self.thrust_command[drone] = 0.0

    def steady(self, drone: int) -> None:
        self._stiff[:, drone] = self._stiff_running[:, drone]

    def turn(self, drone: int, change_rad_s: float) -> None:
        self.rates[2, drone] += change_rad_s
        self.angles[2, drone] += change_rad_s * STEP_S

    def power(self) -> Floats:
        """Return each drone's current battery power, (n,) [W]: P ~ T^1.5, according to momentum theory in hover."""
        power: Floats = self._hover_power * (self.thrust / GRAVITY_M_S2) ** 1.5 + self._electronics_power
        return power

    def step(self) -> None:
        if not self._few:
            self._turn()
            self._move()
            return
        for drone, (constants, _) in self._each:
            self._turn_one(drone, *constants)
        np.sin(self.angles, out=self.sin)
        np.cos(self.angles, out=self.cos)
        for drone, (_, constants) in self._each:
            self._move_one(drone, *constants)

    def _turn_one(
        self, drone: int, damp: float, damp_yaw: float, most: float, most_yaw: float, airspeed_tilt: float
    ) -> None:
        """Compute :meth:`_turn` for one drone."""
        roll, pitch, yaw, roll_rate, pitch_rate, yaw_rate, *rest = self._turning.read[drone]()
        stiff, stiff_pitch, stiff_yaw, roll_command, pitch_command, yaw_command = rest
        more_roll, more_pitch = self._tilt_one(drone, airspeed_tilt) if airspeed_tilt else (0.0, 0.0)
        # (Comparisons are faster than min and max.)
        change = (roll_command - roll + more_roll) * stiff - roll_rate * damp
        roll_rate += change if -most <= change <= most else math.copysign(most, change)
        change = (pitch_command - pitch + more_pitch) * stiff_pitch - pitch_rate * damp
        pitch_rate += change if -most <= change <= most else math.copysign(most, change)
        change = yaw_command * stiff_yaw - yaw_rate * damp_yaw
        yaw_rate += change if -most_yaw <= change <= most_yaw else math.copysign(most_yaw, change)
        roll, pitch = roll + roll_rate * STEP_S, pitch + pitch_rate * STEP_S
        if abs(roll) > _MOST_TILT_RAD:
            roll = math.copysign(_MOST_TILT_RAD, roll)
        if abs(pitch) > _MOST_TILT_RAD:
            pitch = math.copysign(_MOST_TILT_RAD, pitch)
        self._turned.write[drone](roll, pitch, yaw + yaw_rate * STEP_S, roll_rate, pitch_rate, yaw_rate)

    def _tilt_one(self, drone: int, airspeed_tilt: float) -> tuple[float, float]:
        """Compute :meth:`_tilt_by_airspeed` for one drone."""
        *_, sin_yaw, _, _, cos_yaw, air_x, air_y, _, _, _, _, _, vx, vy, _ = self._moving.read[drone]()
        east, north = vx - air_x, vy - air_y
        speed = math.sqrt(east * east + north * north)
        slowed = min(speed, _MOST_TILTING_AIRSPEED_M_S)
        tilt = airspeed_tilt * (slowed * slowed / max(speed, 1e-9))
        return (cos_yaw * north - sin_yaw * east) * tilt, -(cos_yaw * east + sin_yaw * north) * tilt

    def _move_one(
        self,
        drone: int,
        motor_share: float,
        rotor_offset: float,
        rotor_height: float,
        ground_effect: float,
        linear: float,
        linear_z: float,
        quadratic: float,
        quadratic_z: float,
    ) -> None:
        """Compute :meth:`_move` for one drone."""
        thrust_command, sin_roll, sin_pitch, sin_yaw, cos_roll, cos_pitch, cos_yaw, *rest = self._moving.read[drone]()
        air_x, air_y, air_z, thrust, x, y, z, vx, vy, vz = rest
        thrust += (thrust_command - thrust) * motor_share
        shortfall = ground_effect / max(z + rotor_offset, rotor_height)
        lift = thrust / (1.0 - shortfall * shortfall)
        forward = sin_pitch * cos_roll
        dx, dy, dz = vx - air_x, vy - air_y, vz - air_z
        airspeed = math.sqrt(dx * dx + dy * dy + dz * dz)
        drag = quadratic * airspeed + linear
        ax = (cos_yaw * forward + sin_yaw * sin_roll) * lift - dx * drag
        ay = (sin_yaw * forward - cos_yaw * sin_roll) * lift - dy * drag
        az = cos_pitch * cos_roll * lift - GRAVITY_M_S2 - dz * (quadratic_z * airspeed + linear_z)
        new_vx, new_vy, new_vz = vx + ax * STEP_S, vy + ay * STEP_S, vz + az * STEP_S
        x, y, z = x + new_vx * STEP_S, y + new_vy * STEP_S, z + new_vz * STEP_S
        self._moved.write[drone](thrust, x, y, z, new_vx, new_vy, new_vz, vx, vy, vz)

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
        np.multiply(self.rates, _STEP, out=other)
        np.add(self.angles, other, out=self.angles)
        np.minimum(self._tilts, self._most_tilt, out=self._tilts)
        np.maximum(self._tilts, self._least_tilt, out=self._tilts)
        np.sin(self.angles, out=self.sin)
        np.cos(self.angles, out=self.cos)

    def _tilt_by_airspeed(self) -> Floats:
        """Return the roll and pitch that airflow adds to the commands, shape (2, n); it lifts the leading side."""
        east, north = self.velocity[:2] - self.air[:2]
        sin_yaw, cos_yaw = self.sin[2], self.cos[2]
        forward, left = cos_yaw * east + sin_yaw * north, cos_yaw * north - sin_yaw * east
        speed = np.sqrt(east * east + north * north)
        slowed = np.minimum(speed, _MOST_TILTING_AIRSPEED_M_S)
        tilt: Floats = np.array([left, -forward]) * (self._airspeed_tilt * (slowed * slowed / np.maximum(speed, 1e-9)))
        return tilt

    def _move(self) -> None:
        lift = self._lift()
        total, drag, squares = self._a, self._b, self._squares
        sin_roll, sin_pitch, sin_yaw, cos_roll, cos_pitch, cos_yaw = self._sines_and_cosines
        (x, y, z), side, forward = self._a_rows, self._b_rows[0], self._d
        # This is the third column of Rz(yaw) Ry(pitch) Rx(roll).
        np.multiply(sin_pitch, cos_roll, out=forward)
        np.multiply(cos_yaw, forward, out=x)
        np.multiply(sin_yaw, sin_roll, out=side)
        np.add(x, side, out=x)
        np.multiply(sin_yaw, forward, out=y)
        np.multiply(cos_yaw, sin_roll, out=side)
        np.subtract(y, side, out=y)
        np.multiply(cos_pitch, cos_roll, out=z)
        np.multiply(total, lift, out=total)
        np.subtract(z, _GRAVITY, out=z)

        np.subtract(self.velocity, self.air, out=drag)
        np.multiply(drag, drag, out=squares)
        (x, y, z), airspeed = self._square_rows, self._d
        np.add(x, y, out=airspeed)
        np.add(airspeed, z, out=airspeed)
        np.sqrt(airspeed, out=airspeed)
        np.multiply(self._quadratic, airspeed, out=squares)
        np.add(squares, self._linear, out=squares)
        np.multiply(drag, squares, out=drag)
        np.subtract(total, drag, out=total)

        np.copyto(self.velocity_before, self.velocity)
        np.multiply(total, _STEP, out=total)
        np.add(self.velocity, total, out=self.velocity)
        np.multiply(self.velocity, _STEP, out=total)
        np.add(self.position, total, out=self.position)

    def _lift(self) -> Floats:
        """Return the lagged thrust, multiplied near the floor by 1 / (1 - (R / 4h)²) (Cheeseman, Bennett 1955)."""
        lift, shortfall = self._c, self._d
        np.subtract(self.thrust_command, self.thrust, out=lift)
        np.multiply(lift, self._motor_share, out=lift)
        np.add(self.thrust, lift, out=self.thrust)
        np.add(self.position[2], self._rotor_offset, out=shortfall)
        np.maximum(shortfall, self._rotor_height, out=shortfall)
        np.divide(self._ground_effect, shortfall, out=shortfall)
        np.multiply(shortfall, shortfall, out=shortfall)
        np.subtract(_ONE, shortfall, out=shortfall)
        np.divide(self.thrust, shortfall, out=lift)
        return lift


def body_rates(rates: N, sin: N, cos: N) -> tuple[N, N, N]:
    """Return the angular velocities about a body's axes [rad/s] from its Euler angles' rates, sines and cosines."""
    roll_rate, pitch_rate, yaw_rate = rates
    sin_roll, sin_pitch, _ = sin
    cos_roll, cos_pitch, _ = cos
    return (
        roll_rate - yaw_rate * sin_pitch,
        pitch_rate * cos_roll + yaw_rate * sin_roll * cos_pitch,
        -pitch_rate * sin_roll + yaw_rate * cos_roll * cos_pitch,
    )


def rotations(sin: Floats, cos: Floats) -> Floats:
    """Return world-from-body rotations, (n, 3, 3), from sines and cosines of roll, pitch and yaw, each (3, n)."""
    sr, sp, sy = sin
    cr, cp, cy = cos
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


class WindField:
    """Air velocity at each drone: the world's mean wind plus independent gusts, because gusts are small in extent.

    Gusts are a first-order Gauss-Markov process per axis (the low-pass part of the Dryden gust model of MIL-F-8785C).
    """

    def __init__(self, wind: Wind, seed: int, drones: int, period_s: float) -> None:
        self._mean = np.array(wind.mean_m_s)[:, None]
        self._keep = math.exp(-period_s / wind.time_constant_s)
        deviation = wind.gust_m_s * np.array([[1.0], [1.0], [0.5]])
        self._fresh = deviation * math.sqrt(1.0 - self._keep**2)
        self._calm = wind.gust_m_s == 0
        self._normals = NormalBlocks(seed, Purpose.WIND, 3, drones)
        self._gust: Floats = np.zeros((3, drones)) if self._calm else deviation * self._normals.take()

    def blow(self, air: Floats) -> None:
        """Advance by one period and write the air's velocity in world axes, shape (3, drones) [m/s]."""
        if not self._calm:
            np.multiply(self._gust, self._keep, out=self._gust)
            np.add(self._gust, self._fresh * self._normals.take(), out=self._gust)
        np.add(self._mean, self._gust, out=air)
