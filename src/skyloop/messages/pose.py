"""Where something outside of a vehicle, such as motion capture, saw it: for vehicles that fly by that."""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec

from skyloop.errors import UsageError
from skyloop.messages.numbers import TimeNs


class VehiclePose(msgspec.Struct, frozen=True, array_like=True):
    """A pose for the vehicle itself, from a pilot's application. World axes x east, y north, z up."""

    captured_ns: TimeNs  #: when it was so, on the proxy's clock
    position_m: tuple[float, float, float]  #: of the body's origin [m]
    quaternion: tuple[float, float, float, float]  #: x, y, z, w, from body axes (forward, left, up) to world axes
    position_std_m: float | None = None  #: standard deviation, if it is known
    attitude_std_rad: float | None = None  #: standard deviation, if it is known


def check_pose(
    position: Sequence[float],
    quaternion: Sequence[float],
    position_std_m: float | None = None,
    attitude_std_rad: float | None = None,
) -> None:
    """Check the numbers of a pose.

    Args:
        position: x, y, z [m].
        quaternion: x, y, z, w.
        position_std_m: Standard deviation of the position [m], 0 or more; None if it is not known.
        attitude_std_rad: Standard deviation of the orientation [rad], 0 or more; None if it is not known.

    Raises:
        UsageError: If a number is missing or not finite, a standard deviation is negative, or the quaternion's length
            differs from 1 by more than 0.001.
    """
    for name, axes, values in (("position", "x, y, z", position), ("quaternion", "x, y, z, w", quaternion)):
        count = len(axes.split(", "))
        if len(values) != count or not all(map(math.isfinite, values)):
            raise UsageError(f"{name} must have {count} finite numbers ({axes}), got {tuple(values)!r}")
    length = math.hypot(*quaternion)
    if abs(length - 1.0) > 1e-3:
        raise UsageError(f"quaternion (x, y, z, w) of a rotation must have length 1, got {length:.4g}")
    for name, value in (("position_std_m", position_std_m), ("attitude_std_rad", attitude_std_rad)):
        if value is not None and not 0.0 <= value < math.inf:
            raise UsageError(f"{name} is {value!r} and must be 0 or more, or None where it is not known")
