"""The base class of all trackers that follow a box, with their results, and patches of an image.

A box is x, y, width and height in pixels: its left and top edge, and its size, as in OpenCV. A box with integer values
covers columns x to x + width − 1 and rows y to y + height − 1.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import UsageError
from skyloop.vision.planar import pixels_of

Box = tuple[float, float, float, float]  #: x, y, width, height [px]
Image = NDArray[np.uint8]

LEAST_PX: Final = 6.0  #: minimum side of a box; a smaller one has too little texture to be found again
_IN_VIEW: Final = 0.5  # minimum fraction of the initial box that is inside the image
Floats = NDArray[np.float32]

CELL: Final = 4  #: side of a cell in pixels of the patch


@dataclass(frozen=True, slots=True)
class TrackResult:
    """The target's position in one image."""

    box: Box | None  #: x, y, width, height [px]; None while the target is lost
    score: float  #: similarity to the target, 0 to 1; a score, not a probability
    confidence: float | None = None  #: chance that the overlap is at least half; None without an estimate

    @property
    def lost(self) -> bool:
        """Whether the target was not found in this image."""
        return self.box is None

    @property
    def centre(self) -> tuple[float, float] | None:
        """The middle of the box [px]; None while the target is lost."""
        if self.box is None:
            return None
        x, y, width, height = self.box
        return x + (width - 1) / 2, y + (height - 1) / 2

    @property
    def outline(self) -> tuple[tuple[float, float], ...]:
        """The corners of the box, for annotations; empty while the target is lost."""
        return () if self.box is None else outline(self.box)


class Tracker(ABC):
    """Follows a box's content from image to image: call :meth:`start` once, then :meth:`update` with each new image.

    It can be restarted at any time, even with images of a different size. It is not thread-safe, so call it from one
    thread, such as a controller's or a processor's.
    """

    _shape: tuple[int, ...] | None = None

    def start(self, image: Image, box: Sequence[float]) -> None:
        """Start tracking a box's content and forget the previous target.

        Args:
            image: A :class:`skyloop.Frame` or a uint8 array, (h, w, 3) BGR or (h, w) grey.
            box: x, y, width, height [px]. At least half of it must be in the image.

        Raises:
            UsageError: The array has a wrong shape or type, or the box is empty, not finite or outside the image.
        """
        pixels = pixels_of(image)
        checked = checked_box(box, pixels.shape)
        self._shape = None  # in case _start fails
        self._start(pixels, checked)
        self._shape = pixels.shape

    def update(self, image: Image) -> TrackResult:
        """Track the target in the next image.

        Args:
            image: As in :meth:`start`, of the same size and kind.

        Raises:
            UsageError: The tracker was not started, or the image's shape or type differs from the first image's.
        """
        if self._shape is None:
            raise UsageError("the tracker was not started: call start(image, box) before update(image)")
        pixels = pixels_of(image)
        if pixels.shape != self._shape:
            raise UsageError(
                f"the image has shape {pixels.shape} and must have {self._shape}, as at the start: "
                "start again with a box in the new image"
            )
        return self._update(pixels)

    def shift(self, right: float, down: float) -> None:  # noqa: B027 - to ignore it is allowed
        """Report how far the camera's rotation has moved the target in the image since the last one [px].

        The tracker looks for the target there in the next image. Trackers that search everywhere or measure the image's
        motion themselves ignore this. Calling it is optional.
        """

    @abstractmethod
    def _start(self, image: Image, box: Box) -> None:
        """Start with a checked image and box."""

    @abstractmethod
    def _update(self, image: Image) -> TrackResult:
        """Track the target in a checked image."""


