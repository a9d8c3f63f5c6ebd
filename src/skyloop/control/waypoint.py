"""Fly to a position: position and yaw in, velocity out. Pure: no clock, no thread.

A proportional law. The speed is limited, and near the goal it is at most what a given deceleration brings to rest
there. The error is turned by the yaw alone into the body's levelled axes, in which set-points are given (ROS REP 103).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from skyloop.control.limiting import clamped
from skyloop.errors import UsageError
from skyloop.messages import Feedback, Vector, Velocity
from skyloop.messages.feedback import NO_POSITION, POSITION_SOURCES
from skyloop.messages.geometry import wrap_angle


@dataclass(frozen=True, slots=True)
class Waypoint:
    """A position in world axes, and optionally a yaw.

    Attributes:
        x: East [m].
        y: North [m].
        z: Up [m].
        yaw: Counter-clockwise from x [rad]; None leaves it free.

    Raises:
        UsageError: A number is not finite.
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
        """Return (x, y, z) [m], world axes."""
        return self.x, self.y, self.z


@dataclass(frozen=True, slots=True)
class WaypointSettings:
    """Gains, limits and acceptance radii. The defaults suit a small indoor vehicle with velocity control."""

    gain: float = 1.2  #: speed by distance [1/s]
    yaw_gain: float = 1.5  #: [1/s]
    speed_m_s: float = 1.0  #: greatest, horizontally
    climb_m_s: float = 0.6  #: greatest, up or down
    turn_rad_s: float = 1.2  #: greatest
    slow_down_m_s2: float = 0.6  #: deceleration towards the goal
    near_m: float = 0.15  #: acceptance radius
    near_rad: float = 0.1
    slow_m_s: float = 0.2  #: greatest speed at which the goal counts as reached, where the velocity is known


def lacking(feedback: Feedback) -> str:
    """Return why a vehicle can't be flown to a position and what helps, or an empty string if it can."""
    if feedback.position_m is None or not all(map(math.isfinite, feedback.position_m)):
        return f"{NO_POSITION}: {POSITION_SOURCES}"
    yaw = feedback.yaw_rad
    return "" if yaw is not None and math.isfinite(yaw) else "the vehicle does not report its yaw"


def velocity_to(goal: Waypoint, feedback: Feedback, settings: WaypointSettings | None = None) -> Velocity:
    """Compute the velocity that brings a vehicle to a waypoint.

    Args:
        goal: Where to fly.
        feedback: The vehicle's newest feedback, with position and yaw.
        settings: Gains and limits; None are the defaults.

    Returns:
        Set-point in the body's levelled axes [m/s, rad/s].

    Raises:
        UsageError: Position or yaw are not known.
    """
    s = settings or WaypointSettings()
    east, north, up, yaw = _errors(goal, feedback)
    away = math.hypot(east, north)
    speed = _approach(away, s.speed_m_s, s)
    share = speed / away if away > 1e-9 else 0.0
    assert feedback.yaw_rad is not None
    c, si = math.cos(feedback.yaw_rad), math.sin(feedback.yaw_rad)
    return Velocity(
        forward=share * (c * east + si * north),
        left=share * (c * north - si * east),
        up=math.copysign(_approach(abs(up), s.climb_m_s, s), up),
        yaw_rate=clamped(s.yaw_gain * yaw, s.turn_rad_s),
    )


def reached(goal: Waypoint, feedback: Feedback, settings: WaypointSettings | None = None) -> bool:
    """Whether the vehicle is within the acceptance radius and nearly at rest.

    Args:
        goal: Where it is to be.
        feedback: The vehicle's newest feedback; without a velocity it counts as at rest.
        settings: Acceptance radii; None are the defaults.

    Raises:
        UsageError: Position or yaw are not known.
    """
    s = settings or WaypointSettings()
    east, north, up, yaw = _errors(goal, feedback)
    velocity = feedback.velocity_m_s
    at_rest = velocity is None or math.hypot(*velocity) <= s.slow_m_s
    return at_rest and math.hypot(east, north, up) <= s.near_m and abs(yaw) <= s.near_rad


def _errors(goal: Waypoint, feedback: Feedback) -> tuple[float, float, float, float]:
    """Return east, north, up [m] and yaw [rad] from where the vehicle is to the goal."""
    problem = lacking(feedback)
    if problem or feedback.position_m is None or feedback.yaw_rad is None:
        raise UsageError(f"it can't fly to a waypoint: {problem}")
    x, y, z = feedback.position_m
    turn = 0.0 if goal.yaw is None else wrap_angle(goal.yaw - feedback.yaw_rad)
    return goal.x - x, goal.y - y, goal.z - z, turn


def _approach(away: float, limit: float, s: WaypointSettings) -> float:
    """Return the speed at a distance: by the gain, within the limit, and slow enough to come to rest at the goal."""
    return min(s.gain * away, limit, math.sqrt(2.0 * s.slow_down_m_s2 * away))
