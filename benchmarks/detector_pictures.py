"""Pictures of the simulator's figures for a detector: for training, and degraded as by a camera or a codec.

Every picture has its true boxes. Figures and crates stand at random places, in the shipped worlds and in invented ones,
so that a detector learns their appearance, not their positions.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skyloop.messages.geometry import rotation_from_euler
from skyloop.sim import load_world
from skyloop.sim.camera import FRONT_CAMERA, CameraModel
from skyloop.sim.labels import Labeller, TargetBox
from skyloop.sim.render import PlanarRenderer, Scene, SceneState
from skyloop.sim.solids import Solids
from skyloop.sim.targets import TargetTrack
from skyloop.sim.world import (
    FIGURE_SIZES_M,
    BoardTarget,
    Box,
    FacePose,
    FigureTarget,
    FixedYaw,
    Gate,
    Light,
    Marker,
    MarkerPattern,
    Panel,
    PlatformTarget,
    Room,
    StillPath,
    Target,
    TargetState,
    World,
)

Image = NDArray[np.uint8]
Rng = np.random.Generator

PER_WORLD: Final = 30  #: pictures of one world with one camera and one set of appearances
_SHIPPED: Final = ("room", "empty", "gates", "pillars", "platform", "windy")  # none of these has a figure
_GROUNDS: Final = ("asphalt", "brick", "carpet", "checker", "concrete", "grass", "metal", "parquet", "tiles", "wood")
_SIDES: Final = ("brick", "books", "checker", "concrete", "fabric", "grass", "metal", "plaster", "tiles", "wood")
_HUNG: Final = ("door", "window", "poster_chart", "poster_landscape", "poster_pattern")
_GAP_M: Final = 0.004  # distance of objects from their wall or floor, so that they are in front of it
_NEAREST_M: Final = 0.8  # minimum distance of a figure from the camera
_NEAR_M, _FAR_M = 12.0, 36.0  # maximum distance of most figures, and of the others; at 36 m a person is 12 pixels high
_PERSON: Final = np.array([[0.35], [0.35], [0.8]])  # space to keep free around a person
_CAR: Final = np.array([[0.75], [0.75], [0.5]])  # space to keep free around each half of a car


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """A picture, BGR, and its visible contents."""

    image: Image
    boxes: tuple[TargetBox, ...]


def training_pictures(seed: int, count: int) -> Iterator[Picture]:
    """Yield pictures of many worlds, 320 pixels wide and 240 or 180 high, without the flaws of a sensor."""
    rng = np.random.default_rng(seed)
    for first in range(0, count, PER_WORLD):
        world = _world(rng)
        yield from _of_world(world, rng, min(PER_WORLD, count - first))


def spoil(image: Image, rng: Rng, strength: float = 1.0) -> Image:
    """Degrade an image randomly like a camera and a codec: light, colours, blur, noise and compression."""
    if rng.random() < 0.7:
        image = relit(image, rng.uniform(1 - 0.5 * strength, 1 + 0.35 * strength), rng, 0.08 * strength)
    if rng.random() < 0.3:
        image = smeared(image, rng.uniform(1.5, 7.0) * strength, rng.uniform(0, math.pi))
    if rng.random() < 0.15:
        image = coarse(image, rng.uniform(0.5, 0.9))
    if rng.random() < 0.5:
        image = noisy(image, rng.uniform(1.0, 9.0) * strength, rng)
    if rng.random() < 0.4:
        image = as_jpeg(image, int(rng.integers(15, 90)))
    return image


def relit(image: Image, light: float, rng: Rng | None = None, tint: float = 0.0) -> Image:
    """Change an image's light: a factor, and with a random generator also gamma, tint and grey."""
    values = np.arange(256, dtype=np.float32)
    tables = np.empty((1, 256, 3), np.uint8)
    gamma, lift = (1.0, 0.0) if rng is None else (float(rng.uniform(0.75, 1.35)), float(rng.uniform(-12, 25)))
    for channel in range(3):
        factor = light if rng is None else light * float(rng.uniform(1 - tint, 1 + tint))
        curve = (values / 255) ** gamma * 255 * factor + lift
        tables[0, :, channel] = np.clip(curve, 0, 255)
    return np.asarray(cv2.LUT(image, tables), np.uint8)


def noisy(image: Image, sigma: float, rng: Rng) -> Image:
    """Add the noise of a sensor to an image; ``sigma`` in steps of 0 to 255."""
    noise = np.empty(image.shape, np.int16)
    cv2.setRNGSeed(int(rng.integers(1 << 31)))
    cv2.randn(noise, np.zeros(3), np.full(3, sigma))
    return np.asarray(cv2.add(image, noise, dtype=cv2.CV_8U), np.uint8)


