"""Tables with one column per drone, which can also be read and written drone by drone as plain floats.

NumPy takes as long for three numbers as for three hundred. A few drones are therefore faster one by one in plain
floats, many together in arrays. Both ways give the same bits: they do the same operations in the same order, and sines
and cosines are NumPy's in both.
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

N: TypeAlias = Any  #: a number of one drone, or an array with one of each
FEW = 3  #: up to this many drones are computed one by one


def few(drones: int) -> bool:
    """Return whether this many drones are computed one by one."""
    return drones <= FEW


def columns(rows: int, drones: int) -> Floats:
    """Return zeros of shape (rows, drones), in the memory layout for this many drones."""
    return np.zeros((drones, rows)).T if few(drones) else np.zeros((rows, drones))


class Fields:
    """Consecutive rows of an array made by :func:`columns` for a few drones, as plain floats.

    Attributes:
        read: One function per drone, which returns its numbers.
        write: One function per drone, which replaces them; takes as many numbers.
    """

    def __init__(self, table: Floats, first: int, count: int) -> None:
        rows, drones = table.shape
        memory = memoryview(table.T).cast("B")  # type: ignore[arg-type]
        offsets = [(drone * rows + first) * table.itemsize for drone in range(drones)]
        numbers = Struct(f"{count}d")
        self.read: list[Callable[[], tuple[float, ...]]] = [partial(numbers.unpack_from, memory, at) for at in offsets]
        self.write: list[Callable[..., None]] = [partial(numbers.pack_into, memory, at) for at in offsets]


@dataclass(frozen=True, slots=True)
class Operations:
    """Operations that differ between numbers and arrays, so that one formula serves both.

    Attributes:
        least: The smaller of two values.
        most: The larger of two values.
        root: The square root.
        choose: The second value where the first is true, else the third.
    """

    least: Callable[[N, N], N]
    most: Callable[[N, N], N]
    root: Callable[[N], N]
    choose: Callable[[N, N, N], N]


NUMBERS: Final = Operations(min, max, math.sqrt, lambda condition, one, other: one if condition else other)
ARRAYS: Final = Operations(np.minimum, np.maximum, np.sqrt, np.where)
