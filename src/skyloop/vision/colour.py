"""Detection of things of one colour in an image."""

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
_LEAST_SATURATION: Final = 80  # of 255: a colour with less is too grey to be distinguished from others
_LEAST_VALUE: Final = 35  # of 255: darker pixels have no hue worth the name


class ColourMask:
    """Selects pixels by their colour: by the hue, with enough saturation, at any brightness."""

    def __init__(self, colour: Rgb) -> None:
        """Prepare the mask.

        Args:
            colour: Red, green, blue, 0 to 255.

        Raises:
            UsageError: That is no colour, or too grey to have a hue.
            MissingExtraError: OpenCV is not installed.
        """
        if len(colour) != 3 or not all(isinstance(part, int) and 0 <= part <= 255 for part in colour):
            raise UsageError(f"colour is {colour!r} and must be red, green and blue, each from 0 to 255")
        self._cv = opencv("finding a colour")
        hue, saturation, _ = self._cv.cvtColor(np.array([[colour[::-1]]], np.uint8), self._cv.COLOR_BGR2HSV)[0, 0]
        if saturation < _LEAST_SATURATION:
            raise UsageError(f"colour {colour!r} is too grey to be distinguished from its surroundings")
        self._hue, self._saturation = int(hue), int(saturation * _SATURATION)

    def of(self, pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the mask of a BGR image (h, w, 3): 255 where it has the colour, 0 elsewhere, (h, w), uint8."""
        cv = self._cv
        hsv = cv.cvtColor(cv.GaussianBlur(pixels, (3, 3), 0), cv.COLOR_BGR2HSV)
        reach = round(_HUE_DEG / 2)  # OpenCV's hue goes round in 180 steps
        turned = hsv.copy()
        turned[..., 0] = (hsv[..., 0].astype(np.int16) - self._hue + 90) % 180
        mask = cv.inRange(turned, (90 - reach, self._saturation, _LEAST_VALUE), (90 + reach, 255, 255))
        return np.asarray(cv.morphologyEx(mask, cv.MORPH_CLOSE, np.ones((3, 3), np.uint8)), np.uint8)


@dataclass(frozen=True, slots=True)
class BlobSighting:
    """One thing of a colour in one image."""

    box: tuple[float, float, float, float]  #: left, top, right, bottom [px]
    left_rad: float  #: its left edge, from the optical axis, positive to the left
    right_rad: float  #: its right edge, the same way: less than the left one

    @property
    def bearing_rad(self) -> float:
        """Angle of its middle from the optical axis, positive to the left."""
        return (self.left_rad + self.right_rad) / 2

    @property
    def width_rad(self) -> float:
        """Its apparent width."""
        return self.left_rad - self.right_rad

    @property
    def outline(self) -> tuple[tuple[float, float], ...]:
        """The corners of its box, for annotations."""
        left, top, right, bottom = self.box
        return (left, top), (right, top), (right, bottom), (left, bottom)


class BlobDetector:
    """Detects connected areas of a colour that are large enough."""

    def __init__(self, colour: Rgb, least_px: int = 12) -> None:
        """Prepare the detector.

        Args:
            colour: Red, green, blue, 0 to 255.
            least_px: Narrower or lower areas are left out.

        Raises:
            UsageError: That is no colour, or too grey to have a hue.
            MissingExtraError: OpenCV is not installed.
        """
        self._mask = ColourMask(colour)
        self._cv = opencv("finding a colour")
        self._least_px = least_px

    def detect(self, image: NDArray[np.uint8], intrinsics: Intrinsics | None = None) -> list[BlobSighting]:
        """Detect everything of the colour.

        Args:
            image: A :class:`skyloop.Frame` or a uint8 array, (h, w, 3) BGR.
            intrinsics: Of the camera; None takes the frame's.

        Returns:
            The sightings, the widest first.

        Raises:
            UsageError: The array has another shape or type, or there are no intrinsics.
        """
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
