"""Find the quad visible at each sample of an image, and colour the samples, with soft shadows.

Quads are found by geometry, with neither clipping nor a conventional depth buffer. A ray r through the eye meets a
convex polygon in front of the eye exactly if it is on the inner side of every plane through the eye and an edge: (v_i ×
v_{i+1}) · r has the same sign for all edges. This also holds for corners behind the eye, so nothing is clipped and no
wall is lost at a grazing angle. On one row of the image, each edge becomes a limit on x. Across the image, 1/z is
linear: 1/z = (n · r) / (n · v_0). Source: M. Olano, T. Greer, "Triangle Scan Conversion using 2D Homogeneous
Coordinates", Graphics Hardware 1997.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skyloop.sim.camera import CameraPose
from skyloop.sim.render.quads import GAP, LEVELS, Atlas, Floats, Quads, cv2

# Fraction of its distance by which a picture is considered closer than the wall behind it, per step of priority.
PRIORITY_SHARE = 1e-3
# Maximum distance between the eye and the plane of a quad that is considered edge-on and therefore invisible [m].
EDGE_ON_M = 1e-5
_BAND = 32768  # samples of a quad per batch; small enough for the working arrays to stay in the cache


@dataclass(frozen=True, slots=True)
class Grid:
    """Samples of a distortion-free image plane: sample (X, Y) sees the ray ((X - cx)/fx, (Y - cy)/fy, 1)."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float


@dataclass(frozen=True, slots=True)
class View:
    """The quads that may be visible from a pose, and their position on the grid. The first axis of all arrays is m.

    ``index``: indices in the batch. ``inverse_depth``: c with 1/z = c · ray, ray = (x/z, y/z, 1), shape (m, 3).
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
    """Return a · b along the last axis, of length 3, summed in fixed order, so the bits don't depend on libraries."""
    return np.asarray(a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2])


def turned(vectors: Floats, rotation: Floats) -> Floats:
    """Return vectors, shape (…, 3), multiplied from the right by a rotation, with sums as in :func:`dot`."""
    return np.stack([dot(vectors, rotation[:, axis]) for axis in range(3)], axis=-1)