def smeared(image: Image, length: float, angle: float) -> Image:
    """Smear an image like a turning camera: over a length [px] along a direction [rad]."""
    half = math.ceil(length / 2) + 1
    kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
    for step in np.linspace(-0.5, 0.5, 4 * half + 1) * length:
        kernel[round(half + step * math.sin(angle)), round(half + step * math.cos(angle))] += 1.0
    return np.asarray(cv2.filter2D(image, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE), np.uint8)


def coarse(image: Image, share: float) -> Image:
    """Reduce an image's resolution to a fraction of its width and height, and enlarge it again."""
    rows, columns = image.shape[:2]
    small = cv2.resize(image, (round(columns * share), round(rows * share)), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.resize(small, (columns, rows), interpolation=cv2.INTER_LINEAR), np.uint8)


def as_jpeg(image: Image, quality: int) -> Image:
    """Compress an image as JPEG; its blocks and missing colours also resemble a camera's H.264."""
    coded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR), np.uint8)


def _world(rng: Rng) -> World:
    kind = rng.choice(["street", "yard", "shipped", "made up"], p=[0.26, 0.22, 0.2, 0.32])
    if kind == "made up":
        return _made_up(rng)
    world = load_world(str(rng.choice(_SHIPPED)) if kind == "shipped" else str(kind), int(rng.integers(1 << 30)))
    if kind == "shipped":  # half of these get no figures
        return world if rng.random() < 0.5 else replace(world, targets=world.targets + _figures(rng, 3, 1))
    return replace(world, targets=tuple(_dressed(target, rng) for target in world.targets))


def _dressed(target: Target, rng: Rng) -> Target:
    """Change a figure's appearance, half of the time."""
    if not isinstance(target, FigureTarget) or rng.random() < 0.4:
        return target
    return replace(target, look=int(rng.integers(10_000)), colour=_colour(rng) if rng.random() < 0.5 else None)


def _colour(rng: Rng) -> tuple[int, int, int]:
    red, green, blue = (int(part) for part in rng.integers(15, 250, 3))
    return red, green, blue


def _figures(rng: Rng, people: int, cars: int) -> tuple[Target, ...]:
    made = []
    for number, shape in enumerate(["person"] * people + ["car"] * cars):
        scale = float(rng.uniform(0.9, 1.1))
        x, y, z = FIGURE_SIZES_M[shape]
        colour = _colour(rng) if rng.random() < 0.4 else None
        still, yaw = StillPath((0.0, 0.0, 0.0)), FixedYaw(0.0)
        size = (x * scale, y * scale, z * scale)
        made.append(FigureTarget(f"figure {number}", shape, still, yaw, size, int(rng.integers(10_000)), colour))
    return tuple(made)


def _made_up(rng: Rng) -> World:
    """Return a room or a ground with boxes of all kinds, trees, gates, markers, crates and figures."""
    wide, deep, high = (float(side) for side in rng.uniform((10, 8, 3.5), (50, 34, 9)))
    floor, walls, ceiling = (str(rng.choice(_GROUNDS)) for _ in range(3))
    room = Room((wide, deep, high), floor, walls, ceiling, enclosed=bool(rng.random() < 0.4))
    boxes, panels = _blocks(rng, room)
    boxes += _trees(rng, room)
    for number in range(int(rng.integers(0, 7))):
        side, (x, y) = float(rng.uniform(0.4, 1.1)), _place(rng, room)
        boxes.append(Box(f"crate {number}", (x, y, side / 2), (side, side, side), float(rng.uniform(0, 1.5)), "crate"))
    targets = (*_figures(rng, int(rng.integers(0, 7)), int(rng.integers(0, 4))), *_carriers(rng, room))
    things = tuple(boxes), _gates(rng, room), (*panels, *_posters(rng, room)), _markers(rng, room), targets
    return World("made up", room, *things, light=Light(0.4, 50.0))


def _place(rng: Rng, room: Room) -> tuple[float, float]:
    x, y = rng.uniform(-0.5, 0.5, 2) * (room.size_m[0] - 2.0, room.size_m[1] - 2.0)
    return float(x), float(y)


