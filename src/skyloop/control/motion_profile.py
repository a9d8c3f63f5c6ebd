"""Speed along a path of known length, within limits and at one acceleration. Pure.

Each stretch has its own speed limit. The speeds at the joints come from one backward and one forward pass with
``v² = v₀² + 2·a·s``; within a stretch the vehicle accelerates, cruises and brakes (a trapezoidal profile; Biagiotti and
Melchiorri, "Trajectory Planning for Automatic Machines and Robots", Springer 2008, section 3.2).
"""

from __future__ import annotations

import bisect
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from skyloop.errors import UsageError

#: Shorter stretches are skipped: the squares of the speeds that they allow would be too small for a float.
SHORTEST_M: Final = 1e-9


@dataclass(frozen=True, slots=True)
class _Piece:
    begin_s: float
    begin_m: float
    speed: float
    acceleration: float


class MotionProfile:
    """Distance and speed over time, from rest to rest.

    Attributes:
        duration_s: How long the whole profile takes.
        length_m: Its whole length.
    """

    def __init__(self, stretches: Sequence[tuple[float, float]], acceleration_m_s2: float) -> None:
        """Compute the profile.

        Args:
            stretches: Length [m] and greatest speed [m/s] of each. Speed 0 belongs to a stretch of length 0: a stop.
                Stretches of at most :data:`SHORTEST_M` take no time.
            acceleration_m_s2: For speeding up and slowing down; above 0.

        Raises:
            UsageError: A stretch would never end, because its speed limit is 0.
        """
        self._pieces: list[_Piece] = []
        self.duration_s = 0.0
        self.length_m = 0.0
        joints = _joint_speeds(stretches, acceleration_m_s2)
        for (length, limit), (begin, end) in zip(stretches, itertools.pairwise(joints), strict=True):
            self._stretch(length, limit, begin, end, acceleration_m_s2)

    def at(self, t_s: float) -> tuple[float, float]:
        """Return the distance done [m] and the speed [m/s] at a time.

        Args:
            t_s: Time since the start; the vehicle is at rest before 0 and after :attr:`duration_s`.
        """
        if t_s <= 0.0 or not self._pieces:
            return 0.0, 0.0
        if t_s >= self.duration_s:
            return self.length_m, 0.0
        piece = self._pieces[bisect.bisect_right(self._pieces, t_s, key=lambda one: one.begin_s) - 1]
        dt = t_s - piece.begin_s
        way = piece.begin_m + piece.speed * dt + piece.acceleration * dt * dt / 2
        return min(self.length_m, way), max(0.0, piece.speed + piece.acceleration * dt)

    def _stretch(self, length: float, limit: float, begin: float, end: float, a: float) -> None:
        if length <= SHORTEST_M:
            return
        top = min(limit, math.sqrt((begin * begin + end * end) / 2 + a * length))
        if not top > 0.0:
            raise UsageError(f"a stretch of {length:g} m with a greatest speed of {limit:g} m/s has no end")
        up, down = (top * top - begin * begin) / (2 * a), (top * top - end * end) / (2 * a)
        self._piece(up, begin, a, (top - begin) / a)
        cruise = max(0.0, length - up - down)
        self._piece(cruise, top, 0.0, cruise / top)
        self._piece(down, top, -a, (top - end) / a)

    def _piece(self, length: float, speed: float, acceleration: float, lasts_s: float) -> None:
        if lasts_s > 0.0:
            self._pieces.append(_Piece(self.duration_s, self.length_m, speed, acceleration))
            self.duration_s += lasts_s
            self.length_m += length


def _joint_speeds(stretches: Sequence[tuple[float, float]], a: float) -> list[float]:
    """Return the speed before the first stretch, between each two, and after the last."""
    limits = [limit for _, limit in stretches]
    speeds = [0.0, *(min(pair) for pair in itertools.pairwise(limits)), 0.0]
    for k in range(len(stretches) - 1, -1, -1):
        speeds[k] = min(speeds[k], math.sqrt(speeds[k + 1] ** 2 + 2 * a * stretches[k][0]))
    for k, (length, _) in enumerate(stretches):
        speeds[k + 1] = min(speeds[k + 1], math.sqrt(speeds[k] ** 2 + 2 * a * length))
    return speeds
