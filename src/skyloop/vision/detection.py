"""What all detectors have in common: a detection, the interface, and how overlapping detections are thinned out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from skyloop.vision.tracking import Box, Image, outline

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Detection:
    """One thing that a detector found in one image."""

    box: Box  #: x, y, width, height [px] in the image, within its edges
    score: float  #: 0 to 1, how sure the detector is; a score, not a probability
    class_id: int  #: the detector's number of the class
    class_name: str  #: the name of the class; the number as text where the detector has no names

    @property
    def centre(self) -> tuple[float, float]:
        """The middle of the box [px]."""
        x, y, width, height = self.box
        return x + (width - 1) / 2, y + (height - 1) / 2

    @property
    def outline(self) -> tuple[tuple[float, float], ...]:
        """The four corners of the box [px], for annotations."""
        return outline(self.box)


@runtime_checkable
class ObjectDetector(Protocol):
    """Finds things of known classes in an image. Call one detector from one thread."""

    def detect(self, image: Image) -> list[Detection]:
        """Return what is in the image, surest first.

        Args:
            image: A :class:`skyloop.Frame` or a uint8 array, (h, w, 3) BGR or (h, w) grey.
        """
        ...


def overlaps(one: Floats, others: Floats) -> Floats:
    """Return how well each of the boxes agrees with one: the shared area over that of both together, 0 to 1.

    Args:
        one: (4,) left, top, right, bottom.
        others: (n, 4), in the same order.
    """
    low = np.maximum(one[:2], others[:, :2])
    high = np.minimum(one[2:], others[:, 2:])
    shared = np.prod(np.clip(high - low, 0.0, None), axis=1)
    own = float(np.prod(one[2:] - one[:2]))
    areas = np.prod(others[:, 2:] - others[:, :2], axis=1)
    return np.asarray(shared / np.maximum(areas + own - shared, 1e-12), np.float64)


def suppress(corners: Floats, scores: Floats, classes: NDArray[np.int64], iou: float) -> NDArray[np.int64]:
    """Keep the surest of the boxes that overlap, class by class (non-maximum suppression).

    Args:
        corners: (n, 4) left, top, right, bottom.
        scores: (n,).
        classes: (n,) number of the class.
        iou: Boxes of a class that agree better than this are the same thing.

    Returns:
        The rows that are kept, surest first.
    """
    left = np.argsort(-scores, kind="stable")
    kept: list[int] = []
    while len(left):
        best, left = int(left[0]), left[1:]
        kept.append(best)
        same = (classes[left] == classes[best]) & (overlaps(corners[best], corners[left]) > iou)
        left = left[~same]
    return np.asarray(kept, np.int64)
