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
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skyloop.vision.lens import Array

Pixels = NDArray[np.float32]
_ALONG: Final = np.linspace(0.08, 0.92, 14)  # where an edge is searched, as a fraction of its length
_ACROSS: Final = np.linspace(-1.0, 1.0, 13)  # and how far from it, as a fraction of the reach
_REACH, _CLOSE_REACH = (0.8, 1.6), (0.5, 1.2)  # across an edge, at first and then: in cells, and the least in pixels
_LEAST_CELL_PX: Final = 0.9  # smaller cells can't be read
_LEAST_STEP: Final = 4.0  # grey levels between a dark square and the mean around its edge
_NOISY: Final = 2.5  # grey levels: images with more noise are smoothed before the search
_SHARPENING: Final = 0.25  # of cells against their neighbours, because blur mixes them
_LEAST_CONTRAST: Final = 8.0  # grey levels between black and white
_BORDER_ERRORS: Final = 0.25  # largest fraction of the border's cells that are not black
_CORRECTED: Final = 0.6  # fraction of a dictionary's correctable bits that are corrected (OpenCV's default)
_ITERATIONS: Final = 10
_MOST_UNEXPLAINED: Final = 0.025  # fraction of the brightness's variance, besides noise
# Blur added to the image, because steps from one pixel to the next have no slope to follow: in cells, and at most [px].
_SOFTER, _MOST_SOFTER_PX = 0.1, 0.6
_LEAST_SIGMA_PX: Final = 0.02  # of a corner: lenses and prints are no better known
_SETTLED: Final = 0.004  # of a cell: smaller steps end the fit
_MOST_ROWS: Final = 32_000  # of samples that OpenCV takes at once
_ENDS: Final = np.array([[-1.0, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]])
_MOST_SAMPLES: Final = 10  # per cell


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

    def __init__(self, cv: Any, cells: int) -> None:
        """Prepare the search for squares of ``cells`` cells per side."""
        self._cv, self._least_px = cv, 4 * _LEAST_CELL_PX * cells
        self.noise = 0.0  #: standard deviation of the last image's noise, in grey levels
        self._parameters = parameters = cv.aruco.DetectorParameters()
        # One window suffices, because only the outer edge of the border counts.
        parameters.adaptiveThreshWinSizeMin = parameters.adaptiveThreshWinSizeMax = 23
        parameters.polygonalApproxAccuracyRate = 0.04  # small and tilted markers have few pixels for each corner
        # The white card's edge is another square near the marker's, which must not hide it.
        parameters.minMarkerDistanceRate = parameters.minGroupDistance = 0.0
        # No image matches this code: all quadrilaterals are returned as rejected ones.
        unused = cv.aruco.Dictionary(np.full((1, 5, 4), 0b01010101, np.uint8), 6, 0)
        self._detector = cv.aruco.ArucoDetector(unused, parameters)
        self._set: tuple[int, float] = (0, 0.0)

    def find(self, grey: NDArray[np.uint8]) -> Array:
        """Return quadrilaterals (m, 4, 2), clockwise [px]."""
        self.noise = noise = _noise(grey)
        if noise > _NOISY:  # noise makes thousands of contours
            grey, noise = self._cv.GaussianBlur(grey, (3, 3), 0), 0.375 * noise
        wanted = (max(grey.shape), max(_LEAST_STEP, round(1.3 * noise)))
        if wanted != self._set:
            self._set = wanted
            self._parameters.minMarkerPerimeterRate = min(self._least_px / wanted[0], 3.9)  # below OpenCV's maximum
            self._parameters.adaptiveThreshConstant = wanted[1]
            self._detector.setDetectorParameters(self._parameters)
        quads, _, others = self._detector.detectMarkers(grey)
        return np.asarray([*quads, *others], dtype=np.float64).reshape(-1, 4, 2)


def _noise(grey: NDArray[np.uint8]) -> float:
    """Return the standard deviation of the noise, from second differences along some rows."""
    rows = grey[::16].astype(np.int16)
    if rows.shape[1] < 3:
        return 0.0
    return float(np.median(np.abs(rows[:, 2:] - 2 * rows[:, 1:-1] + rows[:, :-2]))) / (0.6745 * math.sqrt(6.0))


