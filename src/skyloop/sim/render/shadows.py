"""Soft dark spots under things in the air: translucent discs on the surface below."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skyloop.sim.camera import CameraPose
from skyloop.sim.render.opencv import cv2

# How far, as a share of the distance, a pixel may lie off the shadow's plane and still be darkened by it.
_THICKNESS = 4e-3
_NEAR_M = 0.01
_SQUARE = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])


@dataclass(frozen=True, slots=True)
class Shadow:
    """A level round spot with less light.

    Attributes:
        centre_m: World axes.
        radius_m: Where it ends.
        strength: How much light is missing in its middle, 0 to 1.
    """

    centre_m: NDArray[np.float64]
    radius_m: float
    strength: float


def darken(
    picture: NDArray[np.uint8],
    shadow: Shadow,
    pose: CameraPose,
    ray_x: NDArray[np.float32],
    ray_y: NDArray[np.float32],
    inverse_depth: NDArray[np.float32],
) -> None:
    """Darken the pixels of an image that show the shadow's place.

    Args:
        picture: Shape (h, w, 4), changed in place.
        shadow: The shadow.
        pose: Of the camera.
        ray_x: Of each pixel, flat.
        ray_y: Of each pixel, flat.
        inverse_depth: Of each pixel [1/m], flat.
    """
    height, width = picture.shape[:2]
    box = _rows_and_columns(shadow, pose, ray_x.reshape(height, width), ray_y.reshape(height, width))
    if box is None:
        return
    rows, columns = box
    x = ray_x.reshape(height, width)[rows, columns]
    y = ray_y.reshape(height, width)[rows, columns]
    w = inverse_depth.reshape(height, width)[rows, columns]
    east, north, up = pose.rotation.astype(np.float32)
    below = np.float32(shadow.centre_m[2] - pose.position_m[2])
    away_x = np.float32(pose.position_m[0] - shadow.centre_m[0])
    away_y = np.float32(pose.position_m[1] - shadow.centre_m[1])
    depth = 1.0 / w
    off_plane = np.abs((up[0] * x + up[1] * y + up[2]) * depth - below)
    at_x = (east[0] * x + east[1] * y + east[2]) * depth + away_x
    at_y = (north[0] * x + north[1] * y + north[2]) * depth + away_y
    rim = np.clip(1.0 - (at_x * at_x + at_y * at_y) / np.float32(shadow.radius_m**2), 0.0, 1.0)
    rim *= off_plane < _THICKNESS * depth + np.float32(0.004)
    light = (255.0 - 255.0 * shadow.strength * rim * rim * (3.0 - 2.0 * rim)).astype(np.uint8)
    part = picture[rows, columns]
    part[...] = cv2.multiply(np.ascontiguousarray(part), cv2.cvtColor(light, cv2.COLOR_GRAY2BGRA), scale=1.0 / 255.0)


def _rows_and_columns(
    shadow: Shadow, pose: CameraPose, ray_x: NDArray[np.float32], ray_y: NDArray[np.float32]
) -> tuple[slice, slice] | None:
    """The part of the picture that may show the shadow; None if no part does."""
    corners = shadow.centre_m + shadow.radius_m * _SQUARE
    optical = _in_front((corners - pose.position_m) @ pose.rotation)
    if not len(optical):
        return None
    at = optical[:, :2] / optical[:, 2:]
    columns = (ray_x.max(axis=0) >= at[:, 0].min()) & (ray_x.min(axis=0) <= at[:, 0].max())
    rows = (ray_y.max(axis=1) >= at[:, 1].min()) & (ray_y.min(axis=1) <= at[:, 1].max())
    if not (columns.any() and rows.any()):
        return None
    return _span(rows), _span(columns)


def _in_front(corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """The corners of the part of a polygon, (n, 3) optical, that lies farther ahead than a centimetre."""
    ahead = corners[:, 2] > _NEAR_M
    after = np.roll(corners, -1, axis=0)
    crossing = ahead != np.roll(ahead, -1)
    share = (_NEAR_M - corners[crossing, 2]) / (after[crossing, 2] - corners[crossing, 2])
    cuts = corners[crossing] + share[:, None] * (after[crossing] - corners[crossing])
    return np.vstack([corners[ahead], cuts])


def _span(flags: NDArray[np.bool_]) -> slice:
    where = np.flatnonzero(flags)
    return slice(int(where[0]), int(where[-1]) + 1)
