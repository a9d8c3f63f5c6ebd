"""The wind at each drone: the world's mean, and gusts of its own.

Gusts are a first-order Gauss-Markov process per axis (the low-pass part of the Dryden gust model of MIL-F-8785C).
"""

from __future__ import annotations

import math

import numpy as np

from skyloop.sim.streams import Floats, NormalBlocks, Purpose
from skyloop.sim.world import Wind


class WindField:
    """Velocity of the air at each drone. Each drone has its own gusts: they are small beside the distances."""

    def __init__(self, wind: Wind, seed: int, drones: int, period_s: float) -> None:
        self._mean = np.array(wind.mean_m_s)[:, None]
        self._keep = math.exp(-period_s / wind.time_constant_s)
        deviation = wind.gust_m_s * np.array([[1.0], [1.0], [0.5]])
        self._fresh = deviation * math.sqrt(1.0 - self._keep**2)
        self._calm = wind.gust_m_s == 0
        self._normals = NormalBlocks(seed, Purpose.WIND, 3, drones)
        self._gust: Floats = np.zeros((3, drones)) if self._calm else deviation * self._normals.take()

    def blow(self, air: Floats) -> None:
        """Advance by one period, and write the air's velocity, world axes, shape (3, drones) [m/s]."""
        if not self._calm:
            np.multiply(self._gust, self._keep, out=self._gust)
            np.add(self._gust, self._fresh * self._normals.take(), out=self._gust)
        np.add(self._mean, self._gust, out=air)
