"""Where a lens puts the samples of its pictures, and how they see a scene: what both ways of drawing start from."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from skyloop.sim.camera import CameraModel, Distortion
from skyloop.sim.render.shadows import Rays
from skyloop.sim.render.visibility import Grid


@dataclass(frozen=True, slots=True)
class Raster:
    """What is computed once for a lens: where its samples lie on a distortion-free grid.

    A pixel has one sample, the one nearest to where its centre is seen, or four: those around it, which through a lens
    without distortion are exactly those a quarter of a pixel to each side.

    Attributes:
        grid: The grid.
        samples: Of each pixel: 1 or 4.
        lookup: Flat place on the grid of each pixel's first sample, (pixels,); the others are the next one, and those
            below both.
        to_grid: Scale of x and of y, and start of x and of y: a ray (x, y, 1) of ``rays`` times the scale and added to
            the start is the column and row of its first sample, when the fraction is cut off. Computed in single
            precision, like ``lookup``.
        sample_x: x/z of each column of the grid.
        sample_y: y/z of each row of the grid.
        rays: Of each pixel's centre.
    """

    grid: Grid
    samples: int
    lookup: NDArray[np.int32]
    to_grid: NDArray[np.float32]
    sample_x: NDArray[np.float32]
    sample_y: NDArray[np.float32]
    rays: Rays

    @staticmethod
    def of(model: CameraModel, samples: int) -> Raster:
        """Lay out one or four samples a pixel: a fifth of a second for 960×720 pixels with distortion, once.

        Raises:
            UsageError: The model's distortion can't be inverted.
        """
        return _raster(model.width, model.height, model.fx, model.fy, model.cx, model.cy, model.distortion, samples)


@lru_cache(maxsize=8)  # 8 MB for one of 960×720 pixels
def _raster(
    width: int, height: int, fx: float, fy: float, cx: float, cy: float, distortion: Distortion, samples: int
) -> Raster:
    model = CameraModel("lens", width, height, 1.0, fx, fy, cx, cy, distortion)
    centre = _rays(model)
    # From a pixel's centre to its first sample, and from there to its last, in samples.
    fine, first, more = (2, 0.5, 1) if samples > 1 else (1, 0.0, 0)
    scale = np.array([fine * fx, fine * fy])
    low = centre.min(axis=0) * scale
    # Without distortion the grid's samples are exactly the pixels' own; otherwise there is one to spare.
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
    """x/z and y/z of the rays of all pixels' centres, (pixels, 2)."""
    x, y = np.meshgrid(np.arange(model.width, dtype=np.float64), np.arange(model.height, dtype=np.float64))
    return model.rays(np.column_stack([x.ravel(), y.ravel()]))
