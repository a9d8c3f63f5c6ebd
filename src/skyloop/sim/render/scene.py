"""A world prepared for rendering: textures in one atlas, fixed parts as quads, moving parts as templates."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import UsageError
from skyloop.sim.render import models
from skyloop.sim.render.models import card, figure
from skyloop.sim.render.quads import AtlasBuilder, QuadBuilder, Quads, SceneState, Texture, concatenate, cv2, move_each
from skyloop.sim.render.shading import Shadow
from skyloop.sim.render.textures import draw_surface, paint
from skyloop.sim.world import BoardTarget, Box, FigureTarget, PlatformTarget, Room, World

_FADES_AT_M = 4.0  # height above a surface at which a drone's shadow has faded completely


@dataclass(frozen=True, slots=True, eq=False)
class Posed:
    """All parts of a scene at a point in time. ``drone``: the drone that each quad belongs to, or -1, (n,)."""

    quads: Quads
    drone: NDArray[np.intp]
    shadows: tuple[Shadow, ...]


class Scene:
    """The renderable parts of a world and its drones.

    The constructor draws all textures (which takes a few tenths of a second). The scene never changes afterwards, so
    renderers on several threads can share it.
    """

    def __init__(self, world: World, drones: int = 1) -> None:
        atlas = AtlasBuilder()
        self.world = world
        self.drones = drones
        self._static = static_quads(world, atlas)
        self._figures = [figure(atlas, t) if isinstance(t, FigureTarget) else None for t in world.targets]
        self._targets = [
            models.target(atlas, target) if shape is None else shape.standing()
            for target, shape in zip(world.targets, self._figures, strict=True)
        ]
        self._stand = models.stand(atlas)
        hulls = [models.drone(atlas, hull) for hull in models.HULLS[: max(1, drones)]]
        self._hulls = [hulls[k % len(hulls)] for k in range(drones)]
        standing = [
            part
            for target, template in zip(world.targets, self._targets, strict=True)
            for part in ([template, self._stand] if isinstance(target, BoardTarget) else [template])
        ]
        # All parts, in the order used by ``posed``, for properties that motion does not change.
        self._everything = concatenate([self._static, *standing, *self._hulls])
        #: Index of the world target that each quad belongs to, or -1 if none, (n,).
        self.target_of = np.concatenate(
            [np.full(len(self._static), -1, np.intp)]
            + [
                np.full(len(template) + (len(self._stand) if isinstance(target, BoardTarget) else 0), k, np.intp)
                for k, (target, template) in enumerate(zip(world.targets, self._targets, strict=True))
            ]
            + [np.full(len(hull), -1, np.intp) for hull in self._hulls]
        )
        #: Index of the world box that each quad belongs to, or -1 if none, (n,).
        self.box_of = np.full(len(self.target_of), -1, np.intp)
        sides = np.repeat(np.arange(len(world.solids())), SIDES)
        first = len(self._static) - len(world.panels) - len(world.markers) - len(sides)
        self.box_of[first : first + len(sides)] = np.where(sides < len(world.boxes), sides, -1)
        owners = [np.full(len(self._static) + sum(map(len, standing)), -1, np.intp)]
        owners += [np.full(len(hull), k, np.intp) for k, hull in enumerate(self._hulls)]
        self._owner = np.concatenate(owners)
        self._swarm = concatenate(self._hulls) if self._hulls else None
        self.atlas = atlas.pack()
        # Surfaces on which shadows fall: upright solids, as cosine and sine of yaw, centre, half size and top.
        self._tops = [
            (
                math.cos(box.yaw_rad),
                math.sin(box.yaw_rad),
                *map(float, box.position_m[:2]),
                *(side / 2 for side in map(float, box.size_m[:2])),
                float(box.position_m[2] + box.size_m[2] / 2),
            )
            for box in world.solids()
        ]

    def posed(self, state: SceneState) -> Posed:
        """Place all moving parts according to a state."""
        shape = np.shape(state.drone_positions_m), np.shape(state.drone_rotations)
        if shape != ((self.drones, 3), (self.drones, 3, 3)):
            raise UsageError(
                f"the scene has {self.drones} drones: positions must be ({self.drones}, 3) and rotations "
                f"({self.drones}, 3, 3), not {shape[0]} and {shape[1]}"
            )
        if len(state.targets) != len(self._targets):
            raise UsageError(f"the world has {len(self._targets)} moving targets, the state {len(state.targets)}")
        vectors, starts = self._everything.vectors.copy(), self._everything.starts.copy()
        done = len(self._static)
        shadows: list[Shadow] = []
        for template, figure_, target, now in zip(
            self._targets, self._figures, self.world.targets, state.targets, strict=True
        ):
            position, turn = np.array(now.position_m), _yaw(now.yaw_rad)
            part = slice(done, done + len(template))
            done = part.stop
            if figure_ is not None:
                posed = figure_.posed(position, turn, now.walked_m)
                vectors[part], starts[part] = posed.vectors, posed.starts
                shadows += figure_.shadows(position, turn)
                continue
            move_each(template, position[None], turn[None], vectors[part], starts[part])
            on_floor = np.array([position[0], position[1], 0.0])
            if isinstance(target, BoardTarget):
                part = slice(done, done + len(self._stand))
                done = part.stop
                move_each(self._stand, on_floor[None], turn[None], vectors[part], starts[part])
                shadows.append(Shadow(on_floor, 0.32, 0.45))
            elif isinstance(target, PlatformTarget):
                shadows.append(Shadow(on_floor, 0.75 * math.hypot(*target.size_m[:2]), 0.45))
        if self._swarm is not None:
            move_each(self._swarm, state.drone_positions_m, state.drone_rotations, vectors[done:], starts[done:])
            shadows += filter(None, map(self._drone_shadow, state.drone_positions_m.tolist()))
        return Posed(replace(self._everything, vectors=vectors, starts=starts), self._owner, tuple(shadows))

    def _drone_shadow(self, position_m: list[float]) -> Shadow | None:
        """Return a drone's soft shadow on the surface below it; None if the drone is too high above that surface."""
        x, y, z = position_m
        surface = 0.0
        for c, s, at_x, at_y, half_x, half_y, top in self._tops:
            dx, dy = x - at_x, y - at_y
            if surface < top <= z and abs(c * dx + s * dy) < half_x and abs(c * dy - s * dx) < half_y:
                surface = top
        above = z - surface
        fade = 1.0 - above / _FADES_AT_M
        if fade <= 0.0:
            return None
        return Shadow(np.array([x, y, surface]), models.DRONE_RADIUS_M * (1.1 + 0.35 * above), 0.6 * fade**1.5)


