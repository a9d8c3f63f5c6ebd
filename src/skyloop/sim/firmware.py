"""What a simulated drone's instruments read, and who flies a drone by them in place of the built-in autopilot."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import msgspec

from skyloop.sim.world import Vec3


class GpsFix(msgspec.Struct, frozen=True, gc=False):
    """A fix of the satellite receiver, with its error, as old as its delay. Altitude is above mean sea level."""

    time_s: float  #: of the simulation, when the receiver was there
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    velocity_m_s: Vec3  #: east, north, up
    horizontal_error_m: float  #: one standard deviation, as the receiver states it
    vertical_error_m: float
    satellites: int


class FlowSample(msgspec.Struct, frozen=True, gc=False):
    """What a camera that looks down saw move, over an interval.

    Angles are about the body's forward and left axes, as if the vehicle had turned by them over ground that is far
    away: a drone at height h that flies forward at v and turns at the rate ω about its left axis sees ω - v/h; one that
    flies left at v and turns at ω about its forward axis sees ω + v/h.
    """

    interval_s: float
    about_forward_rad: float
    about_left_rad: float
    gyro_forward_rad: float  #: what the gyro turned in the interval, about the same axes
    gyro_left_rad: float
    quality: float  #: 0 to 1; at 0 there is nothing to be seen, and the angles are 0


class Readings(msgspec.Struct, frozen=True, gc=False):
    """Readings of one drone's instruments at one time, and its true state beside them.

    Body axes are forward, left, up; world axes east, north, up. Barometer, magnetometer and range finder keep their
    newest sample until the next.
    """

    time_s: float  #: of the simulation
    gyro_rad_s: Vec3
    acceleration_m_s2: Vec3  #: specific force: at rest, +g along z
    pressure_pa: float
    temperature_c: float
    magnetic_gauss: Vec3  #: body axes
    gps: GpsFix | None  #: a new fix, only in the step in which it comes
    range_m: float | None  #: down along the body's axis to the floor or something solid; None out of reach
    flow: FlowSample | None  #: a new sample, only in the step in which it comes
    battery_v: float
    battery_a: float
    position_m: Vec3  #: true, of the body's centre
    velocity_m_s: Vec3  #: true, world axes
    quaternion: tuple[float, float, float, float]  #: true: w, x, y, z, world from body
    rates_rad_s: Vec3  #: true, about the body's axes


class Firmware(Protocol):
    """Flies one drone of a simulation: see :meth:`~skyloop.sim.simulation.Simulation.fly_by`."""

    def exchange(self, readings: Readings) -> Sequence[float] | None:
        """Take the readings of a step and return what the rotors do in it.

        Called once per step of the plant (1 ms) on the thread that steps the simulation, which holds its lock: it must
        return in bounded time, and call no method of the simulation.

        Args:
            readings: At the begin of the step.

        Returns:
            Commands of the rotors, 0 (stands) to 1 (full): front left, front right, rear left, rear right; what is
            beyond is clamped. None: no new ones, the last stay in force.

        Raises:
            Exception: What it raises, ends the step, and is raised by :meth:`Simulation.step`.
        """
        ...
