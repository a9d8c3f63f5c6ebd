"""Search with a camera that looks forward: turn on the spot, at one height after the other. Pure."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from skyloop.control.limiting import clamped, within
from skyloop.messages.geometry import wrap_angle

Array = NDArray[np.float64]


class TurningSearch:
    """Turns on the spot; after each full turn goes to the next height."""

    def __init__(
        self,
        turn_rad_s: float = 0.7,
        heights_m: tuple[float, ...] = (0.0, 0.4, -0.3, 0.8),
        lowest_m: float = 0.6,
        highest_m: float = 2.2,
    ) -> None:
        """Initialise the search.

        Args:
            turn_rad_s: Yaw rate.
            heights_m: One for each full turn, above the height at the start.
            lowest_m: Least height above the ground.
            highest_m: Greatest height above the ground.
        """
        self._rate = turn_rad_s
        self._heights = heights_m
        self._lowest, self._highest = lowest_m, highest_m
        self._direction = 1.0
        self._turned = 0.0
        self._yaw: float | None = None
        self._base: float | None = None

    def restart(self, *, turning: float) -> None:
        """Start the next search in the direction in which the vehicle is turning.

        Args:
            turning: Yaw rate [rad/s], counter-clockwise positive; below 0.05 the direction stays.
        """
        if abs(turning) > 0.05:
            self._direction = math.copysign(1.0, turning)
        self._turned, self._yaw, self._base = 0.0, None, None

    def step(self, yaw: float, altitude: float | None) -> Array:
        """Compute the set-point.

        Args:
            yaw: Of the vehicle [rad].
            altitude: Above the ground [m]; None keeps the height.

        Returns:
            Forward, left, up [m/s] and yaw rate [rad/s], (4,).
        """
        if self._yaw is not None:
            self._turned += abs(wrap_angle(yaw - self._yaw))
        self._yaw = yaw
        up = 0.0
        if altitude is not None:
            self._base = altitude if self._base is None else self._base
            sweep = int(self._turned / (2 * math.pi))
            goal = self._base + self._heights[sweep % len(self._heights)]
            goal = within(goal, self._lowest, self._highest)
            up = clamped(0.8 * (goal - altitude), 0.4)
        return np.array([0.0, 0.0, up, self._direction * self._rate])
