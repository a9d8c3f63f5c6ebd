"""Detections, in a format common to all detectors, and objects, which are detections matched across images. Pure.

Detections are joined into objects with permanent numbers as in Zhang et al., "ByteTrack: Multi-Object Tracking by
Associating Every Detection Box", ECCV 2022: confident detections are matched with all objects first, then uncertain
ones with the remaining objects, because half-hidden things get low scores. Only confident detections start new objects.
Each object's box has a constant-velocity Kalman filter, which uses timestamps instead of counting images, so that a
missed frame does no harm. The pairs come from SciPy's ``linear_sum_assignment``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import UsageError
from skyloop.estimation import assignment, corrected, drift
from skyloop.vision.tracking import Box, Image, outline

Floats = NDArray[np.float64]
# Fractions of the box's height, as in ByteTrack's filter, which assumes 30 images a second.
_POSITION: Final = 1 / 20  # standard deviation of a detection
_SPEED: Final = 1.5  # initial standard deviation of the velocity [1/s]
_WANDERING: Final = 0.8  # standard deviation of the change in velocity within a second


@dataclass(frozen=True, slots=True)
class Detection:
    """One object that a detector found in one image."""

    box: Box  #: x, y, width, height [px] in the image, within its edges
    score: float  #: the detector's confidence, 0 to 1; a score, not a probability
    class_id: int  #: the detector's class number
    class_name: str  #: class name; its number as text if the detector has no names

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
    """Finds objects of known classes in an image. Call a detector from one thread only."""

    def detect(self, image: Image) -> list[Detection]:
        """Return the objects in the image, the most confident first.

        Args:
            image: A :class:`skyloop.Frame` or a uint8 array, (h, w, 3) BGR or (h, w) grey.
        """
        ...


def overlaps(one: Floats, others: Floats) -> Floats:
    """Return the overlap of each box with one box (left, top, right, bottom): intersection over union, 0 to 1."""
    low = np.maximum(one[:2], others[:, :2])
    high = np.minimum(one[2:], others[:, 2:])
    shared = np.prod(np.clip(high - low, 0.0, None), axis=1)
    own = float(np.prod(one[2:] - one[:2]))
    areas = np.prod(others[:, 2:] - others[:, :2], axis=1)
    return np.asarray(shared / np.maximum(areas + own - shared, 1e-12), np.float64)


def suppress(corners: Floats, scores: Floats, classes: NDArray[np.int64], iou: float) -> NDArray[np.int64]:
    """Apply non-maximum suppression: of overlapping boxes (left, top, right, bottom) of a class, keep only the best.

    Return the indices of the rows to keep, best first. Boxes of a class that overlap by more than ``iou`` count as one.
    """
    left = np.argsort(-scores, kind="stable")
    kept: list[int] = []
    while len(left):
        best, left = int(left[0]), left[1:]
        kept.append(best)
        same = (classes[left] == classes[best]) & (overlaps(corners[best], corners[left]) > iou)
        left = left[~same]
    return np.asarray(kept, np.int64)


@dataclass(frozen=True, slots=True)
class TrackedObject:
    """An object at the time of the newest update."""

    id: int  #: number of the object, from 1; never reused
    detection: Detection  #: the last detection, including its box
    box: Box  #: x, y, width, height [px], filtered; predicted while the object is not detected
    velocity: tuple[float, float]  #: velocity of the box's centre to the right and down [px/s]
    seen: bool  #: whether the object was detected in this image
    age_s: float  #: time since the first detection [s]
    unseen_s: float  #: time since the last detection [s]


@dataclass(slots=True, eq=False)
class _Object:
    number: int
    detection: Detection
    state: Floats  # (2, 4): position and velocity of the centre's x and y, the width and the height
    covariance: Floats  # covariance of position and velocity for each of the four, (2, 2)
    first_s: float
    last_s: float
    hits: int = 1
    corners: Floats = field(default_factory=lambda: np.zeros(4))


class ObjectTracks:
    """Numbers the detections of successive images so that each object keeps its number. Not thread-safe."""

    def __init__(
        self,
        *,
        sure: float = 0.5,
        overlap: float = 0.2,
        overlap_unsure: float = 0.5,
        confirm: int = 2,
        keep_s: float = 1.5,
    ) -> None:
        """Start with no objects.

        Args:
            sure: Minimum score, 0 to 1, for a detection to start a new object. Have the detector return low scores too
                (``OnnxDetector(…, score=0.1)``): such detections keep existing objects alive.
            overlap: Minimum overlap of an object's predicted box with a confident detection, 0 to 1.
            overlap_unsure: Minimum overlap with an uncertain detection, 0 to 1.
            confirm: Number of detections after which an object is returned; 1 or more.
            keep_s: Time for which an undetected object is remembered [s].

        Raises:
            UsageError: An argument is out of its range.
            MissingExtraError: SciPy is not installed.
        """
        for name, value in (("sure", sure), ("overlap", overlap), ("overlap_unsure", overlap_unsure)):
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 <= value <= 1.0:
                raise UsageError(f"{name} is {value!r} and must be a number from 0 to 1")
        if isinstance(confirm, bool) or not isinstance(confirm, int) or confirm < 1:
            raise UsageError(f"confirm is {confirm!r} and must be a whole number of at least 1")
        if isinstance(keep_s, bool) or not isinstance(keep_s, int | float) or not 0.0 <= keep_s < math.inf:
            raise UsageError(f"keep_s is {keep_s!r} and must be a finite number of seconds, 0 or more")
        self._assign = assignment("matching detections", "detect")
        self._sure, self._confirm, self._keep_s = float(sure), confirm, float(keep_s)
        self._overlap, self._overlap_unsure = float(overlap), float(overlap_unsure)
        self._objects: list[_Object] = []
        self._time_s: float | None = None
        self._next = 1

    def update(self, detections: Sequence[Detection], time_s: float) -> list[TrackedObject]:
        """Match the next image's detections; return the confirmed objects by number, including those not seen in it.

        Args:
            detections: Detections in one image; empty and non-finite ones are ignored.
            time_s: Capture time of the image [s], on any clock that never runs backwards.

        Raises:
            UsageError: The time is not finite, or earlier than in the last update.
        """
        if isinstance(time_s, bool) or not isinstance(time_s, int | float) or not math.isfinite(time_s):
            raise UsageError(f"time_s is {time_s!r} and must be a finite number of seconds")
        if self._time_s is not None and time_s < self._time_s:
            raise UsageError(f"time_s is {time_s!r}, before the last update's {self._time_s!r}: give images in order")
        elapsed = 0.0 if self._time_s is None else time_s - self._time_s
        self._time_s = float(time_s)
        self._objects = [each for each in self._objects if time_s - each.last_s <= self._keep_s]
        for each in self._objects:
            _predict(each, elapsed)
        usable = [each for each in detections if _is_usable(each)]
        sure = [each for each in usable if each.score >= self._sure]
        unsure = [each for each in usable if each.score < self._sure]
        # Unconfirmed objects come last, so that they can't take a detection from a known object.
        known = [each for each in self._objects if each.hits >= self._confirm]
        young = [each for each in self._objects if each.hits < self._confirm]
        known, sure = self._match(known, sure, self._overlap, time_s)
        self._match(known, unsure, self._overlap_unsure, time_s)
        young, sure = self._match(young, sure, self._overlap, time_s)
        self._objects = [each for each in self._objects if each not in young]
        for new in sure:
            self._objects.append(_started(self._next, new, time_s))
            self._next += 1
        return [_tracked(each, time_s) for each in self._objects if each.hits >= self._confirm]

    def _match(
        self, objects: list[_Object], detections: list[Detection], least: float, time_s: float
    ) -> tuple[list[_Object], list[Detection]]:
        """Update the objects that match a detection; return the unmatched objects and detections."""
        if not objects or not detections:
            return objects, detections
        corners = np.array([_corners(each.box) for each in detections])
        agreement = np.stack([overlaps(each.corners, corners) for each in objects])
        classes = np.array([[a.detection.class_id == b.class_id for b in detections] for a in objects])
        # Pairs of different classes or with too little overlap cost more than any sum of allowed pairs.
        allowed = classes & (agreement > least)
        cost = np.where(allowed, 1.0 - agreement, float(len(objects) + len(detections) + 1))
        pairs = [(int(i), int(j)) for i, j in zip(*self._assign(cost), strict=True) if allowed[i, j]]
        for i, j in pairs:
            _correct(objects[i], detections[j], time_s)
        taken, used = {i for i, _ in pairs}, {j for _, j in pairs}
        return (
            [each for i, each in enumerate(objects) if i not in taken],
            [each for j, each in enumerate(detections) if j not in used],
        )


def _is_usable(detection: Detection) -> bool:
    numbers = (*detection.box, detection.score)
    return all(math.isfinite(each) and abs(each) < 1e6 for each in numbers) and min(detection.box[2:]) > 0


def _corners(box: Sequence[float]) -> Floats:
    x, y, width, height = box
    return np.array([x, y, x + width, y + height], np.float64)


def _measured(detection: Detection) -> Floats:
    x, y, width, height = detection.box
    return np.array([x + width / 2, y + height / 2, width, height], np.float64)


def _started(number: int, detection: Detection, time_s: float) -> _Object:
    height = detection.box[3]
    state = np.stack([_measured(detection), np.zeros(4)])
    covariance = np.diag([(2 * _POSITION * height) ** 2, (_SPEED * height) ** 2])
    return _Object(number, detection, state, covariance, time_s, time_s, corners=_corners(detection.box))


def _predict(each: _Object, elapsed_s: float) -> None:
    move, wander = drift(elapsed_s, (_WANDERING * max(each.state[0, 3], 1.0)) ** 2)
    each.state, each.covariance = move @ each.state, move @ each.covariance @ move.T + wander
    _place(each)


def _correct(each: _Object, detection: Detection, time_s: float) -> None:
    noise = np.array([[(_POSITION * detection.box[3]) ** 2]])
    off = _measured(detection)[None] - each.state[0]
    each.state, each.covariance = corrected(each.state, each.covariance, off, np.eye(1, 2), noise)
    each.detection, each.last_s, each.hits = detection, time_s, each.hits + 1
    _place(each)


def _place(each: _Object) -> None:
    each.state[0, 2:] = np.maximum(each.state[0, 2:], 1.0)  # keeps a shrinking box from vanishing
    centre, size = each.state[0, :2], each.state[0, 2:]
    each.corners = np.concatenate([centre - size / 2, centre + size / 2])


def _tracked(each: _Object, time_s: float) -> TrackedObject:
    x, y, width, height = (float(v) for v in (*each.corners[:2], *each.state[0, 2:]))
    return TrackedObject(
        id=each.number,
        detection=each.detection,
        box=(x, y, width, height),
        velocity=(float(each.state[1, 0]), float(each.state[1, 1])),
        seen=each.last_s == time_s,
        age_s=time_s - each.first_s,
        unseen_s=time_s - each.last_s,
    )
