"""All textures of a scene in one image, each with its smaller versions (mip levels) beside it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skyloop.sim.render.opencv import cv2

LEVELS = 7
BORDER = 4  # pixels repeated around each level, so that interpolation at its rim meets no neighbour
GAP = 2 * BORDER
_STEP = 1 << (LEVELS - 1)  # padded sizes are multiples of this, so that each level halves exactly
_LIMIT = 32000  # cv2.remap takes source pictures of at most 32767 a side


@dataclass(frozen=True, slots=True)
class Texture:
    """A texture's number in the atlas and its size in texels."""

    index: int
    width: int
    height: int


@dataclass(frozen=True, slots=True)
class Atlas:
    """All textures in one image.

    Attributes:
        image: BGRA (four channels are sampled twice as fast as three).
        x0: Where each texture's level 0 starts; float64, shape (number of textures,).
        y0: The same, vertically.
        span: Twice each texture's padded width.
    """

    image: NDArray[np.uint8]
    x0: NDArray[np.float64]
    y0: NDArray[np.float64]
    span: NDArray[np.float64]


class AtlasBuilder:
    """Collects textures under keys, each drawn once, and packs them."""

    def __init__(self) -> None:
        self._known: dict[object, Texture] = {}
        self._images: list[NDArray[np.uint8]] = []

    def add(self, key: object, make: Callable[[], NDArray[np.uint8]]) -> Texture:
        """Return the texture known as ``key``; if there is none yet, ``make`` draws it (BGR, shape (h, w, 3))."""
        if key not in self._known:
            image = make()
            self._known[key] = Texture(len(self._images), image.shape[1], image.shape[0])
            self._images.append(image)
        return self._known[key]

    @property
    def images(self) -> list[NDArray[np.uint8]]:
        """The textures collected so far, in the order of their numbers; BGR, shape (h, w, 3)."""
        return self._images

    def pack(self) -> Atlas:
        """Pack all textures on shelves, the tallest first."""
        sizes = [(_padded(i.shape[1]), _padded(i.shape[0])) for i in self._images]
        width = max(2048, *(_footprint(w) for w, _ in sizes))
        spots: dict[int, tuple[int, int]] = {}
        x = y = shelf = 0
        for k in sorted(range(len(sizes)), key=lambda k: (-sizes[k][1], k)):
            w, h = sizes[k]
            if x + _footprint(w) > width:
                x, y, shelf = 0, y + shelf, 0
            spots[k] = (x + BORDER, y + BORDER)
            x += _footprint(w)
            shelf = max(shelf, h + GAP)
        height = y + shelf
        if width > _LIMIT or height > _LIMIT:
            raise ValueError(f"the scene's textures need {width}x{height} texels, more than {_LIMIT} a side")
        image = np.zeros((height, width, 4), np.uint8)
        for k, source in enumerate(self._images):
            _place(image, source, *spots[k], *sizes[k])
        corners = np.array([spots[k] for k in range(len(sizes))], dtype=np.float64)
        span = np.array([2.0 * w for w, _ in sizes])
        return Atlas(image, corners[:, 0].copy(), corners[:, 1].copy(), span)


def _padded(side: int) -> int:
    return -(-side // _STEP) * _STEP


def _footprint(padded_width: int) -> int:
    return 2 * padded_width + GAP * LEVELS


def _place(image: NDArray[np.uint8], source: NDArray[np.uint8], x: int, y: int, width: int, height: int) -> None:
    level = cv2.cvtColor(source, cv2.COLOR_BGR2BGRA)
    rows, columns = height - level.shape[0], width - level.shape[1]
    level = cv2.copyMakeBorder(level, 0, rows, 0, columns, cv2.BORDER_REPLICATE)
    for number in range(LEVELS):
        framed = cv2.copyMakeBorder(level, BORDER, BORDER, BORDER, BORDER, cv2.BORDER_REPLICATE)
        left = x + 2 * (width - level.shape[1]) + GAP * number - BORDER
        image[y - BORDER : y - BORDER + framed.shape[0], left : left + framed.shape[1]] = framed
        if number < LEVELS - 1:
            level = cv2.resize(level, (level.shape[1] // 2, level.shape[0] // 2), interpolation=cv2.INTER_AREA)
