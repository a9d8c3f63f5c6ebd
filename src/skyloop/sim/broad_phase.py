"""Which bounding boxes overlap: the broad phase of the collisions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from skyloop.sim.streams import Floats

Indices = NDArray[np.intp]


def overlapping(low: Floats, high: Floats, movable: int) -> tuple[Indices, Indices]:
    """Return the pairs of boxes that overlap, by sweeping over them along the axis on which they are spread most.

    Args:
        low: Least coordinates of the boxes, shape (3, n) [m].
        high: Greatest coordinates, shape (3, n).
        movable: Only pairs with at least one of the first so many boxes are wanted.

    Returns:
        The lesser and the greater number of each pair, in ascending order. Boxes that touch overlap.
    """
    if low.shape[1] < 2:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    axis = int((low.max(axis=1) - low.min(axis=1)).argmax())
    order = low[axis].argsort(kind="stable")
    begins, ends = low[axis, order], high[axis, order]
    # In this order a box overlaps, along the axis, those after it that begin before it ends.
    numbers = np.arange(len(order))
    counts = begins.searchsorted(ends, side="right") - numbers - 1
    first = numbers.repeat(counts)
    before = counts.cumsum() - counts  # pairs of the boxes before each
    second = np.arange(len(first)) - (before - numbers - 1).repeat(counts)
    one, other = order.take(first), order.take(second)
    for across in {0, 1, 2} - {axis}:
        begins, ends = low[across], high[across]
        overlap = (begins.take(one) <= ends.take(other)) & (begins.take(other) <= ends.take(one))
        one, other = one.compress(overlap), other.compress(overlap)
    lesser, greater = np.minimum(one, other), np.maximum(one, other)
    wanted = (lesser < movable).nonzero()[0]
    wanted = wanted.take((lesser.take(wanted) * len(order) + greater.take(wanted)).argsort())
    return lesser.take(wanted), greater.take(wanted)
