"""The instruments of a rotor-level drone as its firmware reads them, with noise, bias, rate and delay.

All worlds have their origin at the same place on Earth, in Zürich, where PX4's simulations start by default.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Final, Protocol

import msgspec
import numpy as np

from skyloop.sim.parameters import VehicleParameters
from skyloop.sim.rotor_dynamics import PLANT_STEP_S, rotation, rotors_of
from skyloop.sim.streams import Purpose, stream
from skyloop.sim.world import Vec3


class GpsFix(msgspec.Struct, frozen=True, gc=False):
    """A satellite receiver's position fix, with its error and delay. Altitude is above mean sea level."""

    time_s: float  #: simulation time at which the receiver was at this position
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    velocity_m_s: Vec3  #: velocity east, north, up
    horizontal_error_m: float  #: one standard deviation of the horizontal position, as reported by the receiver
    vertical_error_m: float
    satellites: int


class FlowSample(msgspec.Struct, frozen=True, gc=False):
    """Motion seen by a camera that looks down, over an interval.

    Angles are about the body's forward and left axes, as if the vehicle had rotated by these angles above very distant
    ground. A drone at height h that flies forward at v and rotates at ω about its left axis sees ω - v/h; a drone that
    flies left at v and rotates at ω about its forward axis sees ω + v/h.
    """

    interval_s: float
    about_forward_rad: float
    about_left_rad: float
    gyro_forward_rad: float  #: rotation measured by the gyro in the interval, about the same axes
    gyro_left_rad: float
    quality: float  #: quality of the image, 0 to 1; at 0 nothing is visible and the angles are 0


class Readings(msgspec.Struct, frozen=True, gc=False):
    """The readings of a drone's instruments at a point in time, together with its true state.

    Body axes are forward, left, up; world axes are east, north, up. The values of the barometer, magnetometer and range
    finder remain until their next sample.
    """

    time_s: float  #: simulation time
    gyro_rad_s: Vec3
    acceleration_m_s2: Vec3  #: specific force: +g along z at rest
    pressure_pa: float
    temperature_c: float
    magnetic_gauss: Vec3  #: magnetic field in body axes
    gps: GpsFix | None  #: a new fix, or None except in the step in which the fix arrives
    range_m: float | None  #: distance to the floor or a solid, down along the body's axis; None if out of range
    flow: FlowSample | None  #: a new sample, or None except in the step in which the sample arrives
    battery_v: float
    battery_a: float
    position_m: Vec3  #: true position of the centre of the body
    velocity_m_s: Vec3  #: true velocity in world axes
    quaternion: tuple[float, float, float, float]  #: true rotation, world from body: w, x, y, z
    rates_rad_s: Vec3  #: true rates about the body's axes


class Firmware(Protocol):
    """Flies one drone of a simulation; see :meth:`~skyloop.sim.simulation.Simulation.fly_by`."""

    def exchange(self, readings: Readings) -> Sequence[float] | None:
        """Process the readings of a step and return the rotor commands for that step.

        Called once per step of the plant (1 ms) on the thread that steps the simulation, which holds the simulation's
        lock. It must return in bounded time and call no method of the simulation.

        Args:
            readings: The readings at the start of the step.

        Returns:
            Rotor commands, 0 (stopped) to 1 (full): front left, front right, rear left, rear right. Values outside this
            range are clamped. If None, the last commands remain in force.

        Raises:
            Exception: Any exception ends the step, and :meth:`Simulation.step` raises it.
        """
        ...


LATITUDE_DEG: Final = 47.397742  #: latitude of the worlds' origin, WGS 84
LONGITUDE_DEG: Final = 8.545594  #: longitude of that origin
ALTITUDE_M: Final = 488.0  #: height of the worlds' floor above mean sea level

#: The Earth's magnetic field at the worlds' origin: east, north, up, from the World Magnetic Model 2025 for early 2026.
MAGNETIC_FIELD_GAUSS: Final[Vec3] = (0.01334, 0.21523, -0.43290)

