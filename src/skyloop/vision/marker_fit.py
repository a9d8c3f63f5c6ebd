"""Reading square markers and fitting their corners to a fraction of a pixel.

Candidates come from OpenCV. Lines are fitted to their four edges, weighted by the gradients (as the AprilTag library
does: Wang and Olson, "AprilTag 2: Efficient and robust fiducial detection", IROS 2016), the cells are read between
black and white planes, and compared with all codes at once. The known pattern is then aligned with the image: a
homography, an affine light and a Gaussian blur are found by least squares (Baker and Matthews, "Lucas-Kanade 20 Years
On", IJCV 56(3), 2004), so that all edges of the pattern count, and the residuals tell the corners' covariance.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skyloop.vision.lens import Array

Pixels = NDArray[np.float32]
_ALONG: Final = np.linspace(0.08, 0.92, 20)  # where an edge is searched, as a fraction of its length
_ACROSS: Final = np.linspace(-1.0, 1.0, 17)  # and how far from it, as a fraction of the reach
_REACH, _LEAST_REACH_PX = 0.8, 1.6  # reach across an edge: in cells, and the least in pixels
_LEAST_PERIMETER_PX: Final = 28.0  # of a quadrilateral
_NOISY: Final = 4.0  # grey levels: images with more noise are smoothed before the search
_SHARPENING: Final = 0.25  # of cells against their neighbours, because blur mixes them
_LEAST_CONTRAST: Final = 8.0  # grey levels between black and white
_BORDER_ERRORS: Final = 0.25  # largest fraction of the border's cells that are not black
_CORRECTED: Final = 0.6  # fraction of a dictionary's correctable bits that are corrected (OpenCV's default)
_ITERATIONS: Final = 10
_LEAST_LIKENESS: Final = 0.9  # fraction of the brightness's variance that the pattern must explain
_LEAST_SIGMA_PX: Final = 0.015  # of a corner: lenses and prints are no better known
_SETTLED: Final = 0.01  # of a cell: smaller steps end the fit
_MOST_SAMPLES: Final = 8  # per cell


class Codes:
    """The codes of a dictionary, in the four turns."""

    def __init__(self, markers: Any, corrected: float = _CORRECTED) -> None:
        """Prepare the codes of OpenCV's dictionary; ``corrected`` is a fraction of its correctable bits."""
        count, width = markers.bytesList.shape[:2]
        self.size = size = int(markers.markerSize)  #: cells of data per side
        # OpenCV packs the bits row by row, the last byte right-aligned, one turn after the other.
        bits = np.unpackbits(markers.bytesList.reshape(count, 4, width)[:, 0], axis=1)
        last = size * size - 8 * (width - 1)
        data = np.concatenate([bits[:, : 8 * (width - 1)], bits[:, 8 * width - last :]], axis=1)
        data = data.reshape(count, size, size).astype(bool)
        self.patterns = np.pad(data, ((0, 0), (1, 1), (1, 1)))  #: with the black border, true where white
        turned = np.stack([np.rot90(data, turns, axes=(1, 2)) for turns in range(4)], axis=1)
        self._signs = np.where(turned, 1.0, -1.0).astype(np.float32).reshape(4 * count, -1)
        self._allowed = int(markers.maxCorrectionBits * corrected)

    def match(self, bits: NDArray[np.bool_]) -> tuple[Any, Any, Any]:
        """Return id, turns and wrong bits of the nearest codes for bits (m, size, size); id is -1 if none is near."""
        signs = np.where(bits, 1.0, -1.0).astype(np.float32).reshape(len(bits), -1)
        alike = signs @ self._signs.T
        best = alike.argmax(axis=1)
        wrong = (self.size**2 - alike[np.arange(len(bits)), best]) / 2
        return np.where(wrong <= self._allowed + 0.5, best // 4, -1), best % 4, wrong


class QuadFinder:
    """Finds dark quadrilaterals by OpenCV's thresholds and contours, without OpenCV's own reading of them.

    Reading takes OpenCV a millisecond for each quadrilateral and a dictionary of 1000 markers, and fails on small ones.
    """

    def __init__(self, cv: Any) -> None:
        self._cv = cv
        self._parameters = parameters = cv.aruco.DetectorParameters()
        # One window suffices, because only the outer edge of the border counts.
        parameters.adaptiveThreshWinSizeMin = parameters.adaptiveThreshWinSizeMax = 13
        parameters.polygonalApproxAccuracyRate = 0.05  # small and tilted markers have few pixels for each corner
        # The white card's edge is another square near the marker's, which must not hide it.
        parameters.minMarkerDistanceRate = parameters.minGroupDistance = 0.0
        # No image matches this code: all quadrilaterals are returned as rejected ones.
        unused = cv.aruco.Dictionary(np.full((1, 5, 4), 0b01010101, np.uint8), 6, 0)
        self._detector = cv.aruco.ArucoDetector(unused, parameters)
        self._set: tuple[int, float] = (0, 0.0)

    def find(self, grey: NDArray[np.uint8]) -> Array:
        """Return quadrilaterals (m, 4, 2), clockwise [px]."""
        noise = _noise(grey)
        if noise > _NOISY:  # noise makes thousands of contours
            grey, noise = self._cv.GaussianBlur(grey, (3, 3), 0), 0.375 * noise
        wanted = (max(grey.shape), 7.0 if noise < _NOISY else max(7.0, round(1.3 * noise)))
        if wanted != self._set:
            self._set = wanted
            self._parameters.minMarkerPerimeterRate = _LEAST_PERIMETER_PX / wanted[0]
            self._parameters.adaptiveThreshConstant = wanted[1]
            self._detector.setDetectorParameters(self._parameters)
        quads, _, others = self._detector.detectMarkers(grey)
        return np.asarray([*quads, *others], dtype=np.float64).reshape(-1, 4, 2)


def _noise(grey: NDArray[np.uint8]) -> float:
    """Return the standard deviation of the noise, from second differences along some rows."""
    rows = grey[::8].astype(np.int16)
    if rows.shape[1] < 3:
        return 0.0
    return float(np.median(np.abs(rows[:, 2:] - 2 * rows[:, 1:-1] + rows[:, :-2]))) / (0.6745 * math.sqrt(6.0))


def line_quads(cv: Any, image: NDArray[Any], quads: Array, cells: int) -> Array:
    """Return quadrilaterals (m, 4, 2), clockwise, with corners where lines fitted to their edges meet.

    Args:
        cv: OpenCV.
        image: Grey, (h, w).
        quads: Rough quadrilaterals around dark squares, clockwise.
        cells: Number of cells of a side, which limits the search to the border's cells.
    """
    way = np.roll(quads, -1, axis=1) - quads
    length = np.maximum(np.linalg.norm(way, axis=2, keepdims=True), 1e-6)
    out = np.stack([way[..., 1], -way[..., 0]], axis=-1) / length
    x, y = np.moveaxis(quads - np.roll(quads, 2, axis=1), 2, 0)
    area = np.abs(x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0])[:, None, None] / 2
    reach = np.maximum(_REACH * area / length / cells, _LEAST_REACH_PX)  # (m, 4, 1), by the extent across the edge
    off = reach * _ACROSS  # (m, 4, across)
    on = quads[:, :, None] + _ALONG[:, None] * way[:, :, None]  # (m, 4, along, 2)
    seen = sample(cv, image, on[:, :, :, None] + (off[..., None] * out[:, :, None])[:, :, None])
    weight = np.maximum(seen[..., 2:] - seen[..., :-2], 0.0) ** 2  # the square of the rise, if brighter outside
    total = weight.sum(axis=-1)
    place = (weight * off[:, :, None, 1:-1]).sum(axis=-1) / np.maximum(total, 1e-9)
    total += 1e-6
    along = _ALONG - (total * _ALONG).sum(axis=-1, keepdims=True) / total.sum(axis=-1, keepdims=True)
    mean = (total * place).sum(axis=-1) / total.sum(axis=-1)
    slope = (total * along * place).sum(axis=-1) / (total * along**2).sum(axis=-1)
    begin, end = mean + slope * along[..., 0], mean + slope * along[..., -1]
    ends = (on[:, :, 0] + begin[..., None] * out, on[:, :, -1] + end[..., None] * out)
    lines = np.cross(*(np.concatenate([each, np.ones_like(each[..., :1])], axis=-1) for each in ends))
    meeting = np.cross(np.roll(lines, 1, axis=1), lines)
    parallel = np.abs(meeting[..., 2:]) < 1e-9
    corners = meeting[..., :2] / np.where(parallel, 1.0, meeting[..., 2:])
    lost = parallel | (np.linalg.norm(corners - quads, axis=2, keepdims=True) > 2.5 * reach)
    return np.where(lost, quads, corners)


