"""Surfaces that show one picture from edge to edge (crate, door, window, posters), and noise to make them irregular.

Each is drawn as BGR at a size in pixels with a given random generator.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skyloop.sim.render.base import cv2

Gray = NDArray[np.float32]


def clouds(rng: np.random.Generator, height: int, width: int, cell_x: float, cell_y: float | None = None) -> Gray:
    """Return smooth noise, about ±1, shape (height, width), whose blotches measure ``cell_x`` by ``cell_y`` pixels."""
    rows = max(2, round(height / (cell_y or cell_x)) + 1)
    columns = max(2, round(width / cell_x) + 1)
    seeds = rng.standard_normal((rows, columns), dtype=np.float32) * np.float32(0.6)
    return np.asarray(cv2.resize(seeds, (width, height), interpolation=cv2.INTER_CUBIC), dtype=np.float32)


def grain(rng: np.random.Generator, height: int, width: int) -> Gray:
    """Return pixel noise, uniform within ±1, shape (height, width). It repeats every 256 pixels."""
    patch = rng.random((min(height, 256), min(width, 256)), dtype=np.float32) * np.float32(2.0) - np.float32(1.0)
    return np.tile(patch, (-(-height // 256), -(-width // 256)))[:height, :width]


def fractal(rng: np.random.Generator, height: int, width: int, cell: float, octaves: int = 4) -> Gray:
    """Return clouds with finer clouds added, about ±1, shape (height, width)."""
    total = np.zeros((height, width), np.float32)
    for k in range(octaves):
        if cell / 2**k >= 1.5:
            total += clouds(rng, height, width, cell / 2**k) * np.float32(0.55**k)
    return total * np.float32(0.6)


def tinted(colour: tuple[float, float, float], brightness: ArrayLike, height: int, width: int) -> NDArray[np.float32]:
    """Return a picture (height, width, 3) of one BGR colour multiplied by a brightness around 1."""
    light = np.broadcast_to(np.asarray(brightness, dtype=np.float32), (height, width))
    return np.asarray(cv2.merge([light * np.float32(c) for c in colour]), dtype=np.float32)


def finished(picture: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return the picture as bytes after clipping the values."""
    return np.clip(picture, 0.0, 255.0).astype(np.uint8)


Rng = np.random.Generator
Picture = NDArray[np.uint8]


