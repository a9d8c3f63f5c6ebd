"""Judge the following of a simulated person or car by the truth: for ``demo_follow.py``, ``follow_judge.py``."""

from __future__ import annotations

import math
import statistics
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from skyloop.cli.demo import channel_rows
from skyloop.client import ChannelStats, Frame
from skyloop.clock import NS_PER_S, nanoseconds
from skyloop.messages import Feedback
from skyloop.messages.geometry import rotation_from_euler
from skyloop.sim.camera import FRONT_CAMERA, CameraModel
from skyloop.sim.labels import Labeller, TargetBox
from skyloop.sim.render import Scene, SceneState
from skyloop.sim.targets import TargetTrack
from skyloop.sim.world import World
from skyloop.vision.tracking import Box, overlap

HIDDEN: Final = 0.25  #: a target with a smaller visible share counts as hidden
SETTLING_S: Final = 5.0  #: from the first sighting; the distance counts afterwards
_SHOWN: Final = 0.3  # overlap of a box with the true one
_MIDDLES_M: Final = {"person": 0.9, "car": 0.6}  # heights that a camera would be aimed at
_EACH: Final = 3  # every third frame is judged: rendering its truth takes a few milliseconds
_FOUND_PX: Final = (8.0, 24.0)  # minimum width and height of a person to point at


class TargetTruth:
    """The true people and cars of a simulated world in a camera's frames. For one thread.

    Args:
        world: The world of the flight.
        camera: The drone's camera.
    """

    def __init__(self, world: World, camera: CameraModel = FRONT_CAMERA) -> None:
        self._names = [target.name for target in world.targets]
        self._middles = [(0.0, 0.0, _MIDDLES_M.get(getattr(target, "shape", ""), 0.0)) for target in world.targets]
        self._tracks = [TargetTrack(target, world.seed, number) for number, target in enumerate(world.targets)]
        self._labeller = Labeller(Scene(world, 0))
        self._camera = camera

    def at(self, frame: Frame) -> FrameTruth | None:
        """Return the truth at a frame's capture; None if the vehicle did not report it."""
        return None if frame.feedback is None else self.at_capture(frame.feedback, frame.captured_ns)

    def at_capture(self, state: Feedback, captured_ns: int) -> FrameTruth | None:
        """Return the truth at a capture, from the state reported nearest to it; None without the truth."""
        known = _true_numbers(state)
        if known is None:
            return None
        place, scene = self._scene(known, captured_ns - state.captured_ns)
        model = self._camera
        turn = rotation_from_euler(known["truth.roll"], known["truth.pitch"], known["truth.yaw"])
        pose = model.pose(place, turn)
        distances, bearings, centred = {}, {}, set()
        for name, target, middle in zip(self._names, scene.targets, self._middles, strict=True):
            way = np.array(target.position_m) - place
            distances[name] = math.hypot(way[0], way[1])
            bearings[name] = math.remainder(math.atan2(way[1], way[0]) - known["truth.yaw"], math.tau)
            ray = pose.rotation.T @ (np.array(target.position_m) + middle - pose.position_m)
            across, down = 0.5 * model.width / model.fx, 0.5 * model.height / model.fy
            if ray[2] > 0.1 and abs(ray[0]) < across * ray[2] and abs(ray[1]) < down * ray[2]:
                centred.add(name)
        boxes = {box.name: box for box in self._labeller.boxes(scene, pose, model)}
        return FrameTruth(boxes, distances, bearings, frozenset(centred))

    def visible_if_aimed(self, state: Feedback, captured_ns: int, name: str) -> float:
        """Return the visible share of a target, 0 to 1, if the camera were turned to it."""
        known = _true_numbers(state)
        if known is None:
            return 0.0
        place, scene = self._scene(known, captured_ns - state.captured_ns)
        number = self._names.index(name)
        way = np.array(scene.targets[number].position_m) + self._middles[number] - place
        pitch = -math.atan2(way[2], math.hypot(way[0], way[1]))
        pose = self._camera.pose(place, rotation_from_euler(0.0, pitch, math.atan2(way[1], way[0])))
        return next((box.visible for box in self._labeller.boxes(scene, pose, self._camera) if box.name == name), 0.0)

    def _scene(self, known: dict[str, float], late_ns: int) -> tuple[NDArray[np.float64], SceneState]:
        """Return the vehicle's place, (3,) [m], and everything that moves."""
        late_s = late_ns / NS_PER_S
        place = np.array([known[f"truth.{axis}"] + late_s * known[f"truth.v{axis}"] for axis in "xyz"])
        targets = tuple(track.at(max(0.0, known["sim.time_s"] + late_s)) for track in self._tracks)
        return place, SceneState(np.zeros((0, 3)), np.zeros((0, 3, 3)), targets, 1.0)


def _true_numbers(state: Feedback) -> dict[str, float] | None:
    known = {name: value for name, value in (state.native or {}).items() if isinstance(value, int | float)}
    return known if known.keys() >= {"sim.time_s", "truth.x", "truth.yaw"} else None


