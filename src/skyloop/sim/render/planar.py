"""The renderer for simulated cameras. It needs one core and no display, GPU or system packages.

The first step determines which quad is at each sample of the image, and the second step colours each pixel once
(``shading``), so hidden surfaces cost little. If the samples of a pixel hit different quads, all four samples are
coloured and averaged, for smooth silhouettes. With distortion, the lens determines the positions of the samples, so
nothing is resampled and textures stay sharp.

:class:`PlainPainter` does this with NumPy and OpenCV. ``compiled`` does the same arithmetic in loops compiled by Numba;
they are several times faster, once they are ready. Both implementations give bit-identical images for the same scene,
state, pose and model.
"""

from __future__ import annotations

import math
from enum import Enum
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import UsageError
from skyloop.sim.camera import CameraModel, CameraPose
from skyloop.sim.render.compiled import COMPILER, CompiledPainter, Compiler
from skyloop.sim.render.painter import Painter, PlainPainter, Raster
from skyloop.sim.render.quads import Image, SceneState, cv2
from skyloop.sim.render.scene import Posed, Scene
from skyloop.sim.render.shading import placed

#: Number of images that a renderer draws before it compiles; with fewer images, compiling takes longer than it saves.
WORTH_COMPILING: Final = 30


class Quality(Enum):
    """How an image is sampled."""

    FAST = "fast"  #: one sample per pixel: edges are jagged, and with distortion the error is up to half a pixel
    SMOOTH = "smooth"  #: four samples per pixel along edges: as good as BEST except for shimmer within textures
    BEST = "best"  #: four samples for every pixel


def use_one_core() -> None:
    """Restrict OpenCV to the calling thread, for the whole process.

    Images this small do not benefit from more threads, and OpenCV's worker threads would occupy cores that proxies and
    applications need. A process that only runs a simulation calls this once when it starts.
    """
    cv2.setNumThreads(1)


def dimmed(picture: Image, light: float) -> Image:
    """Multiply all values of an image in place by a factor of at least 0, rounded, and return the image.

    A table of 256 values makes the result bit-identical on every machine.
    """
    table = np.clip(np.rint(np.arange(256) * light), 0, 255).astype(np.uint8)
    np.copyto(picture, cv2.LUT(picture, table))
    return picture


class PlanarRenderer:
    """Renders an ideal sensor's image behind a camera's lens, with distortion but without noise, blur or vignetting.

    :class:`SensorEffects` adds noise, blur and vignetting. The renderer reuses buffers, so it must be used from one
    thread at a time. Several renderers can share a scene. With ``compiler`` None, it never draws with compiled code.
    """

    def __init__(
        self, scene: Scene, quality: Quality = Quality.SMOOTH, *, compiler: Compiler | None = COMPILER
    ) -> None:
        self.scene = scene
        self.quality = quality
        self._compiler = compiler
        self._pictures = 0
        self._painters: dict[tuple[object, ...], Painter] = {}  # painters by lens
        self._posed: tuple[SceneState, Posed] | None = None

    def render(self, state: SceneState, pose: CameraPose, model: CameraModel, out: Image | None = None) -> Image:
        """Render an image, BGR, (model.height, model.width, 3), uint8, into ``out`` if given."""
        shape = (model.height, model.width, 3)
        if out is None:
            out = np.empty(shape, np.uint8)
        elif out.shape != shape or out.dtype != np.uint8:
            raise UsageError(f"out has shape {out.shape} and type {out.dtype}, and must have {shape} and uint8")
        self._sample(state, pose, model, out)
        if state.light != 1.0:
            dimmed(out, state.light)
        return out

    def _sample(self, state: SceneState, pose: CameraPose, model: CameraModel, out: Image) -> None:
        if self.quality is Quality.BEST:
            fine = _doubled(model)
            large = np.empty((fine.height, fine.width, 3), np.uint8)
            self._draw(state, pose, fine, 1, large)
            cv2.resize(large, (model.width, model.height), dst=out, interpolation=cv2.INTER_AREA)
        elif out.flags.c_contiguous:
            self._draw(state, pose, model, _samples(self.quality), out)
        else:
            whole = np.empty(out.shape, np.uint8)
            self._sample(state, pose, model, whole)
            np.copyto(out, whole)

    def _draw(self, state: SceneState, pose: CameraPose, model: CameraModel, samples: int, picture: Image) -> None:
        painter = self._painter(model, samples)
        posed = self._pose(state)
        shown = np.ones(len(posed.quads), np.bool_) if pose.drone is None else posed.drone != pose.drone
        shadows = [at for shadow in posed.shadows if (at := placed(shadow, pose, painter.raster.rays)) is not None]
        painter.paint(posed.quads, shown, shadows, pose, picture)

    def _pose(self, state: SceneState) -> Posed:
        if self._posed is None or self._posed[0] is not state:
            self._posed = (state, self.scene.posed(state))
        return self._posed[1]

    def _painter(self, model: CameraModel, samples: int) -> Painter:
        key = (model.width, model.height, model.fx, model.fy, model.cx, model.cy, model.distortion, samples)
        painter = self._painters.get(key)
        if painter is None:
            painter = self._painters[key] = PlainPainter(Raster.of(model, samples), model, self.scene.atlas)
        self._pictures += 1
        if self._compiler is not None and not isinstance(painter, CompiledPainter):
            if self._pictures > WORTH_COMPILING:
                self._compiler.start()
            if (kernels := self._compiler.kernels) is not None:
                painter = self._painters[key] = CompiledPainter(painter.raster, model, self.scene.atlas, kernels)
        return painter


