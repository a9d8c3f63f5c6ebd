"""Drawing with NumPy and OpenCV alone, for wherever nothing is compiled, and until it is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from skyloop.sim.camera import CameraModel, CameraPose
from skyloop.sim.render.atlas import Atlas
from skyloop.sim.render.base import Image
from skyloop.sim.render.painter import Painter, Singles
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
        self._numbers = np.empty(raster.lookup.shape, np.int32)

    def find(self, quads: Quads, shown: NDArray[np.bool_], pose: CameraPose) -> tuple[NDArray[np.int32], Singles]:
        """See :meth:`Painter.find`."""
        view = visible_quads(quads, shown, pose, self.raster.grid)
        self._buffer.draw(view, quads.priority[view.index])
        return self._buffer.seen.reshape(-1), sampling_table(quads, view, pose, self.atlas, self.pixel_area)

    def resolve(self, seen: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """See :meth:`Painter.resolve`."""
        numbers = self._numbers
        for k, places in enumerate(self.raster.lookup):
            np.take(seen, places, out=numbers[k], mode="clip")
        mixed = np.flatnonzero((numbers[1:] != numbers[0]).any(axis=0))
        return numbers[0], mixed.astype(np.int32)

    def shade(
        self,
        table: Singles,
        numbers: NDArray[np.int32],
        ray_x: Singles,
        ray_y: Singles,
        colours: NDArray[np.uint8],
        inverse_depth: Singles,
    ) -> None:
        """See :meth:`Painter.shade`."""
        self._shader.shade(table, numbers.astype(np.intp), ray_x, ray_y, colours, inverse_depth)

    def darken(self, picture: Image, shadow: Placed, inverse_depth: Singles) -> None:
        """See :meth:`Painter.darken`."""
        darken(picture, shadow, self.raster.rays, inverse_depth)
