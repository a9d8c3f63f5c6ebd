"""Finding the quad visible at each sample of an image, by geometry without clipping and a depth buffer.

A ray r through the eye meets a convex polygon in front of the eye exactly if it is on the inner side of every plane
through the eye and an edge: (v_i × v_{i+1}) · r has the same sign for all edges. This also holds for corners behind the
eye, so nothing is clipped and no wall is lost at a grazing angle. On one row of the image, each edge becomes a bound on
x. Across the image, 1/z is linear: 1/z = (n · r) / (n · v_0).
Source: M. Olano, T. Greer, "Triangle Scan Conversion using 2D Homogeneous Coordinates", Graphics Hardware 1997.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skyloop.sim.camera import CameraPose
from skyloop.sim.render.quads import Floats, Quads, cv2

# How much closer a picture counts than the wall behind it, per step of priority, as a fraction of the distance.
PRIORITY_SHARE = 1e-3
# Maximum distance of the eye from the plane of a quad that is edge-on and covers nothing visible [m].
EDGE_ON_M = 1e-5
_BAND = 32768  # samples of a quad per batch: few enough for the working arrays to stay in the cache


@dataclass(frozen=True, slots=True)
class Grid:
    """Samples of a distortion-free image plane, where sample (X, Y) sees the ray ((X - cx)/fx, (Y - cy)/fy, 1)."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float


@dataclass(frozen=True, slots=True)
class View:
    """The quads that may be visible from a pose, and their position on the grid. All arrays have m as their first axis.

    ``index``: numbers in the batch. ``inverse_depth``: c with 1/z = c · ray, ray = (x/z, y/z, 1), shape (m, 3).
    ``height_m``: signed height of the eye above the plane, (m,). ``first``, ``end``: columns covered in each row,
    (m, height). ``box``: bounds x0, y0, x1, y1, (m, 4).
    """

    index: NDArray[np.intp]
    inverse_depth: Floats
    height_m: Floats
    first: NDArray[np.int16]
    end: NDArray[np.int16]
    box: NDArray[np.intp]


def dot(a: Floats, b: Floats) -> Floats:
    """Return a · b along the last axis of three, summed in order: independent of libraries, so always the same bits."""
    return np.asarray(a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2])


def turned(vectors: Floats, rotation: Floats) -> Floats:
    """Return vectors, shape (…, 3), multiplied by a rotation from the right, with sums as in :func:`dot`."""
    return np.stack([dot(vectors, rotation[:, axis]) for axis in range(3)], axis=-1)


def visible_quads(quads: Quads, shown: NDArray[np.bool_], pose: CameraPose, grid: Grid) -> View:
    """Return those of the ``shown`` quads, (n,), that are individually visible from a pose through a grid.

    :class:`DepthBuffer` handles occlusion.
    """
    height_m = dot(quads.normals, pose.position_m - quads.corners[:, 0])
    facing = (height_m > EDGE_ON_M) | (quads.two_sided & (height_m < -EDGE_ON_M))
    index = np.flatnonzero(facing & shown)
    corners = turned(quads.corners[index] - pose.position_m, pose.rotation)
    inside = _touches_view(corners, grid)
    index, corners = index[inside], corners[inside]
    height_m = height_m[index]
    edges = np.cross(corners, np.roll(corners, -1, axis=1)) * -np.sign(height_m)[:, None, None]
    first, end = _columns(edges, grid)
    covered = end > first
    seen = covered.any(axis=1)
    index, height_m, first, end, covered = index[seen], height_m[seen], first[seen], end[seen], covered[seen]
    box = np.empty((len(index), 4), np.intp)
    if len(index):
        box[:, 0] = np.where(covered, first, grid.width).min(axis=1)
        box[:, 1] = covered.argmax(axis=1)
        box[:, 2] = np.where(covered, end, 0).max(axis=1)
        box[:, 3] = grid.height - covered[:, ::-1].argmax(axis=1)
    inverse_depth = turned(quads.normals[index], pose.rotation) / -height_m[:, None]
    return View(index, inverse_depth, height_m, first, end, box)


def _touches_view(corners: Floats, grid: Grid) -> NDArray[np.bool_]:
    """Return False for quads entirely beyond one side of the view or behind the eye. Corners (m, 4, 3) are optical."""
    x, y, z = corners[..., 0], corners[..., 1], corners[..., 2]
    left, right = -(0.5 + grid.cx) / grid.fx, (grid.width - 0.5 - grid.cx) / grid.fx
    top, bottom = -(0.5 + grid.cy) / grid.fy, (grid.height - 0.5 - grid.cy) / grid.fy
    beyond = (x < left * z).all(axis=1) | (x > right * z).all(axis=1)
    beyond |= (y < top * z).all(axis=1) | (y > bottom * z).all(axis=1)
    return np.asarray(~(beyond | (z <= 0.0).all(axis=1)))


