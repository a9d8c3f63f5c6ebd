"""Shapes in their own axes: dummies of people and cars, quadrotors, marker boards with their stands, platforms, cards.

Dummies are made of textured boxes, with their origin on the ground, x forward, y left and z up.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skyloop.errors import UnknownNameError, UsageError
from skyloop.sim.render.quads import (
    AtlasBuilder,
    Floats,
    Image,
    QuadBuilder,
    Quads,
    Texture,
    concatenate,
    cv2,
    moved_each,
)
from skyloop.sim.render.shading import Shadow
from skyloop.sim.render.textures import draw_paint, draw_surface, finished, paint, tinted
from skyloop.sim.world import (
    FIGURE_SIZES_M,
    MARKER_DICTIONARIES,
    BoardTarget,
    FigureTarget,
    MarkerPattern,
    PlatformTarget,
    Rgb,
    Target,
    Vec3,
)

_STRIDE_M = 1.5  #: distance covered by two steps
_SWING_RAD = 0.52  # swing of a leg to either side
_TOPS: tuple[Rgb, ...] = (
    (200, 40, 44),
    (36, 92, 190),
    (236, 190, 40),
    (48, 150, 80),
    (228, 228, 224),
    (232, 120, 30),
    (120, 62, 160),
    (40, 44, 52),
    (226, 130, 170),
    (60, 180, 190),
)
_TROUSERS: tuple[Rgb, ...] = ((38, 44, 70), (90, 78, 60), (40, 40, 44), (120, 120, 124), (70, 90, 130), (60, 74, 52))
_HAIR: tuple[Rgb, ...] = ((40, 30, 24), (110, 70, 36), (196, 160, 90), (150, 150, 150), (20, 20, 22))
_SKIN: tuple[Rgb, ...] = ((236, 188, 150), (198, 140, 100), (140, 92, 62), (250, 208, 176))
_CARS: tuple[Rgb, ...] = (
    (176, 28, 34),
    (30, 80, 170),
    (214, 214, 216),
    (40, 44, 50),
    (230, 180, 30),
    (36, 120, 80),
    (120, 126, 134),
)
_GLASS: Rgb = (44, 58, 70)
_TYRE: Rgb = (34, 34, 36)


@dataclass(frozen=True, slots=True, eq=False)
class Figure:
    """A figure's parts: the rigid body, and limbs that swing about their upper ends."""

    body: Quads
    #: one group of quads per joint, all of the same size and with the joint at their origin; None if there are no limbs
    limbs: Quads | None
    joints: Floats  #: positions of the joints, (limbs, 3)
    swings: Floats  #: forward swing of each limb in the middle of a step [rad], (limbs,)
    spots: tuple[Vec3, ...]  #: circles that make up the shadow: x, y, radius [m]

    def posed(self, position_m: Floats, rotation: Floats, walked_m: float) -> Quads:
        """Return the figure at a position after it has walked a distance [m]; its limbs swing only while it walks."""
        body = self.body.moved(position_m, rotation)
        if self.limbs is None:
            return body
        angles = self.swings * math.sin(2.0 * math.pi * walked_m / _STRIDE_M)
        turns = np.zeros((len(angles), 3, 3))
        turns[:, 0, 0] = turns[:, 2, 2] = np.cos(angles)
        turns[:, 0, 2], turns[:, 2, 0] = -np.sin(angles), np.sin(angles)
        turns[:, 1, 1] = 1.0
        limbs = moved_each(self.limbs, self.joints @ rotation.T + position_m, rotation @ turns)
        return body.joined(limbs)

    def standing(self) -> Quads:
        """Return the figure at the origin, at rest."""
        return self.posed(np.zeros(3), np.eye(3), 0.0)

    def shadows(self, position_m: Floats, rotation: Floats) -> list[Shadow]:
        """Return the figure's soft shadow on the ground below it."""
        return [Shadow(position_m + rotation @ (x, y, 0.0), radius, 0.5) for x, y, radius in self.spots]


def figure(atlas: AtlasBuilder, target: FigureTarget) -> Figure:
    """Return the parts of a figure."""
    return _car(atlas, target) if target.shape == "car" else _person(atlas, target)


