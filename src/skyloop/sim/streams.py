"""Independent streams of random numbers, one per purpose and drone, all derived from a single seed.

Adding a drone or enabling a feature therefore doesn't change any other stream.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class Purpose(IntEnum):
    """Purposes of streams. The numbers determine the meaning of a seed, so they must never change or be reused."""

    TARGETS = 1
    WIND = 2
    ESTIMATES = 3
    BIASES = 4
    INERTIAL = 5
    CAMERA = 6
    LIGHT = 7
    LABELS = 8
    LAYOUT = 9
    INSTRUMENTS = 10


def stream(seed: int, purpose: Purpose, index: int = 0) -> np.random.Generator:
    """Return the random stream for a purpose and an index (of a drone, target, camera or step). This takes about 15 µs.

    The same arguments give the same stream in all versions of Skyloop.
    """
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(int(purpose), index)))


class NormalBlocks:
    """Standard normal random numbers for many drones, ``rows`` per drone at a time. Every drone has its own stream.

    They are drawn for ``ahead`` calls at once, because calling a generator costs as much as drawing a hundred numbers.
    """

    def __init__(self, seed: int, purpose: Purpose, rows: int, drones: int, ahead: int = 64) -> None:
        generators = [stream(seed, purpose, drone) for drone in range(drones)]
        self._draws: list[Callable[[tuple[int, int]], Floats]] = [g.standard_normal for g in generators]
        self._rows = rows
        self._block = np.empty((ahead, rows, drones))
        self._next = ahead

    def take(self) -> Floats:
        """Return the next numbers, shape (rows, drones). The next block overwrites them, so copy any that you keep."""
        if self._next == len(self._block):
            for drone, draw in enumerate(self._draws):
                self._block[:, :, drone] = draw((len(self._block), self._rows))
            self._next = 0
        numbers: Floats = self._block[self._next]
        self._next += 1
        return numbers