def _columns(edges: Floats, grid: Grid) -> tuple[NDArray[np.int16], NDArray[np.int16]]:
    """Return the first and one-past-last column in each row, (m, height), inside edge planes, (m, 4, 3)."""
    slope_x = edges[..., 0] / grid.fx
    slope_y = edges[..., 1] / grid.fy
    start = edges[..., 2] - slope_x * grid.cx - slope_y * grid.cy
    # An exactly level edge bounds no columns; with this tiny slope it includes all or none of a row.
    slope_x[slope_x == 0.0] = 1e-30
    crossing = (slope_y / -slope_x)[..., None] * np.arange(grid.height) + (start / -slope_x)[..., None]
    rising = (slope_x > 0.0)[..., None]
    low = np.where(rising, crossing, -1.0).max(axis=1)
    high = np.where(rising, float(grid.width), crossing).min(axis=1)
    first = np.ceil(np.clip(low, 0.0, grid.width)).astype(np.int16)
    end = np.floor(np.clip(high, -1.0, grid.width - 1)).astype(np.int16) + np.int16(1)
    return first, end


class DepthBuffer:
    """Finds the nearest quad at each sample."""

    def __init__(self, grid: Grid) -> None:
        shape = (grid.height, grid.width)
        self._grid = grid
        self._columns = np.arange(grid.width, dtype=np.int16)[None, :]
        self._nearest = np.empty(shape, np.float32)
        working = max(_BAND, grid.width)
        self._candidate = np.empty(working, np.float32)
        self._number = np.empty(working, np.int32)
        self._mask = np.empty(working, np.uint8)
        self._scratch = np.empty(working, np.bool_)
        #: Index in the view of the quad at each sample plus one, 0 for none; int32, shape (height, width). Overwritten
        #: by the next :meth:`draw`.
        self.seen = np.empty(shape, np.int32)

    def draw(self, view: View, priority: NDArray[np.intp]) -> None:
        """Update :attr:`seen`. ``priority``: that of each quad in the view, (m,)."""
        grid = self._grid
        slope = view.inverse_depth * (1.0 + PRIORITY_SHARE * priority)[:, None] / (grid.fx, grid.fy, 1.0)
        start = slope[:, 2] - slope[:, 0] * grid.cx - slope[:, 1] * grid.cy
        along_x = (slope[:, :1] * np.arange(grid.width)).astype(np.float32)
        along_y = (slope[:, 1:2] * np.arange(grid.height) + start[:, None]).astype(np.float32)
        self._nearest.fill(0.0)
        self.seen.fill(0)
        for k, (x0, y0, x1, y1) in enumerate(view.box.tolist()):
            band = max(1, _BAND // (x1 - x0))
            for top in range(y0, y1, band):
                self._draw_band(view, k, along_x[k], along_y[k], (x0, top, x1, min(top + band, y1)))

    def _draw_band(
        self,
        view: View,
        k: int,
        along_x: NDArray[np.float32],
        along_y: NDArray[np.float32],
        box: tuple[int, int, int, int],
    ) -> None:
        """Draw the part of a quad within a box wherever it is closer than earlier quads."""
        x0, y0, x1, y1 = box
        size = (y1 - y0) * (x1 - x0)
        shape = (y1 - y0, x1 - x0)
        candidate, mask = self._candidate[:size].reshape(shape), self._mask[:size].reshape(shape)
        scratch, number = self._scratch[:size].reshape(shape), self._number[:size].reshape(shape)
        flags = mask.view(np.bool_)
        nearest = self._nearest[y0:y1, x0:x1]
        columns = self._columns[:, x0:x1]
        np.add(along_x[None, x0:x1], along_y[y0:y1, None], out=candidate)
        np.greater(candidate, nearest, out=flags)
        np.greater_equal(columns, view.first[k, y0:y1, None], out=scratch)
        np.logical_and(flags, scratch, out=flags)
        np.less(columns, view.end[k, y0:y1, None], out=scratch)
        np.logical_and(flags, scratch, out=flags)
        number.fill(k + 1)
        cv2.copyTo(candidate, mask, nearest)
        cv2.copyTo(number, mask, self.seen[y0:y1, x0:x1])
