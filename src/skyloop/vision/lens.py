"""Lens models: conversion between directions and pixels, and removal of distortion from images.

OpenCV's models: ``pinhole`` with Brown and Conrady's distortion (``calib3d``: k1, k2, p1, p2, k3, …) and ``fisheye``
(Kannala and Brandt, "A Generic Camera Model and Calibration Method", IEEE PAMI 28(8), 2006: an odd polynomial of the
angle to the axis, k1 … k4). Optical axes: x right, y down, z forward; the centre of the first pixel is (0, 0).
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skyloop.errors import UsageError
from skyloop.messages import Intrinsics
from skyloop.vision.opencv import opencv

Array = NDArray[np.float64]
_WIDEST = 1e-9  # z divided by distance: a point with a smaller value is not in front of the camera
_STEEPEST = 3.0  # x/z at 72°; a wider ideal camera would show little but its edges
_DISTANCES = np.linspace(0.0, 20.0, 20_001)  # values of x/z at which the distortion is sampled
_RETURN_PX = 0.01  # maximum error of an inverted distortion after projecting it back
_ITERATIONS = (40, 1e-10)  # iterations and accuracy of the distortion's inversion


def checked(
    image: NDArray[np.uint8], intrinsics: Intrinsics | None, *, colour: bool = False
) -> tuple[NDArray[np.uint8], Intrinsics]:
    """Check an image; return its pixels as a plain array and its intrinsics, which default to the frame's own.

    The image is a :class:`skyloop.Frame` or a uint8 array, (h, w, 3) BGR or, unless ``colour``, (h, w) grey. Raises
    UsageError if the shape or type is wrong, the array is empty, or the intrinsics are missing.
    """
    if intrinsics is None:
        intrinsics = getattr(image, "intrinsics", None)
    if intrinsics is None:
        raise UsageError("the image has no intrinsics: give the camera's as intrinsics=Intrinsics(fx, …)")
    return pixels_of(image, colour=colour), intrinsics


def pixels_of(image: NDArray[np.uint8], *, colour: bool = False) -> NDArray[np.uint8]:
    """Check an image as :func:`checked` does and return its pixels as a plain array that shares its memory."""
    pixels = np.asarray(image)
    grey = pixels.ndim == 2 and not colour
    if pixels.dtype != np.uint8 or not (grey or (pixels.ndim == 3 and pixels.shape[2] == 3)):
        wanted = "(h, w, 3)" if colour else "(h, w, 3) or (h, w)"
        raise UsageError(f"the image has shape {pixels.shape} and type {pixels.dtype} and must be uint8, {wanted}")
    if pixels.size == 0:
        raise UsageError("the image is empty")
    return pixels


def project(points: ArrayLike, intrinsics: Intrinsics) -> Array:
    """Project points into the image.

    Args:
        points: Shape (n, 3) in optical axes; either points, or directions of any length.
        intrinsics: Intrinsics of the camera.

    Returns:
        Pixels (n, 2); NaN for points that the model can't show: those not in front of a pinhole camera, and those
        beyond the angle at which the lens's polynomial turns back.

    Raises:
        UsageError: The shape is wrong, or the model is unknown.
    """
    given = _rows(points, 3)
    if _is_fisheye(intrinsics):
        return _bent(given, intrinsics)
    before = given[:, 2] > _WIDEST * np.linalg.norm(given, axis=1)
    pixels = np.full((len(given), 2), np.nan)
    if before.any():
        cv, none = opencv("projecting"), np.zeros(3)
        seen = given[before].reshape(-1, 1, 3)
        found, _ = cv.projectPoints(seen, none, none, intrinsics.matrix, _distortion(intrinsics))
        pixels[before] = np.asarray(found, dtype=np.float64).reshape(-1, 2)
        flat = given[:, :2] / np.where(before, given[:, 2], np.nan)[:, None]
        pixels[np.hypot(flat[:, 0], flat[:, 1]) > _fold(intrinsics.distortion)] = np.nan
    return pixels


def unproject(pixels: ArrayLike, intrinsics: Intrinsics) -> Array:
    """Return the viewing directions of pixels as unit vectors (n, 3) in optical axes.

    Args:
        pixels: Shape (n, 2).
        intrinsics: Intrinsics of the camera.

    Returns:
        The directions; NaN for pixels that have none in the model.

    Raises:
        UsageError: The shape is wrong, or the model is unknown.
    """
    given = _rows(pixels, 2)
    if _is_fisheye(intrinsics):
        return _straight(given, intrinsics)
    rays = np.column_stack([_ideal(given, intrinsics), np.ones(len(given))])
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True), dtype=np.float64)


def normalised(pixels: ArrayLike, intrinsics: Intrinsics) -> Array:
    """Return x/z and y/z (n, 2) of the directions of pixels (n, 2); NaN if not in front of the camera."""
    if not _is_fisheye(intrinsics):
        return _ideal(_rows(pixels, 2), intrinsics)
    rays = unproject(pixels, intrinsics)
    rays[~(rays[:, 2] > _WIDEST)] = np.nan
    return np.asarray(rays[:, :2] / rays[:, 2:], dtype=np.float64)


def undistort(
    image: NDArray[np.uint8], intrinsics: Intrinsics | None = None, *, balance: float = 0.0
) -> tuple[NDArray[np.uint8], Intrinsics]:
    """Remove the lens distortion from an image.

    Args:
        image: A :class:`skyloop.Frame` or a uint8 array, (h, w, 3) or (h, w).
        intrinsics: Intrinsics of the camera; defaults to the frame's own.
        balance: 0 shows only valid pixels; 1 shows everything that the camera saw, surrounded by black; values in
            between are allowed.

    Returns:
        The image of an ideal pinhole camera, and that camera's intrinsics.

    Raises:
        UsageError: An argument is out of its range, or there are no intrinsics.
        MissingExtraError: OpenCV is not installed.
    """
    pixels, intrinsics = checked(image, intrinsics)
    if not 0.0 <= balance <= 1.0:
        raise UsageError(f"balance is {balance!r} and must be from 0 to 1")
    ideal, across, down = _maps(intrinsics, pixels.shape[1], pixels.shape[0], balance)
    cv = opencv("removing distortion")
    return np.asarray(cv.remap(pixels, across, down, cv.INTER_LINEAR), dtype=np.uint8), ideal


@lru_cache(maxsize=8)
def _maps(intrinsics: Intrinsics, width: int, height: int, balance: float) -> tuple[Intrinsics, Any, Any]:
    """Return the ideal camera and the sampling maps of its pixels. Cached for each camera."""
    cv, size, turn = opencv("removing distortion"), (width, height), np.eye(3)
    focal = _focal_length(intrinsics, width, height, balance)
    ideal = Intrinsics(focal, focal, intrinsics.cx, intrinsics.cy)
    lens = cv.fisheye if _is_fisheye(intrinsics) else cv
    across, down = lens.initUndistortRectifyMap(
        intrinsics.matrix, _distortion(intrinsics), turn, ideal.matrix, size, cv.CV_16SC2
    )
    return ideal, across, down


def _focal_length(intrinsics: Intrinsics, width: int, height: int, balance: float) -> float:
    """Return the ideal pinhole's focal length; ``balance`` 0 keeps only valid pixels, and 1 keeps the whole view."""
    across, down = np.linspace(0, width - 1, 33), np.linspace(0, height - 1, 25)
    reach = []  # for each side: pixels from the axis, divided by the smallest and by the largest direction along it
    for axis, at, along in ((0, 0.0, down), (0, width - 1.0, down), (1, 0.0, across), (1, height - 1.0, across)):
        side = np.full((len(along), 2), at)
        side[:, 1 - axis] = along
        seen = np.nan_to_num(np.abs(normalised(side, intrinsics)[:, axis]), nan=_STEEPEST)
        pixels = abs(at - (intrinsics.cx, intrinsics.cy)[axis])
        reach.append((pixels / min(_STEEPEST, seen.min()), pixels / min(_STEEPEST, seen.max())))
    closest, widest = max(near for near, _ in reach), min(far for _, far in reach)
    return float(closest ** (1.0 - balance) * widest**balance)


