"""Detection of upright poles of a known colour, and of their tops."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skyloop.messages import CameraInfo, Intrinsics
from skyloop.vision.colour import ColourMask, Rgb
from skyloop.vision.lens import normalised
from skyloop.vision.opencv import opencv
from skyloop.vision.planar import Array, checked

_LEAST_HEIGHT_PX: Final = 20
_SLIM: Final = 3.0  # so much higher than wide
_ABOVE_PX: Final = 6
_COLOURFUL: Final = 100  # of 255
_LEAST_SHARE: Final = 0.8  # of the rows in its middle where it is one piece: two behind each other aren't


@dataclass(frozen=True, slots=True, eq=False)
class PoleSighting:
    """One pole in one image.

    Attributes:
        top: The middle of its upper end, (2,) pixels.
        ray: Through that, in optical axes, (3,), z = 1.
        width_px: In the middle of its height.
    """

    top: Array
    ray: Array
    width_px: float

    def ray_in_body(self, camera: CameraInfo) -> Array:
        """Return the ray in body axes, (3,)."""
        turned: Array = np.asarray(camera.rotation, dtype=np.float64).reshape(3, 3) @ self.ray
        return turned


class PoleDetector:
    """Detects poles of one colour, in images that are upright within about 30°."""

    def __init__(self, colour: Rgb) -> None:
        """Prepare the detector.

        Args:
            colour: Red, green, blue, 0 to 255.

        Raises:
            UsageError: That is no colour, or too grey to have a hue.
            MissingExtraError: OpenCV is not installed.
        """
        self._cv = opencv("pole detection")
        self._mask = ColourMask(colour)

    def detect(self, image: NDArray[np.uint8], intrinsics: Intrinsics | None = None) -> list[PoleSighting]:
        """Detect all poles in an image.

        Args:
            image: A :class:`skyloop.Frame` or a uint8 array, (h, w, 3) BGR.
            intrinsics: Of the camera; None takes the frame's.

        Returns:
            The sightings, the widest first.

        Raises:
            UsageError: The array has another shape or type, or there are no intrinsics.
        """
        pixels, intrinsics = checked(image, intrinsics, colour=True)
        count, labels, boxes, _ = self._cv.connectedComponentsWithStats(self._mask.of(pixels))
        found = []
        for label, (x, y, width, height, area) in enumerate(boxes[:count].tolist()):
            if label == 0 or height < _LEAST_HEIGHT_PX or area * _SLIM > height * height:
                continue
            if x == 0 or y == 0 or x + width == pixels.shape[1]:  # not the whole of it is seen, nor its top
                continue
            line = _line(labels[y : y + height, x : x + width] == label)
            if line is None:
                continue
            middle, width_px = line
            if self._hidden(pixels, x + middle, y):
                continue
            top = np.array([x + middle, y - 0.5])
            flat = normalised(top[None], intrinsics)[0]
            if np.isfinite(flat).all():
                found.append(PoleSighting(top, np.array([*flat, 1.0]), width_px))
        return sorted(found, key=lambda one: -one.width_px)

    def _hidden(self, pixels: NDArray[np.uint8], x: float, y: int) -> bool:
        """Return whether something colourful is right above: a gate's bar that hides the top, more likely than not."""
        column = min(max(round(x), 0), pixels.shape[1] - 1)
        above = pixels[max(0, y - _ABOVE_PX) : max(1, y - 1), column : column + 1]
        return bool((self._cv.cvtColor(above, self._cv.COLOR_BGR2HSV)[..., 1] > _COLOURFUL).any())


def _line(shape: NDArray[np.bool_]) -> tuple[float, float] | None:
    """Return where a leaning pole ends at the top, from the left, and its width; None for what is not one piece."""
    rows = np.arange(len(shape))
    first, last = shape.argmax(axis=1), shape.shape[1] - 1 - shape[:, ::-1].argmax(axis=1)
    whole = shape.any(axis=1) & (shape.sum(axis=1) == last - first + 1)
    if whole.mean() < _LEAST_SHARE:
        return None
    upper = whole & (rows <= len(shape) // 2)
    if upper.sum() < 2:
        return None
    middle = float(np.polyval(np.polyfit(rows[upper], (first + last)[upper] / 2, 1), 0.0))
    return middle, float(np.median((last - first + 1)[whole]))
