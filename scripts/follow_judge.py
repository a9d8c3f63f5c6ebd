"""What is true of a simulated target in a frame: its box, whether it is hidden, and whether the frame shows it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skyloop.messages import Feedback
from skyloop.messages.geometry import rotation_from_euler
from skyloop.sim.camera import FRONT_CAMERA, CameraModel
from skyloop.sim.labels import Labeller, TargetBox
from skyloop.sim.render import Scene, SceneState
from skyloop.sim.targets import TargetTrack
from skyloop.sim.world import World
from skyloop.vision.tracking import Box, overlap

Array = NDArray[np.float64]

HIDDEN = 0.25  #: share of a target that is to be seen at least: else it counts as hidden
_MIDDLE = {"person": 0.9, "car": 0.6}  # heights that a camera is aimed at


@dataclass(frozen=True, slots=True)
class Truth:
    """What is true at the capture of one frame."""

    boxes: tuple[TargetBox, ...]  #: of everything in the image
    hidden: bool  #: something stands before the target, wherever the camera looks
    in_view: bool  #: the image shows the target's middle, and it is not hidden
    distance_m: float  #: horizontal, from the vehicle's centre

    def shown_as(self, box: Box) -> str | None:
        """Return the name of what a box shows best; None if it is nothing that is known."""
        best = max(self.boxes, key=lambda one: overlap(one.box, box), default=None)
        return None if best is None or overlap(best.box, box) < 0.3 else best.name


class Judge:
    """Knows the truth of one target of a world.

    Args:
        world: The world that is flown in.
        target: The target's name.
        camera: Of the vehicle.
    """

    def __init__(self, world: World, target: str, camera: CameraModel = FRONT_CAMERA) -> None:
        self._tracks = [TargetTrack(one, world.seed, n) for n, one in enumerate(world.targets)]
        self._number = [one.name for one in world.targets].index(target)
        self._labeller = Labeller(Scene(world, 0))
        self._camera = camera
        self._name = target
        self._middle = _MIDDLE[getattr(world.targets[self._number], "shape", "person")]

    def at(self, state: Feedback, captured_ns: int) -> Truth:
        """Return the truth at a capture, from the state reported nearest to it."""
        native = state.native
        assert native is not None

        def number(name: str) -> float:
            return float(native[name])  # type: ignore[arg-type]

        late_s = (captured_ns - state.captured_ns) / 1e9
        time_s = max(0.0, number("sim.time_s") + late_s)
        body = np.array([number(f"truth.{a}") + late_s * number(f"truth.v{a}") for a in "xyz"])
        turn = rotation_from_euler(number("truth.roll"), number("truth.pitch"), number("truth.yaw"))
        targets = tuple(track.at(time_s) for track in self._tracks)
        scene = SceneState(np.zeros((0, 3)), np.zeros((0, 3, 3)), targets, 1.0)
        place = np.array(targets[self._number].position_m) + np.array([0.0, 0.0, self._middle])
        model = self._camera
        pose = model.pose(body, turn)
        ray = pose.rotation.T @ (place - pose.position_m)
        shown = ray[2] > 0.1 and abs(ray[0] / ray[2]) < 0.5 * model.width / model.fx
        shown = bool(shown and abs(ray[1] / ray[2]) < 0.5 * model.height / model.fy)
        boxes = self._labeller.boxes(scene, pose, model)
        free = self._free(boxes)
        if not shown:  # what would a camera see that looks at it?
            free = self._free(self._labeller.boxes(scene, model.pose(body, _towards(place - body)), model))
        distance = math.hypot(place[0] - body[0], place[1] - body[1])
        return Truth(boxes, free < HIDDEN, shown and free >= HIDDEN, distance)

    def _free(self, boxes: tuple[TargetBox, ...]) -> float:
        """The share of the target that nothing hides."""
        return next((one.visible for one in boxes if one.name == self._name), 0.0)

    def box(self, truth: Truth) -> TargetBox | None:
        """The target's true box; None if it is not in the image."""
        return next((one for one in truth.boxes if one.name == self._name), None)


def _towards(way: Array) -> Array:
    return rotation_from_euler(0.0, -math.atan2(way[2], math.hypot(way[0], way[1])), math.atan2(way[1], way[0]))
