"""Repeatable irregularity: what keeps drawn surfaces from looking drawn, and gives optical flow something to hold."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skyloop.sim.render.opencv import cv2

Gray = NDArray[np.float32]


def clouds(rng: np.random.Generator, height: int, width: int, cell_x: float, cell_y: float | None = None) -> Gray:
    """Smooth noise around 0, about ±1, shape (height, width); its blotches measure ``cell_x`` by ``cell_y`` pixels."""
    rows = max(2, round(height / (cell_y or cell_x)) + 1)
    columns = max(2, round(width / cell_x) + 1)
    seeds = rng.standard_normal((rows, columns), dtype=np.float32) * np.float32(0.6)
    return np.asarray(cv2.resize(seeds, (width, height), interpolation=cv2.INTER_CUBIC), dtype=np.float32)


def grain(rng: np.random.Generator, height: int, width: int) -> Gray:
    """Noise of single pixels, uniform within ±1, shape (height, width). Repeats every 256 pixels."""
    patch = rng.random((min(height, 256), min(width, 256)), dtype=np.float32) * np.float32(2.0) - np.float32(1.0)
    return np.tile(patch, (-(-height // 256), -(-width // 256)))[:height, :width]


def fractal(rng: np.random.Generator, height: int, width: int, cell: float, octaves: int = 4) -> Gray:
    """Clouds upon finer clouds, about ±1, shape (height, width)."""
    total = np.zeros((height, width), np.float32)
    for k in range(octaves):
        if cell / 2**k >= 1.5:
            total += clouds(rng, height, width, cell / 2**k) * np.float32(0.55**k)
    return total * np.float32(0.6)


def tinted(colour: tuple[float, float, float], brightness: ArrayLike, height: int, width: int) -> NDArray[np.float32]:
    """A picture (height, width, 3) of one BGR colour times a brightness around 1."""
    light = np.broadcast_to(np.asarray(brightness, dtype=np.float32), (height, width))
    return np.asarray(cv2.merge([light * np.float32(c) for c in colour]), dtype=np.float32)


def finished(picture: NDArray[np.float32]) -> NDArray[np.uint8]:
    """The same as bytes, with what is out of range cut off."""
    return np.clip(picture, 0.0, 255.0).astype(np.uint8)
