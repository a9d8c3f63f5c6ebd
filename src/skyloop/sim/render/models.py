"""The shapes of quadrotors, marker boards with their stands, platforms and marker cards, each in its own axes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import UnknownNameError, UsageError
from skyloop.sim.render import figures
from skyloop.sim.render.base import cv2
from skyloop.sim.render.pictures import finished, tinted
from skyloop.sim.render.quads import AtlasBuilder, QuadBuilder, Quads
from skyloop.sim.render.textures import draw_surface, paint
from skyloop.sim.world import MARKER_DICTIONARIES, BoardTarget, FigureTarget, MarkerPattern, PlatformTarget, Rgb, Target

# Hull colours of successive drones.
HULLS: tuple[Rgb, ...] = (
    (235, 96, 24),
    (34, 132, 214),
    (238, 196, 40),
    (64, 168, 84),
    (196, 60, 160),
    (60, 190, 190),
    (226, 226, 226),
    (150, 96, 220),
)
DRONE_RADIUS_M = 0.26  #: distance from the centre to the outermost point of a rotor
_ARM_M = 0.16
_ROTOR_M = 0.10
_FEET_M = 0.06  # distance of the feet below the body's origin
_DARK: Rgb = (46, 48, 52)
_POLE_M = 12.0  # length of the stand's pole, which goes through the floor and is hidden below it


def card(builder: QuadBuilder, atlas: AtlasBuilder, pattern: MarkerPattern, priority: int) -> None:
    """Add a marker's card around the origin, in face axes: x right, y up, z along its normal."""
    drawn = draw_card(pattern)
    half = pattern.card_size_m / 2
    texture = atlas.add(("card", pattern), lambda: drawn.image)
    edge = pattern.card_size_m
    builder.rectangle((-half, -half, 0), (edge, 0, 0), (0, edge, 0), texture, priority=priority, uv=drawn.uv)


def drone(atlas: AtlasBuilder, hull: Rgb) -> Quads:
    """Return a quadrotor in body axes: a hull with a nose, a crossed frame and four rotors.

    The front rotors have the hull's colour to make the heading visible.
    """
    shapes = QuadBuilder()
    colour, dark = paint(atlas, hull), paint(atlas, _DARK)
    shapes.box((-0.13, -0.055, -0.035), (0.07, 0.055, 0.04), colour, colour)
    shapes.box((0.07, -0.04, -0.03), (0.13, 0.04, 0.025), dark, dark)
    for side in (-0.06, 0.06):
        shapes.box((-0.09, side - 0.007, -_FEET_M), (0.08, side + 0.007, -0.02), dark)
    arms = QuadBuilder()
    for a in (math.pi / 4, 3 * math.pi / 4):
        along = np.array([math.cos(a), math.sin(a), 0.0])
        across = np.array([-math.sin(a), math.cos(a), 0.0]) * 0.009
        start, run, up = -along * _ARM_M, along * (2 * _ARM_M), np.array([0.0, 0.0, 0.018])
        arms.rectangle(start - across, run, up, dark, two_sided=True)
        arms.rectangle(start - across + up, run, 2 * across, dark, two_sided=True)
    front = atlas.add(("rotor", hull), lambda: _rotor(hull))
    rear = atlas.add(("rotor", _DARK), lambda: _rotor(_DARK))
    for quarter in range(4):
        a = math.pi / 4 + quarter * math.pi / 2
        hub = (_ARM_M * math.cos(a), _ARM_M * math.sin(a), 0.035)
        shapes.disc(hub, _ROTOR_M, front if hub[0] > 0 else rear)
    return shapes.build().joined(arms.build())


