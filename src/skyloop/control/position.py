"""Sources of positions: the vehicle's own feedback, motion capture, or its integrated velocity."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

from skyloop.control.airframe import Airframe
from skyloop.messages import Feedback, Vector
from skyloop.messages.geometry import turned

if TYPE_CHECKING:
    from skyloop.client import Drone


class Fix(NamedTuple):
    """A position in world axes (x east, y north, z up) at one time."""

    at_ns: int  #: on the proxy's clock
    position_m: Vector  #: [m]
    yaw_rad: float  #: counter-clockwise from x [rad]
    velocity_m_s: Vector | None = None  #: in world axes [m/s], if it is known

    @property
    def finite(self) -> bool:
        """Whether all its numbers are finite."""
        return all(map(math.isfinite, (*self.position_m, self.yaw_rad, *(self.velocity_m_s or ()))))


#: Returns the newest known position, None while it is not known; must not block.
PositionSource = Callable[[], Fix | None]


def fix_of(feedback: Feedback) -> Fix | None:
    """Return the position that the vehicle itself reports.

    Returns:
        The fix at the feedback's capture; None while position or yaw are not known.
    """
    if feedback.position_m is None or feedback.yaw_rad is None:
        return None
    return Fix(
        feedback.captured_ns,
        feedback.position_m,
        feedback.yaw_rad,
        _world_velocity(feedback.velocity_m_s, feedback.yaw_rad),
    )


class DeadReckoning:
    """A position source for a vehicle that reports its velocity but no position: integrates it from where it is now.

    The position drifts by the velocity's error. The height is the vehicle's altitude, where it reports one. Feedback is
    handled on the thread that receives it.
    """

    def __init__(self, drone: Drone, begin: tuple[float, float] = (0.0, 0.0)) -> None:
        """Subscribe to the drone's feedback.

        Args:
            drone: The drone.
            begin: Where it is now, x and y [m].
        """
        self._begin = begin
        self._airframe = Airframe()
        self._newest: Fix | None = None
        self._listener = drone.on_feedback(self._take, inline=True)

    def __call__(self) -> Fix | None:
        """Return the newest position; None before velocity and yaw were received."""
        return self._newest

    def close(self) -> None:
        """Cancel the subscription."""
        self._listener.cancel()

    def _take(self, feedback: Feedback) -> None:
        self._airframe.add(feedback)
        motion = self._airframe.newest
        if motion is None or motion.at_ns != feedback.captured_ns:
            return  # nothing new, or nothing of use
        east, north, up = motion.position.tolist()
        height = up if feedback.altitude_m is None else feedback.altitude_m
        vx, vy, vz = motion.velocity.tolist()
        place = (self._begin[0] + east, self._begin[1] + north, height)
        self._newest = Fix(motion.at_ns, place, motion.yaw, (vx, vy, vz))


def _world_velocity(velocity: Vector | None, yaw: float) -> Vector | None:
    if velocity is None:
        return None
    forward, left, up = velocity
    return *turned(forward, left, yaw), up