def read(cv: Any, image: NDArray[Any], quads: Array, codes: Codes) -> list[tuple[int, Array]]:
    """Return the ids and corners, from the marker's top left, of quadrilaterals (m, 4, 2) that show a marker."""
    side = codes.size + 2
    at = (np.arange(-1, side + 1) + 0.5) / side  # one cell beyond the border on each side
    grid = np.stack(np.meshgrid(at, at), axis=-1)
    seen = sample(cv, image, mapped(square_to(quads), grid))
    edge = np.zeros((side + 2, side + 2), dtype=np.int8)
    edge[1:-1, 1:-1], edge[2:-2, 2:-2] = 1, 2  # 0: around the marker, 1: its border, 2: its data
    basis = np.stack([np.ones_like(edge, dtype=float), grid[..., 0], grid[..., 1]], axis=-1)
    white, black = (seen[:, edge == n] @ np.linalg.pinv(basis[edge == n]).T @ basis.reshape(-1, 3).T for n in (0, 1))
    planes = ((white + black) / 2).reshape(seen.shape)
    # Where the white margin is too narrow, the brightest data tell what white is.
    brightest = np.percentile(seen[:, edge == 2], 90, axis=1)
    level = np.broadcast_to(((black.mean(axis=1) + brightest) / 2)[:, None, None], seen.shape)
    neighbours = seen[:, :-2, 1:-1] + seen[:, 2:, 1:-1] + seen[:, 1:-1, :-2] + seen[:, 1:-1, 2:]
    sharp = seen.copy()
    sharp[:, 1:-1, 1:-1] += _SHARPENING * (4 * seen[:, 1:-1, 1:-1] - neighbours)
    found: dict[int, list[tuple[float, float, Array]]] = {}
    for between, contrast in ((planes, (white - black).mean(axis=1)), (level, brightest - black.mean(axis=1))):
        framed = (seen < between)[:, edge == 1].mean(axis=1) >= 1.0 - _BORDER_ERRORS
        kept = np.flatnonzero(framed & (contrast > _LEAST_CONTRAST))
        if not len(kept):
            continue
        bits = (sharp > between)[kept][:, 2:-2, 2:-2]
        for n, number, turns, wrong in zip(kept, *codes.match(bits), strict=True):
            if number >= 0:
                found.setdefault(int(number), []).append((float(wrong), -contrast[n], np.roll(quads[n], turns, axis=0)))
    kept_markers: list[tuple[int, Array]] = []
    for number, ones in found.items():
        places: list[Array] = []
        for _, _, corners in sorted(ones, key=lambda one: one[:2]):
            size = np.ptp(corners, axis=0).max()
            if all(np.linalg.norm(corners.mean(axis=0) - each.mean(axis=0)) > size / 2 for each in places):
                places.append(corners)
        kept_markers += [(number, corners) for corners in places]
    return kept_markers


