"""What some drivers can do besides flying: take poses from outside, and say what of their vehicle wants attention."""

from __future__ import annotations

import math
from dataclasses import dataclass

from skyloop.errors import UsageError
from skyloop.messages import Vector


@dataclass(frozen=True, slots=True)
class ExternalPose:
    """Where something outside of the vehicle, such as motion capture, saw it.

    ``position``: of the body's origin in world axes, x east, y north, z up [m]. ``quaternion``: w, x, y, z, from body
    axes (forward, left, up) to world axes. ``captured_ns``: when it was so, on this host's monotonic clock.
    ``position_std_m`` and ``attitude_std_rad``: standard deviations, None where they are not known.

    Raises :class:`UsageError` for a number that is not finite and for a quaternion that is no rotation.
    """

    position: Vector
    quaternion: tuple[float, float, float, float]
    captured_ns: int
    position_std_m: float | None = None
    attitude_std_rad: float | None = None

    def __post_init__(self) -> None:
        numbers = (*self.position, *self.quaternion, self.position_std_m or 0.0, self.attitude_std_rad or 0.0)
        if len(self.position) != 3 or len(self.quaternion) != 4 or not all(map(math.isfinite, numbers)):
            raise UsageError(f"a pose has three and four finite numbers, not {self.position!r} and {self.quaternion!r}")
        if abs(math.hypot(*self.quaternion) - 1.0) > 1e-3:
            raise UsageError(f"a quaternion of a rotation has the length 1, not {math.hypot(*self.quaternion):.4g}")


@dataclass(frozen=True, slots=True)
class Remark:
    """Something about a vehicle's settings that a person may want to know before flying. ``advice``: what to do."""

    what: str
    good: bool
    detail: str
    advice: str = ""
