"""A tracker that notices when it has lost its target and finds it again by its remembered appearance.

The split into a tracker, a memory that verifies it and a search with that memory follows Kalal, Mikolajczyk and Matas,
"Tracking-learning-detection", TPAMI 34, 2012.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any, Final

import numpy as np

from skyloop.errors import UsageError
from skyloop.messages.geometry import within
from skyloop.vision.lens import pixels_of
from skyloop.vision.opencv import opencv
from skyloop.vision.tracking import (
    LEAST_PX,
    Box,
    CorrelationTracker,
    Floats,
    Image,
    Tracker,
    TrackResult,
    checked_box,
    features,
    overlap,
    patch,
)

_VERIFIED: Final = 0.45  # minimum similarity to the memory for a tracked box to count as verified
_SURE: Final = 0.6  # minimum similarity for the appearance to be learned
_FOUND: Final = 0.55  # minimum similarity for a place to be tried when the target is lost
_UNLIKE_OTHERS: Final = 0.15  # required lead in similarity over all other places and known look-alikes
_LOOK_ALIKE: Final = 0.4  # minimum similarity for anything near the target to be remembered as a look-alike
_PATIENCE: Final = 10  # number of images without verification before the whole image is searched
_TRIAL: Final = 3  # number of images in which a found place must be verified
_LEARN_EACH: Final = 5  # minimum number of images between updates of the memory
_LOOK_AROUND_EACH: Final = 15  # number of images between searches for look-alikes
_SIZES: Final = (1.0, 0.8, 1.25, 1.0, 0.65, 1.55)  # multiples of the target's last size, one searched per image

# Score, and the fraction of boxes that overlap the target by half or more (`python -m benchmarks.tracking_street`).
_CONFIDENCE: Final = ((0.45, 0.857), (0.55, 0.946), (0.65, 0.974), (0.75, 0.986), (0.85, 0.986), (0.95, 0.989))
_PLACES: Final = 5  # number of strips across a box in which its colours are sampled
_ASIDE: Final = 0.12  # offset between neighbouring strips, as a fraction of the box's width
_HALVES: Final = ((0.18, 0.48), (0.55, 0.85))  # upper and lower half: ranges from the top, as fractions of the height
_SIZE: Final = (24, 24)  # size of the stored patch, whatever the target's shape [px]
_GRADIENTS: Final = 7  # number of gradient channels, which come first in the features
_COLOUR_WEIGHT: Final = 1.2  # rate at which the similarity decays with the colour distance
_KEPT: Final = 12  # maximum number of appearances, and of look-alikes
_NEW_BELOW: Final = 0.9  # appearances more similar to a known one than this are not added
_SEARCHED_PX: Final = 16.0  # side of the target in the shrunk search image
_LEAST_MATCH: Final = 0.35  # minimum correlation for a place to be examined
_WORTH_NUDGING: Final = 0.2  # minimum similarity for refining a place; a match reaches it even 20 % off in size
_NUDGE: Final = 0.08  # step of the refinement, as a fraction of the target's size
_GROWTH: Final = (0.9, 1.1)  # scales tried by the refinement


def confidence(score: float) -> float:
    """Return the estimated probability that a box with this score overlaps the target by half or more; monotonic."""
    return float(np.interp(score, [at for at, _ in _CONFIDENCE], [share for _, share in _CONFIDENCE]))


class _State(Enum):
    TRACKING = "tracking"
    ON_TRIAL = "on trial"  # target found again but not yet trusted
    LOST = "lost"


class LongTermTracker(Tracker):
    """Tracks a target, reports its loss, and finds it again anywhere in the image.

    The tracking itself is done by another tracker. Each of its boxes is compared with a memory of the target's
    appearances, learned from boxes that match well, and with look-alikes seen near it. A box that is not verified is
    withheld and the target reported as lost. After ten such images the whole image is searched, at one size per image.
    A place that is similar enough, and clearly more similar than any other place or known look-alike, is tracked on
    trial and returned after three images.

    A target that was hidden next to a twin therefore stays lost, because nothing tells the two apart: restart with a
    new box. The score is the similarity to the closest appearance; ``confidence`` is calibrated on simulated people.
    """

    def __init__(self, tracker: Callable[[], Tracker] = CorrelationTracker) -> None:
        """Prepare the tracker.

        Args:
            tracker: Creates the tracker that follows the target; restarted after each loss.

        Raises:
            MissingExtraError: OpenCV is not installed.
        """
        self._cv: Any = opencv("tracking")
        self._tracker = tracker()

    def shift(self, right: float, down: float) -> None:
        """Look for the target shifted by this much to the right and down in the next image [px]. Ignored if lost."""
        if self._shape is not None and self._state is not _State.LOST:
            self._tracker.shift(right, down)

    def similarity(self, image: Image, box: Sequence[float]) -> float:
        """Return how similar a box's content is to the target, 0 to 1; 0 if a known look-alike fits clearly better.

        Args:
            image: As in :meth:`update`.
            box: x, y, width, height [px].

        Raises:
            UsageError: The tracker was not started, or the box is invalid.
        """
        pixels, checked = self._known(image, box)
        seen = self._memory.judged(pixels, checked)
        return 0.0 if _is_other(seen) else seen.similarity

    def resume(self, image: Image, box: Sequence[float]) -> None:
        """Continue from a box in which another detector found the target. All remembered appearances are kept.

        Args:
            image: As in :meth:`update`; pass the next image to that method.
            box: x, y, width, height [px].

        Raises:
            UsageError: The tracker was not started, or the box is invalid.
        """
        pixels, checked = self._known(image, box)
        self._tracker.start(pixels, checked)
        self._state, self._count, self._size = _State.TRACKING, 0, checked[2:]

    def refuse(self) -> None:
        """Mark the target as lost because other evidence shows that the tracker follows something else.

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
        """Keep an unverified target for a while, but immediately drop a target on trial or a clear look-alike."""
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
    """Return whether a place clearly contains a look-alike. Only tracking can distinguish exact twins."""
    return seen.look_alike - seen.similarity > _UNLIKE_OTHERS