def _yaw(angle: float) -> NDArray[np.float64]:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


_FINEST = 128.0  # texels per metre of a room's surfaces, if their size allows
_LARGEST = 1280.0  # maximum number of texels along a side of a room's surface
_AFAR_M = 150.0  # extent of the open ground
_SKY_M = 400.0  # half the side of the sky
SIDES = 6  #: quads per box; ``static_quads`` has the shell first, then boxes, panels, markers
# Where solids cast their shadows: away from the light in ``shading``, but short, as in a room lit from all sides.
_LEAN = np.array([-0.16, 0.20])


def static_quads(world: World, atlas: AtlasBuilder) -> Quads:
    """Return all fixed parts of a world."""
    parts = [_shell(world, atlas, world.solids())]
    parts += [_box(box, atlas) for box in world.solids()]
    for panel in world.panels:
        shapes = QuadBuilder()
        width, height = panel.size_m
        density = min(256.0, 512.0 / max(width, height))
        texture = _surface(atlas, panel.texture, width, height, density)
        shapes.rectangle((-width / 2, -height / 2, 0), (width, 0, 0), (0, height, 0), texture, priority=1)
        parts.append(shapes.build().moved(np.array(panel.pose.position_m), panel.pose.rotation()))
    for marker in world.markers:
        shapes = QuadBuilder()
        card(shapes, atlas, marker.pattern, priority=2)
        parts.append(shapes.build().moved(np.array(marker.pose.position_m), marker.pose.rotation()))
    return concatenate(parts)


def _surface(atlas: AtlasBuilder, name: str, width_m: float, height_m: float, density: float) -> Texture:
    key = (name, round(width_m, 3), round(height_m, 3), density)
    return atlas.add(key, lambda: draw_surface(name, width_m, height_m, density))


