"""The flaws of a real sensor: motion blur, exposure, vignetting and noise. Seeded, so repeatable."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import UsageError
from skyloop.sim.camera import CameraModel
from skyloop.sim.render.base import Image
from skyloop.sim.render.opencv import cv2

_SPARE = 61  # rows and pixels of noise beyond a picture's own, so that each frame cuts another part out
_BLUR_FROM_PX = 0.8  # a shorter smear can't be distinguished from none


class SensorEffects:
    """The flaws of one camera's sensor. To be used in one thread at a time.

    What frame ``number`` gets depends on the seed and the number alone, not on which frames came before.
    """

    def __init__(self, model: CameraModel, seed: int = 0) -> None:
        self._model = model
        self._seed = seed
        rng = np.random.default_rng([seed, model.width, model.height])
        self._gain = _gain(model)
        shape = (model.height + _SPARE, (model.width + _SPARE) * 3)
        noise = np.rint(rng.standard_normal(shape, dtype=np.float32) * np.float32(model.noise_sigma))
        # Two pictures of bytes, added and taken away with saturation, cost a tenth of one with signs.
        self._brighter = np.clip(noise, 0, 255).astype(np.uint8)
        self._darker = np.clip(-noise, 0, 255).astype(np.uint8)

    def apply(self, picture: Image, number: int, body_rates_rad_s: NDArray[np.float64] | None = None) -> Image:
        """Apply the flaws to an image in place, and return it.

        Args:
            picture: BGR, of the camera's size.
            number: Of the frame.
            body_rates_rad_s: The drone's angular velocity about its body axes (x forward, y left, z up), shape (3,),
                which blurs the image over the exposure; None for a drone that does not turn.

        Raises:
            UsageError: The image has another size.
        """
        model = self._model
        if picture.shape != (model.height, model.width, 3):
            raise UsageError(f"camera {model.name!r} gives {model.width}x{model.height}; this is {picture.shape}")
        if body_rates_rad_s is not None:
            self._smear(picture, body_rates_rad_s)
        if self._gain is not None:
            cv2.multiply(picture, self._gain, dst=picture, scale=1.0 / 128.0)
        if model.noise_sigma > 0.0:
            row, column = np.random.default_rng([self._seed, number]).integers(0, _SPARE, 2)
            part = slice(row, row + model.height), slice(3 * column, 3 * (column + model.width))
            flat = picture.reshape(model.height, model.width * 3)
            cv2.add(flat, self._brighter[part], dst=flat)
            cv2.subtract(flat, self._darker[part], dst=flat)
        return picture

    def _smear(self, picture: Image, body_rates_rad_s: NDArray[np.float64]) -> None:
        model = self._model
        turn = model.rotation_matrix.T @ body_rates_rad_s * model.exposure_s
        # What is ahead moves against the turn: about y (down) to the left, about x (right) down; roll is left out.
        dx, dy = -turn[1] * model.fx, turn[0] * model.fy
        length = math.hypot(dx, dy)
        if length < _BLUR_FROM_PX:
            return
        steps = np.linspace(-0.5, 0.5, 4 * math.ceil(length / 2) + 5)
        right, down = np.rint(dx * steps).astype(np.intp), np.rint(dy * steps).astype(np.intp)
        across, along = abs(right).max(), abs(down).max()
        # No larger than it must be: OpenCV takes a large one's detour over frequencies, which is slow.
        kernel = np.zeros((2 * along + 1, 2 * across + 1), np.float32)
        np.add.at(kernel, (along + down, across + right), 1.0)
        cv2.filter2D(picture, -1, kernel / kernel.sum(), dst=picture, borderType=cv2.BORDER_REPLICATE)


def _gain(model: CameraModel) -> Image | None:
    """Return exposure and vignetting in steps of 1/128; None if there is neither.

    Vignetting is cos⁴-like: with the square of the distance from the centre.
    """
    if model.exposure_gain == 1.0 and model.vignetting == 0.0:
        return None
    x = (np.arange(model.width) - (model.width - 1) / 2) / (model.width / 2)
    y = (np.arange(model.height) - (model.height - 1) / 2) / (model.height / 2)
    gain = model.exposure_gain * (1.0 - model.vignetting * (x[None, :] ** 2 + y[:, None] ** 2) / 2.0)
    return np.repeat(np.clip(np.rint(128.0 * gain), 0, 255).astype(np.uint8)[..., None], 3, axis=2)
