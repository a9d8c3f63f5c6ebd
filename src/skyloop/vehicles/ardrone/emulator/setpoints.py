"""``PCMD`` to set-points in SI: its values are from -1 to 1 of the configured limits. Pure.

Signs of the drone: roll > 0 right, pitch < 0 nose down, gaz > 0 up, yaw > 0 clockwise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from skyloop.messages import Attitude, Hover
from skyloop.messages.geometry import clamped, turned, within
from skyloop.sim.parameters import GRAVITY_M_S2, LIMIT_RANGES, Limits
from skyloop.vehicles.ardrone.emulator.configuration import Configuration
from skyloop.vehicles.ardrone.wire.at import Pcmd

TAKEOFF_ALTITUDE_M: Final = 0.85  #: hovers after a take-off at 0.7 to 1 m
_LEAST_TURNING_SPEED_M_S: Final = 1.0  # of a coordinated turn: slower ones turn as if this fast
_COMBINED_YAW_LEVEL: Final = 2  # bit 1 of control:control_level


@dataclass(frozen=True, slots=True)
class Progress:
    """A ``PCMD`` or ``PCMD_MAG`` as it came.

    ``heading`` is that of the remote control, share of 180° from north, clockwise; None in a ``PCMD``.
    """

    flags: int
    roll: float
    pitch: float
    gaz: float
    yaw: float
    heading: float | None = None

    @property
    def makes_sense(self) -> bool:
        """Whether all numbers are finite."""
        values = (self.roll, self.pitch, self.gaz, self.yaw, self.heading or 0.0)
        return all(math.isfinite(value) for value in values)


NO_PROGRESS: Final = Progress(0, 0.0, 0.0, 0.0, 0.0)


def limits_of(configuration: Configuration) -> Limits:
    """Return the vehicle's limits by the configuration, brought within the range of the simulated vehicle."""
    return Limits(
        tilt_rad=_possible("tilt_rad", configuration.number("control:euler_angle_max")),
        climb_m_s=_possible("climb_m_s", configuration.number("control:control_vz_max") / 1000),
        yaw_rate_rad_s=_possible("yaw_rate_rad_s", configuration.number("control:control_yaw")),
        altitude_m=_possible("altitude_m", configuration.number("control:altitude_max") / 1000),
        takeoff_altitude_m=TAKEOFF_ALTITUDE_M,
    )


def set_point(
    progress: Progress, configuration: Configuration, *, yaw_rad: float, forward_m_s: float
) -> Attitude | Hover:
    """Return the set-point that a ``PCMD`` asks for.

    Args:
        progress: The command.
        configuration: Has the limits.
        yaw_rad: The drone's, counter-clockwise from east.
        forward_m_s: The drone's speed.
    """
    if not progress.flags & Pcmd.PROGRESSIVE:
        return Hover()
    most_tilt = configuration.number("control:euler_angle_max")
    right, ahead = clamped(progress.roll, 1.0), -clamped(progress.pitch, 1.0)
    if progress.flags & Pcmd.ABSOLUTE and progress.heading is not None:
        # Meant for a heading that is so much less far clockwise than the drone's.
        right, ahead = turned(right, ahead, _clockwise_from_north(yaw_rad) - progress.heading * math.pi)
    roll, pitch = right * most_tilt, ahead * most_tilt
    yaw_rate = -clamped(progress.yaw, 1.0) * configuration.number("control:control_yaw")
    if progress.flags & Pcmd.COMBINED_YAW and int(configuration.number("control:control_level")) & _COMBINED_YAW_LEVEL:
        yaw_rate -= GRAVITY_M_S2 * math.tan(roll) / max(forward_m_s, _LEAST_TURNING_SPEED_M_S)
    climb = clamped(progress.gaz, 1.0) * configuration.number("control:control_vz_max") / 1000
    return Attitude(roll, pitch, climb, yaw_rate)


def _clockwise_from_north(yaw_rad: float) -> float:
    return math.pi / 2 - yaw_rad


def _possible(name: str, value: float) -> float:
    return within(value, *LIMIT_RANGES[name])
