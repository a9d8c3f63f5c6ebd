"""Set-points in SI to the drone's stick values, which are shares of its own configured limits. Pure.

``PCMD`` takes roll (positive to the right), pitch (negative nose down), climb (positive up) and yaw rate (positive
clockwise), each from -1 to 1.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from skyloop.drivers.ardrone.sender import Message
from skyloop.errors import DecodeError
from skyloop.messages import Attitude
from skyloop.wire.ardrone.at import Pcmd
from skyloop.wire.ardrone.configuration import parse_value

HEADING_ACCURACY: Final = 0.1  #: of the reference that goes with ``PCMD_MAG``, as share of half a turn
_KEYS: Final = ("control:euler_angle_max", "control:control_vz_max", "control:control_yaw")


@dataclass(frozen=True, slots=True)
class StickLimits:
    """What a stick value of 1 means."""

    tilt_rad: float
    climb_m_s: float
    yaw_rate_rad_s: float


@dataclass(frozen=True, slots=True)
class Stick:
    """The four values of ``PCMD``, each from -1 to 1, with its signs."""

    roll: float
    pitch: float
    climb: float
    yaw: float


def limits_of(configuration: Mapping[str, str]) -> StickLimits | None:
    """The limits in force as the drone's configuration tells them; None if it does not."""
    try:
        tilt, climb_mm_s, yaw = (float(str(parse_value(configuration[key], 0.0))) for key in _KEYS)
    except (KeyError, DecodeError):
        return None
    if min(tilt, climb_mm_s, yaw) <= 0:
        return None
    return StickLimits(tilt, climb_mm_s / 1000, yaw)


def stick_of(action: Attitude, limits: StickLimits) -> tuple[Stick, Attitude]:
    """The stick values, and the attitude that they really ask for: each number within the drone's limit."""
    stick = Stick(
        roll=_share(action.roll, limits.tilt_rad),
        pitch=_share(-action.pitch, limits.tilt_rad),
        climb=_share(action.climb, limits.climb_m_s),
        yaw=_share(-action.yaw_rate, limits.yaw_rate_rad_s),
    )
    applied = Attitude(
        roll=_within(action.roll, limits.tilt_rad),
        pitch=_within(action.pitch, limits.tilt_rad),
        climb=_within(action.climb, limits.climb_m_s),
        yaw_rate=_within(action.yaw_rate, limits.yaw_rate_rad_s),
    )
    return stick, applied


def motion(stick: Stick | None, reference_rad: float | None = None) -> Message:
    """``PCMD`` for these stick values, or for hovering.

    With a ``reference_rad`` it is ``PCMD_MAG``: forward and right are then those of somebody who looks along that
    heading (0 magnetic north, positive counter-clockwise), wherever the drone's nose points.
    """
    if stick is None:
        return ("PCMD", (int(Pcmd.HOVER), 0.0, 0.0, 0.0, 0.0))
    values = (stick.roll, stick.pitch, stick.climb, stick.yaw)
    if reference_rad is None:
        return ("PCMD", (int(Pcmd.PROGRESSIVE), *values))
    heading = -reference_rad / math.pi + 0.0  # without a negative zero
    return ("PCMD_MAG", (int(Pcmd.PROGRESSIVE | Pcmd.ABSOLUTE), *values, heading, HEADING_ACCURACY))


def _share(value: float, limit: float) -> float:
    return max(-1.0, min(1.0, value / limit)) + 0.0  # without a negative zero


def _within(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))
