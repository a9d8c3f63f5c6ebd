"""True image boxes of objects in a camera's view, with their visible fractions, for training, tests and benchmarks.

The boxes use the same geometry as the renderer, without colours: one map gives the target or crate visible at each
pixel, the other the pixels that each would cover if nothing occluded it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import UsageError
from skyloop.messages.geometry import rotation_from_euler
from skyloop.sim.camera import CameraModel, CameraPose
from skyloop.sim.render import PlanarRenderer, Scene, SceneState
from skyloop.sim.render.painter import Raster
from skyloop.sim.render.quads import Image
from skyloop.sim.render.shading import DepthBuffer, visible_quads
from skyloop.sim.solids import Solids
from skyloop.sim.streams import Purpose, stream
from skyloop.sim.targets import TargetTrack
from skyloop.sim.world import FigureTarget, TargetState, World

CLASS_NAMES = ("person", "car", "box")  #: label classes; boards and platforms have none
_CLEAR_M = 0.35  # minimum distance between a camera and solids
_LONGEST_STEP_S = 20.0  # maximum time between two images from ``pictures``; tracks keep only 60 s


@dataclass(frozen=True, slots=True)
class TargetBox:
    """An object's box in an image."""

    name: str  #: name of the target or box in the world
    class_name: str  #: ``person``, ``car``, ``box`` for a crate, ``board`` or ``platform``
    #: x, y of the upper left corner, width and height [px] of the object's whole extent within the image
    box: tuple[int, int, int, int]
    visible: float  #: fraction of the object's pixels within the image that are not occluded, 0 to 1
    cut: bool  #: whether the object touches the outermost pixels, in which case the image's edge may cut it off