def _rotor(rgb: Rgb) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    """Draw a spinning rotor as a blur of its colour, darker at the hub and with a bright rim."""
    size = 64
    y, x = np.mgrid[0:size, 0:size].astype(np.float32) - (size - 1) / 2
    r = np.hypot(x, y) / (size / 2)
    swirl = 0.06 * np.cos(2.0 * np.arctan2(y, x) + 5.0 * r)
    picture = finished(tinted((rgb[2], rgb[1], rgb[0]), 0.62 + 0.25 * r + swirl, size, size))
    cv2.circle(picture, (size // 2, size // 2), round(size * 0.44), (232, 232, 232), 2, cv2.LINE_AA)
    cv2.circle(picture, (size // 2, size // 2), 4, (30, 30, 30), -1, cv2.LINE_AA)
    return picture


def target(atlas: AtlasBuilder, target: Target) -> Quads:
    """Return a target's shape without its stand. A figure is at rest."""
    if isinstance(target, BoardTarget):
        return board(atlas, target)
    if isinstance(target, FigureTarget):
        return figures.figure(atlas, target).standing()
    return platform(atlas, target)


def board(atlas: AtlasBuilder, target: BoardTarget) -> Quads:
    """Return a marker's card in front of a wooden board on a pole; origin is the card's centre, x its normal."""
    face = QuadBuilder()
    card(face, atlas, target.pattern, priority=2)
    # from face axes (right, up, normal) to (x ahead, y left, z up)
    turn = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    half = target.pattern.card_size_m / 2 + 0.02
    wood = atlas.add(("board", round(half, 3)), lambda: draw_surface("wood", 2 * half, 2 * half, min(256, 96 / half)))
    body = QuadBuilder()
    body.box((-0.025, -half, -half), (0.0, half, half), wood)
    metal = paint(atlas, (150, 152, 156))
    body.box((-0.05, -0.014, -half - _POLE_M), (-0.025, 0.014, 0.3 * half), metal)
    return face.build().moved(np.zeros(3), turn).joined(body.build())


def stand(atlas: AtlasBuilder) -> Quads:
    """Return the foot of a board's pole, with the origin on the floor."""
    shapes = QuadBuilder()
    dark = paint(atlas, _DARK)
    shapes.box((-0.19, -0.15, 0.0), (0.11, 0.15, 0.045), dark)
    return shapes.build()


def platform(atlas: AtlasBuilder, target: PlatformTarget) -> Quads:
    """Return a slab on a column with a marker on its top; the origin is the top's centre, with x along the heading."""
    x, y, z = (side / 2 for side in target.size_m)
    density = min(200.0, 160.0 / max(x, y))
    top = atlas.add(("slab", target.texture, x, y), lambda: draw_surface(target.texture, 2 * x, 2 * y, density))
    sides = atlas.add(("rim", target.texture, x, z), lambda: draw_surface(target.texture, 2 * x, 2 * z, density))
    body = QuadBuilder()
    body.box((-x, -y, -2 * z), (x, y, 0.0), sides, top)
    narrow = 0.35 * min(x, y)
    body.box((-narrow, -narrow, -2 * z - _POLE_M), (narrow, narrow, -2 * z), paint(atlas, _DARK))
    face = QuadBuilder()
    card(face, atlas, target.pattern, priority=2)
    # from face axes (right, up, normal) to (x ahead, y left, z up): the image's up is ahead and its right is -y
    turn = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return face.build().moved(np.zeros(3), turn).joined(body.build())


_CELL = 24  # texels per cell of the marker
_PAPER = 235


@dataclass(frozen=True, slots=True)
class Card:
    """An image of a marker."""

    image: NDArray[np.uint8]  #: the image, BGR
    #: the visible part of the image: left, top, right, bottom in fractional texels
    uv: tuple[float, float, float, float]


def draw_card(pattern: MarkerPattern) -> Card:
    """Draw a marker with its margin.

    The black square takes up ``pattern.size_m`` of the card's ``card_size_m``, accurate to a fraction of a texel.
    """
    code = getattr(cv2.aruco, pattern.dictionary, None) if pattern.dictionary.startswith("DICT_") else None
    if code is None:
        raise UnknownNameError("marker dictionary", pattern.dictionary, MARKER_DICTIONARIES)
    dictionary = cv2.aruco.getPredefinedDictionary(code)
    count = len(dictionary.bytesList)
    if not 0 <= pattern.marker_id < count:
        raise UsageError(f"{pattern.dictionary} has ids 0 to {count - 1}, so there is no marker {pattern.marker_id}")
    cells = dictionary.markerSize + 2
    black = cells * _CELL
    margin = pattern.margin_m / pattern.size_m * black
    border = int(np.ceil(margin)) + 2
    square = cv2.aruco.generateImageMarker(dictionary, pattern.marker_id, black, borderBits=1)
    ink = np.where(square > 127, _PAPER, 22).astype(np.uint8)
    image = cv2.copyMakeBorder(ink, border, border, border, border, cv2.BORDER_CONSTANT, value=_PAPER)
    start, end = border - margin, border + black + margin
    return Card(np.repeat(image[..., None], 3, axis=2).astype(np.uint8), (start, start, end, end))
