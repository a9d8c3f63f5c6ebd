"""Pictures of calibration boards by cameras that are known exactly: each pixel's ray is met with the board's plane."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from skyloop.messages import Intrinsics
from skyloop.vision import Board, unproject

_FINER = 2
_TEXTURE_PX = 60  # a square

PINHOLE = Intrinsics(fx=520.0, fy=523.0, cx=324.0, cy=238.0, distortion=(-0.28, 0.09, 0.0008, -0.0005, 0.0))
FISHEYE = Intrinsics(fx=250.0, fy=251.0, cx=322.0, cy=241.0, distortion=(0.04, -0.01, 0.004, -0.001), model="fisheye")
SIZE = (640, 480)


def poses(
    count: int, seed: int, *, near: float, far: float, wide: float
) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Rotations and positions of a board's middle: tilted up to 0.6 rad, aside up to ``wide`` [share of z]."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        turn, _ = cv2.Rodrigues(np.append(rng.uniform(-0.6, 0.6, 2), rng.uniform(-0.3, 0.3)))
        z = rng.uniform(near, far)
        found.append(
            (
                np.asarray(turn, dtype=np.float64),
                np.array([rng.uniform(-wide, wide) * z, rng.uniform(-wide, wide) * 0.7 * z, z]),
            )
        )
    return found


def photograph(
    board: Board,
    intrinsics: Intrinsics,
    turn: NDArray[np.float64],
    middle: NDArray[np.float64],
    rng: np.random.Generator,
    size: tuple[int, int] = SIZE,
) -> NDArray[np.uint8]:
    """The board on a grey wall, with noise; grey, shape (h, w)."""
    width, height = size
    rays = _rays(intrinsics, width, height)
    normal = turn[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        reach = (normal @ middle) / (rays @ normal)
    there = (rays * reach[:, None] - middle) @ turn  # on the board, from its middle
    texture = board.picture(_TEXTURE_PX)
    scale = _TEXTURE_PX / board.square_m
    across = there[:, 0] * scale + (texture.shape[1] - 1) / 2
    down = there[:, 1] * scale + (texture.shape[0] - 1) / 2
    across[~(reach > 0)] = -1e4
    shape = (height * _FINER, width * _FINER)
    fine = cv2.remap(
        texture,
        across.reshape(shape).astype(np.float32),
        down.reshape(shape).astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=110,
    )
    grey = np.asarray(fine, dtype=np.float64).reshape(height, _FINER, width, _FINER).mean(axis=(1, 3))
    noisy = grey * 0.8 + 20 + rng.normal(0, 2.0, (height, width))
    return np.asarray(np.clip(noisy, 0, 255), dtype=np.uint8)


@lru_cache(maxsize=4)
def _rays(intrinsics: Intrinsics, width: int, height: int) -> NDArray[np.float64]:
    columns = (np.arange(width * _FINER) + 0.5) / _FINER - 0.5
    rows = (np.arange(height * _FINER) + 0.5) / _FINER - 0.5
    return unproject(np.column_stack([part.ravel() for part in np.meshgrid(columns, rows)]), intrinsics)
