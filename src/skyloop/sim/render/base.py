"""The seam between a simulation and what draws it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from skyloop.sim.camera import CameraModel, CameraPose
from skyloop.sim.world import TargetState

Image = NDArray[np.uint8]  # BGR, shape (height, width, 3)


@dataclass(frozen=True, slots=True, eq=False)
class SceneState:
    """Where everything that moves is at one instant. A renderer may keep what it made of a state for as long as it is
    shown the same object, so a state's arrays must not be written to afterwards.

    ``drone_positions_m``: of the bodies' origins, world axes, shape (n, 3). ``drone_rotations``: world from body,
    shape (n, 3, 3). ``targets``: one for each target of the world, in the world's order.
    """

    drone_positions_m: NDArray[np.float64]
    drone_rotations: NDArray[np.float64]
    targets: tuple[TargetState, ...] = ()


class Renderer(Protocol):
    """Draws what an ideal sensor behind a camera's lens sees: with its distortion, without noise, blur or vignetting
    (those are :class:`~skyloop.sim.render.effects.SensorEffects`).

    A renderer may keep buffers between calls: use one in one thread at a time.
    """

    def render(self, state: SceneState, pose: CameraPose, model: CameraModel, out: Image | None = None) -> Image:
        """The picture as BGR, shape (model.height, model.width, 3); written into ``out`` where one is given."""
        ...
