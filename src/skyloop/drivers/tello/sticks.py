"""Set-points in SI to the drone's sticks. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from skyloop.messages import Attitude, Velocity
from skyloop.wire.tello.commands import FULL_CLIMB_M_S, FULL_SPEED_M_S, FULL_YAW_RATE_RAD_S, MAX_STICK, Stick

FULL_TILT_RAD: Final = 0.2  #: the attitude that is taken for a full stick: as much as an AR.Drone tilts indoors


@dataclass(frozen=True, slots=True)
class Scale:
    """Numbers of one kind for each stick: what a full one comes to, or the most that is asked for."""

    speed: float = FULL_SPEED_M_S  #: [m/s]
    climb: float = FULL_CLIMB_M_S  #: [m/s]
    yaw_rate: float = FULL_YAW_RATE_RAD_S  #: [rad/s]
    tilt: float = FULL_TILT_RAD  #: [rad]


def sticks_of(action: Velocity | Attitude, full: Scale, limits: Scale) -> tuple[Stick, Velocity | Attitude]:
    """The sticks, and what they really ask for: each number within its limit, and no more than a full stick.

    The Tello holds a speed, and no attitude: a tilt is taken as a share of the full stick, and so of the full speed.
    """
    climb = min(full.climb, limits.climb)
    yaw = min(full.yaw_rate, limits.yaw_rate)
    if isinstance(action, Velocity):
        speed = min(full.speed, limits.speed)
        applied = Velocity(
            forward=_within(action.forward, speed),
            left=_within(action.left, speed),
            up=_within(action.up, climb),
            yaw_rate=_within(action.yaw_rate, yaw),
        )
        right, ahead = -applied.left / full.speed, applied.forward / full.speed
        return _stick(right, ahead, applied.up / full.climb, applied.yaw_rate / full.yaw_rate), applied
    tilt = min(full.tilt, limits.tilt)
    level = Attitude(
        roll=_within(action.roll, tilt),
        pitch=_within(action.pitch, tilt),
        climb=_within(action.climb, climb),
        yaw_rate=_within(action.yaw_rate, yaw),
    )
    right, ahead = level.roll / full.tilt, level.pitch / full.tilt
    return _stick(right, ahead, level.climb / full.climb, level.yaw_rate / full.yaw_rate), level


def _stick(right: float, forward: float, up: float, turn: float) -> Stick:
    return Stick(*(round(MAX_STICK * share) for share in (right, forward, up, -turn)))


def _within(value: float, limit: float) -> float:
    return max(-limit, min(limit, value))
