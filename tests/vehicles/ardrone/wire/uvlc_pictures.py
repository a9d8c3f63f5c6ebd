"""Pictures to encode."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Picture = NDArray[np.uint8]


def scenery(width: int = 320, height: int = 240, seed: int = 0) -> Picture:
    """Slopes of colour, edges, and some grain: about as busy as a room."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:height, 0:width]
    shown = np.stack([60 + 80 * x / width, 90 + 60 * np.sin(y / 23), 160 - 70 * y / height], axis=-1)
    for _ in range(12):
        left, top = rng.integers(0, width - 8), rng.integers(0, height - 8)
        shown[top : top + height // 5, left : left + width // 5] = rng.integers(20, 235, 3)
    return np.clip(shown + rng.normal(0, 2.5, shown.shape), 0, 255).astype(np.uint8)


def noise(width: int = 320, height: int = 240, seed: int = 0) -> Picture:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)
