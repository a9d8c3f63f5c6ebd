"""What does not move: the room or the open ground, boxes, gates, panels and markers, with soft shadows painted on."""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from skyloop.sim.render.atlas import AtlasBuilder, Texture
from skyloop.sim.render.models import card
from skyloop.sim.render.opencv import cv2
from skyloop.sim.render.quads import QuadBuilder, Quads, concatenate
from skyloop.sim.render.textures import draw_surface, paint
from skyloop.sim.world import Box, Room, World

_FINEST = 128.0  # texels per metre of a room's surfaces, where its size allows
_LARGEST = 1280.0  # texels along a side of them
_AFAR_M = 150.0  # how far the open ground goes
_SKY_M = 400.0
SIDES = 6  #: quads of a box; in ``static_quads`` the shell comes first, then boxes, panels, markers
# Where shadows of standing things fall: away from the light of ``shading``, shortened, as in a room lit from all over.
_LEAN = np.array([-0.16, 0.20])


def static_quads(world: World, atlas: AtlasBuilder) -> Quads:
    """Return all of a world that never moves.

    Args:
        world: The world.
        atlas: Gets the textures.
    """
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
    """Floor, walls and ceiling; or ground and sky. ``shadowing``: whose shadows are painted on the floor."""
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
    """Light where surfaces meet: it falls by these shares towards the sides, the top and the bottom."""
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
    bright = 1.16 if room.ceiling == "plaster" else 1.0  # what looks down gets light from the floor
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
    """Ground around the room's floor, as far as one sees, and a sky."""
    x, y, far = room.size_m[0] / 2, room.size_m[1] / 2, _AFAR_M
    ground = _surface(atlas, room.floor, 2 * far, 2 * far, 512 / (2 * far))
    for low, high in (
        ((-far, -far), (far, -y)),
        ((-far, y), (far, far)),
        ((-far, -y), (-x, y)),
        ((x, -y), (far, y)),
    ):
        if high[0] <= low[0] or high[1] <= low[1]:
            continue  # the floor reaches as far
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
    """From haze at the horizon to blue above; the lowest quarter or so is below the horizon."""
    rise = np.clip(1.0 - np.arange(256, dtype=np.float32) / 197.0, 0.0, 1.0)[:, None, None]
    low, high = np.array([226.0, 214.0, 198.0]), np.array([206.0, 156.0, 104.0])
    return np.broadcast_to(low + (high - low) * np.sqrt(rise), (256, 64, 3)).astype(np.uint8)
