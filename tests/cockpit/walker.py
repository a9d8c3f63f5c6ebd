"""A person who walks away from a simulated drone, and the place for a page's box around them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from skyloop.messages import Feedback
from skyloop.messages.geometry import rotation_from_euler
from skyloop.sim import load_world
from skyloop.sim.camera import FRONT_CAMERA
from skyloop.sim.labels import Labeller
from skyloop.sim.render import Scene, SceneState
from skyloop.sim.targets import TargetTrack

Box = tuple[float, float, float, float]

#: The person goes to and fro before the start, 5 to 12 m away from it.
WORLD = """
[room]
size = [36, 24, 10]
floor = "grass"
enclosed = false

[[spawn]]
position = [-8, 0, 0]

[[box]]
name = "house"
stands_at = [12, 4]
size = [2, 12, 4]
texture = "brick"

[[target]]
name = "walker"
kind = "figure"
shape = "person"
look = 3
colour = "#c8282c"
path = { kind = "waypoints", points = [[-3, -0.4, 0], [6, -0.4, 0], [6, 0.6, 0], [-3, 0.6, 0]], speed = 0.7 }
"""


class Walker:
    """Write the world file; return its address, and the person's true place in it.

    Args:
        folder: The folder of the file.
        seed: The seed of the world.
    """

    def __init__(self, folder: Path, seed: int = 1) -> None:
        file = folder / "walker.toml"
        file.write_text(WORLD)
        world = load_world(str(file), seed)
        self.uri = f"sim://?world={file}&cameras=front&width={FRONT_CAMERA.width}&fps=15&wind=0&seed={seed}"
        self._scene = Scene(world, 0)
        self._tracks = [TargetTrack(one, world.seed, n) for n, one in enumerate(world.targets)]

    def box(self, state: Feedback) -> Box:
        """Return the person's box in the front camera's picture now: x, y, width, height [px]."""
        native: dict[str, Any] = dict(state.native or {})
        body = np.array([float(native[f"truth.{axis}"]) for axis in "xyz"])
        turn = rotation_from_euler(*(float(native[f"truth.{axis}"]) for axis in ("roll", "pitch", "yaw")))
        targets = tuple(track.at(float(native["sim.time_s"])) for track in self._tracks)
        scene = SceneState(np.zeros((0, 3)), np.zeros((0, 3, 3)), targets, 1.0)
        found = Labeller(self._scene).boxes(scene, FRONT_CAMERA.pose(body, turn), FRONT_CAMERA)
        x, y, width, height = next(one.box for one in found if one.name == "walker")
        return float(x), float(y), float(width), float(height)