def _ideal(pixels: Array, intrinsics: Intrinsics) -> Array:
    """Return x/z and y/z for the pixels of a pinhole camera."""
    if not len(pixels):
        return np.empty((0, 2))
    cv, given = opencv("removing distortion"), pixels.reshape(-1, 1, 2)
    matrix, distortion = intrinsics.matrix, _distortion(intrinsics)
    criteria = (cv.TERM_CRITERIA_COUNT | cv.TERM_CRITERIA_EPS, *_ITERATIONS)
    if hasattr(cv, "undistortPointsIter"):  # OpenCV 4
        flat = cv.undistortPointsIter(given, matrix, distortion, None, None, criteria)
    else:
        flat = cv.undistortPoints(given, matrix, distortion, criteria=criteria)
    found = np.asarray(flat, dtype=np.float64).reshape(-1, 2)
    # Beyond a lens's fold the iteration may converge to any point, so reject results that don't project back.
    back = project(np.column_stack([found, np.ones(len(found))]), intrinsics)
    found[~(np.abs(back - pixels).max(axis=1) < _RETURN_PX)] = np.nan
    return found


@lru_cache(maxsize=64)
def _fold(distortion: tuple[float, ...]) -> float:
    """Return the distance from the axis (for f = 1) beyond which a pinhole model's distortion folds back."""
    k1, k2, _, _, k3, k4, k5, k6 = (*distortion, *(0.0,) * 8)[:8]
    if not any(distortion):
        return np.inf
    square = _DISTANCES**2
    above, below = 1 + square * (k1 + square * (k2 + square * k3)), 1 + square * (k4 + square * (k5 + square * k6))
    steps = np.diff(_DISTANCES * above / below)
    return float(_DISTANCES[np.argmax(steps <= 0.0)]) if (steps <= 0.0).any() else np.inf