@dataclass(frozen=True, slots=True, eq=False)
class Appearance:
    """The appearance of a box's content in one image."""

    pixels: Image  #: 24×24 patch
    texture: Floats  #: gradients of the patch's cells, normalised to length 1
    colour: Floats  #: both colour components of the patch's cells; empty for a grey image

    @classmethod
    def of(cls, cv: Any, image: Image, box: Box) -> Appearance:
        """Extract the appearance of a box in an image."""
        pixels = patch(cv, image, box, _SIZE)
        cells = features(cv, pixels)
        gradients, rest = cells[:_GRADIENTS].ravel(), cells[_GRADIENTS:]
        light = rest[0].ravel() - rest[0].mean()
        both = np.concatenate([_unit(gradients), _unit(light)])
        return cls(pixels, np.asarray(both / math.sqrt(2), np.float32), rest[1:])

    def similarity(self, other: Appearance) -> float:
        """Return the similarity of two appearances, 0 to 1. It is high only if both texture and colour agree."""
        texture = within(float(self.texture @ other.texture), 0.0, 1.0)
        colour = float(np.abs(self.colour - other.colour).mean()) if self.colour.size else 0.0
        return texture * math.exp(-_COLOUR_WEIGHT * colour)


def colours(image: Image, box: Box) -> Floats:
    """Return the colours of a box's upper and lower half, (5, 6) float32: L, a, b of each (CIELAB).

    There is one row for each of five strips from left to right, each a third of the box's width: the middle of the box
    shows only background if a person has an arm or a leg stretched out. The image is BGR or grey.
    """
    cv = opencv("comparing colours")
    x, y, width, height = box
    grey = image.ndim == 2
    means = np.empty((_PLACES, len(_HALVES), 3), np.float32)
    for n in range(_PLACES):
        middle = x + width * (0.5 + _ASIDE * (n - _PLACES // 2))
        left, right = _within(middle - width / 6, middle + width / 6, image.shape[1])
        for half, (low, high) in enumerate(_HALVES):
            top, bottom = _within(y + low * height, y + high * height, image.shape[0])
            part = image[top:bottom, left:right]
            means[n, half] = part.mean() if grey else np.asarray(part).mean(axis=(0, 1))
    return np.asarray(cv.cvtColor(means / np.float32(255.0), cv.COLOR_BGR2LAB).reshape(_PLACES, -1), np.float32)


def _within(low: float, high: float, most: int) -> tuple[int, int]:
    """Return the pixel range from low to high, clipped to the image but at least one pixel long."""
    first = min(max(0, math.floor(low)), most - 1)
    return first, min(max(first + 1, math.ceil(high)), most)


@dataclass(frozen=True, slots=True)
class Candidate:
    """A place in an image where the target may be."""

    box: Box
    similarity: float  #: similarity to the closest appearance of the target
    look_alike: float  #: similarity to the closest look-alike; 0 if none is known


class TargetMemory:
    """Several appearances of one target, and look-alikes seen near it.

    The first appearance, which the user selected, is never forgotten.
    """

    def __init__(self, cv: Any, image: Image, box: Box) -> None:
        self._cv = cv
        self._appearances = [Appearance.of(cv, image, box)]
        self._look_alikes: list[Appearance] = []
        self._turn = 0

    def judged(self, image: Image, box: Box) -> Candidate:
        """Compare a box's content with all remembered appearances."""
        seen = Appearance.of(self._cv, image, box)
        return Candidate(box, _nearest(seen, self._appearances), _nearest(seen, self._look_alikes))

    def learn(self, image: Image, box: Box) -> None:
        """Remember the target's current appearance unless it is already known."""
        _add(self._appearances, Appearance.of(self._cv, image, box), keep_first=True)

    def learn_look_alike(self, image: Image, box: Box) -> None:
        """Remember a look-alike."""
        _add(self._look_alikes, Appearance.of(self._cv, image, box), keep_first=False)

    def search(self, image: Image, size: tuple[float, float], *, besides: Box | None = None) -> list[Candidate]:
        """Search the whole image for the target at a size [px], using a different one of its appearances each time.

        Return the best places, at most three, most similar first, without those that overlap ``besides`` by a tenth.
        """
        shrink = min(1.0, _SEARCHED_PX / math.sqrt(size[0] * size[1]))
        rows, columns = image.shape[:2]
        template = (max(4, round(size[0] * shrink)), max(4, round(size[1] * shrink)))
        small = (max(template[0], round(columns * shrink)), max(template[1], round(rows * shrink)))
        cv = self._cv
        searched = cv.resize(image, small, interpolation=cv.INTER_AREA)
        wanted = self._appearances[-1 - self._turn % len(self._appearances)]
        self._turn += 1
        match = cv.matchTemplate(
            searched, cv.resize(wanted.pixels, template, interpolation=cv.INTER_AREA), cv.TM_CCOEFF_NORMED
        )
        wide, high = small[0] / columns, small[1] / rows
        found = []
        for _ in range(3):
            _, best, _, (x, y) = cv.minMaxLoc(match)
            if not best >= _LEAST_MATCH:  # NaN where the image has no texture
                break
            box = (x / wide, y / high, float(size[0]), float(size[1]))
            if besides is None or overlap(box, besides) < 0.1:
                found.append(self._nudged(image, box))
            reach_x, reach_y = template[0] // 2 + 1, template[1] // 2 + 1
            match[max(0, y - reach_y) : y + reach_y + 1, max(0, x - reach_x) : x + reach_x + 1] = -1.0
        return sorted(found, key=lambda one: -one.similarity)

    def _nudged(self, image: Image, box: Box) -> Candidate:
        """Refine the coarse search: return the most similar of the nearby boxes, unless the place is hopeless."""
        rough = self.judged(image, box)
        if rough.similarity < _WORTH_NUDGING:
            return rough
        x, y, width, height = box
        tried = [(x + right * _NUDGE * width, y, width, height) for right in (-1, 1)]
        tried += [(x, y + down * _NUDGE * height, width, height) for down in (-1, 1)]
        tried += [(x + width * (1 - k) / 2, y + height * (1 - k) / 2, width * k, height * k) for k in _GROWTH]
        return max([rough, *(self.judged(image, one) for one in tried)], key=lambda one: one.similarity)


def _unit(values: Floats) -> Floats:
    return np.asarray(values / max(float(np.linalg.norm(values)), 1e-6), np.float32)


def _nearest(seen: Appearance, known: list[Appearance]) -> float:
    return max((seen.similarity(one) for one in known), default=0.0)


def _add(known: list[Appearance], seen: Appearance, *, keep_first: bool) -> None:
    if _nearest(seen, known) < _NEW_BELOW:
        known.append(seen)
        if len(known) > _KEPT:
            del known[1 if keep_first else 0]
