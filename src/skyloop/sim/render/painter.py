"""What draws a picture, whoever does the work."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from skyloop.sim.camera import CameraModel, CameraPose
from skyloop.sim.render.atlas import Atlas
from skyloop.sim.render.base import Image
from skyloop.sim.render.quads import Quads
from skyloop.sim.render.raster import Raster
from skyloop.sim.render.shadows import Placed


class Painter(ABC):
    """Draws through one lens. Holds buffers, so it is for one thread at a time.

    Args:
        raster: Of the lens.
        model: The lens.
        atlas: Textures of what is drawn.
    """

    def __init__(self, raster: Raster, model: CameraModel, atlas: Atlas) -> None:
        self.raster = raster
        self.atlas = atlas
        self.pixel_area = 1.0 / (model.fx * model.fy)

    @abstractmethod
    def paint(
        self, quads: Quads, shown: NDArray[np.bool_], shadows: list[Placed], pose: CameraPose, picture: Image
    ) -> None:
        """Draw a picture.

        Args:
            quads: Of the scene.
            shown: Which of them are drawn at all, (n,).
            shadows: What is darkened.
            pose: Of the camera.
            picture: Is written: BGR, (height, width, 3), in one piece.
        """
