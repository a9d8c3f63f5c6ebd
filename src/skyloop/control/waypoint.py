"""Positions, position sources, and a control law that computes the velocity for flying to a position.

The law is purely proportional and keeps no state. The speed is limited, and near the goal it is low enough for the
vehicle to stop there at a given deceleration. Only the yaw is used to convert the error to the body's levelled axes, in
which set-points are given (ROS REP 103).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from skyloop.control.airframe import Airframe
from skyloop.control.limiting import clamped
from skyloop.errors import UsageError
from skyloop.messages import Feedback, Vector, Velocity
from skyloop.messages.feedback import NO_POSITION, POSITION_SOURCES
from skyloop.messages.geometry import turned, wrap_angle

if TYPE_CHECKING:
    from skyloop.client import Drone


@dataclass(frozen=True, slots=True)
class Waypoint:
    """A position in world axes, and optionally a yaw.

    Raises:
        UsageError: A number is not finite.
    """

    x: float  #: east [m]
    y: float  #: north [m]
    z: float  #: up [m]
    yaw: float | None = None  #: counter-clockwise from x [rad]; None to leave it free

    def __post_init__(self) -> None:
        for name in ("x", "y", "z", "yaw"):
            value = getattr(self, name)
            if value is not None and not math.isfinite(value):
                raise UsageError(f"{name} of a waypoint is {value} and must be finite")

    @property
    def position(self) -> Vector:
        """The position (x, y, z) in world axes [m]."""
        return self.x, self.y, self.z


@dataclass(frozen=True, slots=True)
class WaypointSettings:
    """Gains, limits and acceptance radii. The defaults suit a small indoor vehicle with velocity control."""

    gain: float = 1.2  #: speed per metre of distance [1/s]
    yaw_gain: float = 1.5  #: [1/s]
    speed_m_s: float = 1.0  #: maximum horizontal speed
    climb_m_s: float = 0.6  #: maximum vertical speed
    turn_rad_s: float = 1.2  #: maximum yaw rate
    slow_down_m_s2: float = 0.6  #: deceleration towards the goal
    near_m: float = 0.15  #: acceptance radius
    near_rad: float = 0.1
    slow_m_s: float = 0.2  #: maximum speed at which the goal counts as reached, if the velocity is known


def lacking(feedback: Feedback) -> str:
    """Return why a vehicle can't be flown to a position, with a remedy; empty if it can."""
    if feedback.position_m is None or not all(map(math.isfinite, feedback.position_m)):
        return f"{NO_POSITION}: {POSITION_SOURCES}"
    yaw = feedback.yaw_rad
    return "" if yaw is not None and math.isfinite(yaw) else "the vehicle does not report its yaw"


def velocity_to(goal: Waypoint, feedback: Feedback, settings: WaypointSettings | None = None) -> Velocity:
    """Compute the velocity that brings a vehicle to a waypoint, in the body's levelled axes [m/s, rad/s].

    Raises UsageError if the vehicle's position or yaw is unknown.
    """
    s = settings or WaypointSettings()
    east, north, up, yaw = _errors(goal, feedback)
    away = math.hypot(east, north)
    speed = _approach(away, s.speed_m_s, s)
    share = speed / away if away > 1e-9 else 0.0
    assert feedback.yaw_rad is not None
    forward, left = turned(east, north, -feedback.yaw_rad)
    return Velocity(
        forward=share * forward,
        left=share * left,
        up=math.copysign(_approach(abs(up), s.climb_m_s, s), up),
        yaw_rate=clamped(s.yaw_gain * yaw, s.turn_rad_s),
    )


def reached(goal: Waypoint, feedback: Feedback, settings: WaypointSettings | None = None) -> bool:
    """Return whether the vehicle is within the acceptance radius and almost at rest, if its velocity is known."""
    s = settings or WaypointSettings()
    east, north, up, yaw = _errors(goal, feedback)
    velocity = feedback.velocity_m_s
    at_rest = velocity is None or math.hypot(*velocity) <= s.slow_m_s
    return at_rest and math.hypot(east, north, up) <= s.near_m and abs(yaw) <= s.near_rad


def _errors(goal: Waypoint, feedback: Feedback) -> tuple[float, float, float, float]:
    """Return the goal's pose minus the vehicle's: east, north, up [m] and yaw [rad]."""
    problem = lacking(feedback)
    if problem or feedback.position_m is None or feedback.yaw_rad is None:
        raise UsageError(f"can't fly to a waypoint: {problem}")
    x, y, z = feedback.position_m
    turn = 0.0 if goal.yaw is None else wrap_angle(goal.yaw - feedback.yaw_rad)
    return goal.x - x, goal.y - y, goal.z - z, turn


def _approach(away: float, limit: float, s: WaypointSettings) -> float:
    """Return the speed at a distance from the goal, limited so that the vehicle can still stop there."""
    return min(s.gain * away, limit, math.sqrt(2.0 * s.slow_down_m_s2 * away))


class Fix(NamedTuple):
    """A position in world axes (x east, y north, z up) at a point in time."""

    at_ns: int  #: time on the proxy's clock
    position_m: Vector  #: position [m]
    yaw_rad: float  #: yaw, counter-clockwise from x [rad]
    velocity_m_s: Vector | None = None  #: velocity in world axes [m/s]; None if unknown

    @property
    def finite(self) -> bool:
        """Whether all values are finite."""
        return all(map(math.isfinite, (*self.position_m, self.yaw_rad, *(self.velocity_m_s or ()))))


#: Function that returns the newest position, or None if it is unknown. It must not block.
PositionSource = Callable[[], Fix | None]


def fix_of(feedback: Feedback) -> Fix | None:
    """Return the position from a vehicle's own feedback, at its capture time; None if position or yaw is unknown."""
    yaw, velocity = feedback.yaw_rad, feedback.velocity_m_s
    if feedback.position_m is None or yaw is None:
        return None
    if velocity is not None:
        velocity = *turned(velocity[0], velocity[1], yaw), velocity[2]
    return Fix(feedback.captured_ns, feedback.position_m, yaw, velocity)


class DeadReckoning:
    """A position source that integrates the velocity of vehicles that report no position.

    Errors of the velocity make the position drift. The height is the vehicle's altitude, if it reports one. Feedback is
    handled on the thread that receives it.
    """

    def __init__(self, drone: Drone, begin: tuple[float, float] = (0.0, 0.0)) -> None:
        """Subscribe to the drone's feedback.

        Args:
            drone: The drone.
            begin: The vehicle's current position, x and y [m].
        """
        self._begin = begin
        self._airframe = Airframe()
        self._newest: Fix | None = None
        self._listener = drone.on_feedback(self._add, inline=True)

    def __call__(self) -> Fix | None:
        """Return the newest position; None until the vehicle has reported velocity and yaw."""
        return self._newest

    def close(self) -> None:
        """Cancel the subscription."""
        self._listener.cancel()

    def _add(self, feedback: Feedback) -> None:
        self._airframe.add(feedback)
        motion = self._airframe.newest
        if motion is None or motion.at_ns != feedback.captured_ns:
            return  # nothing new or nothing usable
        east, north, up = motion.position.tolist()
        height = up if feedback.altitude_m is None else feedback.altitude_m
        vx, vy, vz = motion.velocity.tolist()
        place = (self._begin[0] + east, self._begin[1] + north, height)
        self._newest = Fix(motion.at_ns, place, motion.yaw, (vx, vy, vz))
