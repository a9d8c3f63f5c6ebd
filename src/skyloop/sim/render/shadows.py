"""Soft dark spots under things in the air: translucent discs on the surface below."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skyloop.sim.camera import CameraPose
from skyloop.sim.render.opencv import cv2

# How far, as a share of the distance, a pixel may lie off the shadow's plane and still be darkened by it.
_THICKNESS = 4e-3
_MORE_M = 4e-3
_NEAR_M = 0.01


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


@dataclass(frozen=True, slots=True)
class Extremes:
    """Least and most of x/z or y/z in each column or row of a picture, (n,), and in all of it."""

    least: NDArray[np.float32]
    most: NDArray[np.float32]
    low: float
    high: float

    @staticmethod
    def along(values: NDArray[np.float32], axis: int) -> Extremes:
        """Find them; axis 0: of columns."""
        least, most = values.min(axis=axis), values.max(axis=axis)
        return Extremes(least, most, float(least.min()), float(most.max()))

    def span(self, low: float, high: float) -> tuple[int, int] | None:
        """The first column or row that may see something between two bounds, and the one after the last, or None."""
        if not (low <= self.high and high >= self.low):
            return None
        where = ((self.most >= low) & (self.least <= high)).nonzero()[0]
        return (int(where[0]), int(where[-1]) + 1) if len(where) else None


@dataclass(frozen=True, slots=True)
class Rays:
    """x/z and y/z of each pixel of a lens, (height, width), and their extremes in each column and row."""

    x: NDArray[np.float32]
    y: NDArray[np.float32]
    columns: Extremes  #: of x
    rows: Extremes  #: of y

    @staticmethod
    def of(x: NDArray[np.float32], y: NDArray[np.float32]) -> Rays:
        """Find the extremes."""
        return Rays(x, y, Extremes.along(x, 0), Extremes.along(y, 1))


@dataclass(frozen=True, slots=True)
class Placed:
    """A shadow as a camera sees it.

    Attributes:
        box: First row that may show it, row after the last, first column, column after the last.
        axes: World from optical.
        numbers: Its plane above the camera [m]; the camera from its centre, east and north [m]; square of its radius
            [m²]; strength of 255; how far a pixel may lie off the plane: share of the distance, and more [m].
    """

    box: tuple[int, int, int, int]
    axes: NDArray[np.float32]
    numbers: NDArray[np.float32]


def placed(shadow: Shadow, pose: CameraPose, rays: Rays) -> Placed | None:
    """Return where a shadow may be seen; None if nowhere."""
    away = pose.position_m - shadow.centre_m
    at = _seen_at((-away @ pose.rotation).tolist(), (shadow.radius_m * pose.rotation[:2]).tolist())
    if not at:
        return None
    across, down = zip(*at, strict=True)
    columns = rays.columns.span(min(across), max(across))
    rows = rays.rows.span(min(down), max(down)) if columns else None
    if columns is None or rows is None:
        return None
    numbers = (-away[2], away[0], away[1], shadow.radius_m**2, 255.0 * shadow.strength, _THICKNESS, _MORE_M)
    return Placed((*rows, *columns), pose.rotation.astype(np.float32), np.array(numbers, np.float32))


def darken(picture: NDArray[np.uint8], shadow: Placed, rays: Rays, inverse_depth: NDArray[np.float32]) -> None:
    """Darken the pixels of an image that show the shadow's place.

    Args:
        picture: BGR, (height, width, 3), changed in place.
        shadow: The shadow.
        rays: Of the lens.
        inverse_depth: Of each pixel [1/m], (height, width).
    """
    top, bottom, left, right = shadow.box
    part = slice(top, bottom), slice(left, right)
    x, y, depth = rays.x[part], rays.y[part], 1.0 / inverse_depth[part]
    east, north, up = shadow.axes
    below, away_x, away_y, square, strength, thickness, more = shadow.numbers
    off_plane = np.abs((up[0] * x + up[1] * y + up[2]) * depth - below)
    at_x = (east[0] * x + east[1] * y + east[2]) * depth + away_x
    at_y = (north[0] * x + north[1] * y + north[2]) * depth + away_y
    rim = np.clip(1.0 - (at_x * at_x + at_y * at_y) / square, 0.0, 1.0)
    rim *= off_plane < thickness * depth + more
    light = (255.0 - strength * rim * rim * (3.0 - 2.0 * rim)).astype(np.uint8)
    target = picture[part]
    target[...] = cv2.multiply(np.ascontiguousarray(target), cv2.cvtColor(light, cv2.COLOR_GRAY2BGR), scale=1.0 / 255.0)


def _seen_at(centre: list[float], sides: list[list[float]]) -> list[tuple[float, float]]:
    """x/z and y/z of the corners of the part of a square that lies farther ahead than a centimetre, optical axes.

    Args:
        centre: Of the square [m].
        sides: From there to the middles of two sides [m].
    """
    (ax, ay, az), (bx, by, bz) = sides
    signs = ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0))
    x, y, z = centre
    corners = [(x + p * ax + q * bx, y + p * ay + q * by, z + p * az + q * bz) for p, q in signs]
    found = [(x / z, y / z) for x, y, z in corners if z > _NEAR_M]
    for (x, y, z), (x2, y2, z2) in zip(corners, corners[1:] + corners[:1], strict=True):
        if (z > _NEAR_M) != (z2 > _NEAR_M):
            share = (_NEAR_M - z) / (z2 - z)
            found.append(((x + share * (x2 - x)) / _NEAR_M, (y + share * (y2 - y)) / _NEAR_M))
    return found
