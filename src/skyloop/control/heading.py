"""Yaw modes: where the front points while flying. Pure.

A mode is called with the position and the velocity that the path wants, both (3,) in world axes, and returns the yaw
[rad], or None to keep the present one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import UsageError

Array = NDArray[np.float64]
_ALONG_M_S = 0.05  # slower velocities have no direction worth turning to
_NEAR_M = 0.3  # a point nearer than this, seen from above, has no reliable bearing


class YawMode(Protocol):
    """Chooses the yaw by the path's position and velocity."""

    def __call__(self, position: Array, velocity: Array) -> float | None: ...


@dataclass(frozen=True, slots=True)
class FixedYaw:
    """Always the same yaw [rad].

    Raises:
        UsageError: The yaw is not finite.
    """

    yaw: float

    def __post_init__(self) -> None:
        if not math.isfinite(self.yaw):
            raise UsageError(f"yaw is {self.yaw} and must be finite")

    def __call__(self, position: Array, velocity: Array) -> float | None:  # noqa: ARG002
        """Return the yaw."""
        return self.yaw


@dataclass(frozen=True, slots=True)
class AlongPath:
    """The direction of flight plus ``offset`` [rad]; the yaw stays while the vehicle hovers or only climbs."""

    offset: float = 0.0

    def __call__(self, position: Array, velocity: Array) -> float | None:  # noqa: ARG002
        """Return the yaw, or None while the horizontal speed is less than 0.05 m/s."""
        if math.hypot(velocity[0], velocity[1]) < _ALONG_M_S:
            return None
        return math.atan2(velocity[1], velocity[0]) + self.offset


@dataclass(frozen=True, slots=True)
class LookAt:
    """Faces a point, x and y in world axes [m]; the yaw stays while the vehicle is above or below it."""

    x: float
    y: float

    def __call__(self, position: Array, velocity: Array) -> float | None:  # noqa: ARG002
        """Return the yaw, or None within 0.3 m of the point, seen from above."""
        east, north = self.x - position[0], self.y - position[1]
        return math.atan2(north, east) if math.hypot(east, north) >= _NEAR_M else None