def line_quads(cv: Any, image: NDArray[Any], quads: Array, cells: int, *, close: bool = False) -> Array:
    """Return quadrilaterals (m, 4, 2), clockwise, with corners where lines fitted to their edges meet.

    Args:
        cv: OpenCV.
        image: Grey, (h, w).
        quads: Rough quadrilaterals around dark squares, clockwise.
        cells: Number of cells of a side, which limits the search to the border's cells.
        close: Whether the lines are near already.
    """
    way = np.roll(quads, -1, axis=1) - quads
    length = np.maximum(np.linalg.norm(way, axis=2, keepdims=True), 1e-6)
    out = np.stack([way[..., 1], -way[..., 0]], axis=-1) / length
    x, y = np.moveaxis(quads - np.roll(quads, 2, axis=1), 2, 0)
    area = np.abs(x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0])[:, None, None] / 2
    share, least = _CLOSE_REACH if close else _REACH
    reach = np.maximum(share * area / length / cells, least)  # (m, 4, 1), by the extent across the edge
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
    first, last = (np.concatenate([each, np.ones_like(each[..., :1])], axis=-1) for each in ends)
    lines = np.cross(first, last)
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


class _Template:
    """A pattern drawn with some samples per cell, which are compared with the image."""

    def __init__(self, pattern: NDArray[np.bool_], per_cell: int) -> None:
        self._per_cell, self._half = per_cell, len(pattern) / 2
        drawn = np.kron(np.pad(pattern, 2, constant_values=True), np.ones((per_cell, per_cell)))
        self._drawn = drawn.astype(np.float32)
        at = (np.arange(len(drawn)) + 0.5) / per_cell - 2.0  # in cells from the border's outer edge
        margin = round(1.65 * per_cell)  # leaves 0.35 cells around the marker: white margins may be narrow
        self._used = slice(margin, len(drawn) - margin)
        # Coordinates of the samples: the marker reaches from -1 to 1.
        self.u, self.v = (each[self._used, self._used].ravel() / self._half - 1.0 for each in np.meshgrid(at, at))

    def blurred(self, cv: Any, blur: Array) -> tuple[Array, Array]:
        """Return the samples' brightness (n,) after a blur, and its derivatives (n, 11).

        Those are by the homography's eight parameters, and by the blur's covariance (2, 2) [cells²]: xx, yy, xy.
        """
        smooth = _blurred(cv, self._drawn, blur * self._per_cell**2)
        du, dv = np.gradient(smooth, axis=1), np.gradient(smooth, axis=0)
        seconds = (np.gradient(du, axis=1) / 2, np.gradient(dv, axis=0) / 2, np.gradient(du, axis=0))
        value, du, dv, *bends = (each[self._used, self._used].ravel() for each in (smooth, du, dv, *seconds))
        scale = self._per_cell * self._half
        du, dv, u, v = du * scale, dv * scale, self.u, self.v
        along = du * u + dv * v
        moving = [du * u, du * v, du, dv * u, dv * v, dv, -along * u, -along * v]
        # A blur spreads brightness as heat does: its derivatives are second derivatives.
        return value, np.stack([*moving, *(each * self._per_cell**2 for each in bends)], axis=1)