@dataclass(frozen=True, slots=True)
class FrameTruth:
    """The truth at the capture of one frame."""

    boxes: dict[str, TargetBox]  #: of everything in the image, by name
    distances_m: dict[str, float]  #: horizontal, of each target
    bearings_rad: dict[str, float]  #: of each target, counter-clockwise from straight ahead
    in_image: frozenset[str]  #: targets with their centre in the image, occluded or not

    def hidden(self, name: str) -> bool:
        """Return whether something in the image occludes a target."""
        return name in self.in_image and (name not in self.boxes or self.boxes[name].visible < HIDDEN)

    def shown_in(self, box: Box) -> str | None:
        """Return the name of the best match of a box; None if nothing known matches."""
        best = max(self.boxes.values(), key=lambda one: overlap(one.box, box), default=None)
        return None if best is None or overlap(best.box, box) < _SHOWN else best.name

    def nearest_person(self) -> TargetBox | None:
        """Return the largest person completely in the image, not occluded, and large enough to point at."""
        people = [
            one
            for one in self.boxes.values()
            if one.class_name == "person"
            and not one.cut
            and one.visible > 0.9
            and min(one.box[2] / _FOUND_PX[0], one.box[3] / _FOUND_PX[1]) >= 1.0
        ]
        return max(people, key=lambda one: one.box[3], default=None)


@dataclass(slots=True)
class FollowReport:
    """The figures of following, and their table.

    Attributes:
        way: How the target was found in the frames: ``detector`` or ``looks``.
        target: Name, in its world, of the person followed; None: none was found.
        distance_m: The horizontal distance to keep.
    """

    way: str
    distance_m: float
    target: str | None = None
    frames: int = 0  #: judged since the first sighting, without those with the target occluded
    in_view: int = 0  #: of these, those with the target in the image
    found: int = 0  #: of these, those with the follower's box on it
    others: int = 0  #: frames with the box on anything else
    times_lost: int = 0
    errors_m: list[float] = field(default_factory=list)  #: true minus desired distance, once settled
    collisions: int = 0
    first_picture_s: float | None = None  #: from the start of the demo
    channels: dict[str, ChannelStats] = field(default_factory=dict)
    _seen: int = 0
    _first_ns: int | None = None
    _phase: StrEnum | None = None

    def judge(self, frame: Frame, truth: TargetTruth, box: Box | None) -> None:
        """Count every third frame.

        Args:
            frame: The newest.
            truth: The truth of its world.
            box: The target's box by the follower; None: not found.
        """
        self._seen += 1
        if self._seen % _EACH or (self.target is None and box is None):
            return
        true = truth.at(frame)
        if true is None:
            return
        shown = None if box is None else true.shown_in(box)
        if self.target is None:
            if shown is None:
                return
            self.target, self._first_ns = shown, frame.captured_ns
        self.count(true, shown, frame.captured_ns)

    def count(self, true: FrameTruth, shown: str | None, captured_ns: int) -> None:
        """Count a frame with known truth, and the true content of the follower's box."""
        assert self.target is not None
        self.others += shown is not None and shown != self.target
        if true.hidden(self.target):
            return
        self.frames += 1
        self.in_view += self.target in true.in_image
        self.found += shown == self.target
        if self._first_ns is None:
            self._first_ns = captured_ns
        if captured_ns - self._first_ns >= nanoseconds(SETTLING_S):
            self.errors_m.append(true.distances_m[self.target] - self.distance_m)

    def enter(self, phase: StrEnum, losses: frozenset[StrEnum]) -> None:
        """Record the present phase: each stretch without sight counts as one loss."""
        if phase in losses and self._phase is not None and self._phase not in losses:
            self.times_lost += 1
        self._phase = phase

    @property
    def share_in_view(self) -> float | None:
        """Share of the frames without occlusion; None: no one was found."""
        return self.in_view / self.frames if self.frames else None

    def good(self, enough: float) -> bool:
        """Return whether a person was found, and in view for at least this share of the frames since."""
        return self.share_in_view is not None and self.share_in_view >= enough

    def verdict(self, enough: float) -> str:
        """Return the reason for a bad result."""
        if self.share_in_view is None:
            return "no one was found"
        return f"the target was in view in {self.share_in_view:.1%} of the frames, less than {enough:.0%}"

    def figures(self) -> dict[str, object]:
        """Return the figures for programs."""
        off = sorted(map(abs, self.errors_m))
        return {
            "way": self.way,
            "target": self.target,
            "distance_m": self.distance_m,
            "frames": self.frames,
            "share_in_view": self.share_in_view,
            "share_found": self.found / self.frames if self.frames else None,
            "frames_on_others": self.others,
            "times_lost": self.times_lost,
            "distance_median_m": self.distance_m + statistics.median(self.errors_m) if off else None,
            "distance_error_median_m": statistics.median(off) if off else None,
            "distance_error_p95_m": off[int(0.95 * (len(off) - 1))] if off else None,
            "collisions": self.collisions,
            "first_picture_s": self.first_picture_s,
            "channels": self.channels,
        }

    def table(self) -> Table:
        """Return the figures for the terminal."""
        table = Table(title="The flight", title_justify="left", show_header=False, box=None)
        told = self.figures()
        rows = [("followed", "no one was found" if self.target is None else f"{self.target}, by {self.way}")]
        if self.frames:
            rows += [
                ("in view, truly", f"{told['share_in_view']:.1%} of {self.frames} frames in which nothing hides it"),
                ("found there", f"{told['share_found']:.1%}; something else was taken for it in {self.others}"),
                ("times lost", str(self.times_lost)),
            ]
        distance = "not known"
        if self.errors_m:
            distance = f"median {told['distance_median_m']:.2f} m, desired {self.distance_m:g} m"
            distance += f"; off by {told['distance_error_median_m']:.2f} m, 95 % within "
            distance += f"{told['distance_error_p95_m']:.2f} m (after the first {SETTLING_S:g} s)"
        rows += [("distance, truly", distance), ("collisions", str(self.collisions))]
        if self.first_picture_s is not None:
            rows.append(("first frame after", f"{self.first_picture_s:.1f} s"))
        for name, channel in self.channels.items():
            rows += channel_rows(name, channel)
        for row in rows:
            table.add_row(*row)
        return table
