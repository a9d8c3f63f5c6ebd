"""Procedurally drawn surfaces for worlds: every name in :data:`skyloop.sim.world.TEXTURES`.

Materials (parquet, brick …) have the same scale on surfaces of any size; objects (crate, door, window, posters) fill
the surface once. All textures are reproducible: the same size and seed give the same pixels.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skyloop.errors import UnknownNameError
from skyloop.sim.render.quads import AtlasBuilder, Image, Texture, cv2

Gray = NDArray[np.float32]


def clouds(rng: np.random.Generator, height: int, width: int, cell_x: float, cell_y: float | None = None) -> Gray:
    """Return smooth noise, about ±1, shape (height, width), whose blotches measure ``cell_x`` by ``cell_y`` pixels."""
    rows = max(2, round(height / (cell_y or cell_x)) + 1)
    columns = max(2, round(width / cell_x) + 1)
    seeds = rng.standard_normal((rows, columns), dtype=np.float32) * np.float32(0.6)
    return np.asarray(cv2.resize(seeds, (width, height), interpolation=cv2.INTER_CUBIC), dtype=np.float32)


def grain(rng: np.random.Generator, height: int, width: int) -> Gray:
    """Return pixel noise, uniform within ±1, shape (height, width). The pattern repeats every 256 pixels."""
    patch = rng.random((min(height, 256), min(width, 256)), dtype=np.float32) * np.float32(2.0) - np.float32(1.0)
    return np.tile(patch, (-(-height // 256), -(-width // 256)))[:height, :width]


def fractal(rng: np.random.Generator, height: int, width: int, cell: float, octaves: int = 4) -> Gray:
    """Return clouds with finer clouds added, with values of about ±1, shape (height, width)."""
    total = np.zeros((height, width), np.float32)
    for k in range(octaves):
        if cell / 2**k >= 1.5:
            total += clouds(rng, height, width, cell / 2**k) * np.float32(0.55**k)
    return total * np.float32(0.6)


def tinted(colour: tuple[float, float, float], brightness: ArrayLike, height: int, width: int) -> NDArray[np.float32]:
    """Return a picture (height, width, 3) of a single BGR colour multiplied by a brightness of around 1."""
    light = np.broadcast_to(np.asarray(brightness, dtype=np.float32), (height, width))
    return np.asarray(cv2.merge([light * np.float32(c) for c in colour]), dtype=np.float32)


def finished(picture: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Clip the values and return the picture as bytes."""
    return np.clip(picture, 0.0, 255.0).astype(np.uint8)


Rng = np.random.Generator