def _shell(world: World, atlas: AtlasBuilder, shadowing: tuple[Box, ...]) -> Quads:
    """Return floor, walls and ceiling, or ground and sky, with the shadows of some boxes painted on the floor."""
    room = world.room
    x, y, z = room.size_m
    density = min(_FINEST, _LARGEST / max(x, y, z))
    shapes = QuadBuilder()
    floor = atlas.add("floor", lambda: _floor(room, density, shadowing))
    shapes.rectangle((-x / 2, -y / 2, 0), (x, 0, 0), (0, y, 0), floor)
    if not room.enclosed:
        _outdoors(shapes, atlas, room)
        return shapes.build()
    ceiling = atlas.add("ceiling", lambda: _ceiling(room, density))
    shapes.rectangle((x / 2, -y / 2, z), (-x, 0, 0), (0, y, 0), ceiling)
    for number, (corner, right) in enumerate(
        (
            ((-x / 2, y / 2, 0), (x, 0, 0)),
            ((x / 2, -y / 2, 0), (-x, 0, 0)),
            ((x / 2, y / 2, 0), (0, -y, 0)),
            ((-x / 2, -y / 2, 0), (0, y, 0)),
        )
    ):
        texture = atlas.add(("wall", number), partial(_wall, room, x if number < 2 else y, density, number))
        shapes.rectangle(corner, right, (0, 0, z), texture)
    return shapes.build()


def _shaded(picture: NDArray[np.uint8], light: NDArray[np.float32]) -> NDArray[np.uint8]:
    gain = cv2.merge([np.clip(light * 200.0, 0.0, 255.0).astype(np.uint8)] * 3)
    return np.asarray(cv2.multiply(picture, gain, scale=1.0 / 200.0), dtype=np.uint8)


def _corner_dark(height: int, width: int, per_m: float, sides: float, top: float, bottom: float) -> NDArray[np.float32]:
    """Return a surface's light, which falls by these fractions towards the sides, the top and the bottom."""
    x = (np.arange(width, dtype=np.float32) + 0.5) / per_m
    y = (np.arange(height, dtype=np.float32) + 0.5) / per_m
    across = 1.0 - sides * (np.exp(-x / 0.35) + np.exp(-x[::-1] / 0.35))
    down = 1.0 - top * np.exp(-y / 0.35) - bottom * np.exp(-y[::-1] / 0.35)
    return np.asarray(down[:, None] * across[None, :], dtype=np.float32)


def _floor(room: Room, density: float, shadowing: tuple[Box, ...]) -> NDArray[np.uint8]:
    picture = draw_surface(room.floor, room.size_m[0], room.size_m[1], density)
    height, width = picture.shape[:2]
    edge = 0.22 if room.enclosed else 0.0
    light = _corner_dark(height, width, density, edge, edge, edge)
    corner = np.array([-room.size_m[0] / 2, room.size_m[1] / 2])
    for reach, lean, blur_m, dark in ((0.0, 0.0, 0.06, 0.42), (1.0, 1.0, 0.05, 0.24)):
        mask = np.zeros((height, width), np.uint8)
        for box in shadowing:
            points = box.corners()
            if points[:, 2].min() > 1.0 and reach == 0.0:
                continue
            at = points[:, :2] + lean * points[:, 2:] * _LEAN
            pixels = ((at - corner) * (density, -density)).astype(np.int32)
            cv2.fillConvexPoly(mask, cv2.convexHull(pixels), 255)
        soft = cv2.GaussianBlur(mask, (0, 0), max(1.0, blur_m * density))
        light *= 1.0 - dark * soft.astype(np.float32) / np.float32(255.0)
    return _shaded(picture, light)


