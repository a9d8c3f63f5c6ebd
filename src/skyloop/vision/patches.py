"""Patches of an image at any place and size, and what is compared of them: gradients, brightness and colour."""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skyloop.vision.tracking import Box, Image

Floats = NDArray[np.float32]

CELL: Final = 4  #: pixels of a patch along a side of a cell


def patch(cv: Any, image: Image, box: Box, size: tuple[int, int]) -> Image:
    """Sample a box of an image; what is outside of the image repeats its edge.

    Args:
        cv: The module ``cv2``.
        image: (h, w, 3) or (h, w).
        box: x, y, width, height [px], at least partly in the image.
        size: Width and height of the result [px].
    """
    x, y, width, height = box
    rows, columns = image.shape[:2]
    left, top = max(0, math.floor(x) - 1), max(0, math.floor(y) - 1)
    right, bottom = min(columns, math.ceil(x + width) + 1), min(rows, math.ceil(y + height) + 1)
    left, top = min(left, columns - 1), min(top, rows - 1)
    part = image[top : max(bottom, top + 1), left : max(right, left + 1)]
    # Linear sampling looks at the nearest pixels only: a large part is averaged down first.
    coarse = [max(1, int(full / wanted)) for full, wanted in zip((width, height), size, strict=True)]
    high, wide = part.shape[:2]
    if max(coarse) > 1:
        wanted = (max(1, round(wide / coarse[0])), max(1, round(high / coarse[1])))
        part = cv.resize(part, wanted, interpolation=cv.INTER_AREA)
    shrink_x, shrink_y = part.shape[1] / wide, part.shape[0] / high
    step_x, step_y = width / size[0] * shrink_x, height / size[1] * shrink_y
    first_x = (x - left) * shrink_x + step_x / 2 - 0.5  # centres of pixels, not their edges
    first_y = (y - top) * shrink_y + step_y / 2 - 0.5
    turn = np.array([[step_x, 0.0, first_x], [0.0, step_y, first_y]])
    flags = cv.INTER_LINEAR | cv.WARP_INVERSE_MAP
    return np.asarray(cv.warpAffine(part, turn, size, flags=flags, borderMode=cv.BORDER_REPLICATE), np.uint8)


def features(cv: Any, pixels: Image) -> Floats:
    """Return the features of a patch, (channels, height / CELL, width / CELL): 8 of a grey one, 10 of a colour one.

    The gradient's strength in each cell and the first harmonics of its direction, which say what a histogram of
    directions says with fewer numbers; each over the strength around, so that light and contrast do not matter. Then
    brightness and, of a colour image, both parts of the colour, over the whole patch's.
    """
    size = (pixels.shape[1] // CELL, pixels.shape[0] // CELL)
    if pixels.ndim == 3:
        lab = cv.cvtColor(pixels, cv.COLOR_BGR2LAB)
        grey = np.ascontiguousarray(lab[..., 0])
        colours = cv.resize(lab, size, interpolation=cv.INTER_AREA).astype(np.float32)
        plain = [colours[..., 0], colours[..., 1], colours[..., 2]]
    else:
        grey = pixels
        plain = [cv.resize(pixels, size, interpolation=cv.INTER_AREA).astype(np.float32)]
    x = cv.Sobel(grey, cv.CV_32F, 1, 0, ksize=1)
    y = cv.Sobel(grey, cv.CV_32F, 0, 1, ksize=1)
    strength = cv.magnitude(x, y) + np.float32(1e-3)
    cos, sin = x / strength, y / strength
    twice_cos, twice_sin = x * cos - y * sin, 2 * x * sin  # strength times the cosine and sine of twice the angle
    cos2, sin2 = twice_cos / strength, twice_sin / strength
    maps = [
        strength,
        x,
        y,
        twice_cos,
        twice_sin,
        twice_cos * cos2 - twice_sin * sin2,
        2 * twice_cos * sin2,
    ]
    cells = [cv.resize(one, size, interpolation=cv.INTER_AREA) for one in maps]
    around = cv.blur(cells[0], (3, 3)) + np.float32(4.0)  # grey levels: the noise of a flat wall is no texture
    light = [(plain[0] - plain[0].mean()) / np.float32(64.0)]
    colour = [(one - 128) / np.float32(32.0) for one in plain[1:]]
    return np.stack([one / around for one in cells] + light + colour)