def _person(atlas: AtlasBuilder, target: FigureTarget) -> Figure:
    rng = np.random.default_rng([target.look, 1])
    top = _pick(rng, _TOPS) if target.colour is None else target.colour
    trousers, hair, skin = _pick(rng, _TROUSERS), _pick(rng, _HAIR), _pick(rng, _SKIN)
    pattern = int(rng.integers(0, 4))
    second = _pick(rng, tuple(c for c in _TOPS if c != top))
    cloth = atlas.add(("cloth", top, second, pattern), lambda: _cloth(top, second, pattern))
    face = atlas.add(("face", skin, hair), lambda: _face(skin, hair))
    hairy, bare, legs, shoe = paint(atlas, hair), paint(atlas, skin), paint(atlas, trousers), paint(atlas, (30, 28, 28))
    scale = np.asarray(target.size_m) / FIGURE_SIZES_M["person"]

    def box(shapes: QuadBuilder, low: ArrayLike, high: ArrayLike, sides: Texture, ends: Texture | None = None) -> None:
        shapes.box(np.asarray(low) * scale, np.asarray(high) * scale, sides, ends)

    body = QuadBuilder()
    box(body, (-0.12, -0.19, 0.92), (0.12, 0.19, 1.46), cloth, cloth)
    box(body, (-0.11, -0.17, 0.80), (0.11, 0.17, 0.92), legs)
    box(body, (-0.05, -0.055, 1.46), (0.05, 0.055, 1.53), bare)
    box(body, (-0.095, -0.085, 1.52), (0.10, 0.085, 1.72), hairy)
    low, across, up = (np.array(v) * scale for v in ((0.101, -0.085, 1.52), (0, 0.17, 0), (0, 0, 0.20)))
    body.rectangle(low, across, up, face, priority=1)
    box(body, (-0.115, -0.095, 1.69), (0.085, 0.095, 1.76), hairy)
    box(body, (-0.115, -0.09, 1.54), (-0.095, 0.09, 1.69), hairy)
    box(body, (-0.06, 0.085, 1.52), (0.10, 0.087, 1.68), bare)
    box(body, (-0.06, -0.087, 1.52), (0.10, -0.085, 1.68), bare)
    leg, arm = QuadBuilder(), QuadBuilder()
    box(leg, (-0.085, -0.075, -0.74), (0.085, 0.075, 0.06), legs)
    box(leg, (-0.09, -0.08, -0.84), (0.17, 0.08, -0.74), shoe)
    box(arm, (-0.06, -0.045, -0.48), (0.06, 0.045, 0.04), cloth)
    box(arm, (-0.05, -0.04, -0.62), (0.05, 0.04, -0.48), bare)
    legs_, arms = leg.build(), arm.build()
    joints = np.array([(0, 0.095, 0.84), (0, -0.095, 0.84), (0, 0.24, 1.41), (0, -0.24, 1.41)]) * scale
    swings = np.array([1.0, -1.0, -0.8, 0.8]) * _SWING_RAD
    return Figure(body.build(), concatenate([legs_, legs_, arms, arms]), joints, swings, ((0.0, 0.0, 0.55),))


def _car(atlas: AtlasBuilder, target: FigureTarget) -> Figure:
    rng = np.random.default_rng([target.look, 2])
    rgb = _pick(rng, _CARS) if target.colour is None else target.colour
    hull = paint(atlas, rgb)
    length, width, height = target.size_m
    x, y, floor, waist = length / 2, width / 2, 0.14 * height, 0.56 * height
    body = QuadBuilder()
    side = atlas.add(("car side", rgb), lambda: _car_side(rgb))
    body.box((-x, -y, floor), (x, y, waist), (hull, side), hull)
    front = atlas.add(("car front", rgb), lambda: _car_end(rgb, front=True))
    back = atlas.add(("car back", rgb), lambda: _car_end(rgb, front=False))
    high = waist - floor
    body.rectangle((x + 0.002, -y, floor), (0, 2 * y, 0), (0, 0, high), front, priority=1)
    body.rectangle((-x - 0.002, y, floor), (0, -2 * y, 0), (0, 0, high), back, priority=1)
    glass = atlas.add(("glass", rgb), lambda: _glass(rgb, panes=1))
    panes = atlas.add(("panes", rgb), lambda: _glass(rgb, panes=2))
    low = (-0.80 * x, 0.42 * x, 0.94 * y)
    roof = (-0.58 * x, 0.10 * x, 0.78 * y)
    _cabin(body, low, roof, waist, height, (glass, panes, hull))
    radius = 0.25 * height
    body.box((-0.82 * x, -0.85 * y, 0.08 * height), (0.82 * x, 0.85 * y, floor), paint(atlas, _TYRE))
    wheel = atlas.add("wheel", _wheel)
    disc = QuadBuilder()
    disc.disc((0, 0, 0), radius, wheel)
    upright = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    flat = disc.build()
    wheels = [
        flat.moved(np.array([at * x, across * (y + 0.012), radius]), upright)
        for at in (0.62, -0.60)
        for across in (1.0, -1.0)
    ]
    spots = tuple((at * x, 0.0, 1.15 * y) for at in (-0.62, 0.0, 0.62))
    return Figure(concatenate([body.build(), *wheels]), None, np.zeros((0, 3)), np.zeros(0), spots)


