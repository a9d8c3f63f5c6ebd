"""The shortest way round posts and gates on the ground plan. Pure.

A visibility graph (Lozano-Pérez and Wesley, "An algorithm for planning collision-free paths among polyhedral
obstacles", Communications of the ACM 22(10), 1979) over points around each obstacle, searched by Dijkstra's algorithm.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Point = tuple[float, float]

_AROUND = 8  # points around each end
_OUTSIDE = 1.0 / math.cos(math.pi / _AROUND) + 0.01  # so far out, the lines between them stay clear
_WITHIN_M = 0.02  # how much nearer one may be than where one stands already


class Wall(NamedTuple):
    """What a way must keep away from: the points within ``reach_m`` of a line; of a point where both ends are one."""

    begin: Point
    end: Point
    reach_m: float


def detour(start: Point, goal: Point, walls: Sequence[Wall]) -> list[Point] | None:
    """Return the points of the shortest way, without the start and with the goal; None where there is none.

    A start or goal that is too near to a wall may stay as near as it is, but the way comes no nearer.

    Args:
        start: East, north [m].
        goal: East, north [m].
        walls: At most a few dozen: the effort grows with the cube of their number.
    """
    ends = np.array([[wall.begin, wall.end] for wall in walls], dtype=np.float64).reshape(-1, 2, 2)
    reach = np.array([wall.reach_m for wall in walls], dtype=np.float64)
    both = np.array([start, goal], dtype=np.float64)
    for point in both:
        reach = np.minimum(reach, _distances(point[None], point[None], ends)[0] - _WITHIN_M)
    points = np.concatenate([both, *_corners(ends, reach)])
    begin, end = np.triu_indices(len(points), 1)
    clear = (_distances(points[begin], points[end], ends) >= reach - 1e-9).all(axis=1)
    lengths = np.full((len(points), len(points)), math.inf)
    apart = np.linalg.norm(points[begin] - points[end], axis=1)
    lengths[begin[clear], end[clear]] = lengths[end[clear], begin[clear]] = apart[clear]
    return _shortest(points, lengths)


def _corners(ends: Array, reach: Array) -> list[Array]:
    """Return points around both ends of each wall, (n, 2) each."""
    turns = np.arange(_AROUND) * (2 * math.pi / _AROUND)
    circle = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    corners = []
    for (first, last), far in zip(ends, reach, strict=True):
        for end in (first,) if np.array_equal(first, last) else (first, last):
            corners.append(end + circle * (max(far, 0.05) * _OUTSIDE))
    return corners


def _shortest(points: Array, lengths: Array) -> list[Point] | None:
    """Return the way from the first point to the second."""
    best, came = {0: 0.0}, {0: 0}
    queue = [(0.0, 0)]
    while queue:
        far, here = heapq.heappop(queue)
        if here == 1:
            way = [here]
            while came[way[-1]] != 0:
                way.append(came[way[-1]])
            return [(float(points[number, 0]), float(points[number, 1])) for number in reversed(way)]
        if far > best[here]:
            continue
        for there in np.flatnonzero(np.isfinite(lengths[here])).tolist():
            total = far + float(lengths[here, there])
            if total < best.get(there, math.inf):
                best[there], came[there] = total, here
                heapq.heappush(queue, (total, there))
    return None


def _distances(begin: Array, end: Array, walls: Array) -> Array:
    """Return the distance of each segment (n, 2) to (n, 2) from each wall (m, 2, 2), shape (n, m)."""
    a, b = begin[:, None], end[:, None]
    c, d = walls[None, :, 0], walls[None, :, 1]
    apart = np.minimum(
        np.minimum(_to_segment(a, c, d), _to_segment(b, c, d)), np.minimum(_to_segment(c, a, b), _to_segment(d, a, b))
    )
    crossing = (_side(a, b, c) * _side(a, b, d) < 0) & (_side(c, d, a) * _side(c, d, b) < 0)
    return np.where(crossing, 0.0, apart)


def _to_segment(point: Array, begin: Array, end: Array) -> Array:
    way = end - begin
    share = ((point - begin) * way).sum(axis=-1) / np.maximum((way * way).sum(axis=-1), 1e-12)
    nearest = begin + np.clip(share, 0.0, 1.0)[..., None] * way
    distance: Array = np.linalg.norm(point - nearest, axis=-1)
    return distance


def _side(begin: Array, end: Array, point: Array) -> Array:
    side: Array = (end[..., 0] - begin[..., 0]) * (point[..., 1] - begin[..., 1]) - (end[..., 1] - begin[..., 1]) * (
        point[..., 0] - begin[..., 0]
    )
    return side
