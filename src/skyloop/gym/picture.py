"""A drone and its goal, drawn for a person."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import MissingExtraError

if TYPE_CHECKING:
    from skyloop.gym.arena import Arena

SIZE = (320, 240)
_FOCAL_PX = 260.0
_FROM = np.array([-5.5, -3.0, 3.2])  #: where the onlooker stands, from the middle of the first cell's floor [m]
_AT = np.array([0.0, 0.0, 1.8])  #: and what it looks at


class Picture:
    """Draws the first drone of an arena. Raises :class:`MissingExtraError` without OpenCV."""

    def __init__(self, arena: Arena) -> None:
        try:
            from skyloop.sim.camera import CameraModel, CameraPose
            from skyloop.sim.render import PlanarRenderer, Scene, SceneState
        except ImportError:
            raise MissingExtraError("drawing the simulator's world", "sim") from None
        width, height = SIZE
        self._arena = arena
        self._model = CameraModel("onlooker", width, height, 25.0, _FOCAL_PX, _FOCAL_PX, width / 2, height / 2)
        middle = np.array([*arena.centres[0], 0.0])
        self._pose: Any = CameraPose(middle + _FROM, look_at(_FROM, _AT))
        self._middle = middle
        self._state = SceneState
        self._renderer = PlanarRenderer(Scene(arena.world, arena.count))

    def draw(self, goal: NDArray[np.float64]) -> NDArray[np.uint8]:
        """RGB, shape (240, 320, 3), uint8; the goal, relative to the cell, is a red ring."""
        import cv2

        positions, rotations = self._arena.simulation.poses()
        image = self._renderer.render(self._state(positions, rotations), self._pose, self._model)
        x, y, depth = self._pose.rotation.T @ (goal + self._middle - self._pose.position_m)
        at = (round(self._model.cx + _FOCAL_PX * x / depth), round(self._model.cy + _FOCAL_PX * y / depth))
        cv2.circle(image, at, max(3, round(_FOCAL_PX * 0.2 / depth)), (40, 40, 230), 2, cv2.LINE_AA)
        return np.ascontiguousarray(image[:, :, ::-1])


def look_at(eye: NDArray[np.float64], target: NDArray[np.float64]) -> NDArray[np.float64]:
    """World from optical axes (x right, y down, z forward) of a camera that looks from one point at another."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward], axis=1)
