"""Things of one colour in a picture: which pixels have it, and what they make up."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import UsageError
from skyloop.messages import Intrinsics
from skyloop.vision.lens import normalised
from skyloop.vision.opencv import opencv
from skyloop.vision.planar import checked

Rgb = tuple[int, int, int]

_HUE_DEG: Final = 16.0  # on each side of the colour's own
_SATURATION: Final = 0.5  # of the colour's own: paint in the light and in the shade
_LEAST_SATURATION: Final = 80  # of 255: a colour with less is too grey to be told from others
_LEAST_VALUE: Final = 35  # of 255: darker pixels have no hue worth the name


class ColourMask:
    """Which pixels have a colour: its hue, and enough of it, however bright."""

    def __init__(self, colour: Rgb) -> None:
        """``colour``: red, green, blue, 0 to 255. Raises :class:`UsageError` for what is no colour or has no hue,
        :class:`MissingExtraError` without OpenCV."""
        if len(colour) != 3 or not all(isinstance(part, int) and 0 <= part <= 255 for part in colour):
            raise UsageError(f"colour is {colour!r} and must be red, green and blue, each from 0 to 255")
        self._cv = opencv("finding a colour")
        hue, saturation, _ = self._cv.cvtColor(np.array([[colour[::-1]]], np.uint8), self._cv.COLOR_BGR2HSV)[0, 0]
        if saturation < _LEAST_SATURATION:
            raise UsageError(f"colour {colour!r} is too grey to be told from what is around")
        self._hue, self._saturation = int(hue), int(saturation * _SATURATION)

    def of(self, pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """255 where a BGR picture (h, w, 3) has the colour, 0 elsewhere, (h, w)."""
        cv = self._cv
        hsv = cv.cvtColor(cv.GaussianBlur(pixels, (3, 3), 0), cv.COLOR_BGR2HSV)
        reach = round(_HUE_DEG / 2)  # OpenCV's hue goes round in 180 steps
        turned = hsv.copy()
        turned[..., 0] = (hsv[..., 0].astype(np.int16) - self._hue + 90) % 180
        mask = cv.inRange(turned, (90 - reach, self._saturation, _LEAST_VALUE), (90 + reach, 255, 255))
        return np.asarray(cv.morphologyEx(mask, cv.MORPH_CLOSE, np.ones((3, 3), np.uint8)), np.uint8)


@dataclass(frozen=True, slots=True)
class BlobSighting:
    """One thing of a colour in one picture."""

    box: tuple[float, float, float, float]  #: left, top, right, bottom [px]
    left_rad: float  #: its left edge, from the optical axis, positive to the left
    right_rad: float  #: its right edge, the same way: less than the left one

    @property
    def bearing_rad(self) -> float:
        """Its middle, from the optical axis, positive to the left."""
        return (self.left_rad + self.right_rad) / 2

    @property
    def width_rad(self) -> float:
        """How wide it looks."""
        return self.left_rad - self.right_rad

    @property
    def outline(self) -> tuple[tuple[float, float], ...]:
        """The box as annotations want it."""
        left, top, right, bottom = self.box
        return (left, top), (right, top), (right, bottom), (left, bottom)


class BlobDetector:
    """Finds what has a colour and is large enough."""

    def __init__(self, colour: Rgb, least_px: int = 12) -> None:
        """``least_px``: narrower or lower than this is not told. Raises as :class:`ColourMask`."""
        self._mask = ColourMask(colour)
        self._cv = opencv("finding a colour")
        self._least_px = least_px

    def detect(self, image: NDArray[np.uint8], intrinsics: Intrinsics | None = None) -> list[BlobSighting]:
        """Everything of the colour, the widest first; arguments and errors as :meth:`.GateDetector.detect`."""
        pixels, intrinsics = checked(image, intrinsics, colour=True)
        count, _, boxes, _ = self._cv.connectedComponentsWithStats(self._mask.of(pixels))
        found = []
        for x, y, width, height, _ in boxes[1:count].tolist():
            if width < self._least_px or height < self._least_px:
                continue
            middle = y + height / 2
            edges = np.array([[x, middle], [x + width - 1, middle]], np.float64)
            left, right = np.arctan(-normalised(edges, intrinsics)[:, 0]).tolist()
            found.append(BlobSighting((x, y, x + width, y + height), left, right))
        return sorted(found, key=lambda one: -one.width_rad)