def _blocks(rng: Rng, room: Room) -> tuple[list[Box], list[Panel]]:
    """Return boxes of any surface or colour, and panels on the large ones."""
    boxes, panels = [], []
    for number in range(int(rng.integers(2, 12))):
        wide, deep, high = (
            float(side) for side in rng.uniform((0.15, 0.15, 0.3), (5, 3, 3.3)) * rng.choice([0.3, 0.6, 1.0])
        )
        (x, y), yaw = _place(rng, room), float(rng.uniform(-math.pi, math.pi))
        colour = _colour(rng) if rng.random() < 0.3 else None
        boxes.append(Box(f"block {number}", (x, y, high / 2), (wide, deep, high), yaw, str(rng.choice(_SIDES)), colour))
        if wide > 1.2 and high > 1.0:
            out = deep / 2 + _GAP_M
            pose = FacePose((x + out * math.sin(yaw), y - out * math.cos(yaw), high / 2), yaw - math.pi / 2)
            size = min(1.0, 0.6 * wide), 0.8 * high
            panels.append(Panel(f"panel {number}", pose, size, str(rng.choice(_HUNG))))
    return boxes, panels


def _trees(rng: Rng, room: Room) -> list[Box]:
    boxes = []
    for number in range(int(rng.integers(0, 6))):
        (x, y), trunk, crown = _place(rng, room), float(rng.uniform(1.2, 2.4)), float(rng.uniform(1.0, 2.2))
        boxes.append(Box(f"trunk {number}", (x, y, trunk / 2), (0.28, 0.28, trunk), 0.0, "wood"))
        yaw, middle = float(rng.uniform(0, 1.5)), trunk + 0.4 * crown
        boxes.append(Box(f"crown {number}", (x, y, middle), (crown, crown, crown), yaw, "grass"))
    return boxes


def _gates(rng: Rng, room: Room) -> tuple[Gate, ...]:
    gates = []
    for number in range(int(rng.integers(0, 3))):
        low, side = float(rng.uniform(0.4, 1.4)), float(rng.uniform(0.6, 1.2))
        at = (*_place(rng, room), low + side / 2)
        gates.append(Gate(f"gate {number}", at, (side, side), float(rng.uniform(-3, 3)), colour=_colour(rng)))
    return tuple(gates)


def _markers(rng: Rng, room: Room) -> tuple[Marker, ...]:
    """Return markers on the floor."""
    markers = []
    for number in range(int(rng.integers(0, 4))):
        pose = FacePose((*_place(rng, room), _GAP_M), 0.0, math.pi / 2, float(rng.uniform(-3, 3)))
        markers.append(Marker(f"marker {number}", pose, _pattern(rng)))
    return tuple(markers)


def _posters(rng: Rng, room: Room) -> tuple[Panel, ...]:
    """Return pictures and windows on the walls in the east and the west."""
    if not room.enclosed:
        return ()
    panels = []
    for name, side, heading in (("east", 0.5, math.pi), ("west", -0.5, 0.0)):
        x = side * (room.size_m[0] - 2 * _GAP_M)
        pose = FacePose((x, _place(rng, room)[1], float(rng.uniform(1.2, 2.2))), heading)
        size = float(rng.uniform(0.5, 2.0)), float(rng.uniform(0.5, 1.6))
        panels.append(Panel(name, pose, size, str(rng.choice(_HUNG[1:]))))
    return tuple(panels)


def _carriers(rng: Rng, room: Room) -> list[Target]:
    """Return objects that carry markers: boards and platforms."""
    targets: list[Target] = []
    yaw = FixedYaw(float(rng.uniform(-3, 3)))
    if rng.random() < 0.4:
        path = StillPath((*_place(rng, room), float(rng.uniform(0.8, 1.8))))
        targets.append(BoardTarget("board", _pattern(rng), path, yaw))
    if rng.random() < 0.4:
        wide, deep, high = (float(side) for side in rng.uniform((0.6, 0.6, 0.1), (1.6, 1.6, 0.3)))
        path = StillPath((*_place(rng, room), float(rng.uniform(0.2, 0.6))))
        targets.append(
            PlatformTarget("platform", _pattern(rng), path, yaw, (wide, deep, high), str(rng.choice(_SIDES)))
        )
    return targets


def _pattern(rng: Rng) -> MarkerPattern:
    side = float(rng.uniform(0.15, 0.5))
    return MarkerPattern("DICT_4X4_50", int(rng.integers(50)), side, side / 6)


def _camera(rng: Rng) -> CameraModel:
    """Return the camera of the simulated AR.Drone, or another without distortion; neither has a sensor's flaws."""
    if rng.random() < 0.35:
        return replace(FRONT_CAMERA, noise_sigma=0.0, vignetting=0.0, position_m=(0.0, 0.0, 0.0))
    height = 240 if rng.random() < 0.65 else 180
    focal = 320 * float(rng.uniform(0.55, 1.1))
    return CameraModel("camera", 320, height, 30.0, focal, focal, 159.5, (height - 1) / 2)