def _cabin(
    shapes: QuadBuilder, low: Vec3, roof: Vec3, bottom: float, top: float, textures: tuple[Texture, Texture, Texture]
) -> None:
    """Add a cabin with slanted sides. ``low`` and ``roof`` are x from, x to, ±y; textures: of ends, sides and roof."""
    (a0, a1, b), (c0, c1, d) = low, roof
    under = [np.array(p) for p in ((a0, -b, bottom), (a1, -b, bottom), (a1, b, bottom), (a0, b, bottom))]
    over = [np.array(p) for p in ((c0, -d, top), (c1, -d, top), (c1, d, top), (c0, d, top))]
    for n in range(4):
        m = (n + 1) % 4
        corners = np.array([under[n], under[m], over[m], over[n]])
        right = under[m] - under[n]
        up = (over[n] + over[m] - under[n] - under[m]) / 2
        up -= right * ((up @ right) / (right @ right))
        shapes.polygon(corners, under[n], right, up, textures[1] if n % 2 == 0 else textures[0])
    shapes.rectangle(over[0], over[1] - over[0], over[3] - over[0], textures[2])


def _pick(rng: np.random.Generator, colours: tuple[Rgb, ...]) -> Rgb:
    return colours[int(rng.integers(len(colours)))]


def _cloth(first: Rgb, second: Rgb, pattern: int) -> Image:
    """Draw cloth that is plain or has horizontal stripes, a broad band, or checks."""
    picture, other = draw_paint(first, 96, 64), draw_paint(second, 96, 64)
    rows, columns = np.arange(96)[:, None], np.arange(64)[None, :]
    masks: tuple[Callable[[], NDArray[np.bool_]], ...] = (
        lambda: np.zeros((96, 64), np.bool_),
        lambda: (rows // 10 % 2 == 1) | (columns < 0),
        lambda: (abs(rows - 38) < 13) | (columns < 0),
        lambda: (rows // 12 + columns // 12) % 2 == 1,
    )
    mask = masks[pattern]()
    picture[mask] = other[mask]
    return picture


def _face(skin: Rgb, hair: Rgb) -> Image:
    picture = draw_paint(skin, 64, 56)
    picture[:14] = hair[::-1]
    for eye in (18, 38):
        cv2.circle(picture, (eye, 28), 4, (245, 245, 245), -1, cv2.LINE_AA)
        cv2.circle(picture, (eye, 28), 2, (40, 30, 20), -1, cv2.LINE_AA)
    cv2.line(picture, (20, 48), (36, 48), (70, 60, 150), 3, cv2.LINE_AA)
    return picture


def _car_side(rgb: Rgb) -> Image:
    picture = draw_paint(rgb, 48, 256)
    dark = tuple(int(0.5 * c) for c in reversed(rgb))
    for column in (88, 132, 178):
        cv2.line(picture, (column, 2), (column, 40), dark, 1, cv2.LINE_AA)
    for column in (94, 138):
        cv2.rectangle(picture, (column, 10), (column + 10, 13), (190, 190, 190), -1)
    cv2.line(picture, (0, 42), (255, 42), dark, 3)
    return picture


def _car_end(rgb: Rgb, *, front: bool) -> Image:
    picture = draw_paint(rgb, 64, 160)
    lamp = (210, 250, 255) if front else (30, 20, 200)
    for left in (8, 122):
        cv2.rectangle(picture, (left, 10), (left + 30, 26), (40, 40, 40), -1)
        cv2.rectangle(picture, (left + 2, 12), (left + 28, 24), lamp, -1)
    cv2.rectangle(picture, (46, 14), (114, 26), (30, 30, 30) if front else (90, 90, 90), -1)
    cv2.rectangle(picture, (56, 38), (104, 50), (240, 240, 240), -1)
    cv2.rectangle(picture, (0, 54), (159, 63), (50, 50, 52), -1)
    return picture


def _glass(rgb: Rgb, *, panes: int) -> Image:
    """Draw window panes surrounded by the car's colour, with a bright streak."""
    picture = draw_paint(rgb, 64, 128)
    width = 128 // panes
    for pane in range(panes):
        left, right = pane * width + 8, (pane + 1) * width - 8
        cv2.rectangle(picture, (left, 6), (right, 56), tuple(reversed(_GLASS)), -1)
        shine = np.array([(left + 10, 56), (left + 22, 56), (left + 40, 6), (left + 28, 6)])
        cv2.fillConvexPoly(picture, shine, (128, 112, 96), cv2.LINE_AA)
    return picture


def _wheel() -> Image:
    picture = draw_paint(_TYRE, 64, 64)
    cv2.circle(picture, (32, 32), 19, (170, 170, 168), -1, cv2.LINE_AA)
    for spoke in range(5):
        angle = 2 * math.pi * spoke / 5
        end = (round(32 + 17 * math.cos(angle)), round(32 + 17 * math.sin(angle)))
        cv2.line(picture, (32, 32), end, (90, 90, 90), 3, cv2.LINE_AA)
    cv2.circle(picture, (32, 32), 4, (60, 60, 60), -1, cv2.LINE_AA)
    return picture


# Hull colours of consecutive drones.
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
_ARM_M, _ROTOR_M = 0.16, 0.10  # distance of the rotors' axes from the centre, and radius of a rotor
_FEET_M = 0.06  # distance of the feet below the body's origin
_DARK: Rgb = (46, 48, 52)
_POLE_M = 12.0  # length of the stand's pole, which extends through the floor and is hidden below it


def card(builder: QuadBuilder, atlas: AtlasBuilder, pattern: MarkerPattern, priority: int) -> None:
    """Add a marker's card around the origin, in face axes: x right, y up, z along its normal."""
    image, uv = draw_card(pattern)
    half = pattern.card_size_m / 2
    texture = atlas.add(("card", pattern), lambda: image)
    edge = pattern.card_size_m
    builder.rectangle((-half, -half, 0), (edge, 0, 0), (0, edge, 0), texture, priority=priority, uv=uv)


def drone(atlas: AtlasBuilder, hull: Rgb) -> Quads:
    """Return a quadrotor in body axes: a hull with a nose, a crossed frame and four rotors.

    The front rotors have the colour of the hull, so that the heading is visible.
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
    """Return a target's shape without its stand. Figures are shown at rest."""
    if isinstance(target, BoardTarget):
        return board(atlas, target)
    if isinstance(target, FigureTarget):
        return figure(atlas, target).standing()
    return platform(atlas, target)


def board(atlas: AtlasBuilder, target: BoardTarget) -> Quads:
    """Return a marker's card in front of a wooden board on a pole; origin is the card's centre, x its normal."""
    face = QuadBuilder()
    card(face, atlas, target.pattern, priority=2)
    # rotates face axes (right, up, normal) to (x forward, y left, z up)
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
    """Return a slab on a column with a marker on top; the origin is the centre of the top, with x along the heading."""
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
    # rotates face axes (right, up, normal) to (x forward, y left, z up): the image's up is forward and its right is -y
    turn = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return face.build().moved(np.zeros(3), turn).joined(body.build())


_CELL = 24  # number of texels per cell of the marker
_PAPER, _INK = 235, 22  # grey values of a card's white and black


def draw_card(pattern: MarkerPattern) -> tuple[Image, tuple[float, float, float, float]]:
    """Draw a marker with its margin, BGR; also return the visible left, top, right, bottom in fractional texels.

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
    ink = np.where(square > 127, _PAPER, _INK).astype(np.uint8)
    image = cv2.copyMakeBorder(ink, border, border, border, border, cv2.BORDER_CONSTANT, value=_PAPER)
    start, end = border - margin, border + black + margin
    return np.repeat(image[..., None], 3, axis=2).astype(np.uint8), (start, start, end, end)