_EQUATOR_M, _FLATTENING = 6378137.0, 1 / 298.257223563  # WGS 84
_SEA_LEVEL_PA, _SEA_LEVEL_K, _LAPSE_K_M, _EXPONENT = 101325.0, 288.15, 0.0065, 5.25588  # ISO 2533, standard atmosphere


def _radii_m() -> tuple[float, float]:
    """Return the Earth's radii of curvature at the origin, along the meridian and across it."""
    squared = _FLATTENING * (2 - _FLATTENING)
    bulge = 1 - squared * math.sin(math.radians(LATITUDE_DEG)) ** 2
    return _EQUATOR_M * (1 - squared) / bulge**1.5, _EQUATOR_M / math.sqrt(bulge)


_MERIDIAN_M, _NORMAL_M = _radii_m()
_DEG_PER_NORTH_M = math.degrees(1 / (_MERIDIAN_M + ALTITUDE_M))
_DEG_PER_EAST_M = math.degrees(1 / ((_NORMAL_M + ALTITUDE_M) * math.cos(math.radians(LATITUDE_DEG))))


def geodetic(position_m: Vec3) -> Vec3:
    """Return the latitude, longitude [deg] and altitude above mean sea level [m] of a position in world axes.

    The Earth is treated as flat; at a distance of one kilometre, the error is below 0.1 m.
    """
    east, north, up = position_m
    return LATITUDE_DEG + north * _DEG_PER_NORTH_M, LONGITUDE_DEG + east * _DEG_PER_EAST_M, ALTITUDE_M + up


def local(latitude_deg: float, longitude_deg: float, altitude_m: float) -> Vec3:
    """Return the position in world axes, the inverse of :func:`geodetic`."""
    north = (latitude_deg - LATITUDE_DEG) / _DEG_PER_NORTH_M
    return (longitude_deg - LONGITUDE_DEG) / _DEG_PER_EAST_M, north, altitude_m - ALTITUDE_M


def pressure_pa(height_m: float) -> float:
    """Return the air pressure at a height above the worlds' floor, in the standard atmosphere."""
    share = 1 - _LAPSE_K_M * (ALTITUDE_M + height_m) / _SEA_LEVEL_K
    return float(_SEA_LEVEL_PA * share**_EXPONENT)


#: Distance from a point to the first solid along a unit vector (both in world axes); infinite if there is none.
Ranging = Callable[[Vec3, Vec3], float]

_NOISE_BLOCK = 256  # number of samples whose noise is drawn in one call
_WANDER_STEPS = 100  # number of steps between changes of the biases (10 Hz)
_LEAST_FLOW_M = 0.08  # minimum height; below it, the image is out of focus
_GPS_VERTICAL = 1.7  # ratio of the vertical error to the horizontal error
_SATELLITES = 14  # number reported with every fix


