"""Assign objects to the cells of a detector's three grids, as its training targets. Pure.

As in FCOS, an object belongs to the grids that suit its size, and there to the cells around its centre (Tian et al.,
"FCOS: Fully Convolutional One-Stage Object Detection", ICCV 2019).
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

STRIDES: Final = (8, 16, 32)
#: By stride: the range of the longer sides of its objects [px].
SIZES: Final = ((0.0, 72.0), (40.0, 160.0), (104.0, np.inf))
NOTHING, IGNORED = -1, -2
_REACH: Final = 1.0  # distance from an object's centre, in strides
_LEAST_REACH: Final = 0.75  # the same for an object smaller than a stride

Floats = NDArray[np.float32]


def places(width: int, height: int) -> tuple[Floats, Floats]:
    """Return the centres of all places of an input [px], (n, 2), and their strides, (n,), the finest grid first."""
    middles, strides = [], []
    for stride in STRIDES:
        y, x = np.mgrid[0 : height // stride, 0 : width // stride]
        middles.append((np.stack([x.ravel(), y.ravel()], axis=1) + 0.5) * stride)
        strides.append(np.full(x.size, stride))
    return np.concatenate(middles).astype(np.float32), np.concatenate(strides).astype(np.float32)


def assign(boxes: Floats, classes: NDArray[np.int64], grid: tuple[Floats, Floats]) -> tuple[NDArray[np.int64], Floats]:
    """Give each place its target class and box.

    If two objects claim a place, the smaller one gets it, because it has fewer. Objects that need not be found exclude
    their remaining places from the count.

    Args:
        boxes: Centre and size of the objects [px], (m, 4).
        classes: Classes of the objects, (m,); ``IGNORED`` for an object that need not be found.
        grid: From :func:`places`.

    Returns:
        Class, ``NOTHING`` or ``IGNORED`` of each place, (n,), and its box, (n, 4).
    """
    middles, strides = grid
    answer, target = np.full(len(middles), NOTHING, np.int64), np.ones((len(middles), 4), np.float32)
    low, high = (np.repeat([pair[side] for pair in SIZES], _counts(strides)) for side in (0, 1))
    areas = boxes[:, 2] * boxes[:, 3]
    order = np.argsort(-areas, kind="stable")
    ordered = [int(row) for row in order if classes[row] == IGNORED] + [int(r) for r in order if classes[r] != IGNORED]
    for row in ordered:
        x, y, width, height = boxes[row]
        longer = max(width, height)
        across = np.minimum(_REACH * strides, np.maximum(width / 2, _LEAST_REACH * strides))
        along = np.minimum(_REACH * strides, np.maximum(height / 2, _LEAST_REACH * strides))
        if classes[row] == IGNORED:
            across, along = np.maximum(across, width / 2), np.maximum(along, height / 2)
        mine = (abs(middles[:, 0] - x) < across) & (abs(middles[:, 1] - y) < along)
        if classes[row] != IGNORED:
            mine &= (low <= longer) & (longer < high)
        answer[mine], target[mine] = classes[row], boxes[row]
    return answer, target


def _counts(strides: Floats) -> list[int]:
    return [int((strides == stride).sum()) for stride in STRIDES]
