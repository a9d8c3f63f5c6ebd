"""What all trackers of a box have in common: how they are started and updated, and what they return.

A box is x, y, width and height in pixels: its left and top edge, and its size, as in OpenCV. A box of whole numbers
covers the columns x to x + width − 1 and the rows y to y + height − 1.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import UsageError
from skyloop.vision.planar import pixels_of

Box = tuple[float, float, float, float]  #: x, y, width, height [px]
Image = NDArray[np.uint8]

LEAST_PX: Final = 6.0  #: sides of a box: a smaller one has too little in it to be found again
_IN_VIEW: Final = 0.5  # of the box, at the start


@dataclass(frozen=True, slots=True)
class TrackResult:
    """Where the target is in one image."""

    box: Box | None  #: x, y, width, height [px]; None while the target is lost
    score: float  #: 0 to 1, how much it looks like the target; a score, not a probability
    confidence: float | None = None  #: chance that the box overlaps the target by a half or more; None: no estimate

    @property
    def lost(self) -> bool:
        """Whether the target was not found in this image."""
        return self.box is None

    @property
    def centre(self) -> tuple[float, float] | None:
        """The middle of the box, pixels; None while the target is lost."""
        if self.box is None:
            return None
        x, y, width, height = self.box
        return x + (width - 1) / 2, y + (height - 1) / 2

    @property
    def outline(self) -> tuple[tuple[float, float], ...]:
        """The corners of the box, for annotations; none while the target is lost."""
        if self.box is None:
            return ()
        x, y, width, height = self.box
        return (x, y), (x + width, y), (x + width, y + height), (x, y + height)


class Tracker(ABC):
    """Follows what is in a box from image to image: :meth:`start` once, then :meth:`update` with each new image.

    It may be started again at any time, with images of another size, too. It is not thread-safe: call it from one
    thread, such as a controller's or a processor's.
    """

    _shape: tuple[int, ...] | None = None

    def start(self, image: Image, box: Sequence[float]) -> None:
        """Start to track what is in the box, and forget what was tracked before.

        Args:
            image: A :class:`skyloop.Frame` or a uint8 array, (h, w, 3) BGR or (h, w) grey.
            box: x, y, width, height [px]. At least half of it is in the image.

        Raises:
            UsageError: The array has another shape or type, or the box is empty, not finite or outside of the image.
        """
        pixels = pixels_of(image)
        checked = checked_box(box, pixels.shape)
        self._shape = None  # in case that _start fails
        self._start(pixels, checked)
        self._shape = pixels.shape

    def update(self, image: Image) -> TrackResult:
        """Track the target in the next image.

        Args:
            image: As in :meth:`start`, of the same size and kind.

        Raises:
            UsageError: The tracker was not started, or the image has another shape or type than at the start.
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
        """Say how far the target moved in the image since the last one, as is known when the camera turned [px].

        It is looked for there in the next image. Trackers that look for it everywhere, or by the image's own motion,
        ignore it; so it may be left out.
        """

    @abstractmethod
    def _start(self, image: Image, box: Box) -> None:
        """Start with a checked image and box."""

    @abstractmethod
    def _update(self, image: Image) -> TrackResult:
        """Track in a checked image."""


def checked_box(box: Sequence[float], shape: Sequence[int]) -> Box:
    """Check a box that a tracker is started with.

    Args:
        box: x, y, width, height [px].
        shape: Of the image: height, width, and more.

    Raises:
        UsageError: It is anything else, too small, or less than half of it is in the image.
    """
    try:
        x, y, width, height = (float(part) for part in box)
    except (TypeError, ValueError):
        raise UsageError(f"the box is {box!r} and must be x, y, width and height in pixels") from None
    given = f"x={x:g}, y={y:g}, width={width:g}, height={height:g}"
    if not all(math.isfinite(part) for part in (x, y, width, height)):
        raise UsageError(f"the box is {given} and must be of finite numbers")
    if width < LEAST_PX or height < LEAST_PX:
        raise UsageError(f"the box is {given} and must be at least {LEAST_PX:g} pixels wide and high")
    rows, columns = shape[:2]
    if overlap_area((x, y, width, height), (0.0, 0.0, columns, rows)) < _IN_VIEW * width * height:
        raise UsageError(f"the box is {given} and at least half of it must be in the image of {columns}×{rows} pixels")
    return x, y, width, height


def overlap_area(one: Box, other: Box) -> float:
    """Return the area that two boxes share [px²]."""
    wide = min(one[0] + one[2], other[0] + other[2]) - max(one[0], other[0])
    high = min(one[1] + one[3], other[1] + other[3]) - max(one[1], other[1])
    return max(wide, 0.0) * max(high, 0.0)


def overlap(one: Box, other: Box) -> float:
    """Return how well two boxes agree: the shared area over that of both together, 0 to 1."""
    shared = overlap_area(one, other)
    return shared / max(one[2] * one[3] + other[2] * other[3] - shared, 1e-9)
