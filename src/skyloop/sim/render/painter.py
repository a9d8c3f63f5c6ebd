"""How a picture comes about, whoever does the work of each step."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from skyloop.sim.camera import CameraModel, CameraPose
from skyloop.sim.render.atlas import Atlas
from skyloop.sim.render.base import Image
from skyloop.sim.render.opencv import cv2
from skyloop.sim.render.quads import Quads
from skyloop.sim.render.raster import Raster
from skyloop.sim.render.shadows import Placed

Singles = NDArray[np.float32]


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
        self._colours = np.empty((model.height, model.width, 4), np.uint8)
        self._inverse_depth = np.empty((model.height, model.width), np.float32)

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
        rays, colours = self.raster.rays, self._colours.reshape(-1, 4)
        seen, table = self.find(quads, shown, pose)
        numbers, mixed = self.resolve(seen)
        self.shade(table, numbers, rays.x.reshape(-1), rays.y.reshape(-1), colours, self._inverse_depth.reshape(-1))
        if len(mixed):
            self._smooth(seen, table, mixed, colours)
        cv2.cvtColor(self._colours, cv2.COLOR_BGRA2BGR, dst=picture)
        for shadow in shadows:
            self.darken(picture, shadow, self._inverse_depth)

    def _smooth(
        self, seen: NDArray[np.int32], table: Singles, pixels: NDArray[np.int32], colours: NDArray[np.uint8]
    ) -> None:
        """Colour all samples of pixels whose samples see different quads, and average them."""
        raster = self.raster
        places = raster.lookup[:, pixels].reshape(-1)
        row = places // raster.grid.width
        ray_x, ray_y = raster.sample_x[places - row * raster.grid.width], raster.sample_y[row]
        samples = np.empty((len(places), 4), np.uint8)
        self.shade(table, seen[places], ray_x, ray_y, samples, np.empty(len(places), np.float32))
        count = len(raster.lookup)
        total = samples.reshape(count, -1, 4).sum(axis=0, dtype=np.uint16)
        colours[pixels] = total + count // 2 >> 2  # the mean of four

    @abstractmethod
    def find(self, quads: Quads, shown: NDArray[np.bool_], pose: CameraPose) -> tuple[NDArray[np.int32], Singles]:
        """Return which column of a table each sample on the grid shows, flat, and the table: see ``sampling_table``."""

    @abstractmethod
    def resolve(self, seen: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Return the column of each pixel's first sample, (pixels,), and the pixels whose samples differ."""

    @abstractmethod
    def shade(
        self,
        table: Singles,
        numbers: NDArray[np.int32],
        ray_x: Singles,
        ray_y: Singles,
        colours: NDArray[np.uint8],
        inverse_depth: Singles,
    ) -> None:
        """Write the colours and inverse depths of samples.

        Args:
            table: Of :meth:`find`.
            numbers: The table's column for each sample, (n,).
            ray_x: x of the ray (x, y, 1), (n,).
            ray_y: y of the ray, (n,).
            colours: Is written: BGR and something, (n, 4).
            inverse_depth: Is written [1/m], (n,).
        """

    @abstractmethod
    def darken(self, picture: Image, shadow: Placed, inverse_depth: Singles) -> None:
        """Darken the pixels that show a shadow's place; inverse_depth: of each pixel [1/m], (height, width)."""
