"""What some drivers can do besides flying: accept poses from outside, and check their vehicle's settings."""

from __future__ import annotations

from dataclasses import dataclass

from skyloop.messages import Vector
from skyloop.messages.pose import check_pose


@dataclass(frozen=True, slots=True)
class ExternalPose:
    """Where something outside of the vehicle, such as motion capture, saw it.

    Args:
        position: Of the body's origin in world axes, x east, y north, z up [m].
        quaternion: (x, y, z, w), rotates body axes (x forward, y left, z up) to world axes.
        captured_ns: When it was measured, on this host's monotonic clock.
        position_std_m: Standard deviation of the position [m], 0 or more; None if it is not known.
        attitude_std_rad: Standard deviation of the orientation [rad], 0 or more; None if it is not known.

    Raises:
        UsageError: A number is not finite, a standard deviation is negative, or the quaternion's length differs from 1
            by more than 0.001.
    """

    position: Vector
    quaternion: tuple[float, float, float, float]
    captured_ns: int
    position_std_m: float | None = None
    attitude_std_rad: float | None = None

    def __post_init__(self) -> None:
        check_pose(self.position, self.quaternion, self.position_std_m, self.attitude_std_rad)


@dataclass(frozen=True, slots=True)
class Remark:
    """Something about a vehicle's settings that a person may want to know before flying.

    Args:
        what: What was examined.
        good: Whether it is as it should be.
        detail: What was found.
        advice: What to do about it, empty if nothing.
    """

    what: str
    good: bool
    detail: str
    advice: str = ""
