"""The vehicles' own estimates: the truth with noise and slowly wandering biases."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from skyloop.sim.columns import Fields, N, columns, few
from skyloop.sim.dynamics import BodyTable, column
from skyloop.sim.parameters import VehicleParameters
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
            self.numbers = Fields(self._estimate, 0, 4)  #: for a few drones: altitude and velocity
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
        """Measure a drone that was moved and is at rest, because its last estimate was for another position."""
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
            # Drone after drone, so that adding drones doesn't change the noise of the earlier ones.
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