def checked_box(box: Sequence[float], shape: Sequence[int]) -> Box:
    """Return a tracker's initial box; UsageError if malformed, too small, or less than half in the image."""
    try:
        x, y, width, height = (float(part) for part in box)
    except (TypeError, ValueError):
        raise UsageError(f"the box is {box!r} and must be x, y, width and height in pixels") from None
    given = f"x={x:g}, y={y:g}, width={width:g}, height={height:g}"
    if not all(math.isfinite(part) for part in (x, y, width, height)):
        raise UsageError(f"the box is {given} and must consist of finite numbers")
    if width < LEAST_PX or height < LEAST_PX:
        raise UsageError(f"the box is {given} and must be at least {LEAST_PX:g} pixels wide and high")
    rows, columns = shape[:2]
    if overlap_area((x, y, width, height), (0.0, 0.0, columns, rows)) < _IN_VIEW * width * height:
        raise UsageError(f"the box is {given} and at least half of it must be in the image of {columns}×{rows} pixels")
    return x, y, width, height


def outline(box: Box) -> tuple[tuple[float, float], ...]:
    """Return the four corners of a box [px], for annotations."""
    x, y, width, height = box
    return (x, y), (x + width, y), (x + width, y + height), (x, y + height)


def overlap_area(one: Box, other: Box) -> float:
    """Return the area shared by two boxes [px²]."""
    wide = min(one[0] + one[2], other[0] + other[2]) - max(one[0], other[0])
    high = min(one[1] + one[3], other[1] + other[3]) - max(one[1], other[1])
    return max(wide, 0.0) * max(high, 0.0)


def overlap(one: Box, other: Box) -> float:
    """Return the overlap of two boxes: intersection over union, 0 to 1."""
    shared = overlap_area(one, other)
    return shared / max(one[2] * one[3] + other[2] * other[3] - shared, 1e-9)


def patch(cv: Any, image: Image, box: Box, size: tuple[int, int]) -> Image:
    """Sample a box, at least partly in the image, at a size of width and height. Pixels outside repeat the edge."""
    x, y, width, height = box
    rows, columns = image.shape[:2]
    left, top = max(0, math.floor(x) - 1), max(0, math.floor(y) - 1)
    right, bottom = min(columns, math.ceil(x + width) + 1), min(rows, math.ceil(y + height) + 1)
    left, top = min(left, columns - 1), min(top, rows - 1)
    part = image[top : max(bottom, top + 1), left : max(right, left + 1)]
    # Linear sampling uses only the nearest pixels, so average a large area down first.
    coarse = [max(1, int(full / wanted)) for full, wanted in zip((width, height), size, strict=True)]
    high, wide = part.shape[:2]
    if max(coarse) > 1:
        wanted = (max(1, round(wide / coarse[0])), max(1, round(high / coarse[1])))
        part = cv.resize(part, wanted, interpolation=cv.INTER_AREA)
    shrink_x, shrink_y = part.shape[1] / wide, part.shape[0] / high
    step_x, step_y = width / size[0] * shrink_x, height / size[1] * shrink_y
    first_x = (x - left) * shrink_x + step_x / 2 - 0.5  # pixel centres, not pixel edges
    first_y = (y - top) * shrink_y + step_y / 2 - 0.5
    turn = np.array([[step_x, 0.0, first_x], [0.0, step_y, first_y]])
    flags = cv.INTER_LINEAR | cv.WARP_INVERSE_MAP
    return np.asarray(cv.warpAffine(part, turn, size, flags=flags, borderMode=cv.BORDER_REPLICATE), np.uint8)


def features(cv: Any, pixels: Image) -> Floats:
    """Return a patch's features, (channels, height / CELL, width / CELL): 8 channels for grey, 10 for colour.

    Each cell has its gradient strength and the first harmonics of the gradient's direction, which carry the information
    of a direction histogram in fewer numbers. Both are normalised by the local strength, so light and contrast don't
    matter. The other channels are brightness and, for a colour image, both colour components relative to the patch's.
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
    around = cv.blur(cells[0], (3, 3)) + np.float32(4.0)  # 4 grey levels: noise on a flat wall is not texture
    light = [(plain[0] - plain[0].mean()) / np.float32(64.0)]
    colour = [(one - 128) / np.float32(32.0) for one in plain[1:]]
    return np.stack([one / around for one in cells] + light + colour)
