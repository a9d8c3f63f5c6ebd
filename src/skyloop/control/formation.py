"""Formation shapes, assignment of drones to positions, and checks of the distances between flying drones. Pure.

A formation shape is a float64 array (n, 3) of positions in metres: x ahead, y left, z up, centred on the origin.
:func:`placed` converts it to world axes (ROS REP 103).
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skyloop.control.limiting import within
from skyloop.errors import UsageError
from skyloop.estimation import assignment
from skyloop.messages.geometry import rotation_from_euler

#: Positions of n drones, shape (n, 3), float64 [m].
Places = NDArray[np.float64]

MOST: Final = 200  #: maximum number of positions for :func:`assign`


class Approach(NamedTuple):
    """The closest approach between any two of several drones."""

    distance_m: float  #: infinite if there are fewer than two drones
    first: int  #: index of one drone of the pair
    second: int  #: index of the other drone


def line(n: int, spacing_m: float) -> Places:
    """Return a line abreast with the first drone at the left end.

    Args:
        n: Number of drones.
        spacing_m: Distance between neighbours.

    Raises:
        UsageError: ``n`` is less than 1, or the spacing is not a finite number greater than 0.
    """
    _check(n, spacing_m=spacing_m)
    return _centred([(0.0, -spacing_m * k, 0.0) for k in range(n)])


def column(n: int, spacing_m: float) -> Places:
    """Return a column of drones behind one another, with the first drone at the front.

    Args:
        n: Number of drones.
        spacing_m: Distance between neighbours.

    Raises:
        UsageError: ``n`` is less than 1, or the spacing is not a finite number greater than 0.
    """
    _check(n, spacing_m=spacing_m)
    return _centred([(-spacing_m * k, 0.0, 0.0) for k in range(n)])


def circle(n: int, spacing_m: float) -> Places:
    """Return a circle with the first drone ahead and the others following counter-clockwise.

    Args:
        n: Number of drones.
        spacing_m: Distance between neighbours, along the chord.

    Raises:
        UsageError: ``n`` is less than 1, or the spacing is not a finite number greater than 0.
    """
    _check(n, spacing_m=spacing_m)
    radius = spacing_m / (2 * math.sin(math.pi / n)) if n > 1 else 0.0
    turns = [2 * math.pi * k / n for k in range(n)]
    return np.array([(radius * math.cos(turn), radius * math.sin(turn), 0.0) for turn in turns]).reshape(n, 3)


def vee(n: int, spacing_m: float, angle: float = math.pi / 2) -> Places:
    """Return a V formation with the first drone in front and the others behind it, alternately left and right.

    Args:
        n: Number of drones.
        spacing_m: Distance between neighbours on one leg.
        angle: Angle between the legs [rad], π/3 to π; at smaller angles, drones on different legs would be too close.

    Raises:
        UsageError: An argument is out of range.
    """
    _check(n, spacing_m=spacing_m)
    if not math.pi / 3 - 1e-9 <= angle <= math.pi:
        raise UsageError(f"angle is {angle!r} and must be from pi/3 to pi rad")
    back, aside = math.cos(angle / 2), math.sin(angle / 2)
    steps = [((k + 1) // 2, 1 if k % 2 else -1) for k in range(n)]
    return _centred([(-spacing_m * step * back, side * spacing_m * step * aside, 0.0) for step, side in steps])


def grid(n: int, spacing_m: float, columns: int | None = None) -> Places:
    """Return a grid of rows with the first drone at the front left.

    Args:
        n: Number of drones.
        spacing_m: Distance between neighbours in a row and between rows.
        columns: Number of drones per row; None to make the grid as square as possible.

    Raises:
        UsageError: An argument is out of range.
    """
    _check(n, spacing_m=spacing_m)
    wide = math.ceil(math.sqrt(n)) if columns is None else columns
    if wide < 1:
        raise UsageError(f"columns is {columns!r} and must be at least 1")
    return _centred([(-spacing_m * (k // wide), -spacing_m * (k % wide), 0.0) for k in range(n)])


def placed(shape: ArrayLike, at: ArrayLike, yaw: float = 0.0) -> Places:
    """Rotate a shape and move it into world axes.

    Args:
        shape: The formation shape, (n, 3) [m].
        at: World position of the shape's centre, (3,) [m].
        yaw: Rotation about z, counter-clockwise [rad].

    Raises:
        UsageError: An argument is not finite or has the wrong shape.
    """
    middle = np.asarray(at, dtype=np.float64)
    if middle.shape != (3,) or not np.isfinite(middle).all() or not math.isfinite(yaw):
        raise UsageError(f"a formation needs three finite coordinates and a finite yaw, got {at!r}, {yaw!r}")
    turned: Places = places(shape) @ rotation_from_euler(0.0, 0.0, yaw).T
    return turned + middle


def places(values: ArrayLike) -> Places:
    """Convert to an array of positions.

    Raises:
        UsageError: A coordinate is not finite, or an array does not have shape (n, 3).
    """
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise UsageError(f"{values!r:.80} is not an array of positions") from None
    if array.ndim != 2 or array.shape[1] != 3 or not np.isfinite(array).all():
        raise UsageError(f"positions need shape (n, 3) and finite coordinates, got shape {array.shape}")
    return array


def assign(starts: ArrayLike, slots: ArrayLike) -> list[int]:
    """Assign drones to slots so that the sum of squared distances is minimal; return the slot index for each start.

    With this assignment, the straight paths of drones that leave and arrive together do not cross. The distance between
    drones never falls below 1/√2 of the smallest distance between two starts or two slots (Turpin, Michael and Kumar,
    "CAPT", International Journal of Robotics Research 33, 2014).

    Args:
        starts: Start positions, (n, 3) [m].
        slots: Positions to assign, (m, 3) [m]; m is at least n and at most :data:`MOST`.

    Raises:
        UsageError: There are fewer slots than starts, too many slots, or non-finite coordinates.
        MissingExtraError: SciPy is not installed (extra ``control``).
    """
    a, b = places(starts), places(slots)
    if len(a) > len(b):
        raise UsageError(f"{len(a)} drones have only {len(b)} places to fly to")
    if len(b) > MOST:
        raise UsageError(f"at most {MOST} places can be assigned, got {len(b)}")
    costs = ((a[:, None, :] - b[None, :, :]) ** 2).sum(axis=2)
    _, columns = assignment("a formation", "control")(costs)
    return [int(column) for column in columns]


def closest_approach(starts: ArrayLike, goals: ArrayLike) -> Approach:
    """Return the closest approach between drones that fly straight from start to goal and all take the same time.

    Args:
        starts: Start positions, (n, 3) [m].
        goals: Goal positions, (n, 3) [m].

    Raises:
        UsageError: A coordinate is not finite, or an array does not have shape (n, 3).
    """
    a, b = places(starts), places(goals)
    nearest = Approach(math.inf, 0, 0)
    for i in range(len(a)):
        for j in range(i + 1, len(a)):
            begin, change = a[i] - a[j], (b[i] - b[j]) - (a[i] - a[j])
            moved = float(change @ change)
            at = within(-float(begin @ change) / moved, 0.0, 1.0) if moved > 0.0 else 0.0
            distance = float(np.linalg.norm(begin + at * change))
            if distance < nearest.distance_m:
                nearest = Approach(distance, i, j)
    return nearest


def kept_apart(
    velocities: ArrayLike, positions: ArrayLike, apart_m: float, gain: float = 1.0, *, fixed: int = 0
) -> Places:
    """Change velocities so that drones closer together than ``apart_m`` separate.

    Their distance grows at a rate of ``gain`` times the missing distance, and each drone contributes half of that. If
    one drone doesn't yield, the other makes the whole change and approaches at no more than ``gain`` times the distance
    beyond ``apart_m``. Velocity components perpendicular to the line between the drones are unchanged.

    Args:
        velocities: Velocities in world axes, (n, 3) [m/s].
        positions: Positions in world axes, (n, 3) [m].
        apart_m: The minimum allowed distance.
        gain: Speed of separation per metre by which drones are too close [1/s].
        fixed: Number of drones at the end of the list that are not steered here and therefore don't yield.

    Returns:
        The changed velocities, (n, 3) [m/s].

    Raises:
        UsageError: A number is not finite, or an array does not have shape (n, 3).
    """
    changed, at = places(velocities).copy(), places(positions)
    free = len(at) - fixed
    # Drones that do not yield come last, so that later changes can't undo the separation from them.
    for j in range(1, len(at)):
        for i in range(min(j, free)):
            between = at[i] - at[j]
            distance = float(np.linalg.norm(between))
            if distance >= apart_m and j < free:
                continue
            away = between / distance if distance > 1e-6 else np.array([1.0, 0.0, 0.0])
            missing = gain * (apart_m - distance) - float((changed[i] - changed[j]) @ away)
            if missing > 0.0:
                share = 0.5 if j < free else 1.0
                changed[i] += share * missing * away
                changed[j] -= (1.0 - share) * missing * away
    return changed


def _centred(points: list[tuple[float, float, float]]) -> Places:
    array: Places = np.array(points, dtype=np.float64)
    middle: Places = (array.max(axis=0) + array.min(axis=0)) / 2
    return array - middle


def _check(n: int, *, spacing_m: float) -> None:
    if not isinstance(n, int) or n < 1:
        raise UsageError(f"a formation needs at least one position, got {n!r}")
    if not (math.isfinite(spacing_m) and spacing_m > 0.0):
        raise UsageError(f"spacing_m is {spacing_m!r} and must be above 0 m")