def prepare(model: CameraModel, quality: Quality = Quality.SMOOTH) -> None:
    """Precompute a lens's values to save time on its first image: 0.2 s for 960×720 pixels with distortion.

    The values are kept for all renderers in the process.
    """
    Raster.of(_doubled(model) if quality is Quality.BEST else model, _samples(quality))


def _samples(quality: Quality) -> int:
    return 4 if quality is Quality.SMOOTH else 1


@lru_cache(maxsize=16)
def _doubled(model: CameraModel) -> CameraModel:
    return model.scaled(2.0)


_NOISE_MARGIN = 61  # extra rows and columns of noise around the image, so that each frame can use a different part
_BLUR_FROM_PX = 0.8  # minimum length at which blur is visible


class SensorEffects:
    """Imperfections of a camera's sensor: motion blur, exposure, vignetting, noise. Use it from one thread at a time.

    The imperfections of frame ``number`` depend only on the seed and that number, not on earlier frames.
    """

    def __init__(self, model: CameraModel, seed: int = 0) -> None:
        self._model = model
        self._seed = seed
        rng = np.random.default_rng([seed, model.width, model.height])
        self._gain = _gain(model)
        shape = (model.height + _NOISE_MARGIN, (model.width + _NOISE_MARGIN) * 3)
        noise = np.rint(rng.standard_normal(shape, dtype=np.float32) * np.float32(model.noise_sigma))
        # Saturated addition and saturated subtraction of two byte images together cost a tenth of one signed addition.
        self._brighter = np.clip(noise, 0, 255).astype(np.uint8)
        self._darker = np.clip(-noise, 0, 255).astype(np.uint8)

    def apply(self, picture: Image, number: int, body_rates_rad_s: NDArray[np.float64] | None = None) -> Image:
        """Apply the imperfections to a BGR image of the camera's size, in place, and return it.

        The drone's angular velocity about its body axes (x forward, y left, z up), (3,), determines the motion blur
        during the exposure; None if the drone does not turn. ``number`` is the frame number.
        """
        model = self._model
        if picture.shape != (model.height, model.width, 3):
            raise UsageError(
                f"camera {model.name!r} has {model.width}x{model.height} pixels, the image {picture.shape}"
            )
        if body_rates_rad_s is not None:
            self._smear(picture, body_rates_rad_s)
        if self._gain is not None:
            cv2.multiply(picture, self._gain, dst=picture, scale=1.0 / 128.0)
        if model.noise_sigma > 0.0:
            row, column = np.random.default_rng([self._seed, number]).integers(0, _NOISE_MARGIN, 2)
            part = slice(row, row + model.height), slice(3 * column, 3 * (column + model.width))
            flat = picture.reshape(model.height, model.width * 3)
            cv2.add(flat, self._brighter[part], dst=flat)
            cv2.subtract(flat, self._darker[part], dst=flat)
        return picture

    def _smear(self, picture: Image, body_rates_rad_s: NDArray[np.float64]) -> None:
        model = self._model
        turn = model.rotation_matrix.T @ body_rates_rad_s * model.exposure_s
        # The scene moves left if the camera rotates about y (down), and down if about x (right). Roll is ignored.
        dx, dy = -turn[1] * model.fx, turn[0] * model.fy
        length = math.hypot(dx, dy)
        if length < _BLUR_FROM_PX:
            return
        steps = np.linspace(-0.5, 0.5, 4 * math.ceil(length / 2) + 5)
        right, down = np.rint(dx * steps).astype(np.intp), np.rint(dy * steps).astype(np.intp)
        across, along = abs(right).max(), abs(down).max()
        # Keep this as small as possible: for large kernels, OpenCV uses a slow method in the frequency domain.
        kernel = np.zeros((2 * along + 1, 2 * across + 1), np.float32)
        np.add.at(kernel, (along + down, across + right), 1.0)
        cv2.filter2D(picture, -1, kernel / kernel.sum(), dst=picture, borderType=cv2.BORDER_REPLICATE)


def _gain(model: CameraModel) -> Image | None:
    """Return exposure and vignetting in steps of 1/128, or None if there is neither.

    Like a cos⁴ falloff, vignetting grows with the square of the distance from the centre.
    """
    if model.exposure_gain == 1.0 and model.vignetting == 0.0:
        return None
    x = (np.arange(model.width) - (model.width - 1) / 2) / (model.width / 2)
    y = (np.arange(model.height) - (model.height - 1) / 2) / (model.height / 2)
    gain = model.exposure_gain * (1.0 - model.vignetting * (x[None, :] ** 2 + y[:, None] ** 2) / 2.0)
    return np.repeat(np.clip(np.rint(128.0 * gain), 0, 255).astype(np.uint8)[..., None], 3, axis=2)