def _ceiling(room: Room, density: float) -> NDArray[np.uint8]:
    per_m = density / 2
    picture = draw_surface(room.ceiling, room.size_m[0], room.size_m[1], per_m)
    height, width = picture.shape[:2]
    bright = 1.16 if room.ceiling == "plaster" else 1.0  # the floor reflects light onto surfaces that face downwards
    lit = _shaded(picture, bright * _corner_dark(height, width, per_m, 0.18, 0.18, 0.18))
    for cx in np.arange(1, 2 * max(1, round(room.size_m[0] / 3)), 2) / (2 * max(1, round(room.size_m[0] / 3))):
        for cy in np.arange(1, 2 * max(1, round(room.size_m[1] / 3)), 2) / (2 * max(1, round(room.size_m[1] / 3))):
            a, b = round(0.6 * per_m), round(0.15 * per_m)
            x, y = round(cx * width), round(cy * height)
            cv2.rectangle(lit, (x - a, y - b), (x + a, y + b), (170, 174, 176), -1)
            cv2.rectangle(lit, (x - a + 2, y - b + 2), (x + a - 2, y + b - 2), (255, 255, 255), -1)
    return lit


def _wall(room: Room, length_m: float, density: float, seed: int) -> NDArray[np.uint8]:
    picture = draw_surface(room.walls, length_m, room.size_m[2], density, seed)
    height, width = picture.shape[:2]
    lit = _shaded(picture, _corner_dark(height, width, density, 0.14, 0.12, 0.12))
    if room.walls == "plaster":
        skirting = max(2, round(0.09 * density))
        lit[-skirting:] = (84, 104, 122)
        lit[-skirting] = (150, 164, 174)
        lit[-2:] = (50, 60, 68)
    return lit


def _box(box: Box, atlas: AtlasBuilder) -> Quads:
    x, y, z = box.size_m
    shapes = QuadBuilder()
    low, high = (-x / 2, -y / 2, -z / 2), (x / 2, y / 2, z / 2)
    if box.colour is not None:
        shapes.box(low, high, paint(atlas, box.colour))
    else:
        density = min(200.0, 256.0 / max(x, y, z))
        ends = _surface(atlas, box.texture if box.texture != "books" else "wood", x, y, density)
        for_x = _surface(atlas, box.texture, y, z, density)
        for_y = _surface(atlas, box.texture, x, z, density)
        shapes.box(low, high, (for_x, for_y), ends)
    c, s = np.cos(box.yaw_rad), np.sin(box.yaw_rad)
    return shapes.build().moved(np.array(box.position_m), np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]))


def _outdoors(shapes: QuadBuilder, atlas: AtlasBuilder, room: Room) -> None:
    """Add the ground around the room's floor up to the limit of visibility, and a sky."""
    x, y, far = room.size_m[0] / 2, room.size_m[1] / 2, _AFAR_M
    ground = _surface(atlas, room.floor, 2 * far, 2 * far, 512 / (2 * far))
    for low, high in (((-far, -far), (far, -y)), ((-far, y), (far, far)), ((-far, -y), (-x, y)), ((x, -y), (far, y))):
        if high[0] <= low[0] or high[1] <= low[1]:
            continue  # the floor extends up to this edge
        texels = ground.width / (2 * far)
        uv = ((low[0] + far) * texels, (far - high[1]) * texels, (high[0] + far) * texels, (far - low[1]) * texels)
        shapes.rectangle((*low, 0), (high[0] - low[0], 0, 0), (0, high[1] - low[1], 0), ground, uv=uv)
    sky, side = atlas.add("sky", _sky), _SKY_M
    for corner, right in (
        ((-side, side), (2 * side, 0, 0)),
        ((side, -side), (-2 * side, 0, 0)),
        ((side, side), (0, -2 * side, 0)),
        ((-side, -side), (0, 2 * side, 0)),
    ):
        shapes.rectangle((*corner, -0.3 * side), right, (0, 0, 1.3 * side), sky, lit=False)
    top = atlas.add("zenith", lambda: np.full((64, 64, 3), _sky()[0, 0], np.uint8))
    shapes.rectangle((side, -side, side), (-2 * side, 0, 0), (0, 2 * side, 0), top, lit=False)


def _sky() -> NDArray[np.uint8]:
    """Draw a sky, from haze at the horizon to blue above. About the lowest quarter lies below the horizon."""
    rise = np.clip(1.0 - np.arange(256, dtype=np.float32) / 197.0, 0.0, 1.0)[:, None, None]
    low, high = np.array([226.0, 214.0, 198.0]), np.array([206.0, 156.0, 104.0])
    return np.broadcast_to(low + (high - low) * np.sqrt(rise), (256, 64, 3)).astype(np.uint8)