class Instruments:
    """A drone's instruments, each with its own stream of random numbers."""

    def __init__(self, vehicle: VehicleParameters, drone: int, seed: int, ranging: Ranging) -> None:
        errors = self._errors = rotors_of(vehicle).instruments
        self._ranging = ranging
        self._feet_m = vehicle.half_height_m
        self._inertial_noise = _rows(seed, drone, 0, 6)
        self._slow_noise = {
            kind: _rows(seed, drone, kind, count) for kind, count in ((1, 3), (2, 1), (3, 6), (4, 1), (5, 2))
        }
        deviations = (
            *[errors.gyro_bias_rad_s] * 3,
            *[errors.accelerometer_bias_m_s2] * 3,
            *[errors.magnetometer_bias_gauss] * 3,
            errors.barometer_bias_pa,
            errors.gps_bias_m,
            errors.gps_bias_m,
            errors.gps_bias_m * _GPS_VERTICAL,
        )
        constants_s = [errors.gyro_time_constant_s] * 3 + [errors.bias_time_constant_s] * (len(deviations) - 3)
        self._wandering = _wandering(seed, drone, np.array(deviations), np.array(constants_s))
        self._bias = next(self._wandering)
        self._magnetometer_steps, self._barometer_steps, self._gps_steps, self._range_steps, self._flow_steps = (
            _steps(period_s)
            for period_s in (
                errors.magnetometer_period_s,
                errors.barometer_period_s,
                errors.gps_period_s,
                errors.range_period_s,
                errors.flow_period_s,
            )
        )
        self._delay_steps = round(errors.gps_delay_s / PLANT_STEP_S)
        self._fixes: deque[tuple[int, GpsFix]] = deque()  # GPS fixes, each with the step in which it arrives
        self._magnetic: Vec3 = (0.0, 0.0, 0.0)
        self._pressure_pa = 0.0
        self._below_m = math.inf
        self._range_m: float | None = None
        self._turned = (0.0, 0.0, 0.0, 0.0)  # rotation about the forward and left axes: the true one, then the gyro's
        self._first = -1

    def read(
        self,
        step: int,
        position: Vec3,
        velocity: Vec3,
        quaternion: tuple[float, float, float, float],
        rates: Vec3,
        force: Vec3,
        battery_v: float,
        battery_a: float,
    ) -> Readings:
        """Return the readings for one step of the plant. Call this method for every step, in order."""
        if step % _WANDER_STEPS == 0:
            self._bias = next(self._wandering)
        errors, bias = self._errors, self._bias
        n1, n2, n3, n4, n5, n6 = next(self._inertial_noise)
        turning, pushing = errors.gyro_noise_rad_s, errors.accelerometer_noise_m_s2
        p, q, r = rates
        gyro = (p + bias[0] + turning * n1, q + bias[1] + turning * n2, r + bias[2] + turning * n3)
        fx, fy, fz = force
        acceleration = (fx + bias[3] + pushing * n4, fy + bias[4] + pushing * n5, fz + bias[5] + pushing * n6)
        if self._first < 0:
            self._first = step
        age = step - self._first
        if age % self._magnetometer_steps == 0:
            self._magnetic = self._sample_magnetic(quaternion)
        if age % self._barometer_steps == 0:
            noise = errors.barometer_noise_pa * next(self._slow_noise[2])[0]
            self._pressure_pa = pressure_pa(position[2]) + bias[9] + noise
        if age % self._gps_steps == 0:
            self._fixes.append((step + self._delay_steps, self._locate(step, position, velocity)))
        gps = self._fixes.popleft()[1] if self._fixes and self._fixes[0][0] <= step else None
        if age % self._range_steps == 0:
            self._range_m = self._sample_range(position, quaternion)
        true_p, true_q, gyro_p, gyro_q = self._turned
        self._turned = true_p + p, true_q + q, gyro_p + gyro[0], gyro_q + gyro[1]
        flow = self._sample_flow(velocity, quaternion) if (age + 1) % self._flow_steps == 0 else None
        return Readings(
            step * PLANT_STEP_S,
            gyro,
            acceleration,
            self._pressure_pa,
            errors.temperature_c,
            self._magnetic,
            gps,
            self._range_m,
            flow,
            battery_v,
            battery_a,
            position,
            velocity,
            quaternion,
            rates,
        )

    def _sample_magnetic(self, quaternion: tuple[float, float, float, float]) -> Vec3:
        x, y, z = _to_body(quaternion, MAGNETIC_FIELD_GAUSS)
        n1, n2, n3 = next(self._slow_noise[1])
        noise, bias = self._errors.magnetometer_noise_gauss, self._bias
        return x + bias[6] + noise * n1, y + bias[7] + noise * n2, z + bias[8] + noise * n3

    def _locate(self, step: int, position: Vec3, velocity: Vec3) -> GpsFix:
        errors, bias = self._errors, self._bias
        n1, n2, n3, n4, n5, n6 = next(self._slow_noise[3])
        noise, faster = errors.gps_noise_m, errors.gps_velocity_noise_m_s
        x, y, z = position
        latitude, longitude, altitude = geodetic(
            (x + bias[10] + noise * n1, y + bias[11] + noise * n2, z + bias[12] + noise * _GPS_VERTICAL * n3)
        )
        vx, vy, vz = velocity
        stated = math.hypot(noise, errors.gps_bias_m)
        return GpsFix(
            step * PLANT_STEP_S,
            latitude,
            longitude,
            altitude,
            (vx + faster * n4, vy + faster * n5, vz + faster * _GPS_VERTICAL * n6),
            stated,
            stated * _GPS_VERTICAL,
            _SATELLITES,
        )

    def _sample_range(self, position: Vec3, quaternion: tuple[float, float, float, float]) -> float | None:
        (_, _, x), (_, _, y), (_, _, z) = rotation(*quaternion)
        feet = self._feet_m
        px, py, pz = position
        self._below_m = self._ranging((px - x * feet, py - y * feet, pz - z * feet), (-x, -y, -z))
        errors = self._errors
        if not errors.range_least_m <= self._below_m <= errors.range_most_m:
            return None
        return max(0.0, self._below_m + errors.range_noise_m * next(self._slow_noise[4])[0])

    def _sample_flow(self, velocity: Vec3, quaternion: tuple[float, float, float, float]) -> FlowSample:
        errors = self._errors
        interval = self._flow_steps * PLANT_STEP_S
        true_p, true_q, gyro_p, gyro_q = (turned * PLANT_STEP_S for turned in self._turned)
        self._turned = 0.0, 0.0, 0.0, 0.0
        if not _LEAST_FLOW_M <= self._below_m <= errors.range_most_m:
            return FlowSample(interval, 0.0, 0.0, gyro_p, gyro_q, 0.0)
        forward, left, _ = _to_body(quaternion, velocity)
        n1, n2 = next(self._slow_noise[5])
        noise, moved = errors.flow_noise_rad_s * interval, interval / self._below_m
        about_forward, about_left = true_p + left * moved + noise * n1, true_q - forward * moved + noise * n2
        return FlowSample(interval, about_forward, about_left, gyro_p, gyro_q, 1.0)


