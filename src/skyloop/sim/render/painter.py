"""Drawing of images: the sample positions for a lens, and a painter that uses only NumPy and OpenCV.

This painter is used until the compiled one is ready, or permanently if Numba is not available.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from skyloop.sim.camera import CameraModel, CameraPose, Distortion
from skyloop.sim.render.quads import Atlas, Image, Quads, cv2
from skyloop.sim.render.shading import DepthBuffer, Grid, Placed, Rays, Shader, darken, sampling_table, visible_quads


@dataclass(frozen=True, slots=True)
class Raster:
    """Precomputed values for a lens: the positions of its samples on a distortion-free grid.

    A pixel has either one sample, at the grid point nearest to its centre, or four samples, at the points around its
    centre. Without distortion, these points are exactly a quarter of a pixel to each side.
    """

    grid: Grid
    samples: int  #: samples per pixel: 1 or 4
    #: Flat index on the grid of each pixel's first sample, (pixels,). The other three samples are to its right, below
    #: it, and below and to its right.
    lookup: NDArray[np.int32]
    #: Scales in x and y, then offsets in x and y. Scaling a ray (x, y, 1) from ``rays`` and adding the offsets gives,
    #: after truncation, the column and row of its first sample. Computed in single precision, like ``lookup``.
    to_grid: NDArray[np.float32]
    sample_x: NDArray[np.float32]  #: x/z of each column of the grid
    sample_y: NDArray[np.float32]  #: y/z of each row of the grid
    rays: Rays  #: rays through the pixel centres

    @staticmethod
    def of(model: CameraModel, samples: int) -> Raster:
        """Compute one or four samples per pixel; with distortion, the first call for 960×720 pixels takes 0.2 s."""
        return _raster(model.width, model.height, model.fx, model.fy, model.cx, model.cy, model.distortion, samples)


@lru_cache(maxsize=8)  # 8 MB each for 960×720 pixels
def _raster(
    width: int, height: int, fx: float, fy: float, cx: float, cy: float, distortion: Distortion, samples: int
) -> Raster:
    model = CameraModel("lens", width, height, 1.0, fx, fy, cx, cy, distortion)
    centre = _rays(model)
    # Distance from a pixel's centre to its first sample, and distance from the first to the last sample, in samples.
    fine, first, more = (2, 0.5, 1) if samples > 1 else (1, 0.0, 0)
    scale = np.array([fine * fx, fine * fy])
    low = centre.min(axis=0) * scale
    # Without distortion, the grid's samples coincide with the image's pixels; otherwise the grid has one extra sample.
    middle = np.ceil(1.0 - low) if model.distorted else first - low
    to_grid = np.concatenate([scale, middle + (0.5 - first)]).astype(np.float32)
    x, y = (np.ascontiguousarray(part.astype(np.float32).reshape(height, width)) for part in centre.T)
    column = (x * to_grid[0] + to_grid[2]).astype(np.int32)
    row = (y * to_grid[1] + to_grid[3]).astype(np.int32)
    columns, rows = int(column.max()) + 1 + more, int(row.max()) + 1 + more
    middle_x, middle_y = (float(n) for n in middle)
    return Raster(
        Grid(columns, rows, float(scale[0]), float(scale[1]), middle_x, middle_y),
        samples,
        (row * np.int32(columns) + column).reshape(-1),
        to_grid,
        ((np.arange(columns) - middle_x) / scale[0]).astype(np.float32),
        ((np.arange(rows) - middle_y) / scale[1]).astype(np.float32),
        Rays.of(x, y),
    )


def _rays(model: CameraModel) -> NDArray[np.float64]:
    """Return x/z and y/z of the rays of all pixel centres, (pixels, 2)."""
    x, y = np.meshgrid(np.arange(model.width, dtype=np.float64), np.arange(model.height, dtype=np.float64))
    return model.rays(np.column_stack([x.ravel(), y.ravel()]))


class Painter(ABC):
    """Draws images as seen through one lens. It reuses buffers, so use it from one thread at a time."""

    def __init__(self, raster: Raster, model: CameraModel, atlas: Atlas) -> None:
        self.raster = raster
        self.atlas = atlas
        self.pixel_area = 1.0 / (model.fx * model.fy)

    @abstractmethod
    def paint(
        self, quads: Quads, shown: NDArray[np.bool_], shadows: list[Placed], pose: CameraPose, picture: Image
    ) -> None:
        """Draw the ``shown`` quads, (n,), and the shadows into ``picture``: BGR, (height, width, 3), contiguous."""


class PlainPainter(Painter):
    """Draws with NumPy and OpenCV."""

    def __init__(self, raster: Raster, model: CameraModel, atlas: Atlas) -> None:
        super().__init__(raster, model, atlas)
        self._shader = Shader(atlas)
        self._buffer = DepthBuffer(raster.grid)
        # Index offsets from a pixel's first sample to each of its samples.
        self._steps = (0, 1, raster.grid.width, raster.grid.width + 1)[: raster.samples]
        self._numbers = np.empty((raster.samples, len(raster.lookup)), np.int32)
        self._colours = np.empty((model.height, model.width, 4), np.uint8)
        self._inverse_depth = np.empty((model.height, model.width), np.float32)

    def paint(
        self, quads: Quads, shown: NDArray[np.bool_], shadows: list[Placed], pose: CameraPose, picture: Image
    ) -> None:
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
        """Return the table column of each pixel's first sample, (pixels,), and the pixels whose samples differ."""
        raster, numbers = self.raster, self._numbers
        for k, step in enumerate(self._steps):
            np.take(seen[step:], raster.lookup, out=numbers[k], mode="clip")
        return numbers[0], np.flatnonzero((numbers[1:] != numbers[0]).any(axis=0))

    def _smooth(
        self, seen: NDArray[np.int32], table: NDArray[np.float32], pixels: NDArray[np.intp], colours: NDArray[np.uint8]
    ) -> None:
        """Colour the pixels whose samples hit different quads, by averaging all of their samples."""
        raster = self.raster
        places = (raster.lookup[pixels] + np.array(self._steps, dtype=np.int32)[:, None]).reshape(-1)
        row = places // raster.grid.width
        ray_x, ray_y = raster.sample_x[places - row * raster.grid.width], raster.sample_y[row]
        samples = np.empty((len(places), 4), np.uint8)
        self._shader.shade(table, seen[places], ray_x, ray_y, samples, np.empty(len(places), np.float32))
        total = samples.reshape(4, -1, 4).sum(axis=0, dtype=np.uint16)
        colours[pixels] = total + 2 >> 2  # the rounded mean
