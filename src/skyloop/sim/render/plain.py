"""Drawing with NumPy and OpenCV alone, for wherever nothing is compiled, and until it is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from skyloop.sim.camera import CameraModel, CameraPose
from skyloop.sim.render.atlas import Atlas
from skyloop.sim.render.base import Image
from skyloop.sim.render.opencv import cv2
from skyloop.sim.render.painter import Painter
from skyloop.sim.render.quads import Quads
from skyloop.sim.render.raster import Raster
from skyloop.sim.render.shading import Shader, sampling_table
from skyloop.sim.render.shadows import Placed, darken
from skyloop.sim.render.visibility import DepthBuffer, visible_quads


class PlainPainter(Painter):
    """Draws with NumPy and OpenCV; see :class:`Painter`."""

    def __init__(self, raster: Raster, model: CameraModel, atlas: Atlas) -> None:
        super().__init__(raster, model, atlas)
        self._shader = Shader(atlas)
        self._buffer = DepthBuffer(raster.grid)
        # From a pixel's first sample to all of them.
        self._steps = (0, 1, raster.grid.width, raster.grid.width + 1)[: raster.samples]
        self._numbers = np.empty((raster.samples, len(raster.lookup)), np.int32)
        self._colours = np.empty((model.height, model.width, 4), np.uint8)
        self._inverse_depth = np.empty((model.height, model.width), np.float32)

    def paint(
        self, quads: Quads, shown: NDArray[np.bool_], shadows: list[Placed], pose: CameraPose, picture: Image
    ) -> None:
        """See :meth:`Painter.paint`."""
        view = visible_quads(quads, shown, pose, self.raster.grid)
        self._buffer.draw(view, quads.priority[view.index])
        seen = self._buffer.seen.reshape(-1)
        table = sampling_table(quads, view, pose, self.atlas, self.pixel_area)
        numbers, mixed = self._resolve(seen)
        rays, colours = self.raster.rays, self._colours.reshape(-1, 4)
        flat_x, flat_y, inverse_depth = rays.x.reshape(-1), rays.y.reshape(-1), self._inverse_depth.reshape(-1)
        self._shader.shade(table, numbers, flat_x, flat_y, colours, inverse_depth)
        if len(mixed):
            self._smooth(seen, table, mixed, colours)
        cv2.cvtColor(self._colours, cv2.COLOR_BGRA2BGR, dst=picture)
        for shadow in shadows:
            darken(picture, shadow, rays, self._inverse_depth)

    def _resolve(self, seen: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.intp]]:
        """Return the table's column of each pixel's first sample, (pixels,), and the pixels whose samples differ."""
        raster, numbers = self.raster, self._numbers
        for k, step in enumerate(self._steps):
            np.take(seen[step:], raster.lookup, out=numbers[k], mode="clip")
        return numbers[0], np.flatnonzero((numbers[1:] != numbers[0]).any(axis=0))

    def _smooth(
        self, seen: NDArray[np.int32], table: NDArray[np.float32], pixels: NDArray[np.intp], colours: NDArray[np.uint8]
    ) -> None:
        """Colour all samples of pixels whose samples see different quads, and average them."""
        raster = self.raster
        places = (raster.lookup[pixels] + np.array(self._steps, dtype=np.int32)[:, None]).reshape(-1)
        row = places // raster.grid.width
        ray_x, ray_y = raster.sample_x[places - row * raster.grid.width], raster.sample_y[row]
        samples = np.empty((len(places), 4), np.uint8)
        self._shader.shade(table, seen[places], ray_x, ray_y, samples, np.empty(len(places), np.float32))
        total = samples.reshape(4, -1, 4).sum(axis=0, dtype=np.uint16)
        colours[pixels] = total + 2 >> 2