def _of_world(world: World, rng: Rng, count: int) -> Iterator[Picture]:
    model = _camera(rng)
    solids = Solids(replace(world, targets=()), ())
    scene = Scene(world, 1)
    renderer, labeller = PlanarRenderer(scene), Labeller(scene)
    tracks = [TargetTrack(target, world.seed, number) for number, target in enumerate(world.targets)]
    for _ in range(count):
        at, yaw = _free_place(world, solids, rng)
        tilted = rng.random() < 0.5
        pitch = float(rng.uniform(-0.35, 0.4)) if tilted else float(rng.normal(0.08, 0.12))
        roll = float(rng.uniform(-0.35, 0.35)) if tilted else float(rng.normal(0.0, 0.05))
        states = _states(world, tracks, solids, at, yaw, rng)
        away = float(rng.uniform(1.0, 6.0)) if rng.random() < 0.25 else 1000.0
        bearing = yaw + float(rng.normal(0.0, 0.3))
        drone = at + away * np.array([math.cos(bearing), math.sin(bearing), float(rng.uniform(-0.1, 0.1))])
        turned = rotation_from_euler(0.0, 0.0, float(rng.uniform(-math.pi, math.pi)))
        light = 1.0 if rng.random() < 0.4 else float(rng.uniform(0.55, 1.0))
        state = SceneState(drone[None], turned[None], states, light)
        pose = model.pose(at, rotation_from_euler(roll, pitch, yaw))
        yield Picture(renderer.render(state, pose, model), labeller.boxes(state, pose, model))


def _free_place(world: World, solids: Solids, rng: Rng) -> tuple[NDArray[np.float64], float]:
    x, y, top = world.room.size_m
    hull = np.full((3, 1), 0.4)
    at = np.array([0.0, 0.0, 1.0])
    for _ in range(200):
        at = rng.uniform((-x / 2, -y / 2, 0.5), (x / 2, y / 2, min(3.2, top)))
        if solids.clearance(at[:, None], hull)[0] > 0.0:
            break
    if rng.random() < 0.1:
        return at, float(rng.uniform(-math.pi, math.pi))
    # Most visible objects are placed ahead, where there is room.
    ahead = math.atan2(-at[1] + rng.normal(0.0, y / 6), -at[0] + rng.normal(0.0, x / 6))
    return at, float(ahead)


def _states(
    world: World, tracks: list[TargetTrack], solids: Solids, camera: NDArray[np.float64], yaw: float, rng: Rng
) -> tuple[TargetState, ...]:
    """Put most figures in front of the camera, where there is room, and the others anywhere."""
    states: list[TargetState] = []
    taken: list[tuple[float, float, float]] = []
    for target, track in zip(world.targets, tracks, strict=True):
        if not isinstance(target, FigureTarget):
            states.append(track.at(float(rng.uniform(0.0, 10.0))))
            continue
        radius = 1.4 if target.shape == "car" else 0.35
        seen = rng.random() < 0.7
        heading = x = y = 0.0
        for _ in range(40):
            heading = float(rng.uniform(-math.pi, math.pi))
            if seen:
                nearest = _NEAREST_M + radius
                near = float(np.exp(rng.uniform(math.log(nearest), math.log(_NEAR_M))))
                away = near if rng.random() < 0.65 else float(rng.uniform(_NEAR_M, _FAR_M))
                bearing = yaw + float(rng.uniform(-0.65, 0.65))
                x, y = float(camera[0] + away * math.cos(bearing)), float(camera[1] + away * math.sin(bearing))
            else:
                x, y = (float(part) for part in rng.uniform(-0.5, 0.5, 2) * world.room.size_m[:2])
            far = math.hypot(x - camera[0], y - camera[1]) > radius + 0.5
            if (
                far
                and _free(target, x, y, heading, solids)
                and all(math.hypot(x - a, y - b) > radius + r for a, b, r in taken)
            ):
                break
        else:
            x, y = 500.0, 500.0  # there is no room for the figure
        taken.append((x, y, radius))
        walked = 0.0 if rng.random() < 0.3 else float(rng.uniform(0.0, 1.5))
        states.append(TargetState(target.name, 0.0, (x, y, 0.0), heading, (0.0, 0.0, 0.0), walked))
    return tuple(states)


def _free(target: FigureTarget, x: float, y: float, heading: float, solids: Solids) -> bool:
    if target.shape != "car":
        return bool(solids.clearance(np.array([[x], [y], [0.85]]), _PERSON)[0] > 0.0)
    along = np.array([-0.6, 0.6])
    points = np.array([x + along * math.cos(heading), y + along * math.sin(heading), [0.55, 0.55]])
    return bool(solids.clearance(points, np.repeat(_CAR, 2, axis=1)).min() > 0.0)
