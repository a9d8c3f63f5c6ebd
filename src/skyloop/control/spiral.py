"""Search with a camera that looks down: a square spiral outwards. Pure.

The expanding square of search and rescue: International Aeronautical and Maritime Search and Rescue Manual, volume II,
section 5.5 (legs of 1, 1, 2, 2, 3, 3 … lanes, each a quarter turn from the one before).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import UsageError

Array = NDArray[np.float64]


class SpiralSearch:
    """Flies an expanding square around its start; at its greatest size it returns to the start and starts over."""

    def __init__(self, lane_m: float = 1.1, speed_m_s: float = 0.7, largest_m: float = 4.4) -> None:
        """Initialise the search.

        Args:
            lane_m: Distance between lanes.
            speed_m_s: Greatest speed.
            largest_m: Length of the longest leg.

        Raises:
            UsageError: A number is not finite and above 0.
        """
        for name, value in (("lane_m", lane_m), ("speed_m_s", speed_m_s), ("largest_m", largest_m)):
            if not 0.0 < value < math.inf:
                raise UsageError(f"{name} is {value!r} and must be a finite number above 0")
        self._lane, self._speed = lane_m, speed_m_s
        self._legs = max(1, int(largest_m / lane_m)) * 2
        self._leg = 0
        self._goal: Array | None = None
        self._begin: Array | None = None

    def restart(self) -> None:
        """Start the next search around the position at its first step."""
        self._leg, self._goal = 0, None

    def step(self, position: Array) -> Array:
        """Return the wanted velocity (2,) [m/s] at a position (2,) [m], in the same axes."""
        if self._goal is None:
            self._begin = self._goal = position.copy()
        way = self._goal - position
        distance = float(np.linalg.norm(way))
        if distance < 0.2:
            self._goal = self._next(self._goal)
            way = self._goal - position
            distance = float(np.linalg.norm(way))
        return way * (min(self._speed, 1.5 * distance) / max(distance, 1e-9))

    def _next(self, corner: Array) -> Array:
        """Return where the next leg ends."""
        if self._leg >= self._legs and self._begin is not None:
            self._leg = 0
            return self._begin
        length = self._lane * (self._leg // 2 + 1)
        angle = self._leg * math.pi / 2
        self._leg += 1
        return corner + length * np.array([math.cos(angle), math.sin(angle)])