def fit_pattern(
    cv: Any,
    image: NDArray[Any],
    corners: Array,
    pattern: NDArray[np.bool_],
    to_pixels: Callable[[Array], Array],
    noise: float,
) -> tuple[Array, Array] | None:
    """Align a marker's pattern with the image, and return its corners and their covariance.

    Args:
        cv: OpenCV.
        image: Grey, (h, w).
        corners: First guess in the plane of an ideal camera, (4, 2) [px], from the pattern's top left.
        pattern: The cells with the black border, true where white.
        to_pixels: Turns points (n, 2) of that plane into pixels.
        noise: Standard deviation of the image's noise, in grey levels.

    Returns:
        Corners (4, 2) in the plane of the ideal camera [px], and covariance (8, 8) of x and y of the first, of the
        second … [px²]; None if the pattern does not explain the image, for example because of a sharp shadow.

    Raises:
        numpy.linalg.LinAlgError: The image leaves the corners undetermined.
    """
    cell_px = math.sqrt(max(1e-6, abs(cv.contourArea(corners.astype(np.float32))))) / len(pattern)
    per_cell = int(np.clip(math.ceil(cell_px), 4, _MOST_SAMPLES))
    softer_px = max(min(_SOFTER * cell_px, _MOST_SOFTER_PX), 0.4 * cell_px / per_cell)
    template = _Template(pattern, per_cell)
    u, v, ones = template.u, template.v, np.ones_like(template.u)
    points = np.stack([u, v, ones], axis=1)
    shape = square_to(corners[None])[0] @ np.array([[0.5, 0, 0.5], [0, 0.5, 0.5], [0, 0, 1.0]])
    blur = np.eye(2) * min(max(0.3, 0.7 / cell_px), 1.0) ** 2
    weight, part = ones, None
    for step in range(_ITERATIONS):
        flat = points @ shape.T
        where = to_pixels(flat[:, :2] / flat[:, 2:])
        if not np.isfinite(where).all():
            return None
        if part is None:
            part, origin = _around(cv, image, where, softer_px)
            if part is None:
                return None
        seen = sample(cv, part, where - origin).astype(np.float64)
        value, slopes = template.blurred(cv, blur)
        # Black and white may each change linearly across the marker.
        light = np.stack([value, value * u, value * v, ones, u, v], axis=1)
        trusted = light * (weight**2)[:, None]
        shade = np.linalg.solve(trusted.T @ light + 1e-9 * np.eye(6), trusted.T @ seen)
        gain = shade[0] + shade[1] * u + shade[2] * v
        rows = np.concatenate([gain[:, None] * slopes, light], axis=1)
        trusted = rows * (weight**2)[:, None]
        normal = trusted.T @ rows
        normal[range(8, 11), range(8, 11)] *= 1.05  # the blur settles more slowly, and matters less
        left = seen - light @ shade
        found = np.linalg.solve(normal, trusted.T @ left)
        left -= rows @ found
        change = np.array([found[0:3], found[3:6], [found[6], found[7], 0.0]])
        most = float(np.abs(change).max()) * len(pattern) / 2
        shape = shape @ np.linalg.inv(np.eye(3) + change * min(1.0, 0.5 / max(most, 1e-9)))
        shape /= shape[2, 2]
        blur = _bounded(
            blur + np.array([[found[8], found[10]], [found[10], found[9]]]), max(softer_px / cell_px, 0.4 / per_cell)
        )
        if step >= 2 and most < _SETTLED:
            break
        if 1 <= step <= 2:  # glare, dirt and shadows count less
            deviation = 1.4826 * float(np.median(np.abs(left))) + 0.5
            weight = 1.0 / (1.0 + (left / (4.0 * deviation)) ** 2)
    flat = _ENDS @ shape.T
    fitted = flat[:, :2] / flat[:, 2:]
    unexplained = (float((left**2).mean()) - noise**2) / max(float(seen.var()), 1e-9)
    if unexplained > _MOST_UNEXPLAINED or np.abs(fitted - corners).max() > max(2.5, 1.2 * cell_px):
        return None
    # Neighbouring samples share pixels: only as many are independent as there are pixels.
    variance = float((weight * left) @ (weight * left) / ((weight**2).sum() - len(normal)))
    covariance = np.linalg.inv(normal)[:8, :8] * variance * max(1.0, (per_cell / cell_px) ** 2)
    moves = [([x, y, 1, 0, 0, 0, -x * x, -x * y], [0, 0, 0, x, y, 1, -x * y, -y * y]) for x, y, _ in _ENDS]
    slope = (shape[:2, :2] - fitted[:, :, None] * shape[2, :2]) / flat[:, 2, None, None]
    turned = (slope @ np.array(moves)).reshape(8, 8)
    # Systematic errors: the true blur is no Gaussian, which matters once it reaches the next cell, and a soft shadow
    # moves corners by about the unexplained fraction of a cell (both measured by benchmarks.markers).
    spread = float(np.linalg.eigvalsh(blur)[-1]) ** 1.5
    least = _LEAST_SIGMA_PX**2 + (0.15 * cell_px * spread) ** 2 + (cell_px * max(0.0, unexplained)) ** 2
    return fitted, turned @ covariance @ turned.T + least * np.eye(8)


def _around(cv: Any, image: NDArray[Any], where: Array, blur_px: float) -> tuple[Any, Any]:
    """Return the blurred part of an image around points, and its first pixel; None if they are not in it."""
    height, width = image.shape
    low = np.floor(where.min(axis=0)).astype(int) - 8
    high = np.ceil(where.max(axis=0)).astype(int) + 9
    low, high = np.maximum(low, 0), np.minimum(high, (width, height))
    if (high - low < 4).any():
        return None, low
    part = image[low[1] : high[1], low[0] : high[0]].astype(np.float32)
    return cv.GaussianBlur(part, (0, 0), blur_px), low


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
    rows = np.ascontiguousarray(
        points.reshape(-1 if points.ndim == 2 else len(points), points[0].size // 2, 2), np.float32
    )
    parts = [
        cv.remap(image, rows[at : at + _MOST_ROWS], None, cv.INTER_LINEAR, borderMode=cv.BORDER_REPLICATE)
        for at in range(0, len(rows), _MOST_ROWS)
    ]
    return np.asarray(np.concatenate(parts), dtype=np.float32).reshape(points.shape[:-1])