@dataclass(frozen=True, slots=True, eq=False)
class PatternFit:
    """A pattern aligned with the image."""

    corners: Array  #: (4, 2) in the plane of an ideal camera [px]
    covariance: Array  #: of the corners, (8, 8): x and y of the first, of the second … [px²]


def fit_pattern(
    cv: Any, image: NDArray[Any], corners: Array, pattern: NDArray[np.bool_], to_pixels: Callable[[Array], Array]
) -> PatternFit | None:
    """Align a marker's pattern with the image; None if it does not settle.

    Args:
        cv: OpenCV.
        image: Grey, (h, w).
        corners: First guess in the plane of an ideal camera, (4, 2) [px], from the pattern's top left.
        pattern: The cells with the black border, true where white.
        to_pixels: Turns points (n, 2) of that plane into pixels.
    """
    side = len(pattern)
    cell_px = math.sqrt(max(1e-6, abs(cv.contourArea(corners.astype(np.float32))))) / side
    per_cell = int(np.clip(math.ceil(cell_px), 4, _MOST_SAMPLES))
    drawn = np.kron(np.pad(pattern, 2, constant_values=True), np.ones((per_cell, per_cell))).astype(np.float32)
    at = (np.arange(len(drawn)) + 0.5) / per_cell - 2.0  # in cells from the border's outer edge
    used = slice(round(1.65 * per_cell), len(drawn) - round(1.65 * per_cell))  # 0.35 cells around the marker
    u, v = (each[used, used].ravel() * 2 / side - 1.0 for each in np.meshgrid(at, at))  # the marker is -1 … 1
    ones = np.ones_like(u)
    points = np.stack([u, v, ones], axis=1)
    shape = square_to(corners[None])[0] @ np.array([[0.5, 0, 0.5], [0, 0.5, 0.5], [0, 0, 1.0]])
    start, blur, likeness = corners, np.eye(2) * max(0.3, 0.7 / cell_px) ** 2, 0.0
    weight = ones
    spacing_px = cell_px / per_cell
    for step in range(_ITERATIONS):
        flat = points @ shape.T
        where = to_pixels(flat[:, :2] / flat[:, 2:])
        if not np.isfinite(where).all():
            return None
        if step == 0:
            image, origin = _around(cv, image, where, spacing_px)
            if image is None:
                return None
        seen = sample(cv, image, where - origin).astype(np.float64)
        smooth = _blurred(cv, drawn, blur * per_cell**2)
        du, dv = np.gradient(smooth, axis=1) * per_cell, np.gradient(smooth, axis=0) * per_cell
        seconds = (np.gradient(du, axis=1), np.gradient(dv, axis=0), np.gradient(du, axis=0))
        value, du, dv, duu, dvv, duv = (
            each[used, used].ravel() for each in (smooth, du, dv, *(s * per_cell for s in seconds))
        )
        light = np.stack([value, value * u, value * v, ones, u, v], axis=1)
        brightness = light * (weight**2)[:, None]
        shade = np.linalg.solve(brightness.T @ light + 1e-9 * np.eye(6), brightness.T @ seen)
        gain = (shade[0] + shade[1] * u + shade[2] * v)[:, None]
        half = side / 2
        along = (du * u + dv * v) * half
        moving = [
            *(du * half * c for c in (u, v, ones)),
            *(dv * half * c for c in (u, v, ones)),
            -along * u,
            -along * v,
        ]
        blurring = [duu / 2, dvv / 2, duv]
        rows = np.concatenate([gain * np.stack([*moving, *blurring], axis=1), light], axis=1)
        weighted = rows * (weight**2)[:, None]
        normal = weighted.T @ rows
        normal[range(8, 11), range(8, 11)] *= 1.05  # blur is only a nuisance, and settles more slowly
        left = seen - light @ shade
        try:
            found = np.linalg.solve(normal, weighted.T @ left)
        except np.linalg.LinAlgError:
            return None
        left -= rows @ found
        change = np.array([found[0:3], found[3:6], [found[6], found[7], 0.0]])
        most = float(np.abs(change).max()) * half
        shape = shape @ np.linalg.inv(np.eye(3) + change * min(1.0, 0.5 / max(most, 1e-9)))
        shape /= shape[2, 2]
        blur = _bounded(blur + np.array([[found[8], found[10]], [found[10], found[9]]]), 0.4 / per_cell)
        deviation = 1.4826 * float(np.median(np.abs(left))) + 0.5
        if step >= 1:
            weight = 1.0 / (1.0 + (left / (4.0 * deviation)) ** 2)
        likeness = 1.0 - float((left**2).mean()) / max(float(seen.var()), 1e-9)
        if step >= 2 and most < _SETTLED:
            break
    ends = np.array([[-1.0, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]])
    flat = ends @ shape.T
    fitted = flat[:, :2] / flat[:, 2:]
    if likeness < _LEAST_LIKENESS or np.abs(fitted - start).max() > max(2.5, 1.2 * cell_px):
        return None
    # Neighbouring samples share pixels: only as many are independent as there are pixels.
    shared = max(1.0, 1.0 / spacing_px**2)
    noise = float((weight**2 * left**2).sum() / max(1.0, (weight**2).sum() - len(normal))) * shared
    spread_of = np.linalg.inv(normal)[:8, :8] * noise
    turned = np.zeros((8, 8))
    for n, (x, y, _) in enumerate(ends):
        moves = np.array([[x, y, 1, 0, 0, 0, -x * x, -x * y], [0, 0, 0, x, y, 1, -x * y, -y * y]])
        slope = (shape[:2, :2] - np.outer(fitted[n], shape[2, :2])) / flat[n, 2]
        turned[2 * n : 2 * n + 2] = slope @ moves
    # A Gaussian is not the true blur, which matters once it reaches the next cell (measured by benchmarks.markers).
    blurred = float(np.linalg.eigvalsh(blur)[-1]) ** 1.5
    least = _LEAST_SIGMA_PX**2 + (0.15 * cell_px * blurred) ** 2
    return PatternFit(fitted, turned @ spread_of @ turned.T + least * np.eye(8))


