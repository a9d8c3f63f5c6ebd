"""Tables with one column per drone, which can also be read and written drone by drone as plain floats.

NumPy takes as long for three numbers as for three hundred. A few drones are therefore faster one by one in plain
floats, and many drones together in arrays. Both give the same bits, because they do the same operations in the same
order and both use NumPy's sines and cosines.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from struct import Struct
from typing import Any, Final, TypeAlias

import numpy as np

from skyloop.sim.streams import Floats

N: TypeAlias = Any  #: a number for one drone, or an array with one for each
FEW = 3  #: maximum number of drones that are computed one by one


def few(drones: int) -> bool:
    """Return whether this number of drones is computed one by one."""
    return drones <= FEW


def columns(rows: int, drones: int) -> Floats:
    """Return zeros of shape (rows, drones), in the memory layout for this number of drones."""
    return np.zeros((drones, rows)).T if few(drones) else np.zeros((rows, drones))


class Fields:
    """Consecutive rows of an array made by :func:`columns`, as plain floats for a few drones."""

    def __init__(self, table: Floats, first: int, count: int) -> None:
        rows, drones = table.shape
        memory = memoryview(table.T).cast("B")  # type: ignore[arg-type]
        offsets = [(drone * rows + first) * table.itemsize for drone in range(drones)]
        numbers = Struct(f"{count}d")
        #: one function per drone that returns the drone's numbers
        self.read: list[Callable[[], tuple[float, ...]]] = [partial(numbers.unpack_from, memory, at) for at in offsets]
        #: one function per drone that replaces its numbers; it takes as many numbers
        self.write: list[Callable[..., None]] = [partial(numbers.pack_into, memory, at) for at in offsets]


@dataclass(frozen=True, slots=True)
class Operations:
    """Operations that differ between numbers and arrays, so that one formula works for both."""

    least: Callable[[N, N], N]  #: the smaller of two values
    most: Callable[[N, N], N]  #: the larger of two values
    root: Callable[[N], N]  #: the square root
    choose: Callable[[N, N, N], N]  #: the second value where the first is true, otherwise the third


NUMBERS: Final = Operations(min, max, math.sqrt, lambda condition, one, other: one if condition else other)
ARRAYS: Final = Operations(np.minimum, np.maximum, np.sqrt, np.where)
