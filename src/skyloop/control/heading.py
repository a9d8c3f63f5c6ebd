"""Where to look while flying: yaw modes. Pure.

A mode is called with the place and the velocity that the path wants, both (3,) in world axes, and returns the yaw
[rad], or None where it does not care.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import UsageError

Array = NDArray[np.float64]
_ALONG_M_S = 0.05  # slower than this a velocity has no direction worth turning to
_NEAR_M = 0.3  # a point nearer than this, seen from above, is nothing to look at


class YawMode(Protocol):
    """One way to choose the yaw."""

    def __call__(self, position: Array, velocity: Array) -> float | None: ...


@dataclass(frozen=True, slots=True)
class FixedYaw:
    """Always this yaw [rad]."""

    yaw: float

    def __post_init__(self) -> None:
        if not math.isfinite(self.yaw):
            raise UsageError(f"yaw is {self.yaw} and must be finite")

    def __call__(self, position: Array, velocity: Array) -> float | None:  # noqa: ARG002
        return self.yaw


@dataclass(frozen=True, slots=True)
class AlongPath:
    """The way it flies, plus ``offset`` [rad]; while it stands or only climbs, as before."""

    offset: float = 0.0

    def __call__(self, position: Array, velocity: Array) -> float | None:  # noqa: ARG002
        if math.hypot(velocity[0], velocity[1]) < _ALONG_M_S:
            return None
        return math.atan2(velocity[1], velocity[0]) + self.offset


@dataclass(frozen=True, slots=True)
class LookAt:
    """At a point [m]; while it is above or below it, as before."""

    x: float
    y: float

    def __call__(self, position: Array, velocity: Array) -> float | None:  # noqa: ARG002
        east, north = self.x - position[0], self.y - position[1]
        return math.atan2(north, east) if math.hypot(east, north) >= _NEAR_M else None
