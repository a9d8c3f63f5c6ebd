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

    Attributes:
        grid: The grid.
        lookup: Flat places on it of each pixel's samples, (samples, pixels).
        sample_x: x/z of each column of the grid.
        sample_y: y/z of each row of the grid.
        rays: Of each pixel's centre.
    """

    grid: Grid
    lookup: NDArray[np.int32]
    sample_x: NDArray[np.float32]
    sample_y: NDArray[np.float32]
    rays: Rays

    @staticmethod
    def of(model: CameraModel, samples: int) -> Raster:
        """Lay out one or four samples a pixel: a second for 960×720 pixels with distortion, once in a process.

        Raises:
            UsageError: The model's distortion can't be inverted.
        """
        return _raster(model.width, model.height, model.fx, model.fy, model.cx, model.cy, model.distortion, samples)


@lru_cache(maxsize=8)  # 22 MB for one of 960×720 pixels
def _raster(
    width: int, height: int, fx: float, fy: float, cx: float, cy: float, distortion: Distortion, samples: int
) -> Raster:
    model = CameraModel("lens", width, height, 1.0, fx, fy, cx, cy, distortion)
    fine = 2 if samples > 1 else 1
    offsets = [(0.0, 0.0)] if samples == 1 else [(x, y) for y in (-0.25, 0.25) for x in (-0.25, 0.25)]
    rays = [_rays(model, dx, dy) for dx, dy in offsets]
    scale = (fine * fx, fine * fy)
    low = np.min([r.min(axis=0) for r in rays], axis=0) * scale
    high = np.max([r.max(axis=0) for r in rays], axis=0) * scale
    # Without distortion the grid's samples are exactly the pixels' own.
    middle = -low if not model.distorted else np.ceil(-low)
    columns, rows = (int(n) for n in np.rint(high + middle) + 1)
    places = [np.rint(r * scale + middle).astype(np.int32) for r in rays]
    middle_x, middle_y = (float(n) for n in middle)
    centre = _rays(model, 0.0, 0.0).astype(np.float32).reshape(height, width, 2)
    return Raster(
        Grid(columns, rows, *scale, middle_x, middle_y),
        np.array([p[:, 1] * columns + p[:, 0] for p in places], dtype=np.int32),
        ((np.arange(columns) - middle_x) / scale[0]).astype(np.float32),
        ((np.arange(rows) - middle_y) / scale[1]).astype(np.float32),
        Rays.of(np.ascontiguousarray(centre[..., 0]), np.ascontiguousarray(centre[..., 1])),
    )


def _rays(model: CameraModel, dx: float, dy: float) -> NDArray[np.float64]:
    x, y = np.meshgrid(np.arange(model.width) + dx, np.arange(model.height) + dy)
    return model.rays(np.column_stack([x.ravel(), y.ravel()]))
