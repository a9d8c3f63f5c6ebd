"""A short film of a recorded flight of simulated drones: an onlooker's view of their world with the paths flown so far,
and in a corner a drone's own camera with the drawings on it."""

from __future__ import annotations

import bisect
import itertools
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray
from pictures import draw
from PIL import Image

from skyloop.messages import Annotation, Feedback, Text
from skyloop.recording.layout import Channel
from skyloop.recording.reader import Recording
from skyloop.sim import load_world
from skyloop.sim.camera import CameraModel, CameraPose, look_at
from skyloop.sim.render import PlanarRenderer, Quality, Scene, SceneState
from skyloop.sim.world import TargetState, Vec3

WIDTH, HEIGHT = 480, 270
INSET = (160, 120)
FRAMES, FPS = 40, 8
DRAWN_NS = 400_000_000  # maximum age of a picture shown for its drawings
BACKDROP = (72, 64, 58)  # BGR, around a room seen from outside
WAYS = ((246, 130, 59), (22, 115, 249), (94, 197, 34))  # BGR, one per drone
Picture = NDArray[np.uint8]
Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class View:
    """An onlooker's position and world. World axes [m]."""

    world: str = "room"
    eye: Vec3 = (-3.8, -2.8, 2.6)
    at: Vec3 = (0.6, 0.4, 0.9)
    focal_px: float = 300.0

    @property
    def pose(self) -> CameraPose:
        eye = np.array(self.eye)
        return CameraPose(eye, look_at(eye, np.array(self.at)))

    @property
    def lens(self) -> CameraModel:
        focal = self.focal_px
        return CameraModel("onlooker", WIDTH, HEIGHT, 30.0, focal, focal, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)

    def pixels(self, points: Array) -> Array:
        """Project points (n, 3) to pixels (n, 2); NaN for those behind the onlooker."""
        right, down, ahead = self.pose.rotation.T @ (points - np.array(self.eye)).T
        ahead = np.where(ahead > 0.05, ahead, np.nan)
        return np.column_stack([WIDTH / 2 + self.focal_px * right / ahead, HEIGHT / 2 + self.focal_px * down / ahead])

    def outside(self) -> NDArray[np.bool_]:
        """Return the pixels beyond the room for an onlooker outside; none for one inside."""
        size = np.array(load_world(self.world).room.size_m)
        low, high = size * (-0.5, -0.5, 0.0), size * (0.5, 0.5, 1.0)
        if (low < self.eye).all() and (self.eye < high).all():
            return np.zeros((HEIGHT, WIDTH), np.bool_)
        corners = self.pixels(np.array(list(itertools.product(*zip(low, high, strict=True)))))
        inside = np.zeros((HEIGHT, WIDTH), np.uint8)
        cv2.fillConvexPoly(inside, cv2.convexHull(np.round(corners).astype(np.int32)), 1)
        return np.equal(inside, 0)


@dataclass(frozen=True, slots=True)
class Sight:
    """A picture from a drone's camera."""

    picture: Picture
    drawing: Annotation | None  # the drawings on it


@dataclass(slots=True)
class Track:
    """One drone's true states during the recording."""

    states: list[Feedback]
    times_s: list[float]
    annotations: dict[int, Annotation] = field(default_factory=dict)

    @classmethod
    def of(cls, recording: Recording, drone: str, begin_ns: int) -> Track:
        states = [item.value for item in recording.items(drone, (Channel.FEEDBACK,))]
        states = [one for one in states if one.native and "truth.x" in one.native]
        drawn = {item.value.captured_ns: item.value for item in recording.items(drone, (Channel.ANNOTATIONS,))}
        return cls(states, [(one.captured_ns - begin_ns) / 1e9 for one in states], drawn)

    def index(self, time_s: float) -> int:
        return max(0, bisect.bisect(self.times_s, time_s) - 1)

    def way(self, end_s: float) -> Array:
        """Return its path until then, ten times a second, (n, 3)."""
        times = np.arange(0.0, end_s, 0.1)
        return np.array([place(self.states[self.index(time)]) for time in times]).reshape(-1, 3)


def film(
    path: Path, view: View, *, owners: bool = False, captions: bool = False, after_s: float = 0.0
) -> list[Picture]:
    """Return the pictures of a film, from the first take-off until ``after_s`` after the last landing. ``owners``:
    write the pilot's name at each drone; ``captions``: move text from the camera's picture to the lower edge, where
    there is room for it."""
    recording = Recording.open(path)
    names = [drone.name for drone in recording.drones]
    begin_ns, end_ns = span_ns(recording, after_s)
    tracks = [Track.of(recording, name, begin_ns) for name in names]
    times = np.linspace(0.0, (end_ns - begin_ns) / 1e9, FRAMES)
    renderer = PlanarRenderer(Scene(load_world(view.world), len(tracks)), Quality.SMOOTH)
    outside = view.outside()
    sights = _sights(recording, names[0], tracks[0], begin_ns, times)
    shown = []
    for time, sight in zip(times, sights, strict=True):
        now = [track.states[track.index(time)] for track in tracks]
        state = SceneState(
            np.array([place(one) for one in now]), np.array([_rotation(one) for one in now]), _targets(view, now[0])
        )
        canvas = renderer.render(state, view.pose, view.lens)
        canvas[outside] = BACKDROP
        for number, track in enumerate(tracks):
            _way(canvas, view.pixels(track.way(time)), WAYS[number % len(WAYS)])
            if owners:
                _label(canvas, view.pixels(place(now[number])[None])[0], now[number].owner or "nobody")
        if sight is not None:
            _inset(canvas, sight, captions)
        shown.append(canvas)
    return shown


