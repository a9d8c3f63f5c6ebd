"""Daylight over a whole picture: the same for every painter, because it is applied to what they painted."""

from __future__ import annotations

import numpy as np

from skyloop.sim.render.base import Image
from skyloop.sim.render.opencv import cv2


def dimmed(picture: Image, light: float) -> Image:
    """Multiply all values of an image by a factor of at least 0, in place, rounded, and return it.

    By a table of 256 values, so that it is the same bit by bit on every machine.
    """
    table = np.clip(np.rint(np.arange(256) * light), 0, 255).astype(np.uint8)
    np.copyto(picture, cv2.LUT(picture, table))
    return picture
