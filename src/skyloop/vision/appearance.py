"""What a target looks like: a memory of its appearances and of its look-alikes, and the search of an image for it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from skyloop.messages.geometry import within
from skyloop.vision.opencv import opencv
from skyloop.vision.tracking import Box, Floats, Image, features, overlap, patch

_PLACES: Final = 5  # across a box, at which its colours are taken
_ASIDE: Final = 0.12  # of its width, from one to the next
_HALVES: Final = ((0.18, 0.48), (0.55, 0.85))  # from the top, as shares of its height
_SIZE: Final = (24, 24)  # of the stored patch, whatever the target's shape
_GRADIENTS: Final = 7  # the first channels of the features
_COLOUR_WEIGHT: Final = 1.2
_KEPT: Final = 12  # appearances, and as many look-alikes
_NEW_BELOW: Final = 0.9  # an appearance that is more similar to a known one adds nothing
_SEARCHED_PX: Final = 16.0  # side of the target in the shrunk image that is searched
_LEAST_MATCH: Final = 0.35  # correlation of a place worth a look
_WORTH_NUDGING: Final = 0.2  # similarity; a fifth of the size aside it is more
_NUDGE: Final = 0.08  # of the target's size
_GROWTH: Final = (0.9, 1.1)


@dataclass(frozen=True, slots=True, eq=False)
class Appearance:
    """What was in a box once."""

    pixels: Image  #: the patch, 24×24
    texture: Floats  #: its gradients in cells, of length 1
    colour: Floats  #: both parts of its colour in cells; empty for a grey image

    @classmethod
    def of(cls, cv: Any, image: Image, box: Box) -> Appearance:
        """Take what is in a box of an image."""
        pixels = patch(cv, image, box, _SIZE)
        cells = features(cv, pixels)
        gradients, rest = cells[:_GRADIENTS].ravel(), cells[_GRADIENTS:]
        light = rest[0].ravel() - rest[0].mean()
        both = np.concatenate([_unit(gradients), _unit(light)])
        return cls(pixels, np.asarray(both / math.sqrt(2), np.float32), rest[1:])

    def similarity(self, other: Appearance) -> float:
        """Return how much they look alike, 0 to 1: texture and colour must both agree."""
        texture = within(float(self.texture @ other.texture), 0.0, 1.0)
        colour = float(np.abs(self.colour - other.colour).mean()) if self.colour.size else 0.0
        return texture * math.exp(-_COLOUR_WEIGHT * colour)


def colours(image: Image, box: Box) -> Floats:
    """Return the colours of the upper and the lower half of what is in a box, (5, 6) float32: L, a, b of each (CIELAB).

    Five times, each of a third of its width, from left to right: with an arm or a leg stretched out, a person is not in
    the middle of the box, and what is there is background.

    Args:
        image: uint8, (h, w, 3) BGR or (h, w) grey.
        box: x, y, width, height [px].

    Raises:
        MissingExtraError: OpenCV is not installed.
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
    """Return the pixels from low to high that are within the image, one at least."""
    first = min(max(0, math.floor(low)), most - 1)
    return first, min(max(first + 1, math.ceil(high)), most)


@dataclass(frozen=True, slots=True)
class Candidate:
    """A place in an image that may be the target."""

    box: Box
    similarity: float  #: to the most similar appearance of the target
    look_alike: float  #: to the most similar look-alike; 0 if none is known


class TargetMemory:
    """Several appearances of one target, and what was seen beside it that looks like it.

    The first appearance is what the user pointed at, and is never forgotten.
    """

    def __init__(self, cv: Any, image: Image, box: Box) -> None:
        """Remember the first appearance."""
        self._cv = cv
        self._appearances = [Appearance.of(cv, image, box)]
        self._look_alikes: list[Appearance] = []
        self._turn = 0

    def judged(self, image: Image, box: Box) -> Candidate:
        """Compare what is in a box with everything that is remembered."""
        seen = Appearance.of(self._cv, image, box)
        return Candidate(box, _nearest(seen, self._appearances), _nearest(seen, self._look_alikes))

    def learn(self, image: Image, box: Box) -> None:
        """Remember the target's present appearance, unless it is known."""
        _add(self._appearances, Appearance.of(self._cv, image, box), keep_first=True)

    def learn_look_alike(self, image: Image, box: Box) -> None:
        """Remember something else that looks like the target."""
        _add(self._look_alikes, Appearance.of(self._cv, image, box), keep_first=False)

    def search(self, image: Image, size: tuple[float, float], *, besides: Box | None = None) -> list[Candidate]:
        """Look for the target in the whole image, each time with another one of its appearances.

        Args:
            image: The image.
            size: Width and height to look for [px].
            besides: Places that share more than a tenth with this box are left out.

        Returns:
            The three best places at most, the most similar first.
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
            if not best >= _LEAST_MATCH:  # not a number in a part without texture
                break
            box = (x / wide, y / high, float(size[0]), float(size[1]))
            if besides is None or overlap(box, besides) < 0.1:
                found.append(self._nudged(image, box))
            reach_x, reach_y = template[0] // 2 + 1, template[1] // 2 + 1
            match[max(0, y - reach_y) : y + reach_y + 1, max(0, x - reach_x) : x + reach_x + 1] = -1.0
        return sorted(found, key=lambda one: -one.similarity)

    def _nudged(self, image: Image, box: Box) -> Candidate:
        """Return the most similar of the boxes near a box, unless it is nothing like it: the search was coarse."""
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
