"""Shapes for several drones, who flies to which place, and whether their ways keep apart. Pure.

A shape is an array of places, shape (n, 3), float64, in metres: x ahead, y left, z up, centred on its own middle. With
:func:`placed` it stands in world axes (ROS REP 103).
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skyloop.errors import UsageError
from skyloop.messages.geometry import rotation_from_euler

#: Of n drones, shape (n, 3), float64.
Places = NDArray[np.float64]

MOST: Final = 200  #: drones that :func:`assign` takes


class Approach(NamedTuple):
    """How near two of several drones come to each other."""

    distance_m: float  #: infinite for less than two drones
    first: int
    second: int


def line(n: int, spacing_m: float) -> Places:
    """Side by side, the first at the left end."""
    _check(n, spacing_m=spacing_m)
    return _centred([(0.0, -spacing_m * k, 0.0) for k in range(n)])


def column(n: int, spacing_m: float) -> Places:
    """One behind the other, the first ahead."""
    _check(n, spacing_m=spacing_m)
    return _centred([(-spacing_m * k, 0.0, 0.0) for k in range(n)])


def circle(n: int, spacing_m: float) -> Places:
    """On a circle, neighbours so far apart, the first ahead and the others counter-clockwise after it."""
    _check(n, spacing_m=spacing_m)
    radius = spacing_m / (2 * math.sin(math.pi / n)) if n > 1 else 0.0
    turns = [2 * math.pi * k / n for k in range(n)]
    return np.array([(radius * math.cos(turn), radius * math.sin(turn), 0.0) for turn in turns]).reshape(n, 3)


def vee(n: int, spacing_m: float, angle: float = math.pi / 2) -> Places:
    """Like geese: the first ahead, the others behind it by turns left and right, on legs that open by ``angle`` [rad].

    An angle of less than π/3 would bring the two legs closer than the spacing.
    """
    _check(n, spacing_m=spacing_m)
    if not math.pi / 3 - 1e-9 <= angle <= math.pi:
        raise UsageError(f"angle is {angle!r} and must be from pi/3 to pi rad")
    back, aside = math.cos(angle / 2), math.sin(angle / 2)
    steps = [((k + 1) // 2, 1 if k % 2 else -1) for k in range(n)]
    return _centred([(-spacing_m * step * back, side * spacing_m * step * aside, 0.0) for step, side in steps])


def grid(n: int, spacing_m: float, columns: int | None = None) -> Places:
    """In rows of ``columns`` (default: as square as it gets), the first ahead and left."""
    _check(n, spacing_m=spacing_m)
    wide = math.ceil(math.sqrt(n)) if columns is None else columns
    if wide < 1:
        raise UsageError(f"columns is {columns!r} and must be at least 1")
    return _centred([(-spacing_m * (k // wide), -spacing_m * (k % wide), 0.0) for k in range(n)])


def placed(shape: ArrayLike, at: ArrayLike, yaw: float = 0.0) -> Places:
    """The shape turned by ``yaw`` [rad] counter-clockwise about z, its middle at ``at`` in world axes [m]."""
    middle = np.asarray(at, dtype=np.float64)
    if middle.shape != (3,) or not np.isfinite(middle).all() or not math.isfinite(yaw):
        raise UsageError(f"a formation is placed at three finite coordinates with a finite yaw, not {at!r}, {yaw!r}")
    turned: Places = places(shape) @ rotation_from_euler(0.0, 0.0, yaw).T
    return turned + middle


def places(values: ArrayLike) -> Places:
    """An array of places. Raises :class:`UsageError` for what is not finite or not of shape (n, 3)."""
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise UsageError(f"{values!r:.80} is no array of places") from None
    if array.ndim != 2 or array.shape[1] != 3 or not np.isfinite(array).all():
        raise UsageError(f"places have the shape (n, 3) and finite coordinates, not {array.shape}")
    return array


def assign(starts: ArrayLike, slots: ArrayLike) -> list[int]:
    """For each start the number of its slot, so that the sum of the squared distances is the least.

    With that sum the straight ways of drones that leave and arrive together do not cross, and keep apart by 1/√2 of the
    least distance among starts and among slots, each start being that far from other starts and each slot from other
    slots (Turpin, Michael and Kumar, "CAPT", International Journal of Robotics Research 33, 2014). There may be
    more slots than starts. Raises :class:`UsageError`.
    """
    a, b = places(starts), places(slots)
    if len(a) > len(b):
        raise UsageError(f"{len(a)} drones have only {len(b)} places to fly to")
    if len(b) > MOST:
        raise UsageError(f"{len(b)} places are more than the {MOST} that can be assigned")
    costs = ((a[:, None, :] - b[None, :, :]) ** 2).sum(axis=2)
    return _least_cost(costs)


def closest_approach(starts: ArrayLike, goals: ArrayLike) -> Approach:
    """How near two drones come when each flies straight from its start to its goal, all in the same time."""
    a, b = places(starts), places(goals)
    nearest = Approach(math.inf, 0, 0)
    for i in range(len(a)):
        for j in range(i + 1, len(a)):
            begin, change = a[i] - a[j], (b[i] - b[j]) - (a[i] - a[j])
            moved = float(change @ change)
            at = min(1.0, max(0.0, -float(begin @ change) / moved)) if moved > 0.0 else 0.0
            distance = float(np.linalg.norm(begin + at * change))
            if distance < nearest.distance_m:
                nearest = Approach(distance, i, j)
    return nearest


def kept_apart(velocities: ArrayLike, positions: ArrayLike, apart_m: float, gain: float = 1.0) -> Places:
    """World velocities [m/s], changed where two drones are closer than ``apart_m``, so that these part.

    Their velocities along the line between them become such that the distance grows by ``gain`` [1/s] times what is
    missing; both give way by half. What they do across that line stays.
    """
    changed, at = places(velocities).copy(), places(positions)
    for i in range(len(at)):
        for j in range(i + 1, len(at)):
            between = at[i] - at[j]
            distance = float(np.linalg.norm(between))
            if distance >= apart_m:
                continue
            away = between / distance if distance > 1e-6 else np.array([1.0, 0.0, 0.0])
            missing = gain * (apart_m - distance) - float((changed[i] - changed[j]) @ away)
            if missing > 0.0:
                changed[i] += 0.5 * missing * away
                changed[j] -= 0.5 * missing * away
    return changed


def _centred(points: list[tuple[float, float, float]]) -> Places:
    array: Places = np.array(points, dtype=np.float64)
    middle: Places = (array.max(axis=0) + array.min(axis=0)) / 2
    return array - middle


def _check(n: int, *, spacing_m: float) -> None:
    if not isinstance(n, int) or n < 1:
        raise UsageError(f"a formation has at least one place, not {n!r}")
    if not (math.isfinite(spacing_m) and spacing_m > 0.0):
        raise UsageError(f"spacing_m is {spacing_m!r} and must be more than 0 m")


def _least_cost(costs: NDArray[np.float64]) -> list[int]:
    """The column of each row with the least sum; not more rows than columns.

    By successive shortest augmenting paths with potentials (Kuhn 1955; Jonker and Volgenant 1987): rows join one after
    the other, each by the cheapest chain of changes among those that are there.
    """
    rows, columns = costs.shape
    row_price, column_price = np.zeros(rows), np.zeros(columns)
    row_of = np.full(columns, -1)
    for new in range(rows):
        least = np.full(columns, math.inf)  # of the reduced cost at which a column is reached
        before = np.full(columns, -1)  # the column from whose row it is reached
        done = np.zeros(columns, dtype=bool)
        row, column, so_far = new, -1, 0.0
        while row >= 0:
            reduced = so_far + costs[row] - row_price[row] - column_price
            better = ~done & (reduced < least)
            least[better], before[better] = reduced[better], column
            column = int(np.argmin(np.where(done, math.inf, least)))
            so_far = float(least[column])
            done[column] = True
            row = int(row_of[column])
        reached = np.flatnonzero(done & (row_of >= 0))
        row_price[row_of[reached]] += so_far - least[reached]
        row_price[new] += so_far
        column_price[done] -= so_far - least[done]
        while column >= 0:
            previous = int(before[column])
            row_of[column] = row_of[previous] if previous >= 0 else new
            column = previous
    slot_of = {int(row): column for column, row in enumerate(row_of) if row >= 0}
    return [slot_of[row] for row in range(rows)]
