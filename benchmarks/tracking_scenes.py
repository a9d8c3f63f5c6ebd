"""Draw image sequences with known boxes from a seed: a textured object that moves over a textured background.

Also show a film as a camera that pans and zooms would see it, with the film's own pixels and labels.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from skyloop.vision.tracking import Box, Image

KINDS: Final = ("plain", "light", "hidden", "leaves", "look-alike")
SIZE: Final = (640, 480)  #: width and height of the drawn images
_MARGIN: Final = 160  # pixels of background around the first image, for the camera to pan over
_NOISE: Final = 64  # extra size of the noise over an image [pixels]
Truth = Box | None  #: None while the target is out of view


Step = tuple[Image, Truth, bool]


class Sequence(NamedTuple):
    """One target in a series of images; the first one shows it.

    ``frames`` gives each image, the target's box in it, and whether that box is known well enough to count.
    """

    name: str
    frames: Callable[[], Iterator[Step]]


def texture(rng: np.random.Generator, width: int, height: int, mean: Iterable[float] = (128, 128, 128)) -> Image:
    """Draw random texture with fine and coarse parts around a mean colour (BGR), (height, width, 3)."""
    drawn = np.zeros((height, width, 3), np.float32) + np.array(list(mean), np.float32)
    for grain, strength in ((4, 10.0), (12, 22.0), (48, 22.0)):
        coarse = rng.normal(size=(height // grain + 3, width // grain + 3, 3)).astype(np.float32)
        drawn += strength * cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    return np.clip(drawn, 0, 255).astype(np.uint8)


def scene(kind: str, seed: int, count: int = 120) -> Sequence:
    """Return a drawn sequence of ``count`` images, reproducibly.

    Args:
        kind: ``plain``: it moves and changes size; ``light``: the light changes, too; ``hidden``: a pillar hides it
          a fifth of the time; ``leaves``: it leaves the image and comes back; ``look-alike``: an object of the same
          colours crosses its path, and stays in view while a pillar hides the target.
        seed: Seed of all randomness.
        count: Number of images.
    """
    return Sequence(f"{kind} {seed}", lambda: _drawn(kind, seed, count))


def _drawn(kind: str, seed: int, count: int) -> Iterator[Step]:
    rng = np.random.default_rng([seed, *kind.encode()])
    width, height = SIZE
    background = texture(rng, width + 2 * _MARGIN, height + 2 * _MARGIN)
    colour = rng.uniform(60, 200, 3)
    target = texture(rng, 56, 76, colour)
    other = texture(rng, 56, 76, colour)
    pillar = texture(rng, 150, height, rng.uniform(60, 200, 3))
    noise = rng.normal(0, 5, (height + _NOISE, width + _NOISE, 3)).round().astype(np.int16)
    phases = rng.uniform(0, 2 * math.pi, 6)
    for n in range(count):
        share = n / count
        pan = 60 * np.sin(2 * math.pi * share + phases[:2]) - 60 * np.sin(phases[:2])
        left, top = (_MARGIN + pan).astype(int)
        image = background[top : top + height, left : left + width].copy()
        scale = 1.0 + 0.35 * math.sin(2 * math.pi * share + phases[2]) - 0.35 * math.sin(phases[2])
        scale = min(max(scale, 0.6), 1.8)
        x = width / 2 - 130 + 170 * math.sin(2 * math.pi * share) + (420 * _bump(share) if kind == "leaves" else 0)
        y = height / 2 - 60 + 70 * (math.sin(4 * math.pi * share + phases[3]) - math.sin(phases[3]))
        x = x + 700 * _bump(share) if kind == "leaves" else x
        box = (x, y, 56 * scale, 76 * scale)
        if kind == "look-alike":
            across = width - 90 - (width - 60) * share
            _paste(image, other, (across, y + 25 + 60 * math.cos(6 * share), 56 * scale, 76 * scale))
        _paste(image, target, box)
        covered = 0.0
        if kind in ("hidden", "look-alike") and 0.45 <= share < 0.65:
            at = int(x + 28 * scale - 75)
            _paste(image, pillar, (at, 0, 150, height))
            covered = 1.0
        if kind == "light":
            gain = 1.0 + 0.45 * math.sin(4 * math.pi * share)
            image = np.asarray(cv2.convertScaleAbs(image, alpha=gain, beta=20 * math.sin(7 * share)), np.uint8)
        right, down = rng.integers(0, _NOISE, 2).tolist()  # another part of the noise for each image
        part = noise[down : down + height, right : right + width]
        image = np.asarray(cv2.add(image, part, dtype=cv2.CV_8U), np.uint8)
        inside = max(0.0, min(x + box[2], width) - max(x, 0)) / box[2]
        yield image, None if covered or inside < 0.3 else box, True


def _bump(share: float) -> float:
    """Return 0, 1 in the middle, and 0 again, smoothly."""
    return math.sin(math.pi * min(max((share - 0.3) / 0.5, 0.0), 1.0)) ** 2


def _paste(image: Image, what: Image, box: Box) -> None:
    """Draw a patch over a box of an image, with subpixel accuracy."""
    x, y, width, height = box
    across, down = width / what.shape[1], height / what.shape[0]
    turn = np.array([[across, 0, x + across / 2 - 0.5], [0, down, y + down / 2 - 0.5]])
    size = (image.shape[1], image.shape[0])
    cv2.warpAffine(what, turn, size, dst=image, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_TRANSPARENT)


def fixed(name: str, film: NDArray[np.uint8], labels: dict[int, Box]) -> Sequence:
    """Return a film unchanged; only labelled frames count."""
    return Sequence(name, lambda: ((image, labels.get(n), n in labels) for n, image in enumerate(film)))


def moved(name: str, film: NDArray[np.uint8], labels: dict[int, Box], count: int, seed: int) -> Sequence:
    """Return a film as seen by a camera that pans and zooms over it; beyond it, its edge pixels are repeated.

    Args:
        name: Name of the target.
        film: Its frames, (n, h, w, 3).
        labels: The target's box in some of them, by number; frames in between use the nearest one.
        count: Number of images.
        seed: Seed of the motion.
    """
    return Sequence(f"{name}, moved", lambda: _moved(film, labels, count, seed))


def _moved(film: NDArray[np.uint8], labels: dict[int, Box], count: int, seed: int) -> Iterator[Step]:
    phases = np.random.default_rng(seed).uniform(0, 2 * math.pi, 3)
    rows, columns = film.shape[1:3]
    x, y, width, height = labels[0]
    aim = np.array([x + width / 2, y + height / 2])
    for n in range(count):
        share = n / count
        zoom = 1.0 + 0.35 * math.sin(2 * math.pi * share)
        sway = np.array([90.0, 60.0]) * np.sin(2 * math.pi * np.array([2, 3]) * share + phases[:2])
        shift = np.array([columns, rows]) / 2 + sway - zoom * aim
        turn: Any = np.array([[zoom, 0, shift[0]], [0, zoom, shift[1]]])
        image = cv2.warpAffine(film[n], turn, (columns, rows), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        x, y, width, height = labels[min(labels, key=lambda known: abs(known - n))]
        left, top = (zoom * np.array([x, y]) + shift).tolist()
        yield np.asarray(image, np.uint8), (left, top, zoom * width, zoom * height), True