def _around(cv: Any, image: NDArray[Any], where: Array, spacing_px: float) -> tuple[Any, Any]:
    """Return the part of an image around points, as float32, and its first pixel; None if they are not in it."""
    height, width = image.shape
    low = np.floor(where.min(axis=0)).astype(int) - 8
    high = np.ceil(where.max(axis=0)).astype(int) + 9
    low, high = np.maximum(low, 0), np.minimum(high, (width, height))
    if (high - low < 4).any():
        return None, low
    part = image[low[1] : high[1], low[0] : high[0]].astype(np.float32)
    if spacing_px > 1.3:  # samples are sparse: let each stand for its surroundings
        part = cv.GaussianBlur(part, (0, 0), 0.4 * spacing_px)
    return part, low


def _blurred(cv: Any, image: Pixels, covariance: Array) -> Array:
    reach = max(1, math.ceil(3.0 * math.sqrt(float(covariance.diagonal().max()))))
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    inverse = np.linalg.inv(covariance)
    kernel = np.exp(-0.5 * (inverse[0, 0] * x * x + 2 * inverse[0, 1] * x * y + inverse[1, 1] * y * y))
    kernel = (kernel / kernel.sum()).astype(np.float32)
    return np.asarray(cv.filter2D(image, -1, kernel, borderType=cv.BORDER_REPLICATE), dtype=np.float64)


