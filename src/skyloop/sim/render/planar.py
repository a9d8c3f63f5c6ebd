"""The renderer that works everywhere: NumPy and OpenCV on one core, no display, no GPU, no system packages.

First it is found which quad each sample of the picture shows (``visibility``), then every pixel is coloured once
(``shading``): hidden surfaces cost little. Where the samples of a pixel see different quads, all four are coloured and
averaged, so that silhouettes are smooth. Through a lens with distortion the samples are chosen where the lens puts
them; nothing is resampled, and textures stay sharp.

The picture is the same, bit by bit, for the same scene, state, pose and model, on one machine with one OpenCV.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import UsageError
from skyloop.sim.camera import CameraModel, CameraPose, Distortion
from skyloop.sim.render.base import Image, SceneState
from skyloop.sim.render.opencv import cv2
from skyloop.sim.render.scene import Posed, Scene
from skyloop.sim.render.shading import Shader, sampling_table
from skyloop.sim.render.shadows import darken
from skyloop.sim.render.visibility import DepthBuffer, Grid, visible_quads


class Quality(Enum):
    """How a picture is sampled."""

    FAST = "fast"  #: one sample a pixel: jagged edges, and behind a distorting lens up to half a pixel out of place
    SMOOTH = "smooth"  #: four samples a pixel along edges: as good as BEST but for shimmer within textures
    BEST = "best"  #: four samples for every pixel


def use_one_core() -> None:
    """Restrict OpenCV, in this whole process, to the calling thread.

    Images this small gain nothing from more, and its worker threads would take the cores that proxies and applications
    need: a process that only simulates calls this once when it starts.
    """
    cv2.setNumThreads(1)


class PlanarRenderer:
    """Renders a :class:`~skyloop.sim.render.scene.Scene`. Implements :class:`~skyloop.sim.render.base.Renderer`.

    It holds buffers, so it is for one thread at a time; several renderers may share a scene.
    """

    def __init__(self, scene: Scene, quality: Quality = Quality.SMOOTH) -> None:
        self.scene = scene
        self.quality = quality
        self._shader = Shader(scene.atlas)
        self._rasters: dict[tuple[object, ...], _Raster] = {}
        self._posed: tuple[SceneState, Posed] | None = None

    def render(self, state: SceneState, pose: CameraPose, model: CameraModel, out: Image | None = None) -> Image:
        """Render an image; see :meth:`skyloop.sim.render.base.Renderer.render`.

        Raises:
            UsageError: ``out`` or the state does not fit, or the model's distortion can't be inverted.
        """
        shape = (model.height, model.width, 3)
        if out is None:
            out = np.empty(shape, np.uint8)
        elif out.shape != shape or out.dtype != np.uint8:
            raise UsageError(f"out is {out.dtype} of shape {out.shape}; this camera's image is uint8 of {shape}")
        if self.quality is Quality.BEST:
            large = self._draw(state, pose, _doubled(model), samples=1)
            small = cv2.resize(large, (model.width, model.height), interpolation=cv2.INTER_AREA)
            cv2.cvtColor(small, cv2.COLOR_BGRA2BGR, dst=out)
        else:
            picture = self._draw(state, pose, model, samples=_samples(self.quality))
            cv2.cvtColor(picture, cv2.COLOR_BGRA2BGR, dst=out)
        return out

    def _draw(self, state: SceneState, pose: CameraPose, model: CameraModel, samples: int) -> NDArray[np.uint8]:
        raster = self._raster(model, samples)
        lens = raster.lens
        posed = self._pose(state)
        quads = posed.quads
        shown = np.ones(len(quads), np.bool_) if pose.drone is None else posed.drone != pose.drone
        view = visible_quads(quads, shown, pose, lens.grid)
        raster.buffer.draw(view, quads.priority[view.index])
        table = sampling_table(quads, view, pose, self.scene.atlas, 1.0 / (model.fx * model.fy))
        seen = raster.buffer.seen.reshape(-1)
        np.take(seen, lens.lookup[0], out=raster.seen[0], mode="clip")
        np.copyto(raster.column, raster.seen[0])
        self._shader.shade(table, raster.column, lens.ray_x, lens.ray_y, raster.colours, raster.inverse_depth)
        if samples > 1:
            self._smooth_edges(raster, table)
        picture = raster.colours.reshape(model.height, model.width, 4)
        for shadow in posed.shadows:
            darken(picture, shadow, pose, lens.ray_x, lens.ray_y, raster.inverse_depth)
        return picture

    def _smooth_edges(self, raster: _Raster, table: NDArray[np.float32]) -> None:
        """Colours all samples of the pixels whose samples see different quads, and averages them."""
        seen, lens = raster.seen, raster.lens
        for k in range(1, len(seen)):
            np.take(raster.buffer.seen.reshape(-1), lens.lookup[k], out=seen[k], mode="clip")
        mixed = (seen[1:] != seen[0]).any(axis=0)
        pixels = np.flatnonzero(mixed)
        places = lens.lookup[:, pixels]
        columns = seen[:, pixels].astype(np.intp).reshape(-1)
        colours = np.empty((columns.size, 4), np.uint8)
        ray_x = lens.sample_x[places % lens.grid.width].reshape(-1)
        ray_y = lens.sample_y[places // lens.grid.width].reshape(-1)
        self._shader.shade(table, columns, ray_x, ray_y, colours, np.empty(columns.size, np.float32))
        total = colours.reshape(len(seen), -1, 4).sum(axis=0, dtype=np.uint16)
        raster.colours[pixels] = (total + len(seen) // 2) // len(seen)

    def _pose(self, state: SceneState) -> Posed:
        if self._posed is None or self._posed[0] is not state:
            self._posed = (state, self.scene.posed(state))
        return self._posed[1]

    def _raster(self, model: CameraModel, samples: int) -> _Raster:
        key = _lens_key(model, samples)
        if key not in self._rasters:
            self._rasters[key] = _Raster.of(_Lens.of(*key))
        return self._rasters[key]


def prepare(model: CameraModel, quality: Quality = Quality.SMOOTH) -> None:
    """Compute what the first picture through a lens would wait for: a second for 960×720 pixels with distortion.

    It is kept for all renderers of the process.
    """
    _Lens.of(*_lens_key(_doubled(model) if quality is Quality.BEST else model, _samples(quality)))


def _samples(quality: Quality) -> int:
    return 4 if quality is Quality.SMOOTH else 1


_LensKey = tuple[int, int, float, float, float, float, Distortion, int]


def _lens_key(model: CameraModel, samples: int) -> _LensKey:
    return (model.width, model.height, model.fx, model.fy, model.cx, model.cy, model.distortion, samples)


@dataclass(frozen=True, slots=True)
class _Lens:
    """What is computed once for a lens, and only read: where its samples lie on a distortion-free grid."""

    grid: Grid
    lookup: NDArray[np.intp]  # flat places on the grid of each pixel's samples, (samples, pixels)
    sample_x: NDArray[np.float32]  # x/z of each column of the grid
    sample_y: NDArray[np.float32]  # y/z of each row of the grid
    ray_x: NDArray[np.float32]  # x/z of each pixel
    ray_y: NDArray[np.float32]

    @staticmethod
    @lru_cache(maxsize=8)  # 30 MB for one of 960×720 pixels
    def of(
        width: int, height: int, fx: float, fy: float, cx: float, cy: float, distortion: Distortion, samples: int
    ) -> _Lens:
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
        places = [np.rint(r * scale + middle).astype(np.intp) for r in rays]
        middle_x, middle_y = (float(n) for n in middle)
        ray_x, ray_y = _rays(model, 0.0, 0.0).T.astype(np.float32)
        return _Lens(
            Grid(columns, rows, *scale, middle_x, middle_y),
            np.array([p[:, 1] * columns + p[:, 0] for p in places]),
            ((np.arange(columns) - middle_x) / scale[0]).astype(np.float32),
            ((np.arange(rows) - middle_y) / scale[1]).astype(np.float32),
            np.ascontiguousarray(ray_x),
            np.ascontiguousarray(ray_y),
        )


@dataclass(slots=True)
class _Raster:
    """A lens, and a renderer's buffers of its size."""

    lens: _Lens
    buffer: DepthBuffer
    seen: NDArray[np.int32]  # (samples, pixels)
    column: NDArray[np.intp]
    colours: NDArray[np.uint8]  # (pixels, 4)
    inverse_depth: NDArray[np.float32]

    @staticmethod
    def of(lens: _Lens) -> _Raster:
        samples, pixels = lens.lookup.shape
        return _Raster(
            lens,
            DepthBuffer(lens.grid),
            np.empty((samples, pixels), np.int32),
            np.empty(pixels, np.intp),
            np.empty((pixels, 4), np.uint8),
            np.empty(pixels, np.float32),
        )


@lru_cache(maxsize=16)
def _doubled(model: CameraModel) -> CameraModel:
    return model.scaled(2.0)


def _rays(model: CameraModel, dx: float, dy: float) -> NDArray[np.float64]:
    x, y = np.meshgrid(np.arange(model.width) + dx, np.arange(model.height) + dy)
    return model.rays(np.column_stack([x.ravel(), y.ravel()]))
