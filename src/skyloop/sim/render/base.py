"""The renderer's input and output, and an import of OpenCV with a clear error if it is not installed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import MissingExtraError
from skyloop.sim.world import TargetState

try:
    import cv2
except ImportError as error:
    raise MissingExtraError("the simulator", "sim", cause=str(error)) from error

__all__ = ["Image", "SceneState", "cv2"]

Image = NDArray[np.uint8]  # BGR, shape (height, width, 3)


@dataclass(frozen=True, slots=True, eq=False)
class SceneState:
    """The poses of all moving objects at a point in time.

    The renderer may cache results for as long as it receives the same state object, so don't write to a state's arrays
    afterwards.
    """

    drone_positions_m: NDArray[np.float64]  #: positions of the bodies' origins in world axes, shape (n, 3)
    drone_rotations: NDArray[np.float64]  #: world from body, shape (n, 3, 3)
    targets: tuple[TargetState, ...] = ()  #: one state for each target in the world, in the world's order
    #: Brightness of the whole image, where 1 is full. See :class:`~skyloop.sim.world.Light`.
    light: float = 1.0