def span_ns(recording: Recording, after_s: float = 0.0) -> tuple[int, int]:
    """Return the span from the first take-off until ``after_s`` after the last landing, on the proxies' clock [ns]."""
    airborne = [
        item.value.captured_ns
        for drone in recording.drones
        for item in recording.items(drone.name, (Channel.FEEDBACK,))
        if item.value.state.airborne
    ]
    return min(airborne), max(airborne) + round(after_s * 1e9)


def save(path: Path, pictures: list[Picture], most_bytes: int) -> None:
    """Write an animated WebP, in the best quality within ``most_bytes``."""
    images = [Image.fromarray(np.ascontiguousarray(picture[:, :, ::-1])) for picture in pictures]
    path.parent.mkdir(parents=True, exist_ok=True)
    for quality in (70, 55, 40, 25, 10):
        images[0].save(
            path, save_all=True, append_images=images[1:], duration=1000 // FPS, loop=0, quality=quality, method=4
        )
        if path.stat().st_size <= most_bytes:
            print(f"{path.name}: {len(images)} pictures, quality {quality}, {path.stat().st_size:,} bytes")
            return
    raise SystemExit(f"{path.name} has {path.stat().st_size:,} bytes, more than {most_bytes:,}")


# Inside ---------------------------------------------------------------------------------------------------------------


def place(state: Feedback) -> Array:
    """Return its true place, (3,)."""
    return np.array([_native(state, f"truth.{axis}") for axis in "xyz"])


def _native(state: Feedback, name: str) -> float:
    value: Any = (state.native or {})[name]
    return float(value)


def _rotation(state: Feedback) -> Array:
    """Return the rotation from body to world, (3, 3)."""
    (cr, sr), (cp, sp), (cy, sy) = (
        (math.cos(angle), math.sin(angle))
        for angle in (_native(state, f"truth.{name}") for name in ("roll", "pitch", "yaw"))
    )
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def _targets(view: View, state: Feedback) -> tuple[TargetState, ...]:
    found = []
    for number, target in enumerate(load_world(view.world).targets, 1):
        name = "truth.target" if number == 1 else f"truth.target{number}"
        x, y, z, yaw = (_native(state, f"{name}.{axis}") for axis in ("x", "y", "z", "yaw"))
        found.append(TargetState(target.name, 0.0, (x, y, z), yaw, (0.0, 0.0, 0.0)))
    return tuple(found)


def _sights(recording: Recording, drone: str, track: Track, begin_ns: int, times: Array) -> list[Sight | None]:
    """Return the first camera's picture at each time; None each without a camera."""
    cameras = recording.cameras(drone)
    if not cameras:
        return [None] * len(times)
    shown: list[Sight | None] = []
    newest: Sight | None = None
    for picture in recording.pictures(drone, cameras[0]):
        while len(shown) < len(times) and (picture.header.captured_ns - begin_ns) / 1e9 > times[len(shown)]:
            shown.append(newest)
        if len(shown) == len(times):
            break
        captured_ns = picture.header.captured_ns
        drawing = track.annotations.get(captured_ns)
        # Busy controllers skip pictures: keep the last one with drawings a little longer.
        if drawing or not (newest and newest.drawing) or captured_ns - newest.drawing.captured_ns > DRAWN_NS:
            newest = Sight(picture.pixels(), drawing)
    return shown + [newest] * (len(times) - len(shown))


def _inset(canvas: Picture, sight: Sight, captions: bool) -> None:
    """Draw the camera's picture in the upper right corner. ``captions``: its drawing's text goes to the lower edge."""
    drawing = sight.drawing
    if drawing is not None and captions:
        words = [shape.text for shape in drawing.shapes if isinstance(shape, Text)]
        drawing = replace(drawing, shapes=tuple(shape for shape in drawing.shapes if not isinstance(shape, Text)))
        if words:
            _caption(canvas, ", ".join(words))
    small = cv2.resize(draw(sight.picture, drawing), INSET, interpolation=cv2.INTER_AREA)
    canvas[8 : 8 + INSET[1], WIDTH - 8 - INSET[0] : WIDTH - 8] = small
    cv2.rectangle(canvas, (WIDTH - 9 - INSET[0], 7), (WIDTH - 8, 8 + INSET[1]), (255, 255, 255), 1)


def _way(canvas: Picture, pixels: Array, colour: tuple[int, int, int]) -> None:
    seen = pixels[np.isfinite(pixels).all(axis=1)]
    line = np.round(seen * 16).astype(np.int32)
    cv2.polylines(canvas, [line], False, colour, 2, cv2.LINE_AA, 4)


def _caption(canvas: Picture, text: str) -> None:
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.42, 1)
    cv2.rectangle(canvas, (8, HEIGHT - 18 - height), (18 + width, HEIGHT - 8), (40, 40, 40), -1)
    cv2.putText(canvas, text, (13, HEIGHT - 14), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (255, 255, 255), 1, cv2.LINE_AA)


def _label(canvas: Picture, at: Array, text: str) -> None:
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.5, 1)
    x, y = round(at[0]) - width // 2, round(at[1]) - 22
    cv2.rectangle(canvas, (x - 5, y - height - 5), (x + width + 5, y + 5), (40, 40, 40), -1)
    cv2.putText(canvas, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
