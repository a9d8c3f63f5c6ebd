"""A tracker that notices when it lost its target, finds it again, and does not take something else for it.

The division into tracking, a memory that verifies, and detection by that memory is that of Kalal, Mikolajczyk and
Matas, "Tracking-learning-detection", TPAMI 34, 2012.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import Enum
from typing import Any, Final

import numpy as np

from skyloop.errors import UsageError
from skyloop.vision.appearance import Candidate, TargetMemory
from skyloop.vision.opencv import opencv
from skyloop.vision.planar import pixels_of
from skyloop.vision.trackers import CorrelationTracker
from skyloop.vision.tracking import LEAST_PX, Box, Image, Tracker, TrackResult, checked_box

_VERIFIED: Final = 0.45  # similarity to the memory from which a tracked box is the target's
_SURE: Final = 0.6  # from which its appearance is learned
_FOUND: Final = 0.55  # from which a place is worth a trial, while the target is lost
_UNLIKE_OTHERS: Final = 0.15  # by which a place must be more similar than any other one, and than known look-alikes
_LOOK_ALIKE: Final = 0.4  # from which something beside the target is remembered as its look-alike
_PATIENCE: Final = 10  # images without verification after which the target is searched for everywhere
_TRIAL: Final = 3  # images in which a place that was found must be verified
_LEARN_EACH: Final = 5  # images
_LOOK_AROUND_EACH: Final = 15  # images
_SIZES: Final = (1.0, 0.8, 1.25, 1.0, 0.65, 1.55)  # of the last one, searched in turn, one in each image

# Score, and the share of such boxes that overlapped the target by a half: `python -m benchmarks.tracking_street`.
_CONFIDENCE: Final = ((0.45, 0.857), (0.55, 0.946), (0.65, 0.974), (0.75, 0.986), (0.85, 0.986), (0.95, 0.989))


def confidence(score: float) -> float:
    """Return the estimated chance, 0 to 1, that a box of a score overlaps the target by a half or more; monotone."""
    return float(np.interp(score, [at for at, _ in _CONFIDENCE], [share for _, share in _CONFIDENCE]))


class _State(Enum):
    TRACKING = "tracking"
    ON_TRIAL = "on trial"  # found again, and not yet believed
    LOST = "lost"


class LongTermTracker(Tracker):
    """Tracks a target, says when it is lost, and finds it again anywhere in the image.

    Another tracker follows the target. Each box that it returns is compared with a memory of the target's appearances,
    which learns when it is sure, and with that of look-alikes seen beside it. A box that is not verified is not
    returned: the result is lost. After ten such images the whole image is searched, for one size in each. A place that
    is similar enough, clearly more so than any other place and than every known look-alike, is tracked on trial and
    returned after three images.

    So a target that was hidden beside a twin stays lost, as nothing tells them apart: start again with a new box. The
    score is the similarity to the nearest appearance, and the confidence is calibrated on the simulator's figures.
    """

    def __init__(self, tracker: Callable[[], Tracker] = CorrelationTracker) -> None:
        """Prepare the tracker.

        Args:
            tracker: Makes the tracker that follows the target; it is started again after each loss.

        Raises:
            MissingExtraError: OpenCV is not installed.
        """
        self._cv: Any = opencv("tracking")
        self._tracker = tracker()

    def shift(self, right: float, down: float) -> None:
        """Look for the target so much farther right and down in the next image [px], unless it is lost."""
        if self._shape is not None and self._state is not _State.LOST:
            self._tracker.shift(right, down)

    def similarity(self, image: Image, box: Sequence[float]) -> float:
        """Return how much what is in a box looks like the target, 0 to 1; 0 if it looks more like a known look-alike.

        Args:
            image: As in :meth:`update`.
            box: x, y, width, height [px].

        Raises:
            UsageError: The tracker was not started, or the box is not one.
        """
        pixels, checked = self._known(image, box)
        seen = self._memory.judged(pixels, checked)
        return 0.0 if _is_other(seen) else seen.similarity

    def resume(self, image: Image, box: Sequence[float]) -> None:
        """Go on from a box, in which something else found the target, with all that is remembered of its looks.

        Args:
            image: As in :meth:`update`, which is called with the next one.
            box: x, y, width, height [px].

        Raises:
            UsageError: The tracker was not started, or the box is not one.
        """
        pixels, checked = self._known(image, box)
        self._tracker.start(pixels, checked)
        self._state, self._count, self._size = _State.TRACKING, 0, checked[2:]

    def refuse(self) -> None:
        """Take the target for lost, because something else shows that what was followed is not the target.

        Raises:
            UsageError: The tracker was not started.
        """
        if self._shape is None:
            raise UsageError("the tracker was not started: call start(image, box) first")
        self._state, self._count = _State.LOST, 0

    def _known(self, image: Image, box: Sequence[float]) -> tuple[Image, Box]:
        if self._shape is None:
            raise UsageError("the tracker was not started: call start(image, box) first")
        pixels = pixels_of(image)
        return pixels, checked_box(box, pixels.shape)

    def _start(self, image: Image, box: Box) -> None:
        self._tracker.start(image, box)
        self._memory = TargetMemory(self._cv, image, box)
        self._state, self._count, self._images = _State.TRACKING, 0, 0
        self._size = box[2:]

    def _update(self, image: Image) -> TrackResult:
        self._images += 1
        if self._state is _State.LOST:
            return self._search(image)
        found = self._tracker.update(image)
        seen = None if found.box is None else self._memory.judged(image, found.box)
        if seen is None or seen.similarity < _VERIFIED or _is_other(seen):
            return self._doubt(seen)
        if self._state is _State.ON_TRIAL:
            self._count += 1
            if self._count < _TRIAL:
                return TrackResult(None, seen.similarity)
            self._state = _State.TRACKING
        self._count = 0
        self._size = seen.box[2:]
        self._learn(image, seen)
        return TrackResult(seen.box, seen.similarity, confidence(seen.similarity))

    def _doubt(self, seen: Candidate | None) -> TrackResult:
        """Go on for a while with a target that is not verified; give up at once on one on trial, or another one."""
        self._count += 1
        mistaken = seen is not None and _is_other(seen)
        if self._state is _State.ON_TRIAL or mistaken or self._count >= _PATIENCE:
            self._state, self._count = _State.LOST, 0
        return TrackResult(None, 0.0 if seen is None else seen.similarity)

    def _search(self, image: Image) -> TrackResult:
        share = _SIZES[self._count % len(_SIZES)]
        self._count += 1
        width, height = (min(side * share, most) for side, most in zip(self._size, image.shape[1::-1], strict=True))
        places = self._memory.search(image, (width, height))
        if not places:
            return TrackResult(None, 0.0)
        best = places[0]
        others = max([best.look_alike, *(place.similarity for place in places[1:])])
        clearly = best.similarity >= _FOUND and best.similarity - others >= _UNLIKE_OTHERS
        if clearly and min(best.box[2:]) >= LEAST_PX:
            self._tracker.start(image, best.box)
            self._state, self._count = _State.ON_TRIAL, 0
        return TrackResult(None, best.similarity)

    def _learn(self, image: Image, seen: Candidate) -> None:
        if seen.similarity >= _SURE and self._images % _LEARN_EACH == 0:
            self._memory.learn(image, seen.box)
        if self._images % _LOOK_AROUND_EACH == 0:
            for place in self._memory.search(image, (seen.box[2], seen.box[3]), besides=seen.box):
                if place.similarity >= _LOOK_ALIKE:
                    self._memory.learn_look_alike(image, place.box)


def _is_other(seen: Candidate) -> bool:
    """Whether it is clearly a look-alike; an exact twin is not: while it is tracked, continuity tells them apart."""
    return seen.look_alike - seen.similarity > _UNLIKE_OTHERS
