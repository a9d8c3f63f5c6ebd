"""Procedurally drawn surfaces for worlds: every name in :data:`skyloop.sim.world.TEXTURES`.

Materials (parquet, brick …) keep their scale at any size of the surface; objects (crate, door, window, posters) fill it
once. All are reproducible: the same size and seed give the same pixels.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import UnknownNameError
from skyloop.sim.render.base import cv2
from skyloop.sim.render.pictures import PICTURES, clouds, finished, fractal, grain, tinted
from skyloop.sim.render.quads import AtlasBuilder, Texture

Picture = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Sheet:
    """A surface to draw on, with its size in pixels, pixels per metre and its own random generator."""

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
        """Number of pixels for a length, at least 1."""
        return max(1, round(metres * self.per_m))


def draw_surface(name: str, width_m: float, height_m: float, per_m: float, seed: int = 0) -> NDArray[np.uint8]:
    """Draw a surface of a size in metres at a number of texels per metre, BGR, as seen upright."""
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


def _rows(sheet: Sheet, length_m: float, course_m: float, shift: float) -> tuple[NDArray[np.intp], Picture, Picture]:
    """Lay planks or bricks in courses: return each pixel's piece, and its position (0 … 1) along and across it."""
    course = sheet.y_m / course_m
    course_number = np.floor(course).astype(np.intp)
    along = sheet.x_m / length_m + (course_number * shift).astype(np.float32)
    piece = np.floor(along).astype(np.intp)
    return piece + 977 * course_number, along - piece, np.broadcast_to(course - course_number, along.shape)


def _per_piece(piece: NDArray[np.intp], salt: int) -> Picture:
    """Return a number within ±1 for each pixel that is constant over each piece."""
    values = np.random.default_rng([salt, 7]).random(1009, dtype=np.float32) * np.float32(2.0) - np.float32(1.0)
    return np.asarray(values[piece % 1009])


def _joints(sheet: Sheet, along: Picture, across: Picture, length_m: float, course_m: float, gap_m: float) -> Picture:
    """Return 1 in the joints between pieces and 0 elsewhere, with soft edges."""
    gap_m = max(gap_m, 0.8 / sheet.per_m)
    distance = np.minimum(np.minimum(along, 1 - along) * length_m, np.minimum(across, 1 - across) * course_m)
    return np.asarray(np.clip(1.5 - distance * np.float32(2.0 / gap_m), 0.0, 1.0), dtype=np.float32)


def _parquet(s: Sheet) -> Picture:
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


def _wood(s: Sheet) -> Picture:
    fibre = clouds(s.rng, s.height, s.width, s.px(0.6), s.px(0.02)) + 0.6 * clouds(
        s.rng, s.height, s.width, s.px(0.2), max(1.6, s.px(0.006))
    )
    wave = np.sin(40.0 * s.y_m + 2.2 * clouds(s.rng, s.height, s.width, s.px(0.5), s.px(0.12)))
    return tinted((66, 106, 150), 1.0 + 0.08 * fibre + 0.05 * wave, s.height, s.width)


def _brick(s: Sheet) -> Picture:
    piece, along, across = _rows(s, 0.25, 0.083, 0.5)
    joints = _joints(s, along, across, 0.25, 0.083, 0.012)[..., None]
    rough = 0.08 * fractal(s.rng, s.height, s.width, s.px(0.05), 3) + 0.05 * grain(s.rng, s.height, s.width)
    bricks = tinted((62, 78, 150), 1.0 + 0.18 * _per_piece(piece, 4) + rough, s.height, s.width)
    mortar = tinted((150, 160, 168), 1.0 + rough, s.height, s.width)
    return np.asarray(bricks * (1.0 - joints) + mortar * joints, dtype=np.float32)


def _tiles(s: Sheet) -> Picture:
    piece, along, across = _rows(s, 0.40, 0.40, 0.0)
    vein = np.abs(fractal(s.rng, s.height, s.width, s.px(0.3)))
    light = 1.0 + 0.05 * _per_piece(piece, 5) - 0.10 * np.clip(0.12 - vein, 0.0, 0.12) / 0.12
    light += 0.012 * grain(s.rng, s.height, s.width)
    light *= 1.0 - 0.40 * _joints(s, along, across, 0.40, 0.40, 0.006)
    return tinted((188, 198, 204), light, s.height, s.width)


