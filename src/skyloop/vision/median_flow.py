"""A tracker by the optical flow of points in the target.

Kalal, Mikolajczyk and Matas, "Forward-backward error: automatic detection of tracking failures", ICPR 2010: a grid of
points is tracked to the next image and back by pyramidal Lucas-Kanade. The half that comes back nearest to where it
began, of those the half whose surroundings look most alike, give the motion by the median of their displacements, and
the scale by the median of how their distances changed.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skyloop.vision.opencv import opencv
from skyloop.vision.tracking import Box, Floats, Image, Tracker, TrackResult, overlap_area

_GRID: Final = 10  # points along each side
_WINDOW: Final = (11, 11)
_LEVELS: Final = 3
_AROUND: Final = (9, 9)  # pixels of a point's surroundings that are compared
_ENOUGH: Final = 6  # points
_RETURN_PX: Final = 5.0  # a median that comes back farther away is a failure
_SPREAD: Final = 0.35  # of the box's smaller side: more disagreement among the displacements is a failure
_SMALLEST_PX: Final = 6.0


class MedianFlowTracker(Tracker):
    """Tracks place and size of a target from each image to the next, and remembers no appearance.

    It is exact while the target is in view and moves smoothly, and notices at once when that fails. Then it stays lost
    until it is started again. It drifts, as it never compares with the beginning. The score says how many points came
    back, and how near.
    """

    def __init__(self) -> None:
        """Prepare the tracker.

        Raises:
            MissingExtraError: OpenCV is not installed.
        """
        self._cv: Any = opencv("tracking")
        self._box: Box | None = None

    def _start(self, image: Image, box: Box) -> None:
        self._grey, self._box = self._grey_of(image), box

    def _update(self, image: Image) -> TrackResult:
        if self._box is None:
            return TrackResult(None, 0.0)
        grey = self._grey_of(image)
        self._box, score = self._follow(grey, self._box)
        self._grey = grey
        return TrackResult(self._box, score)

    def _grey_of(self, image: Image) -> Image:
        grey = self._cv.cvtColor(image, self._cv.COLOR_BGR2GRAY) if image.ndim == 3 else image.copy()
        return np.asarray(grey, np.uint8)

    def _follow(self, grey: Image, box: Box) -> tuple[Box | None, float]:
        before = _grid(box)
        after, off, good = self._there_and_back(grey, before)
        rows, columns = grey.shape
        good &= (after >= 0).all(axis=1) & (after[:, 0] <= columns - 1) & (after[:, 1] <= rows - 1)
        good &= (before >= 0).all(axis=1) & (before[:, 0] <= columns - 1) & (before[:, 1] <= rows - 1)
        if np.count_nonzero(good) < _ENOUGH:
            return None, 0.0
        back = float(np.median(off[good]))
        nearest = good & (off <= back)
        alike = np.full(len(before), -1.0)
        alike[nearest] = self._similarity(grey, before[nearest], after[nearest])
        kept = nearest & (alike >= np.median(alike[nearest]))
        before, after = before[kept], after[kept]
        moved = after - before
        shift = np.median(moved, axis=0)
        spread = float(np.median(np.linalg.norm(moved - shift, axis=1)))
        if back > _RETURN_PX or spread > _SPREAD * min(box[2:]) or len(before) < 2:
            return None, 0.0
        scale = _stretch(before, after)
        width, height = box[2] * scale, box[3] * scale
        x = box[0] + float(shift[0]) - (width - box[2]) / 2
        y = box[1] + float(shift[1]) - (height - box[3]) / 2
        found = (x, y, width, height)
        if min(width, height) < _SMALLEST_PX or overlap_area(found, (0.0, 0.0, columns, rows)) < 0.25 * width * height:
            return None, 0.0
        score = float(np.count_nonzero(good & (off < 1.0)) / len(off)) * max(0.0, float(np.median(alike[kept])))
        return found, min(score, 1.0)

    def _there_and_back(self, grey: Image, before: Floats) -> tuple[Floats, Floats, NDArray[np.bool_]]:
        """Return where the points are now, how far from their start they come back, and which could be tracked."""
        cv = self._cv
        points = before.reshape(-1, 1, 2)
        after, forth, _ = cv.calcOpticalFlowPyrLK(self._grey, grey, points, None, winSize=_WINDOW, maxLevel=_LEVELS)
        again, back, _ = cv.calcOpticalFlowPyrLK(grey, self._grey, after, None, winSize=_WINDOW, maxLevel=_LEVELS)
        off = np.linalg.norm((again - points).reshape(-1, 2), axis=1)
        return after.reshape(-1, 2), off, (forth.ravel() == 1) & (back.ravel() == 1)

    def _similarity(self, grey: Image, before: Floats, after: Floats) -> Floats:
        """Return the normalised cross-correlation of the points' surroundings, −1 to 1."""
        cut = self._cv.getRectSubPix
        old = np.stack([cut(self._grey, _AROUND, (float(x), float(y))) for x, y in before]).astype(np.float32)
        new = np.stack([cut(grey, _AROUND, (float(x), float(y))) for x, y in after]).astype(np.float32)
        old -= old.mean(axis=(1, 2), keepdims=True)
        new -= new.mean(axis=(1, 2), keepdims=True)
        energy = np.sqrt((old**2).sum(axis=(1, 2)) * (new**2).sum(axis=(1, 2)))
        return np.asarray((old * new).sum(axis=(1, 2)) / np.maximum(energy, 1e-3), np.float32)


def _grid(box: Box) -> Floats:
    """Return points in the box, evenly spaced and not at its edge, (n, 2) pixels."""
    x, y, width, height = box
    share = (np.arange(_GRID) + 0.5) / _GRID
    across, down = np.meshgrid(x + width * share - 0.5, y + height * share - 0.5)
    return np.stack([across.ravel(), down.ravel()], axis=1).astype(np.float32)


def _stretch(before: Floats, after: Floats) -> float:
    """Return by how much the distances between the points grew: the median over all pairs."""
    one, other = np.triu_indices(len(before), k=1)
    old = np.linalg.norm(before[one] - before[other], axis=1)
    new = np.linalg.norm(after[one] - after[other], axis=1)
    return float(np.median(new / np.maximum(old, 1e-6)))
