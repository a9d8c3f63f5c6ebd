"""Fly to a place: position and yaw in, velocity out. Pure: no clock, no thread.

A proportional law whose speed is limited and, near the place, by what a given deceleration brings to rest there; the
error is turned into the body's levelled axes by the yaw alone, as set-points are given in them (ROS REP 103).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from skyloop.errors import UsageError
from skyloop.messages import Feedback, Vector, Velocity
from skyloop.messages.geometry import wrap_angle


@dataclass(frozen=True, slots=True)
class Waypoint:
    """A place in world axes: x east, y north, z up [m]; ``yaw`` counter-clockwise from x [rad], None: any.

    Raises :class:`UsageError` for what is not finite.
    """

    x: float
    y: float
    z: float
    yaw: float | None = None

    def __post_init__(self) -> None:
        for name in ("x", "y", "z", "yaw"):
            value = getattr(self, name)
            if value is not None and not math.isfinite(value):
                raise UsageError(f"{name} of a waypoint is {value} and must be finite")

    @property
    def position(self) -> Vector:
        return self.x, self.y, self.z


@dataclass(frozen=True, slots=True)
class WaypointSettings:
    """How hard it flies, and what counts as there. The defaults suit a small indoor vehicle with velocity control."""

    gain: float = 1.2  #: speed by distance [1/s]
    yaw_gain: float = 1.5  #: [1/s]
    speed_m_s: float = 1.0  #: greatest, horizontally
    climb_m_s: float = 0.6  #: greatest, up or down
    turn_rad_s: float = 1.2  #: greatest
    slow_down_m_s2: float = 0.6  #: deceleration towards the place
    near_m: float = 0.15  #: so close to the place is there
    near_rad: float = 0.1
    slow_m_s: float = 0.2  #: and no faster than this, where the velocity is known


def lacking(feedback: Feedback) -> str:
    """Why it can't be flown to a place, in words; empty if it can."""
    if feedback.position is None:
        return "the vehicle does not tell its position"
    return "the vehicle does not tell its yaw" if feedback.yaw is None else ""


def velocity_to(goal: Waypoint, feedback: Feedback, settings: WaypointSettings | None = None) -> Velocity:
    """The velocity to ask for now. Raises :class:`UsageError` while position or yaw are not known."""
    s = settings or WaypointSettings()
    east, north, up, yaw = _errors(goal, feedback)
    away = math.hypot(east, north)
    speed = _approach(away, s.speed_m_s, s)
    share = speed / away if away > 1e-9 else 0.0
    assert feedback.yaw is not None
    c, si = math.cos(feedback.yaw), math.sin(feedback.yaw)
    return Velocity(
        forward=share * (c * east + si * north),
        left=share * (c * north - si * east),
        up=math.copysign(_approach(abs(up), s.climb_m_s, s), up),
        yaw_rate=max(-s.turn_rad_s, min(s.turn_rad_s, s.yaw_gain * yaw)),
    )


def reached(goal: Waypoint, feedback: Feedback, settings: WaypointSettings | None = None) -> bool:
    """Whether it is there, and nearly at rest. Raises :class:`UsageError` while position or yaw are not known."""
    s = settings or WaypointSettings()
    east, north, up, yaw = _errors(goal, feedback)
    velocity = feedback.velocity
    at_rest = velocity is None or math.hypot(*velocity) <= s.slow_m_s
    return at_rest and math.hypot(east, north, up) <= s.near_m and abs(yaw) <= s.near_rad


def _errors(goal: Waypoint, feedback: Feedback) -> tuple[float, float, float, float]:
    """East, north, up [m] and yaw [rad] from where it is to where it shall be."""
    problem = lacking(feedback)
    if problem or feedback.position is None or feedback.yaw is None:
        raise UsageError(f"it can't fly to a waypoint: {problem}")
    x, y, z = feedback.position
    turn = 0.0 if goal.yaw is None else wrap_angle(goal.yaw - feedback.yaw)
    return goal.x - x, goal.y - y, goal.z - z, turn


def _approach(away: float, limit: float, s: WaypointSettings) -> float:
    """Speed at this distance: by the gain, within the limit, and slow enough to come to rest at the place."""
    return min(s.gain * away, limit, math.sqrt(2.0 * s.slow_down_m_s2 * away))