def _plaster(s: Sheet) -> Picture:
    light = 1.0 + 0.022 * fractal(s.rng, s.height, s.width, s.px(0.8)) + 0.016 * grain(s.rng, s.height, s.width)
    light += 0.014 * clouds(s.rng, s.height, s.width, max(2.0, s.px(0.03)))
    return tinted((198, 214, 220), light, s.height, s.width)


def _concrete(s: Sheet) -> Picture:
    _, along, across = _rows(s, 2.4, 1.2, 0.0)
    light = 1.0 + 0.10 * fractal(s.rng, s.height, s.width, s.px(0.9), 5) + 0.035 * grain(s.rng, s.height, s.width)
    light *= 1.0 - 0.28 * _joints(s, along, across, 2.4, 1.2, 0.010)
    hole = (np.minimum(np.abs(along - 0.2), np.abs(along - 0.8)) * 2.4) ** 2 + (np.abs(across - 0.5) * 1.2) ** 2
    light *= 1.0 - 0.45 * np.clip(2.0 - hole / np.float32(0.022**2), 0.0, 1.0)
    return tinted((148, 154, 156), light, s.height, s.width)


def _asphalt(s: Sheet) -> Picture:
    light = 1.0 + 0.14 * fractal(s.rng, s.height, s.width, s.px(1.5), 4) + 0.20 * grain(s.rng, s.height, s.width)
    light += 0.25 * np.clip(clouds(s.rng, s.height, s.width, max(1.6, s.px(0.015))) - 0.5, 0.0, 1.0)
    return tinted((78, 76, 74), light, s.height, s.width)


def _carpet(s: Sheet) -> Picture:
    piece, along, across = _rows(s, 0.5, 0.5, 0.0)
    pile = 0.10 * grain(s.rng, s.height, s.width) + 0.07 * clouds(s.rng, s.height, s.width, max(1.6, s.px(0.02)))
    stripe = np.where((piece % 977 + piece // 977) % 2 == 0, np.sin(along * 75.0), np.sin(across * 75.0))
    light = 1.0 + 0.09 * _per_piece(piece, 6) + pile + 0.04 * stripe
    return tinted((116, 94, 78), light, s.height, s.width)


def _fabric(s: Sheet) -> Picture:
    weave = 0.06 * np.sin(s.x_m * 420.0) * np.sin(s.y_m * 420.0)
    broad = np.where(np.mod(s.x_m, 0.24) < 0.035, -0.16, 0.0)
    light = 1.0 + weave + broad + 0.05 * clouds(s.rng, s.height, s.width, s.px(0.15))
    return tinted((104, 92, 64), light + 0.04 * grain(s.rng, s.height, s.width), s.height, s.width)


def _grass(s: Sheet) -> Picture:
    patches = fractal(s.rng, s.height, s.width, s.px(2.0), 5)
    blades = clouds(s.rng, s.height, s.width, 1.6, 3.2) + 0.6 * grain(s.rng, s.height, s.width)
    picture = tinted((52, 122, 84), 1.0 + 0.20 * patches + 0.16 * blades, s.height, s.width)
    picture[..., 2] += 22.0 * clouds(s.rng, s.height, s.width, s.px(0.7))
    return picture


def _metal(s: Sheet) -> Picture:
    piece, along, across = _rows(s, 1.0, 1.0, 0.0)
    brushed = 0.035 * clouds(s.rng, s.height, s.width, s.px(0.5), 1.6)
    light = 1.0 + 0.05 * _per_piece(piece, 8) + brushed + 0.05 * fractal(s.rng, s.height, s.width, s.px(1.0), 2)
    light *= 1.0 - 0.30 * _joints(s, along, across, 1.0, 1.0, 0.012)
    rivet = (np.minimum(along, 1 - along) - 0.06) ** 2 + (np.minimum(across, 1 - across) - 0.06) ** 2
    light *= 1.0 - 0.30 * np.clip(2.0 - rivet / np.float32(0.014**2), 0.0, 1.0)
    return tinted((172, 168, 162), light, s.height, s.width)


def _checker(s: Sheet) -> Picture:
    odd = (np.floor(s.x_m / 0.25) + np.floor(s.y_m / 0.25)) % 2
    light = np.where(odd > 0, 1.0, 0.22) + 0.015 * grain(s.rng, s.height, s.width)
    return tinted((225, 228, 230), light.astype(np.float32), s.height, s.width)


def _books(s: Sheet) -> Picture:
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


def _book(s: Sheet, picture: Picture, x: int, bottom: int, room: int) -> int:
    """Draw the spine of a book that stands at a column, and return the column after it."""
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


_SURFACES: dict[str, Callable[[Sheet], Picture]] = {
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
