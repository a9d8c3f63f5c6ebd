"""A drone and its goal, drawn for a person who looks on; and what the drone's own camera sees."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import MissingExtraError

if TYPE_CHECKING:
    from skyloop.gym.arena import Arena

Floats = NDArray[np.float64]
#: Centre in the cell [m], normal (None: it faces the camera), radius [m].
Rings = Iterable[tuple[Floats, Floats | None, float]]

SIZE: Final = (320, 240)
ONBOARD_PX: Final = 64  #: edge of the pictures on board, if nothing else is asked for
_FOCAL_PX: Final = 260.0
_ONBOARD_FOCAL: Final = 40.0 / 64.0  # of the edge: 77° across
_FROM: Final = np.array([-5.5, -3.0, 3.2])  #: where the onlooker stands, from the middle of the first cell's floor [m]
_AT: Final = np.array([0.0, 0.0, 1.8])  #: and what it looks at
_EYE_M: Final = np.array([0.12, 0.0, 0.0])  # in front of its own body
_AHEAD: Final = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # body from optical axes
_RED: Final = (40, 40, 230)  # BGR
_LATER: Final = (40, 160, 230)  # of what is to be reached after it
_NEAREST_M: Final = 0.05
_TURN: Final = np.linspace(0.0, 2.0 * np.pi, 25)
_CIRCLE: Final = np.stack([np.cos(_TURN), np.sin(_TURN)], axis=1)  # (25, 2)


class _View:
    """Draws one drone of an arena, and rings, without the other drones: they fly in one world only to save time.

    Raises :class:`MissingExtraError` without OpenCV.
    """

    def __init__(self, arena: Arena, width: int, height: int, focal_px: float) -> None:
        try:
            from skyloop.sim.camera import CameraModel, CameraPose
            from skyloop.sim.render import PlanarRenderer, Scene, SceneState
        except ImportError:
            raise MissingExtraError("drawing the simulator's world", "sim") from None
        self.arena = arena  #: another one of as many drones may take its place: the world is the same
        self._model = CameraModel("view", width, height, 25.0, focal_px, focal_px, width / 2, height / 2)
        self._pose: Any = CameraPose
        self._state = SceneState
        self._renderer = PlanarRenderer(Scene(arena.world, 1))

    def render(self, drone: int, eye: Floats, rotation: Floats, rings: Rings) -> NDArray[np.uint8]:
        """RGB of shape (height, width, 3), uint8, from a point in world axes."""
        import cv2

        positions, rotations = self.arena.poses()
        alone = self._state(positions[drone : drone + 1], rotations[drone : drone + 1])
        image = self._renderer.render(alone, self._pose(eye, rotation), self._model)
        middle = np.array([*self.arena.centres[drone], 0.0])
        for number, (centre, normal, radius) in reversed(list(enumerate(rings))):
            points = _circle(centre + middle, rotation[:, 2] if normal is None else normal, radius)
            seen = (points - eye) @ rotation
            if (seen[:, 2] < _NEAREST_M).any():
                continue
            pixels = self._model.fx * seen[:, :2] / seen[:, 2:] + [self._model.cx, self._model.cy]
            corners = np.round(np.clip(pixels, -4096, 4096)).astype(np.int32)
            cv2.polylines(image, [corners], True, _LATER if number else _RED, 2, cv2.LINE_AA)
        return np.ascontiguousarray(image[:, :, ::-1])


class Picture(_View):
    """Draws the first drone of an arena for a person."""

    def __init__(self, arena: Arena) -> None:
        super().__init__(arena, *SIZE, _FOCAL_PX)

    def draw(self, rings: Rings) -> NDArray[np.uint8]:
        """RGB, shape (240, 320, 3), uint8; what to reach next is a red ring."""
        middle = np.array([*self.arena.centres[0], 0.0])
        return self.render(0, middle + _FROM, look_at(_FROM, _AT), rings)


class OnBoard(_View):
    """What the cameras of an arena's drones see ahead.

    Args:
        arena: The drones.
        size_px: Edge of the pictures.
    """

    def __init__(self, arena: Arena, size_px: int = ONBOARD_PX) -> None:
        super().__init__(arena, size_px, size_px, _ONBOARD_FOCAL * size_px)

    def draw(self, drone: int, rings: Rings) -> NDArray[np.uint8]:
        """RGB, shape (size, size, 3), uint8; what to reach next is a red ring."""
        positions, rotations = self.arena.poses()
        rotation = rotations[drone]
        return self.render(drone, positions[drone] + rotation @ _EYE_M, rotation @ _AHEAD, rings)


def _circle(centre: Floats, normal: Floats, radius: float) -> Floats:
    """Points of a circle round a normal, shape (25, 3)."""
    x, y, z = normal.tolist()
    level = abs(z) < 0.9
    aside = np.array([y, -x, 0.0] if level else [0.0, z, -y]) / math.hypot(*((x, y) if level else (y, z)))
    a, b, c = aside.tolist()
    points: Floats = centre + radius * (_CIRCLE @ np.array([aside, [y * c - z * b, z * a - x * c, x * b - y * a]]))
    return points


def look_at(eye: Floats, target: Floats) -> Floats:
    """World from optical axes (x right, y down, z forward) of a camera that looks from one point at another."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward], axis=1)