def _to_body(quaternion: tuple[float, float, float, float], vector: Vec3) -> Vec3:
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = rotation(*quaternion)
    x, y, z = vector
    return r00 * x + r10 * y + r20 * z, r01 * x + r11 * y + r21 * z, r02 * x + r12 * y + r22 * z


def _rows(seed: int, drone: int, instrument: int, count: int) -> Iterator[tuple[float, ...]]:
    """Yield standard normal numbers indefinitely, ``count`` at a time."""
    # Each drone has eight streams: numbers 0 to 5 for noise, and 7 for the biases.
    generator = stream(seed, Purpose.INSTRUMENTS, drone * 8 + instrument)
    while True:
        yield from map(tuple, generator.standard_normal((_NOISE_BLOCK, count)).tolist())


def _wandering(
    seed: int, drone: int, deviations: np.typing.NDArray[np.float64], constants_s: np.typing.NDArray[np.float64]
) -> Iterator[list[float]]:
    """Yield biases indefinitely: first-order Gauss-Markov processes, updated every :data:`_WANDER_STEPS`."""
    generator = stream(seed, Purpose.INSTRUMENTS, drone * 8 + 7)
    keep = np.exp(-_WANDER_STEPS * PLANT_STEP_S / constants_s)
    fresh = np.sqrt(1.0 - keep * keep)
    bias = deviations * generator.standard_normal(len(deviations))
    while True:
        yield bias.tolist()
        bias = bias * keep + deviations * fresh * generator.standard_normal(len(deviations))


def _steps(period_s: float) -> int:
    return max(1, round(period_s / PLANT_STEP_S))
