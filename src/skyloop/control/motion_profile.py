"""How fast to go along a way of known length: speeds within limits, changed at one acceleration. Pure.

Each stretch has a speed limit of its own. Speeds at the joints come from one pass back and one forth with
``v² = v₀² + 2·a·s``; within a stretch it speeds up, cruises and slows down (a trapezoidal profile; Biagiotti and
Melchiorri, "Trajectory Planning for Automatic Machines and Robots", Springer 2008, section 3.2).
"""

from __future__ import annotations

import bisect
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class _Piece:
    begin_s: float
    begin_m: float
    speed: float
    acceleration: float


class MotionProfile:
    """From rest to rest along stretches, each given by its length [m] and its greatest speed [m/s].

    A limit of 0 belongs to a stretch of no length: a stop. :attr:`duration_s` is how long it takes.
    """

    def __init__(self, stretches: Sequence[tuple[float, float]], acceleration_m_s2: float) -> None:
        self._pieces: list[_Piece] = []
        self.duration_s = 0.0
        self.length_m = 0.0
        joints = _joint_speeds(stretches, acceleration_m_s2)
        for (length, limit), (begin, end) in zip(stretches, itertools.pairwise(joints), strict=True):
            self._stretch(length, limit, begin, end, acceleration_m_s2)

    def at(self, t_s: float) -> tuple[float, float]:
        """Way done [m] and speed [m/s] at a time from the begin; at rest before it and after the end."""
        if t_s <= 0.0 or not self._pieces:
            return 0.0, 0.0
        if t_s >= self.duration_s:
            return self.length_m, 0.0
        piece = self._pieces[bisect.bisect_right(self._pieces, t_s, key=lambda one: one.begin_s) - 1]
        dt = t_s - piece.begin_s
        way = piece.begin_m + piece.speed * dt + piece.acceleration * dt * dt / 2
        return min(self.length_m, way), max(0.0, piece.speed + piece.acceleration * dt)

    def _stretch(self, length: float, limit: float, begin: float, end: float, a: float) -> None:
        if length <= 0.0:
            return
        top = min(limit, math.sqrt((begin * begin + end * end) / 2 + a * length))
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
    """The speed before the first stretch, between each two, and after the last."""
    limits = [limit for _, limit in stretches]
    speeds = [0.0, *(min(pair) for pair in itertools.pairwise(limits)), 0.0]
    for k in range(len(stretches) - 1, -1, -1):
        speeds[k] = min(speeds[k], math.sqrt(speeds[k + 1] ** 2 + 2 * a * stretches[k][0]))
    for k, (length, _) in enumerate(stretches):
        speeds[k + 1] = min(speeds[k + 1], math.sqrt(speeds[k] ** 2 + 2 * a * length))
    return speeds