def visible_quads(quads: Quads, shown: NDArray[np.bool_], pose: CameraPose, grid: Grid) -> View:
    """Return the ``shown`` quads, (n,), that would be visible from a pose through a grid if nothing occluded them.

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
    """Return False for quads wholly beyond one edge of the view or behind the eye. ``corners``: optical, (m, 4, 3)."""
    x, y, z = corners[..., 0], corners[..., 1], corners[..., 2]
    left, right = -(0.5 + grid.cx) / grid.fx, (grid.width - 0.5 - grid.cx) / grid.fx
    top, bottom = -(0.5 + grid.cy) / grid.fy, (grid.height - 0.5 - grid.cy) / grid.fy
    beyond = (x < left * z).all(axis=1) | (x > right * z).all(axis=1)
    beyond |= (y < top * z).all(axis=1) | (y > bottom * z).all(axis=1)
    return np.asarray(~(beyond | (z <= 0.0).all(axis=1)))


def _columns(edges: Floats, grid: Grid) -> tuple[NDArray[np.int16], NDArray[np.int16]]:
    """Return the first and the one-past-last column of each row, (m, height), inside edge planes, (m, 4, 3)."""
    slope_x = edges[..., 0] / grid.fx
    slope_y = edges[..., 1] / grid.fy
    start = edges[..., 2] - slope_x * grid.cx - slope_y * grid.cy
    # An exactly level edge does not bound any columns; with this tiny slope, it includes all or none of a row.
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
        #: One-based index, in the view, of the quad at each sample; 0 for no quad; int32, shape (height, width).
        #: Overwritten by the next call of :meth:`draw`.
        self.seen = np.empty(shape, np.int32)

    def draw(self, view: View, priority: NDArray[np.intp]) -> None:
        """Update :attr:`seen`. ``priority`` has one value per quad in the view, (m,)."""
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


CHUNK = 16384  # samples per batch; small enough for the working arrays to stay in the cache

# Light from high above and slightly from the east and south, plus ambient light: moderate contrast between faces.
SUN = np.array([0.33, -0.42, 0.85])
TO_SUN = SUN / np.linalg.norm(SUN)
AMBIENT, DIRECT = 0.74, 0.30
UNIT = 128.0  # eight-bit gain that represents a light of 1.0
# Factor for the pixel size when choosing a level: sharper textures that shimmer slightly. Doubled, as explained below.
FOOTPRINT = 2.0 * 0.6
FARTHEST = np.float32(1e-6)  # 1/z assumed for a ray that points beyond a quad's horizon [1/m]
_ONE = 0x3F800000  # bit pattern of 1.0 as a float32


def light_on(normals: Floats) -> Floats:
    """Return the brightness of faces, around 1, from their normals, shape (n,)."""
    return np.asarray(AMBIENT + DIRECT * np.maximum(dot(normals, TO_SUN), 0.0))


def sampling_table(quads: Quads, view: View, pose: CameraPose, atlas: Atlas, pixel_area: float) -> NDArray[np.float32]:
    """Return one column per quad in the view, after a column 0 for "nothing".

    The rows are a', b', c (three rows each), footprint, atlas x and y, and light; float32, shape (13, m + 1).
    ``pixel_area`` is 1/(fx fy) of the image.
    """
    k = view.index
    c = view.inverse_depth
    u_slope, v_slope = quads.u_slope[k], quads.v_slope[k]
    texture = quads.texture[k]
    # a = (slope in optical axes) + (texel under the eye, less the span) c, because levels shift as ``Atlas`` explains.
    under_u = dot(u_slope, pose.position_m) + quads.u_start[k] - atlas.span[texture]
    under_v = dot(v_slope, pose.position_m) + quads.v_start[k]
    table = np.zeros((13, len(k) + 1))
    table[0:3, 1:] = (turned(u_slope, pose.rotation) + under_u[:, None] * c).T
    table[3:6, 1:] = (turned(v_slope, pose.rotation) + under_v[:, None] * c).T
    table[6:9, 1:] = c.T
    table[9, 1:] = quads.density[k] / np.abs(view.height_m) * (pixel_area * FOOTPRINT)
    table[10, 1:] = atlas.x0[texture] + atlas.span[texture] - 0.5
    table[11, 1:] = atlas.y0[texture] - 0.5
    facing = np.where(view.height_m > 0.0, 1.0, -1.0)[:, None]
    table[12, 1:] = np.where(quads.lit[k], light_on(quads.normals[k] * facing), 1.0) * UNIT
    table[8, 0] = 1.0  # any finite depth works for "nothing", because its light is 0
    return table.astype(np.float32)


class Shader:
    """Colours samples from an atlas. The shader reuses buffers, so it must be used from one thread at a time."""

    def __init__(self, atlas: Atlas) -> None:
        self._image = atlas.image
        self._floats = np.empty((5, CHUNK), np.float32)
        self._levels = np.empty(CHUNK, np.int32)
        self._places = np.empty((1, CHUNK, 2), np.int16)
        self._parts = np.empty((1, CHUNK), np.uint16)
        self._light = np.empty((1, CHUNK), np.uint8)
        self._light4 = np.empty((1, CHUNK, 4), np.uint8)

    def shade(
        self,
        table: NDArray[np.float32],
        seen: NDArray[np.int32],
        ray_x: NDArray[np.float32],
        ray_y: NDArray[np.float32],
        colours: NDArray[np.uint8],
        inverse_depth: NDArray[np.float32],
    ) -> None:
        """Write the samples' colours, BGRA, (n, 4), and inverse depths [1/m], (n,), to the last two arguments.

        ``seen`` is each sample's column in the table from :func:`sampling_table`, (n,), and its ray is (x, y, 1).
        """
        for start in range(0, len(seen), CHUNK):
            part = slice(start, min(start + CHUNK, len(seen)))
            numbers = seen[part].astype(np.intp)
            self._shade_chunk(table, numbers, ray_x[part], ray_y[part], colours[None, part], inverse_depth[part])

    def _shade_chunk(
        self,
        table: NDArray[np.float32],
        seen: NDArray[np.intp],
        ray_x: NDArray[np.float32],
        ray_y: NDArray[np.float32],
        colours: NDArray[np.uint8],
        w: NDArray[np.float32],
    ) -> None:
        n = len(seen)
        u, v, got, inverse, scale = self._floats[:, :n]
        levels = self._levels[:n]

        def dot(row: int, into: NDArray[np.float32]) -> None:
            np.take(table[row], seen, out=into, mode="clip")
            np.multiply(into, ray_x, out=into)
            np.take(table[row + 1], seen, out=got, mode="clip")
            np.multiply(got, ray_y, out=got)
            np.add(into, got, out=into)
            np.take(table[row + 2], seen, out=got, mode="clip")
            np.add(into, got, out=into)

        dot(6, w)
        np.maximum(w, FARTHEST, out=w)
        dot(0, u)
        dot(3, v)
        np.divide(1.0, w, out=inverse)
        # level = floor((floor(log2(footprint)) + 1) / 2), from the exponent bits, which also give scale = 2^-level
        np.take(table[9], seen, out=scale, mode="clip")
        for _ in range(3):  # the area that a pixel covers on a plane grows with the cube of its depth
            np.multiply(scale, inverse, out=scale)
        np.subtract(scale.view(np.int32), _ONE, out=levels)
        np.right_shift(levels, 24, out=levels)
        np.clip(levels, 0, LEVELS - 1, out=levels)
        bits = scale.view(np.int32)
        np.left_shift(levels, 23, out=bits)
        np.subtract(_ONE, bits, out=bits)
        np.multiply(inverse, scale, out=inverse)
        np.multiply(u, inverse, out=u)
        np.multiply(v, inverse, out=v)
        np.multiply(levels, GAP, out=levels)
        np.copyto(got, levels)
        np.add(u, got, out=u)
        np.take(table[10], seen, out=got, mode="clip")
        np.add(u, got, out=u)
        np.take(table[11], seen, out=got, mode="clip")
        np.add(v, got, out=v)
        np.clip(u, 0.0, self._image.shape[1] - 2.0, out=u)
        np.clip(v, 0.0, self._image.shape[0] - 2.0, out=v)
        # Coordinates in 1/32 texel: all versions of OpenCV round these the same way and sample them faster.
        cv2.convertMaps(u[None], v[None], cv2.CV_16SC2, dstmap1=self._places[:, :n], dstmap2=self._parts[:, :n])
        places, parts = self._places[:, :n], self._parts[:, :n]
        cv2.remap(self._image, places, parts, cv2.INTER_LINEAR, dst=colours, borderMode=cv2.BORDER_REPLICATE)
        np.take(table[12], seen, out=got, mode="clip")
        light, light4 = self._light[:, :n], self._light4[:, :n]
        np.copyto(light[0], got, casting="unsafe")
        cv2.cvtColor(light, cv2.COLOR_GRAY2BGRA, dst=light4)
        cv2.multiply(colours, light4, dst=colours, scale=1.0 / UNIT)


# A pixel is darkened if its distance from the shadow's plane is below this fraction of its depth, plus this constant.
_THICKNESS, _MORE_M = 4e-3, 4e-3
_NEAR_M = 0.01  # corners of a shadow closer to the camera's plane than this are cut off


@dataclass(frozen=True, slots=True)
class Shadow:
    """A level, round area that receives less light."""

    centre_m: NDArray[np.float64]  #: centre in world axes
    radius_m: float  #: outer radius
    strength: float  #: fraction of the light missing in the middle, 0 to 1


@dataclass(frozen=True, slots=True)
class Extremes:
    """Minimum and maximum of x/z or y/z, in each column or row of an image, (n,), and overall."""

    least: NDArray[np.float32]
    most: NDArray[np.float32]
    low: float
    high: float

    @staticmethod
    def along(values: NDArray[np.float32], axis: int) -> Extremes:
        """Compute the extremes of the columns (axis 0) or of the rows (axis 1)."""
        least, most = values.min(axis=axis), values.max(axis=axis)
        return Extremes(least, most, float(least.min()), float(most.max()))

    def span(self, low: float, high: float) -> tuple[int, int] | None:
        """Return the first column or row with values between two bounds and the one after the last such, or None."""
        if not (low <= self.high and high >= self.low):
            return None
        where = ((self.most >= low) & (self.least <= high)).nonzero()[0]
        return (int(where[0]), int(where[-1]) + 1) if len(where) else None


@dataclass(frozen=True, slots=True)
class Rays:
    """x/z and y/z of each pixel seen through a lens, (height, width), and their extremes in each column and row."""

    x: NDArray[np.float32]
    y: NDArray[np.float32]
    columns: Extremes  #: extremes of x
    rows: Extremes  #: extremes of y

    @staticmethod
    def of(x: NDArray[np.float32], y: NDArray[np.float32]) -> Rays:
        """Compute the minimum and maximum values."""
        return Rays(x, y, Extremes.along(x, 0), Extremes.along(y, 1))


@dataclass(frozen=True, slots=True)
class Placed:
    """A shadow in a camera's view."""

    #: first row that may show the shadow, row after the last one, first column, column after the last one
    box: tuple[int, int, int, int]
    axes: NDArray[np.float32]  #: rotation from optical to world axes
    #: height of its plane above the camera [m]; camera's offset from its centre, east and north [m]; squared radius
    #: [m²]; strength out of 255; tolerance of a pixel's distance from the plane: fraction of depth, constant part [m]
    numbers: NDArray[np.float32]


def placed(shadow: Shadow, pose: CameraPose, rays: Rays) -> Placed | None:
    """Return a shadow in a camera's view, or None if no part of it is visible."""
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
    """Darken the pixels of a BGR image that show the area of a shadow, by the inverse depth of each pixel [1/m]."""
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
    """Return x/z and y/z, in optical axes, of the corners of the part of a square that is more than 1 cm ahead.

    ``sides`` are the vectors from the square's centre to the midpoints of two sides [m].
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