def _bent(points: Array, intrinsics: Intrinsics) -> Array:
    """Project directions through a fisheye lens and return their pixels."""
    aside = np.hypot(points[:, 0], points[:, 1])
    angle = np.arctan2(aside, points[:, 2])
    radius, slope = _polynomial(angle, intrinsics)
    scale = np.divide(radius, aside, out=np.ones_like(aside), where=aside > 0.0)
    scale[slope <= 0.0] = np.nan
    return points[:, :2] * scale[:, None] * (intrinsics.fx, intrinsics.fy) + (intrinsics.cx, intrinsics.cy)


def _straight(pixels: Array, intrinsics: Intrinsics) -> Array:
    """Return the viewing directions of a fisheye's pixels, using Newton's method on the angle to the axis."""
    flat = (pixels - (intrinsics.cx, intrinsics.cy)) / (intrinsics.fx, intrinsics.fy)
    radius = np.hypot(flat[:, 0], flat[:, 1])
    angle = np.minimum(radius, np.pi)
    for _ in range(_ITERATIONS[0]):
        value, slope = _polynomial(angle, intrinsics)
        angle = np.clip(angle - (value - radius) / np.where(np.abs(slope) > 1e-6, slope, 1.0), 0.0, np.pi)
    value, slope = _polynomial(angle, intrinsics)
    lost = (np.abs(value - radius) > 1e-9) | (slope <= 0.0)
    aside = np.divide(np.sin(angle), radius, out=np.zeros_like(radius), where=radius > 0.0)
    rays = np.column_stack([flat * aside[:, None], np.cos(angle)])
    rays[lost] = np.nan
    return rays


def _polynomial(angle: Array, intrinsics: Intrinsics) -> tuple[Array, Array]:
    """Return the distance from the axis in the image (for f = 1) at an angle to the axis, and its derivative."""
    k1, k2, k3, k4 = _distortion(intrinsics)
    square = angle * angle
    value = angle * (1.0 + square * (k1 + square * (k2 + square * (k3 + square * k4))))
    slope = 1.0 + square * (3 * k1 + square * (5 * k2 + square * (7 * k3 + square * 9 * k4)))
    return value, slope


def _is_fisheye(intrinsics: Intrinsics) -> bool:
    if intrinsics.model not in ("pinhole", "fisheye"):
        raise UsageError(f"the intrinsics' model is {intrinsics.model!r} and must be 'pinhole' or 'fisheye'")
    return intrinsics.model == "fisheye"


def _distortion(intrinsics: Intrinsics) -> Array:
    return np.asarray(intrinsics.distortion or (0.0, 0.0, 0.0, 0.0), dtype=np.float64)


def _rows(values: ArrayLike, columns: int) -> Array:
    rows = np.asarray(values, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != columns:
        raise UsageError(f"the array must have shape (n, {columns}), got {rows.shape}")
    return np.ascontiguousarray(rows)
