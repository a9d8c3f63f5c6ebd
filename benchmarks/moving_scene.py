"""Render a moving camera's view for all senders of video; an image depends only on its stamp. Needs only NumPy.

A window of a large picture, with detail at all scales and some noise, moves like a drone that looks around. Each
picture carries its stamp in its upper left corner, in a form that survives any encoder, because some transports drop
stamps.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from benchmarks.measuring.contract import Image
from benchmarks.measuring.schedule import Size

STAMP_NS: Final = 125_000  #: resolution of the stamps
_BITS: Final = 24
_COLUMNS: Final = 12
_CELL: Final = 1 / 40  # size of one of the stamp's cells, as a fraction of the width
_DARK, _LIGHT = 40, 215
_PERIOD_S: Final = 6.0
_NOISE: Final = 2.0
_WRAP: Final = 1 << _BITS


class MovingScene:
    """The scene of one camera.

    Args:
        size: Size of its pictures.
    """

    def __init__(self, size: Size) -> None:
        self.size = size
        rng = np.random.default_rng(1)
        height, width = size.height * 2, size.width * 2
        scene = np.full((height, width, 3), 128.0)
        for cell, contrast in ((160, 40.0), (40, 25.0), (10, 12.0), (3, 6.0)):
            coarse = rng.normal(0.0, contrast, (height // cell + 2, width // cell + 2, 3))
            scene += np.kron(coarse, np.ones((cell, cell, 1)))[:height, :width]
        self._scene = np.clip(scene, 20, 235).astype(np.int16)
        self._noise = rng.normal(0.0, _NOISE, (2 * size.height, 2 * size.width, 3)).astype(np.int16)

    def picture(self, stamp_ns: int) -> Image:
        """Return the view at a time [ns, in multiples of :data:`STAMP_NS`], with its stamp.

        Returns:
            Shape (height, width, 3), dtype uint8.
        """
        stamp = stamp_ns // STAMP_NS
        turn = 2 * math.pi * (stamp * STAMP_NS * 1e-9 % (6 * _PERIOD_S)) / _PERIOD_S
        width, height = self.size.width, self.size.height
        left = round(width / 2 * (1 + 0.9 * math.sin(turn)))
        top = round(height / 2 * (1 + 0.9 * math.sin(turn / 1.5)))
        x, y = stamp * 7919 % width, stamp * 104729 % height
        image = self._scene[top : top + height, left : left + width] + self._noise[y : y + height, x : x + width]
        picture: Image = image.astype(np.uint8)
        cell = round(width * _CELL)
        for bit in range(_BITS):
            row, column = divmod(bit, _COLUMNS)
            value = _LIGHT if stamp >> bit & 1 else _DARK
            picture[row * cell : (row + 1) * cell, column * cell : (column + 1) * cell] = value
        return picture


def stamp_in(image: Image, now_ns: int) -> int:
    """Return the stamp of a picture, however damaged or small, from the last half hour [ns]."""
    cell = image.shape[1] * _CELL
    stamp = 0
    for bit in range(_BITS):
        row, column = divmod(bit, _COLUMNS)
        y, x = round((row + 0.5) * cell), round((column + 0.5) * cell)
        reach = max(1, int(cell / 4))
        if image[y - reach : y + reach, x - reach : x + reach].mean() > (_DARK + _LIGHT) / 2:
            stamp |= 1 << bit
    now = now_ns // STAMP_NS
    return (now - (now - stamp) % _WRAP) * STAMP_NS


def psnr_db(image: Image, original: Image) -> float:
    """Return a picture's similarity to its original: the peak signal-to-noise ratio [dB]."""
    error = np.mean((image.astype(np.float32) - original) ** 2)
    return float(10.0 * np.log10(255.0**2 / max(error, 1e-3)))