def _planks(height: int, width: int, rng: Rng, planks: int, colour: tuple[float, float, float]) -> NDArray[np.float32]:
    number = np.minimum((np.arange(height) * planks // height), planks - 1)
    tone = rng.uniform(-1.0, 1.0, planks).astype(np.float32)[number][:, None]
    fibre = clouds(rng, height, width, width / 2.5, max(1.6, height / 60))
    light = 1.0 + 0.10 * tone + 0.08 * fibre + 0.02 * grain(rng, height, width)
    seam = np.abs((np.arange(height) * planks / height + 0.5) % 1.0 - 0.5) * height / planks
    return tinted(colour, light * (1.0 - 0.5 * np.clip(1.6 - seam, 0.0, 1.0))[:, None], height, width)


def _crate(height: int, width: int, rng: Rng) -> Picture:
    picture = _planks(height, width, rng, 6, (76, 124, 172)) * 0.82
    rim = max(3, round(0.11 * min(height, width)))
    brace = np.zeros((height, width), np.uint8)
    cv2.line(brace, (rim, height - rim), (width - rim, rim), 255, round(rim * 0.9), cv2.LINE_AA)
    frame = np.full((height, width), 255, np.uint8)
    frame[rim : height - rim, rim : width - rim] = 0
    for mask, wood in (
        (brace, tinted((84, 136, 186), 1.0 + 0.06 * fractal(rng, height, width, width / 6), height, width)),
        (frame, _planks(height, width, rng, 1, (88, 142, 194))),
    ):
        shade = cv2.GaussianBlur(mask, (0, 0), rim / 4).astype(np.float32)[..., None] / 255.0
        solid = mask.astype(np.float32)[..., None] / 255.0
        picture = picture * (1.0 - 0.45 * shade) * (1.0 - solid) + wood * solid
    result = finished(picture)
    nail = max(1, rim // 8)
    for y in (rim // 2, height - rim // 2):
        for x in (rim // 2, width // 2, width - rim // 2):
            cv2.circle(result, (x, y), nail, (60, 66, 72), -1, cv2.LINE_AA)
    return result


def _door(height: int, width: int, rng: Rng) -> Picture:
    light = 1.0 + 0.05 * clouds(rng, height, width, max(2.0, width / 40), height / 2)
    picture = finished(tinted((96, 122, 140), light + 0.015 * grain(rng, height, width), height, width))
    edge = max(2, width // 16)
    cv2.rectangle(picture, (0, 0), (width - 1, height - 1), (206, 214, 218), 2 * edge)
    for top, bottom in ((0.12, 0.46), (0.54, 0.92)):
        low, high = (round(0.22 * width), round(top * height)), (round(0.78 * width), round(bottom * height))
        cv2.rectangle(picture, low, high, (70, 92, 108), max(1, edge // 2), cv2.LINE_AA)
        cv2.rectangle(picture, (low[0] + edge // 2, low[1] + edge // 2), high, (126, 150, 166), 1, cv2.LINE_AA)
    cv2.circle(picture, (round(0.85 * width), height // 2), max(2, edge // 2), (120, 190, 205), -1, cv2.LINE_AA)
    return picture


def _sky(height: int, width: int, rng: Rng, low: tuple[int, int, int], high: tuple[int, int, int]) -> Picture:
    down = np.linspace(0.0, 1.0, height, dtype=np.float32)[:, None, None]
    picture = np.array(high, np.float32) * (1.0 - down) + np.array(low, np.float32) * down
    cloud = np.clip(fractal(rng, height, width, width / 3), 0.0, 1.0)[..., None]
    return finished(picture + (245.0 - picture) * cloud * 0.8)


def _hill(picture: Picture, rng: Rng, base: float, rise: float, colour: tuple[int, int, int]) -> None:
    height, width = picture.shape[:2]
    ridge = base + rise * clouds(rng, 2, width, width / 5)[0] + 0.25 * rise * clouds(rng, 2, width, width / 22)[0]
    points = np.column_stack([np.arange(width), np.clip(ridge, 0.0, 1.0) * height]).astype(np.int32)
    outline = np.vstack([[(0, height)], points, [(width, height)]]).astype(np.int32)
    cv2.fillPoly(picture, [outline], colour, cv2.LINE_AA)


def _window(height: int, width: int, rng: Rng) -> Picture:
    picture = _sky(height, width, rng, (238, 228, 212), (226, 178, 128))
    _hill(picture, rng, 0.70, 0.05, (150, 158, 128))
    _hill(picture, rng, 0.80, 0.06, (84, 128, 92))
    picture = finished(picture * 1.08)
    bar = max(2, round(0.05 * min(height, width)))
    light, dark = (232, 236, 238), (168, 174, 178)
    cv2.rectangle(picture, (0, 0), (width - 1, height - 1), light, 2 * bar)
    cv2.rectangle(picture, (bar, bar), (width - bar, height - bar), dark, 1)
    for a, b in (((width // 2, 0), (width // 2, height)), ((0, height // 2), (width, height // 2))):
        cv2.line(picture, a, b, dark, bar + 2)
        cv2.line(picture, a, b, light, bar)
    return picture


def _poster_landscape(height: int, width: int, rng: Rng) -> Picture:
    picture = _sky(height, width, rng, (150, 196, 250), (176, 104, 70))
    cv2.circle(picture, (round(0.70 * width), round(0.40 * height)), round(0.09 * height), (190, 236, 255), -1, 16)
    for base, rise, colour in (
        (0.50, 0.10, (146, 112, 104)),
        (0.62, 0.09, (112, 82, 66)),
        (0.74, 0.06, (74, 82, 46)),
        (0.86, 0.04, (42, 56, 30)),
    ):
        _hill(picture, rng, base, rise, colour)
    return _framed(picture, (40, 44, 48))


def _poster_chart(height: int, width: int, rng: Rng) -> Picture:
    picture = np.full((height, width, 3), 246, np.uint8)
    left, right = round(0.12 * width), round(0.92 * width)
    top, bottom = round(0.26 * height), round(0.86 * height)
    cv2.rectangle(picture, (left, round(0.08 * height)), (round(0.66 * width), round(0.15 * height)), (70, 60, 52), -1)
    for k in range(6):
        y = bottom - k * (bottom - top) // 5
        cv2.line(picture, (left, y), (right, y), (205, 208, 210), 1)
    colours = ((180, 120, 40), (60, 150, 235), (90, 170, 80))
    bars = 9
    for k in range(bars):
        x = left + (2 * k + 1) * (right - left) // (2 * bars + 1)
        tall = round((bottom - top) * rng.uniform(0.15, 0.85))
        cv2.rectangle(picture, (x, bottom - tall), (x + (right - left) // (2 * bars + 1), bottom), colours[k % 3], -1)
    curve = np.cumsum(rng.normal(0.0, 1.0, 24))
    curve = (curve - curve.min()) / (np.ptp(curve) + 1e-9)
    points = np.column_stack([np.linspace(left, right, 24), bottom - curve * (bottom - top)]).astype(np.int32)
    cv2.polylines(picture, [points], False, (70, 50, 200), max(2, height // 90), cv2.LINE_AA)
    cv2.line(picture, (left, bottom), (right, bottom), (60, 56, 52), max(1, height // 160))
    cv2.line(picture, (left, top), (left, bottom), (60, 56, 52), max(1, height // 160))
    return _framed(picture, (58, 62, 66))


def _poster_pattern(height: int, width: int, rng: Rng) -> Picture:
    picture = np.full((height, width, 3), (208, 222, 230), np.uint8)
    palette = ((58, 70, 208), (196, 132, 40), (52, 168, 242), (96, 156, 74), (128, 70, 122), (48, 44, 42))
    cells = max(3, round(8 * width / max(width, height))), max(3, round(8 * height / max(width, height)))
    step = width / cells[0], height / cells[1]
    for row in range(cells[1]):
        for column in range(cells[0]):
            x, y = column * step[0], row * step[1]
            square = np.array([[x, y], [x + step[0], y], [x + step[0], y + step[1]], [x, y + step[1]]])
            cv2.fillConvexPoly(picture, square.astype(np.int32), palette[int(rng.integers(6))])
            if rng.random() < 0.5:
                half = np.roll(square, int(rng.integers(4)), axis=0)[:3]
                cv2.fillConvexPoly(picture, half.astype(np.int32), palette[int(rng.integers(6))], cv2.LINE_AA)
            else:
                middle = (round(x + step[0] / 2), round(y + step[1] / 2))
                cv2.circle(picture, middle, round(min(step) * 0.32), palette[int(rng.integers(6))], -1, cv2.LINE_AA)
    return _framed(picture, (44, 46, 50))


def _framed(picture: Picture, colour: tuple[int, int, int]) -> Picture:
    height, width = picture.shape[:2]
    cv2.rectangle(picture, (0, 0), (width - 1, height - 1), colour, max(2, round(0.045 * min(height, width))))
    return picture


PICTURES: dict[str, Callable[[int, int, Rng], Picture]] = {
    "crate": _crate,
    "door": _door,
    "poster_chart": _poster_chart,
    "poster_landscape": _poster_landscape,
    "poster_pattern": _poster_pattern,
    "window": _window,
}
