"""Pictures of markers for tests: an ideal pinhole camera, drawn four times finer and averaged down."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from skyloop.messages import Intrinsics

INTRINSICS = Intrinsics(fx=280.0, fy=280.0, cx=159.5, cy=119.5)
_FINER = 4

Pose = tuple[int, NDArray[np.float64], NDArray[np.float64]]  # id, world-from-face rotation in optical axes, position


def facing(turn: float = 0.0, nod: float = 0.0) -> NDArray[np.float64]:
    """Face-to-optical rotation of a marker that looks at the camera, turned about the vertical, then nodded [rad]."""
    c, s = np.cos(turn), np.sin(turn)
    about_vertical = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    c, s = np.cos(nod), np.sin(nod)
    about_side = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    return np.asarray(about_vertical @ about_side @ np.diag([1.0, -1.0, -1.0]))


def project(points: NDArray[np.float64], intrinsics: Intrinsics = INTRINSICS) -> NDArray[np.float64]:
    """Optical axes (n, 3) to pixels (n, 2); the centre of the first pixel is (0, 0)."""
    flat = points @ intrinsics.matrix.T
    return np.asarray(flat[:, :2] / flat[:, 2:])


def square(rotation: NDArray[np.float64], position: NDArray[np.float64], edge: float) -> NDArray[np.float64]:
    """The corners of a square in optical axes (4, 3), from the top left clockwise."""
    h = edge / 2
    return np.asarray(np.array([[-h, h, 0], [h, h, 0], [h, -h, 0], [-h, -h, 0]]) @ rotation.T + position)


def picture(markers: Sequence[Pose], *, size_m: float = 0.3, shape: tuple[int, int] = (240, 320)) -> NDArray[np.uint8]:
    """A grey wall with the markers on white cards, (h, w, 3) uint8."""
    height, width = shape
    canvas = np.full((height * _FINER, width * _FINER), 120, np.uint8)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    for number, rotation, position in markers:
        cell = 20
        black = cv2.aruco.generateImageMarker(dictionary, number, 6 * cell)
        card = cv2.copyMakeBorder(black, cell, cell, cell, cell, cv2.BORDER_CONSTANT, value=255)
        edge = size_m * 8 / 6
        fine = (project(square(rotation, position, edge)) + 0.5) * _FINER - 0.5
        side = 8 * cell - 0.5
        source = np.array([[-0.5, -0.5], [side, -0.5], [side, side], [-0.5, side]], np.float32)
        warp = cv2.getPerspectiveTransform(source, fine.astype(np.float32))
        cv2.warpPerspective(card, warp, canvas.shape[::-1], dst=canvas, borderMode=cv2.BORDER_TRANSPARENT)
    grey = canvas.reshape(height, _FINER, width, _FINER).mean(axis=(1, 3)).astype(np.uint8)
    return np.repeat(grey[:, :, None], 3, axis=2)