class Labeller:
    """Finds the bounding boxes in a scene. It reuses buffers, so use it from one thread at a time."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        world = scene.world
        self._things: list[tuple[str, str, NDArray[np.bool_]]] = []
        for number, target in enumerate(world.targets):
            # BoardTarget is a board, and PlatformTarget a platform.
            kind = target.shape if isinstance(target, FigureTarget) else type(target).__name__[:-6].lower()
            self._things.append((target.name, kind, scene.target_of == number))
        for number, box in enumerate(world.boxes):
            if box.texture == "crate" and box.colour is None:
                self._things.append((box.name, "box", scene.box_of == number))

    def boxes(self, state: SceneState, pose: CameraPose, model: CameraModel) -> tuple[TargetBox, ...]:
        """Return the box of every target and crate with a pixel in the image, even if hidden; targets come first."""
        raster = Raster.of(model, 1)
        posed = self._scene.posed(state)
        shown = np.ones(len(posed.quads), np.bool_) if pose.drone is None else posed.drone != pose.drone
        buffer = DepthBuffer(raster.grid)
        view = visible_quads(posed.quads, shown, pose, raster.grid)
        buffer.draw(view, posed.quads.priority[view.index])
        numbers = np.append(-1, view.index)  # column 0 of the buffer is "nothing"
        seen = numbers[buffer.seen.reshape(-1)[raster.lookup]]
        in_view = np.zeros(len(posed.quads), np.bool_)
        in_view[view.index] = True
        found = []
        for name, class_name, quads in self._things:
            if not (in_view & quads).any():
                continue
            alone = visible_quads(posed.quads, quads, pose, raster.grid)
            buffer.draw(alone, posed.quads.priority[alone.index])
            whole = buffer.seen.reshape(-1)[raster.lookup] > 0
            count = int(whole.sum())
            if not count:
                continue
            free = int((whole & (seen >= 0) & quads[seen]).sum())
            rows, columns = np.nonzero(whole.reshape(model.height, model.width))
            x0, x1, y0, y1 = (int(v) for v in (columns.min(), columns.max(), rows.min(), rows.max()))
            cut = x0 == 0 or y0 == 0 or x1 == model.width - 1 or y1 == model.height - 1
            found.append(TargetBox(name, class_name, (x0, y0, x1 - x0 + 1, y1 - y0 + 1), free / count, cut))
        return tuple(found)


def pictures(
    world: World,  # the world
    seed: int,  # seed of the positions and times
    count: int,  # number of images to yield
    size: tuple[int, int] = (320, 240),  # width and height of the images [px]
    focal_share: float = 0.75,  # focal length as a fraction of the width
    *,
    # camera to use instead of ``size`` and ``focal_share``, but without its sensor's imperfections
    camera: CameraModel | None = None,
    tilt_rad: float | None = None,  # maximum random pitch and roll, in both directions
) -> Iterator[tuple[Image, tuple[TargetBox, ...]]]:
    """Yield labelled images of a world, captured from random positions at random times.

    Cameras are 0.7 to 3 m high and outside of solids; two thirds of them look roughly at a target. Pitch is at most 15°
    and roll is small, unless ``tilt_rad`` sets both.

    Raises:
        UsageError: An argument is out of its range, or the world has no room for a camera.
    """
    width, height = size
    if isinstance(count, bool) or not isinstance(count, int) or count < 0:
        raise UsageError(f"count must be a whole number of at least 0, not {count!r}")
    focal = focal_share * width
    model = camera or CameraModel("label", width, height, 30.0, focal, focal, (width - 1) / 2, (height - 1) / 2)
    if tilt_rad is not None and not 0.0 <= tilt_rad <= math.pi / 4:
        raise UsageError(f"tilt_rad must be from 0 to π/4, not {tilt_rad!r}")
    rng = stream(seed, Purpose.LABELS)
    tracks = tuple(TargetTrack(target, world.seed, n) for n, target in enumerate(world.targets))
    solids, scene = Solids(world, tracks), Scene(world, 0)
    renderer, labeller = PlanarRenderer(scene), Labeller(scene)
    time_s = 0.0
    for _ in range(count):
        time_s += float(rng.uniform(0.1, _LONGEST_STEP_S))
        targets = tuple(track.at(time_s) for track in tracks)
        solids.move(time_s)
        body, rotation = _camera(world, solids, targets, rng, tilt_rad)
        light = world.light.at(time_s, world.seed)
        state, pose = SceneState(np.zeros((0, 3)), np.zeros((0, 3, 3)), targets, light), model.pose(body, rotation)
        yield renderer.render(state, pose, model), labeller.boxes(state, pose, model)


def _camera(
    world: World, solids: Solids, targets: tuple[TargetState, ...], rng: np.random.Generator, tilt_rad: float | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    half_x, half_y, top = world.room.size_m[0] / 2, world.room.size_m[1] / 2, world.room.size_m[2]
    hull = np.full((3, 1), _CLEAR_M)
    for _ in range(1000):
        aim = targets[int(rng.integers(len(targets)))] if targets and rng.random() < 2 / 3 else None
        if aim is None:
            place = rng.uniform((-half_x, -half_y, 0.7), (half_x, half_y, min(3.0, top)))
        else:
            away, around = float(rng.uniform(1.5, 9.0)), float(rng.uniform(-math.pi, math.pi))
            x, y = aim.position_m[0] + away * math.cos(around), aim.position_m[1] + away * math.sin(around)
            place = np.array([x, y, float(rng.uniform(0.7, min(3.0, top)))])
        if float(solids.clearance(place[:, None], hull)[0]) <= 0.0:
            continue
        yaw = float(rng.uniform(-math.pi, math.pi))
        if aim is not None:
            yaw = math.atan2(aim.position_m[1] - place[1], aim.position_m[0] - place[0]) + float(rng.normal(0.0, 0.25))
        pitch, roll = float(rng.uniform(-0.12, 0.26)), float(rng.normal(0.0, 0.05))
        if tilt_rad is not None:
            pitch, roll = (float(angle) for angle in rng.uniform(-tilt_rad, tilt_rad, 2))
        return place, rotation_from_euler(roll, pitch, yaw)
    raise UsageError(f"world {world.name!r} has no free position for a camera between 0.7 and 3 m")