def _planks(height: int, width: int, rng: Rng, planks: int, colour: tuple[float, float, float]) -> NDArray[np.float32]:
    number = np.minimum((np.arange(height) * planks // height), planks - 1)
    tone = rng.uniform(-1.0, 1.0, planks).astype(np.float32)[number][:, None]
    fibre = clouds(rng, height, width, width / 2.5, max(1.6, height / 60))
    light = 1.0 + 0.10 * tone + 0.08 * fibre + 0.02 * grain(rng, height, width)
    seam = np.abs((np.arange(height) * planks / height + 0.5) % 1.0 - 0.5) * height / planks
    return tinted(colour, light * (1.0 - 0.5 * np.clip(1.6 - seam, 0.0, 1.0))[:, None], height, width)


def _crate(height: int, width: int, rng: Rng) -> Image:
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


def _door(height: int, width: int, rng: Rng) -> Image:
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


def _sky(height: int, width: int, rng: Rng, low: tuple[int, int, int], high: tuple[int, int, int]) -> Image:
    down = np.linspace(0.0, 1.0, height, dtype=np.float32)[:, None, None]
    picture = np.array(high, np.float32) * (1.0 - down) + np.array(low, np.float32) * down
    cloud = np.clip(fractal(rng, height, width, width / 3), 0.0, 1.0)[..., None]
    return finished(picture + (245.0 - picture) * cloud * 0.8)


def _hill(picture: Image, rng: Rng, base: float, rise: float, colour: tuple[int, int, int]) -> None:
    height, width = picture.shape[:2]
    ridge = base + rise * clouds(rng, 2, width, width / 5)[0] + 0.25 * rise * clouds(rng, 2, width, width / 22)[0]
    points = np.column_stack([np.arange(width), np.clip(ridge, 0.0, 1.0) * height]).astype(np.int32)
    outline = np.vstack([[(0, height)], points, [(width, height)]]).astype(np.int32)
    cv2.fillPoly(picture, [outline], colour, cv2.LINE_AA)


def _window(height: int, width: int, rng: Rng) -> Image:
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


def _poster_landscape(height: int, width: int, rng: Rng) -> Image:
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


def _poster_chart(height: int, width: int, rng: Rng) -> Image:
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


def _poster_pattern(height: int, width: int, rng: Rng) -> Image:
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


def _framed(picture: Image, colour: tuple[int, int, int]) -> Image:
    height, width = picture.shape[:2]
    cv2.rectangle(picture, (0, 0), (width - 1, height - 1), colour, max(2, round(0.045 * min(height, width))))
    return picture


PICTURES: dict[str, Callable[[int, int, Rng], Image]] = {
    "crate": _crate,
    "door": _door,
    "poster_chart": _poster_chart,
    "poster_landscape": _poster_landscape,
    "poster_pattern": _poster_pattern,
    "window": _window,
}


Drawing = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Sheet:
    """A surface to draw on, with its size in pixels, its pixels per metre and its own random generator."""

    height: int
    width: int
    per_m: float
    rng: np.random.Generator

    @property
    def x_m(self) -> NDArray[np.float32]:
        """Distance of each column from the left [m], shape (1, width)."""
        return (np.arange(self.width, dtype=np.float32) + 0.5)[None, :] / np.float32(self.per_m)

    @property
    def y_m(self) -> NDArray[np.float32]:
        """Distance of each row from the bottom [m], shape (height, 1)."""
        return (np.arange(self.height, 0, -1, dtype=np.float32) - 0.5)[:, None] / np.float32(self.per_m)

    def px(self, metres: float) -> int:
        """Convert a length to pixels, at least 1."""
        return max(1, round(metres * self.per_m))


def draw_surface(name: str, width_m: float, height_m: float, per_m: float, seed: int = 0) -> NDArray[np.uint8]:
    """Draw a surface in BGR, as seen upright, given its size in metres and the number of texels per metre."""
    if name not in _SURFACES and name not in PICTURES:
        raise UnknownNameError("texture", name, [*_SURFACES, *PICTURES])
    height, width = max(4, round(height_m * per_m)), max(4, round(width_m * per_m))
    if name in PICTURES:
        return PICTURES[name](height, width, np.random.default_rng([zlib.crc32(name.encode()), seed]))
    sheet = Sheet(height, width, per_m, np.random.default_rng([zlib.crc32(name.encode()), seed]))
    return finished(_SURFACES[name](sheet))


def draw_paint(rgb: tuple[int, int, int], height: int = 64, width: int = 64) -> NDArray[np.uint8]:
    """Draw a painted surface, BGR: one colour with slight unevenness and a worn rim."""
    rng = np.random.default_rng(zlib.crc32(bytes(rgb)))
    light = 1.0 + 0.05 * clouds(rng, height, width, max(4, width / 6)) + 0.02 * grain(rng, height, width)
    picture = tinted((rgb[2], rgb[1], rgb[0]), light, height, width)
    edge = max(1, min(height, width) // 24)
    picture[:edge] *= 0.88
    picture[-edge:] *= 0.80
    picture[:, :edge] *= 0.86
    picture[:, -edge:] *= 0.86
    return finished(picture)


def paint(atlas: AtlasBuilder, rgb: tuple[int, int, int]) -> Texture:
    """Return a small painted surface."""
    return atlas.add(("paint", rgb), lambda: draw_paint(rgb))


def _rows(sheet: Sheet, length_m: float, course_m: float, shift: float) -> tuple[NDArray[np.intp], Drawing, Drawing]:
    """Lay planks or bricks in rows: return each pixel's piece, and its position (0 … 1) along and across that piece."""
    course = sheet.y_m / course_m
    course_number = np.floor(course).astype(np.intp)
    along = sheet.x_m / length_m + (course_number * shift).astype(np.float32)
    piece = np.floor(along).astype(np.intp)
    # The number is unique as long as a course has fewer than 977 pieces.
    return piece + 977 * course_number, along - piece, np.broadcast_to(course - course_number, along.shape)


def _per_piece(piece: NDArray[np.intp], salt: int) -> Drawing:
    """Return a number within ±1 for each pixel; all pixels of a piece have the same number."""
    values = np.random.default_rng([salt, 7]).random(1009, dtype=np.float32) * np.float32(2.0) - np.float32(1.0)
    return np.asarray(values[piece % 1009])


def _joints(sheet: Sheet, along: Drawing, across: Drawing, length_m: float, course_m: float, gap_m: float) -> Drawing:
    """Return 1 in the joints between pieces and 0 elsewhere, with soft edges."""
    gap_m = max(gap_m, 0.8 / sheet.per_m)
    distance = np.minimum(np.minimum(along, 1 - along) * length_m, np.minimum(across, 1 - across) * course_m)
    return np.asarray(np.clip(1.5 - distance * np.float32(2.0 / gap_m), 0.0, 1.0), dtype=np.float32)


def _parquet(s: Sheet) -> Drawing:
    piece, along, across = _rows(s, 0.95, 0.125, 0.37)
    tone = _per_piece(piece, 1)
    fibre = clouds(s.rng, s.height, s.width, s.px(0.35), s.px(0.012)) + 0.5 * clouds(
        s.rng, s.height, s.width, s.px(0.12), 1.6
    )
    light = 1.0 + 0.13 * tone + 0.075 * fibre + 0.02 * grain(s.rng, s.height, s.width)
    light *= 1.0 - 0.45 * _joints(s, along, across, 0.95, 0.125, 0.004)
    picture = tinted((88, 134, 178), light, s.height, s.width)
    picture[..., 0] -= 9.0 * _per_piece(piece, 2)
    picture[..., 2] += 7.0 * _per_piece(piece, 3)
    return picture


def _wood(s: Sheet) -> Drawing:
    fibre = clouds(s.rng, s.height, s.width, s.px(0.6), s.px(0.02)) + 0.6 * clouds(
        s.rng, s.height, s.width, s.px(0.2), max(1.6, s.px(0.006))
    )
    wave = np.sin(40.0 * s.y_m + 2.2 * clouds(s.rng, s.height, s.width, s.px(0.5), s.px(0.12)))
    return tinted((66, 106, 150), 1.0 + 0.08 * fibre + 0.05 * wave, s.height, s.width)


def _brick(s: Sheet) -> Drawing:
    piece, along, across = _rows(s, 0.25, 0.083, 0.5)
    joints = _joints(s, along, across, 0.25, 0.083, 0.012)[..., None]
    rough = 0.08 * fractal(s.rng, s.height, s.width, s.px(0.05), 3) + 0.05 * grain(s.rng, s.height, s.width)
    bricks = tinted((62, 78, 150), 1.0 + 0.18 * _per_piece(piece, 4) + rough, s.height, s.width)
    mortar = tinted((150, 160, 168), 1.0 + rough, s.height, s.width)
    return np.asarray(bricks * (1.0 - joints) + mortar * joints, dtype=np.float32)


def _tiles(s: Sheet) -> Drawing:
    piece, along, across = _rows(s, 0.40, 0.40, 0.0)
    vein = np.abs(fractal(s.rng, s.height, s.width, s.px(0.3)))
    light = 1.0 + 0.05 * _per_piece(piece, 5) - 0.10 * np.clip(0.12 - vein, 0.0, 0.12) / 0.12
    light += 0.012 * grain(s.rng, s.height, s.width)
    light *= 1.0 - 0.40 * _joints(s, along, across, 0.40, 0.40, 0.006)
    return tinted((188, 198, 204), light, s.height, s.width)


def _plaster(s: Sheet) -> Drawing:
    light = 1.0 + 0.022 * fractal(s.rng, s.height, s.width, s.px(0.8)) + 0.016 * grain(s.rng, s.height, s.width)
    light += 0.014 * clouds(s.rng, s.height, s.width, max(2.0, s.px(0.03)))
    return tinted((198, 214, 220), light, s.height, s.width)


def _concrete(s: Sheet) -> Drawing:
    _, along, across = _rows(s, 2.4, 1.2, 0.0)
    light = 1.0 + 0.10 * fractal(s.rng, s.height, s.width, s.px(0.9), 5) + 0.035 * grain(s.rng, s.height, s.width)
    light *= 1.0 - 0.28 * _joints(s, along, across, 2.4, 1.2, 0.010)
    hole = (np.minimum(np.abs(along - 0.2), np.abs(along - 0.8)) * 2.4) ** 2 + (np.abs(across - 0.5) * 1.2) ** 2
    light *= 1.0 - 0.45 * np.clip(2.0 - hole / np.float32(0.022**2), 0.0, 1.0)
    return tinted((148, 154, 156), light, s.height, s.width)


def _asphalt(s: Sheet) -> Drawing:
    light = 1.0 + 0.14 * fractal(s.rng, s.height, s.width, s.px(1.5), 4) + 0.20 * grain(s.rng, s.height, s.width)
    light += 0.25 * np.clip(clouds(s.rng, s.height, s.width, max(1.6, s.px(0.015))) - 0.5, 0.0, 1.0)
    return tinted((78, 76, 74), light, s.height, s.width)


def _carpet(s: Sheet) -> Drawing:
    piece, along, across = _rows(s, 0.5, 0.5, 0.0)
    pile = 0.10 * grain(s.rng, s.height, s.width) + 0.07 * clouds(s.rng, s.height, s.width, max(1.6, s.px(0.02)))
    stripe = np.where((piece % 977 + piece // 977) % 2 == 0, np.sin(along * 75.0), np.sin(across * 75.0))
    light = 1.0 + 0.09 * _per_piece(piece, 6) + pile + 0.04 * stripe
    return tinted((116, 94, 78), light, s.height, s.width)


def _fabric(s: Sheet) -> Drawing:
    weave = 0.06 * np.sin(s.x_m * 420.0) * np.sin(s.y_m * 420.0)
    broad = np.where(np.mod(s.x_m, 0.24) < 0.035, -0.16, 0.0)
    light = 1.0 + weave + broad + 0.05 * clouds(s.rng, s.height, s.width, s.px(0.15))
    return tinted((104, 92, 64), light + 0.04 * grain(s.rng, s.height, s.width), s.height, s.width)


def _grass(s: Sheet) -> Drawing:
    patches = fractal(s.rng, s.height, s.width, s.px(2.0), 5)
    blades = clouds(s.rng, s.height, s.width, 1.6, 3.2) + 0.6 * grain(s.rng, s.height, s.width)
    picture = tinted((52, 122, 84), 1.0 + 0.20 * patches + 0.16 * blades, s.height, s.width)
    picture[..., 2] += 22.0 * clouds(s.rng, s.height, s.width, s.px(0.7))
    return picture


def _metal(s: Sheet) -> Drawing:
    piece, along, across = _rows(s, 1.0, 1.0, 0.0)
    brushed = 0.035 * clouds(s.rng, s.height, s.width, s.px(0.5), 1.6)
    light = 1.0 + 0.05 * _per_piece(piece, 8) + brushed + 0.05 * fractal(s.rng, s.height, s.width, s.px(1.0), 2)
    light *= 1.0 - 0.30 * _joints(s, along, across, 1.0, 1.0, 0.012)
    rivet = (np.minimum(along, 1 - along) - 0.06) ** 2 + (np.minimum(across, 1 - across) - 0.06) ** 2
    light *= 1.0 - 0.30 * np.clip(2.0 - rivet / np.float32(0.014**2), 0.0, 1.0)
    return tinted((172, 168, 162), light, s.height, s.width)


def _checker(s: Sheet) -> Drawing:
    odd = (np.floor(s.x_m / 0.25) + np.floor(s.y_m / 0.25)) % 2
    light = np.where(odd > 0, 1.0, 0.22) + 0.015 * grain(s.rng, s.height, s.width)
    return tinted((225, 228, 230), light.astype(np.float32), s.height, s.width)


def _books(s: Sheet) -> Drawing:
    picture = tinted((50, 76, 104), 0.55 + 0.04 * clouds(s.rng, s.height, s.width, s.px(0.3), 2), s.height, s.width)
    shelves = max(1, round(s.height / s.per_m / 0.34))
    board = s.px(0.025)
    for shelf in range(shelves):
        bottom = s.height - round(shelf * s.height / shelves)
        room = round(s.height / shelves) - board
        picture[bottom - board : bottom] = (72, 112, 152)
        x = board
        while x < s.width - board:
            x = _book(s, picture, x, bottom - board, room)
    picture[:, :board] = picture[:, s.width - board :] = (66, 104, 142)
    return picture


def _book(s: Sheet, picture: Drawing, x: int, bottom: int, room: int) -> int:
    """Draw the spine of a book that stands at a given column, and return the next free column."""
    wide = max(2, s.px(s.rng.uniform(0.018, 0.055)))
    end = min(x + wide, s.width)
    if s.rng.random() < 0.08:  # a gap
        return end + wide
    top = bottom - int(room * s.rng.uniform(0.62, 0.92))
    hue = np.array([[[s.rng.integers(0, 180), s.rng.integers(60, 190), s.rng.integers(70, 215)]]], dtype=np.uint8)
    colour = cv2.cvtColor(hue, cv2.COLOR_HSV2BGR)[0, 0].astype(np.float32)
    picture[top:bottom, x:end] = colour
    picture[top:bottom, end - 1 : end] = colour * 0.5
    band = top + (bottom - top) // 5
    picture[band : band + max(1, s.px(0.03)), x : end - 1] = colour * 0.4 + 120.0
    return end


_SURFACES: dict[str, Callable[[Sheet], Drawing]] = {
    "asphalt": _asphalt,
    "books": _books,
    "brick": _brick,
    "carpet": _carpet,
    "checker": _checker,
    "concrete": _concrete,
    "fabric": _fabric,
    "grass": _grass,
    "metal": _metal,
    "parquet": _parquet,
    "plaster": _plaster,
    "tiles": _tiles,
    "wood": _wood,
}
