"""The sample positions of a lens."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from skyloop.sim.camera import FRONT_CAMERA, CameraModel
from skyloop.sim.render.painter import Raster

PINHOLE = replace(FRONT_CAMERA, distortion=(0.0,) * 5)
STRONG = replace(FRONT_CAMERA, distortion=(-0.3, 0.1, 0.01, -0.01, 0.0))


def test_without_distortion_the_samples_are_a_quarter_of_a_pixel_to_each_side() -> None:
    raster = Raster.of(PINHOLE, 4)
    row, column = np.divmod(raster.lookup, raster.grid.width)
    rays_x, rays_y = raster.rays.x.reshape(-1), raster.rays.y.reshape(-1)
    for side in (0, 1):
        off = 0.25 * (2 * side - 1)
        assert raster.sample_x[column + side] == pytest.approx(rays_x + off / PINHOLE.fx, abs=1e-6)
        assert raster.sample_y[row + side] == pytest.approx(rays_y + off / PINHOLE.fy, abs=1e-6)


@pytest.mark.parametrize("model", [FRONT_CAMERA, STRONG], ids=["front", "strong"])
@pytest.mark.parametrize(("samples", "size"), [(1, 1), (4, 2)])
def test_with_distortion_they_are_centred_on_the_pixel_to_half_a_sample(
    model: CameraModel, samples: int, size: int
) -> None:
    raster = Raster.of(model, samples)
    assert raster.lookup.min() >= 0
    row, column = np.divmod(raster.lookup, raster.grid.width)
    assert row.max() + size <= raster.grid.height
    assert column.max() + size <= raster.grid.width
    middle_x = (raster.sample_x[column] + raster.sample_x[column + size - 1]) / 2
    middle_y = (raster.sample_y[row] + raster.sample_y[row + size - 1]) / 2
    off_x = (middle_x - raster.rays.x.reshape(-1)) * raster.grid.fx
    off_y = (middle_y - raster.rays.y.reshape(-1)) * raster.grid.fy
    assert np.abs(off_x).max() <= 0.501
    assert np.abs(off_y).max() <= 0.501
    assert abs(off_x.mean()) < 0.02
    assert abs(off_y.mean()) < 0.02