def _bounded(covariance: Array, least: float) -> Array:
    """Return a blur's covariance with deviations between ``least`` and 1 cell."""
    values, axes = np.linalg.eigh(covariance)
    return np.asarray((axes * np.clip(values, least**2, 1.0)) @ axes.T)


def square_to(quads: Array) -> Array:
    """Return homographies (m, 3, 3) from the unit square, (0, 0) (1, 0) (1, 1) (0, 1), to quadrilaterals (m, 4, 2)."""
    a, b, c, d = np.moveaxis(quads, 1, 0)
    s, e, f = a - b + c - d, b - c, d - c
    area = e[:, 0] * f[:, 1] - e[:, 1] * f[:, 0]
    area = np.where(np.abs(area) < 1e-9, 1e-9, area)
    g = (s[:, 0] * f[:, 1] - s[:, 1] * f[:, 0]) / area
    h = (e[:, 0] * s[:, 1] - e[:, 1] * s[:, 0]) / area
    g, h = g[:, None], h[:, None]
    columns = np.stack([b - a + g * b, d - a + h * d, a], axis=-1)
    last = np.concatenate([g, h, np.ones_like(g)], axis=1)[:, None]
    return np.concatenate([columns, last], axis=1)


def mapped(shapes: Array, points: Array) -> Array:
    """Map points (…, 2) by each of the homographies (m, 3, 3)."""
    flat = np.concatenate([points, np.ones_like(points[..., :1])], axis=-1)
    found = np.einsum("mij,...j->m...i", shapes, flat)
    return np.asarray(found[..., :2] / found[..., 2:])


def sample(cv: Any, image: NDArray[Any], points: Array) -> Pixels:
    """Return the brightness at points (m, …, 2), interpolated between pixels."""
    rows = np.ascontiguousarray(points.reshape(len(points), -1, 2), dtype=np.float32)
    if points.ndim == 2:
        rows = np.ascontiguousarray(points.reshape(-1, 1, 2), dtype=np.float32)
    if len(rows) > 30000:
        parts = [
            cv.remap(image, each, None, cv.INTER_LINEAR, borderMode=cv.BORDER_REPLICATE)
            for each in np.array_split(rows, len(rows) // 30000 + 1)
        ]
        found = np.concatenate(parts)
    else:
        found = cv.remap(image, rows, None, cv.INTER_LINEAR, borderMode=cv.BORDER_REPLICATE)
    return np.asarray(found, dtype=np.float32).reshape(points.shape[:-1])
