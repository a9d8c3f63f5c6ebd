"""Trackers that follow a box from image to image by a correlation filter, by the flow of points, or by a network.

**Correlation.** The tracker learns a filter whose correlation with the patch around the target peaks sharply at the
patch's centre. The correlation is a product in the Fourier domain (Bolme, Beveridge, Draper and Lui, "Visual object
tracking using adaptive correlation filters", CVPR 2010), over several channels of gradients and colours and a patch
larger than the target (Henriques, Caseiro, Martins and Batista, "High-speed tracking with kernelized correlation
filters", TPAMI 37, 2015; its linear kernel). The size is tracked by a second, one-dimensional filter over patches of 17
sizes (Danelljan, Häger, Khan and Felsberg, "Accurate scale estimation for robust visual tracking", BMVC 2014).

**Median flow.** Kalal, Mikolajczyk and Matas, "Forward-backward error: automatic detection of tracking failures", ICPR
2010: a grid of points is tracked to the next image and back by pyramidal Lucas-Kanade. The half of the points that
return closest to their start is kept, and then the half of these whose surroundings changed least. Their median
displacement gives the motion, and the median change of the distances between them gives the scale.

**Learned.** ViTTrack (``cv2.TrackerVit``) is a single ONNX file. NanoTrack (``cv2.TrackerNano``) consists of two files:
the backbone, and the neck with the head.

A box is x, y, width and height in pixels: its left and top edge, and its size, as in OpenCV. A box with integer values
covers columns x to x + width − 1 and rows y to y + height − 1.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import FileFormatError, UnsupportedError, UsageError
from skyloop.messages.geometry import within
from skyloop.vision import onnx
from skyloop.vision.lens import pixels_of
from skyloop.vision.opencv import opencv

Box = tuple[float, float, float, float]  #: x, y, width, height [px]
Image = NDArray[np.uint8]

LEAST_PX: Final = 6.0  #: minimum side of a box; a smaller one has too little texture to be found again
_IN_VIEW: Final = 0.5  # minimum fraction of the initial box that is inside the image
Floats = NDArray[np.float32]

CELL: Final = 4  #: side of a cell in pixels of the patch


@dataclass(frozen=True, slots=True)
class TrackResult:
    """The target's position in one image."""

    box: Box | None  #: x, y, width, height [px]; None while the target is lost
    score: float  #: similarity to the target, 0 to 1; a score, not a probability
    confidence: float | None = None  #: probability that the overlap is at least half; None if there is no estimate

    @property
    def lost(self) -> bool:
        """Whether the target was not found in this image."""
        return self.box is None

    @property
    def centre(self) -> tuple[float, float] | None:
        """The middle of the box [px]; None while the target is lost."""
        if self.box is None:
            return None
        x, y, width, height = self.box
        return x + (width - 1) / 2, y + (height - 1) / 2

    @property
    def outline(self) -> tuple[tuple[float, float], ...]:
        """The corners of the box, for annotations; empty while the target is lost."""
        return () if self.box is None else outline(self.box)


class Tracker(ABC):
    """Follows a box's content from image to image: call :meth:`start` once, then :meth:`update` with each new image.

    It can be restarted at any time, even with images of a different size. It is not thread-safe, so call it from one
    thread, such as a controller's or a processor's.
    """

    _shape: tuple[int, ...] | None = None

    def start(self, image: Image, box: Sequence[float]) -> None:
        """Start tracking a box's content and forget the previous target.

        Args:
            image: A :class:`skyloop.Frame` or a uint8 array, (h, w, 3) BGR or (h, w) grey.
            box: x, y, width, height [px]. At least half of the box must be in the image.

        Raises:
            UsageError: The array has a wrong shape or type, or the box is empty, not finite or outside the image.
        """
        pixels = pixels_of(image)
        checked = checked_box(box, pixels.shape)
        self._shape = None  # remains None if _start fails
        self._start(pixels, checked)
        self._shape = pixels.shape

    def update(self, image: Image) -> TrackResult:
        """Track the target in the next image.

        Args:
            image: As in :meth:`start`, of the same size and kind.

        Raises:
            UsageError: The tracker was not started, or the image's shape or type differs from the first image's.
        """
        if self._shape is None:
            raise UsageError("the tracker was not started: call start(image, box) before update(image)")
        pixels = pixels_of(image)
        if pixels.shape != self._shape:
            raise UsageError(
                f"the image has shape {pixels.shape} and must have {self._shape}, as at the start: "
                "start again with a box in the new image"
            )
        return self._update(pixels)

    def shift(self, right: float, down: float) -> None:  # noqa: B027 - subclasses may ignore this
        """Report how far the camera's rotation has moved the target since the last image [px].

        The tracker looks for the target there in the next image. Trackers that search everywhere or measure the image's
        motion themselves ignore this. Calls to this method are optional.
        """

    @abstractmethod
    def _start(self, image: Image, box: Box) -> None:
        """Start tracking in a checked image, with a checked box."""

    @abstractmethod
    def _update(self, image: Image) -> TrackResult:
        """Track the target in a checked image."""


def checked_box(box: Sequence[float], shape: Sequence[int]) -> Box:
    """Return a tracker's initial box; raise UsageError if malformed, too small, or less than half in the image."""
    try:
        x, y, width, height = (float(part) for part in box)
    except (TypeError, ValueError):
        raise UsageError(f"the box is {box!r} and must be x, y, width and height in pixels") from None
    given = f"x={x:g}, y={y:g}, width={width:g}, height={height:g}"
    if not all(math.isfinite(part) for part in (x, y, width, height)):
        raise UsageError(f"the box is {given} and must consist of finite numbers")
    if width < LEAST_PX or height < LEAST_PX:
        raise UsageError(f"the box is {given} and must be at least {LEAST_PX:g} pixels wide and high")
    rows, columns = shape[:2]
    if overlap_area((x, y, width, height), (0.0, 0.0, columns, rows)) < _IN_VIEW * width * height:
        raise UsageError(f"the box is {given} and at least half of it must be in the image of {columns}×{rows} pixels")
    return x, y, width, height


def outline(box: Box) -> tuple[tuple[float, float], ...]:
    """Return the four corners of a box [px], for annotations."""
    x, y, width, height = box
    return (x, y), (x + width, y), (x + width, y + height), (x, y + height)


def overlap_area(one: Box, other: Box) -> float:
    """Return the area shared by two boxes [px²]."""
    wide = min(one[0] + one[2], other[0] + other[2]) - max(one[0], other[0])
    high = min(one[1] + one[3], other[1] + other[3]) - max(one[1], other[1])
    return max(wide, 0.0) * max(high, 0.0)


def overlap(one: Box, other: Box) -> float:
    """Return the overlap of two boxes: intersection over union, 0 to 1."""
    shared = overlap_area(one, other)
    return shared / max(one[2] * one[3] + other[2] * other[3] - shared, 1e-9)


def patch(cv: Any, image: Image, box: Box, size: tuple[int, int]) -> Image:
    """Sample a box that is at least partly in the image, at a size (width, height). Pixels outside repeat the edge."""
    x, y, width, height = box
    rows, columns = image.shape[:2]
    left, top = max(0, math.floor(x) - 1), max(0, math.floor(y) - 1)
    right, bottom = min(columns, math.ceil(x + width) + 1), min(rows, math.ceil(y + height) + 1)
    left, top = min(left, columns - 1), min(top, rows - 1)
    part = image[top : max(bottom, top + 1), left : max(right, left + 1)]
    # Linear sampling uses only the nearest pixels, so shrink a large area by averaging first.
    coarse = [max(1, int(full / wanted)) for full, wanted in zip((width, height), size, strict=True)]
    high, wide = part.shape[:2]
    if max(coarse) > 1:
        wanted = (max(1, round(wide / coarse[0])), max(1, round(high / coarse[1])))
        part = cv.resize(part, wanted, interpolation=cv.INTER_AREA)
    shrink_x, shrink_y = part.shape[1] / wide, part.shape[0] / high
    step_x, step_y = width / size[0] * shrink_x, height / size[1] * shrink_y
    first_x = (x - left) * shrink_x + step_x / 2 - 0.5  # pixel centres, not pixel edges
    first_y = (y - top) * shrink_y + step_y / 2 - 0.5
    turn = np.array([[step_x, 0.0, first_x], [0.0, step_y, first_y]])
    flags = cv.INTER_LINEAR | cv.WARP_INVERSE_MAP
    return np.asarray(cv.warpAffine(part, turn, size, flags=flags, borderMode=cv.BORDER_REPLICATE), np.uint8)


def features(cv: Any, pixels: Image) -> Floats:
    """Return a patch's features, (channels, height / CELL, width / CELL): 8 channels for grey, 10 for colour.

    Each cell has its gradient strength and the first harmonics of the gradient's direction, which hold the information
    of a direction histogram in fewer numbers. Both are normalised by the local strength, so lighting and contrast don't
    matter. The other channels are brightness and, for a colour image, both colour components relative to the patch's.
    """
    size = (pixels.shape[1] // CELL, pixels.shape[0] // CELL)
    if pixels.ndim == 3:
        lab = cv.cvtColor(pixels, cv.COLOR_BGR2LAB)
        grey = np.ascontiguousarray(lab[..., 0])
        colours = cv.resize(lab, size, interpolation=cv.INTER_AREA).astype(np.float32)
        plain = [colours[..., 0], colours[..., 1], colours[..., 2]]
    else:
        grey = pixels
        plain = [cv.resize(pixels, size, interpolation=cv.INTER_AREA).astype(np.float32)]
    x = cv.Sobel(grey, cv.CV_32F, 1, 0, ksize=1)
    y = cv.Sobel(grey, cv.CV_32F, 0, 1, ksize=1)
    strength = cv.magnitude(x, y) + np.float32(1e-3)
    cos, sin = x / strength, y / strength
    twice_cos, twice_sin = x * cos - y * sin, 2 * x * sin  # strength times the cosine and sine of twice the angle
    cos2, sin2 = twice_cos / strength, twice_sin / strength
    maps = [strength, x, y, twice_cos, twice_sin, twice_cos * cos2 - twice_sin * sin2, 2 * twice_cos * sin2]
    cells = [cv.resize(one, size, interpolation=cv.INTER_AREA) for one in maps]
    around = cv.blur(cells[0], (3, 3)) + np.float32(4.0)  # 4 grey levels: noise on a flat wall is not texture
    light = [(plain[0] - plain[0].mean()) / np.float32(64.0)]
    colour = [(one - 128) / np.float32(32.0) for one in plain[1:]]
    return np.stack([one / around for one in cells] + light + colour)


Spectrum = NDArray[np.complex64]

_AREA_PX: Final = 128.0**2  # area of the sampled patch around the target
_CONTEXT: Final = 1.5  # margin added to width and height, as a multiple of the square root of the target's area
_RATE: Final = 0.02  # learning rate per image
_SCALE_RATE: Final = 0.02  # learning rate of the size filter per image
_REGULARISATION: Final = 0.02  # regularisation as a fraction of the spectrum's mean energy
_SPREAD: Final = 0.08  # width of the peak as a fraction of the target's size
_SCALES: Final = 17  # number of sizes tried per image
_SCALE_STEP: Final = 1.03  # ratio between neighbouring sizes
_SCALE_SPREAD: Final = 1.0  # width of the size filter's peak, in size steps
_SCALE_AREA_PX: Final = 32.0**2  # area of the sampled patch for each size
_SMALLEST: Final = 0.2  # smallest size, as a multiple of the initial one
_LARGEST: Final = 6.0  # largest size, as a multiple of the initial one
_LEAST_PX: Final = 4.0  # minimum side of a target
_GRID: Final = 10  # number of points along each side
_WINDOW: Final = (11, 11)  # window of Lucas-Kanade [px]
_LEVELS: Final = 3  # number of levels of its image pyramid
_AROUND: Final = (9, 9)  # size of a point's surroundings to compare [px]
_ENOUGH: Final = 6  # minimum number of points
_RETURN_PX: Final = 5.0  # maximum median distance after tracking back; tracking fails above it
_SPREAD_SHARE: Final = 0.35  # maximum spread of the displacements, as a fraction of the box's smaller side
_SMALLEST_PX: Final = 6.0  # minimum side of the box, below which tracking fails


class _Filter:
    """A ridge regression in the Fourier domain; all channels share one denominator."""

    def __init__(self, wanted: Spectrum, rate: float) -> None:
        self._wanted = wanted
        self._rate = rate
        self._above: Spectrum | None = None
        self._below: Floats | None = None

    def learn(self, spectrum: Spectrum) -> None:
        """Learn from a patch's spectrum (channels first): the first replaces the filter; later ones are mixed in."""
        above = np.conj(self._wanted) * spectrum
        below = np.sum(spectrum.real**2 + spectrum.imag**2, axis=0)
        if self._above is None or self._below is None:
            self._above, self._below = above, below
        else:
            self._above += self._rate * (above - self._above)
            self._below += self._rate * (below - self._below)

    def response(self, spectrum: Spectrum) -> Spectrum:
        """Return the spectrum of the response."""
        assert self._above is not None
        assert self._below is not None
        below = self._below + _REGULARISATION * self._below.mean()
        return np.asarray(np.sum(np.conj(self._above) * spectrum, axis=0) / below, np.complex64)


class CorrelationTracker(Tracker):
    """Tracks a target's position and size with correlation filters. Fast; :class:`LongTermTracker` uses it by default.

    It follows a target that changes slowly and moves by less than half its size between images. The score is the height
    of the correlation peak: about 1 for the image that it was learned from. Below ``lost_below`` the target counts as
    lost, and is searched for only where it was last seen; :class:`LongTermTracker` searches the whole image.
    """

    def __init__(self, *, lost_below: float = 0.3, learn_above: float = 0.4) -> None:
        """Prepare the tracker.

        Args:
            lost_below: Score below which the target counts as lost.
            learn_above: Score below which nothing is learned.

        Raises:
            MissingExtraError: OpenCV is not installed.
        """
        self._cv: Any = opencv("tracking")
        self._lost_below, self._learn_above = lost_below, learn_above
        self._centre: NDArray[np.float64] = np.zeros(2)  # the target's centre [px]

    def shift(self, right: float, down: float) -> None:
        """Look for the target shifted by this much to the right and down in the next image [px]."""
        self._centre = np.add(self._centre, (right, down))

    def _start(self, image: Image, box: Box) -> None:
        x, y, width, height = box
        self._centre = np.array([x + width / 2, y + height / 2])
        self._size = np.array([width, height])
        self._scale = 1.0
        extra = _CONTEXT * math.sqrt(width * height)
        self._around = self._size + extra  # size of the patch in the image at scale 1
        self._sampled = _in_cells(self._around, _AREA_PX)
        self._scale_sampled = _in_cells(self._size, _SCALE_AREA_PX)
        columns, rows = self._sampled[0] // CELL, self._sampled[1] // CELL
        self._window = np.outer(np.hanning(rows + 2)[1:-1], np.hanning(columns + 2)[1:-1]).astype(np.float32)
        cells = np.array([columns, rows]) * self._size / self._around  # size of the target in cells
        wanted = np.outer(_peak(rows, _SPREAD * cells[1] + 0.5), _peak(columns, _SPREAD * cells[0] + 0.5))
        self._filter = _Filter(np.asarray(np.fft.rfft2(wanted), np.complex64), _RATE)
        self._steps = _SCALE_STEP ** (np.arange(_SCALES) - _SCALES // 2)
        self._scale_window = np.hanning(_SCALES + 2)[1:-1].astype(np.float32)
        self._scale_filter = _Filter(np.asarray(np.fft.rfft(_peak(_SCALES, _SCALE_SPREAD)), np.complex64), _SCALE_RATE)
        self._learn(image)

    def _update(self, image: Image) -> TrackResult:
        response = np.fft.irfft2(self._filter.response(self._spectrum(image)), s=self._window.shape)
        row, column = np.unravel_index(int(np.argmax(response)), response.shape)
        score = within(float(response[row, column]), 0.0, 1.0)
        rows, columns = response.shape
        moved = np.array(
            [
                _signed(_refined(response[row, :], int(column)), columns),
                _signed(_refined(response[:, column], int(row)), rows),
            ]
        )
        centre = self._centre + moved * self._around * self._scale / (columns, rows)
        inside = bool((centre >= 0).all() and centre[0] < image.shape[1] and centre[1] < image.shape[0])
        if score < self._lost_below or not inside:
            return TrackResult(None, score)
        self._centre = centre
        self._rescale(image)
        if score >= self._learn_above:
            self._learn(image)
        return TrackResult(self._box(self._size * self._scale), score)

    def _rescale(self, image: Image) -> None:
        response = np.fft.irfft(self._scale_filter.response(self._scale_spectrum(image)), n=_SCALES)
        step = _signed(_refined(response, int(np.argmax(response))), _SCALES)
        scale = self._scale * _SCALE_STEP ** float(step)
        most = min(_LARGEST, float(min(np.array(image.shape[1::-1]) / self._size)) * 1.2)
        least = max(_SMALLEST, _LEAST_PX / float(min(self._size)))
        self._scale = min(max(scale, min(least, 1.0)), max(most, 1.0))

    def _learn(self, image: Image) -> None:
        self._filter.learn(self._spectrum(image))
        self._scale_filter.learn(self._scale_spectrum(image))

    def _box(self, size: NDArray[np.float64]) -> Box:
        x, y = (self._centre - size / 2).tolist()
        return x, y, float(size[0]), float(size[1])

    def _spectrum(self, image: Image) -> Spectrum:
        pixels = patch(self._cv, image, self._box(self._around * self._scale), self._sampled)
        return np.asarray(np.fft.rfft2(features(self._cv, pixels) * self._window), np.complex64)

    def _scale_spectrum(self, image: Image) -> Spectrum:
        """Return the spectrum of each target feature across sizes, (features, _SCALES // 2 + 1)."""
        width, height = self._scale_sampled
        largest = float(self._steps[-1])
        finer = (round(width * largest * 1.5), round(height * largest * 1.5))
        whole = patch(self._cv, image, self._box(self._size * self._scale * largest), finer)
        sizes = []
        for step in self._steps / largest:
            part = (finer[0] * (1 - step) / 2, finer[1] * (1 - step) / 2, finer[0] * step, finer[1] * step)
            sizes.append(patch(self._cv, whole, part, self._scale_sampled))
        cells = features(self._cv, np.concatenate(sizes))  # all sizes stacked vertically
        each = cells.reshape(len(cells), _SCALES, -1).transpose(0, 2, 1).reshape(-1, _SCALES)
        return np.asarray(np.fft.rfft(each * self._scale_window, axis=1), np.complex64)


def _in_cells(size: NDArray[np.float64], area_px: float) -> tuple[int, int]:
    """Return a size in whole cells, both numbers even, with about this area and the same aspect ratio as ``size``."""
    share = math.sqrt(area_px / float(size[0] * size[1]))
    width, height = (max(2, round(float(side) * share / CELL / 2) * 2) * CELL for side in size)
    return width, height


def _peak(count: int, spread: float) -> NDArray[np.float64]:
    """Return a Gaussian on a ring of values, centred on the first one."""
    away = np.minimum(np.arange(count), count - np.arange(count))
    return np.asarray(np.exp(-0.5 * (away / spread) ** 2))


def _signed(place: float, count: int) -> float:
    return place - count if place > count / 2 else place


def _refined(values: NDArray[np.floating[Any]], at: int) -> float:
    """Refine a peak's position in a ring of values, using the parabola through it and its neighbours."""
    before, here, after = float(values[at - 1]), float(values[at]), float(values[(at + 1) % len(values)])
    bend = before - 2 * here + after
    return at if bend >= 0 else at + 0.5 * (before - after) / bend


class MedianFlowTracker(Tracker):
    """Tracks a target's position and size from each image to the next, without remembering the target's appearance.

    It is accurate while the target is in view and moves smoothly. It notices a failure at once and then stays lost
    until restarted. It drifts because it never compares an image with the first one. The score expresses how many
    points returned to where they started, and how closely.
    """

    def __init__(self) -> None:
        """Prepare the tracker.

        Raises:
            MissingExtraError: OpenCV is not installed.
        """
        self._cv: Any = opencv("tracking")
        self._box: Box | None = None

    def _start(self, image: Image, box: Box) -> None:
        self._grey, self._box = self._grey_of(image), box

    def _update(self, image: Image) -> TrackResult:
        if self._box is None:
            return TrackResult(None, 0.0)
        grey = self._grey_of(image)
        self._box, score = self._follow(grey, self._box)
        self._grey = grey
        return TrackResult(self._box, score)

    def _grey_of(self, image: Image) -> Image:
        grey = self._cv.cvtColor(image, self._cv.COLOR_BGR2GRAY) if image.ndim == 3 else image.copy()
        return np.asarray(grey, np.uint8)

    def _follow(self, grey: Image, box: Box) -> tuple[Box | None, float]:
        before = _grid(box)
        after, off, good = self._there_and_back(grey, before)
        rows, columns = grey.shape
        good &= (after >= 0).all(axis=1) & (after[:, 0] <= columns - 1) & (after[:, 1] <= rows - 1)
        good &= (before >= 0).all(axis=1) & (before[:, 0] <= columns - 1) & (before[:, 1] <= rows - 1)
        if np.count_nonzero(good) < _ENOUGH:
            return None, 0.0
        back = float(np.median(off[good]))
        nearest = good & (off <= back)
        alike = np.full(len(before), -1.0)
        alike[nearest] = self._similarity(grey, before[nearest], after[nearest])
        kept = nearest & (alike >= np.median(alike[nearest]))
        before, after = before[kept], after[kept]
        moved = after - before
        shift = np.median(moved, axis=0)
        spread = float(np.median(np.linalg.norm(moved - shift, axis=1)))
        if back > _RETURN_PX or spread > _SPREAD_SHARE * min(box[2:]) or len(before) < 2:
            return None, 0.0
        scale = _stretch(before, after)
        width, height = box[2] * scale, box[3] * scale
        x = box[0] + float(shift[0]) - (width - box[2]) / 2
        y = box[1] + float(shift[1]) - (height - box[3]) / 2
        found = (x, y, width, height)
        if min(width, height) < _SMALLEST_PX or overlap_area(found, (0.0, 0.0, columns, rows)) < 0.25 * width * height:
            return None, 0.0
        score = float(np.count_nonzero(good & (off < 1.0)) / len(off)) * max(0.0, float(np.median(alike[kept])))
        return found, min(score, 1.0)

    def _there_and_back(self, grey: Image, before: Floats) -> tuple[Floats, Floats, NDArray[np.bool_]]:
        """Return the points' new positions, their errors after tracking back, and which of the points were tracked."""
        cv = self._cv
        points = before.reshape(-1, 1, 2)
        after, forth, _ = cv.calcOpticalFlowPyrLK(self._grey, grey, points, None, winSize=_WINDOW, maxLevel=_LEVELS)
        again, back, _ = cv.calcOpticalFlowPyrLK(grey, self._grey, after, None, winSize=_WINDOW, maxLevel=_LEVELS)
        off = np.linalg.norm((again - points).reshape(-1, 2), axis=1)
        return after.reshape(-1, 2), off, (forth.ravel() == 1) & (back.ravel() == 1)

    def _similarity(self, grey: Image, before: Floats, after: Floats) -> Floats:
        """Return the normalised cross-correlation of the points' surroundings, −1 to 1."""
        cut = self._cv.getRectSubPix
        old = np.stack([cut(self._grey, _AROUND, (float(x), float(y))) for x, y in before]).astype(np.float32)
        new = np.stack([cut(grey, _AROUND, (float(x), float(y))) for x, y in after]).astype(np.float32)
        old -= old.mean(axis=(1, 2), keepdims=True)
        new -= new.mean(axis=(1, 2), keepdims=True)
        energy = np.sqrt((old**2).sum(axis=(1, 2)) * (new**2).sum(axis=(1, 2)))
        return np.asarray((old * new).sum(axis=(1, 2)) / np.maximum(energy, 1e-3), np.float32)


def _grid(box: Box) -> Floats:
    """Return evenly spaced points in the box, away from its edge, (n, 2) pixels."""
    x, y, width, height = box
    share = (np.arange(_GRID) + 0.5) / _GRID
    across, down = np.meshgrid(x + width * share - 0.5, y + height * share - 0.5)
    return np.stack([across.ravel(), down.ravel()], axis=1).astype(np.float32)


def _stretch(before: Floats, after: Floats) -> float:
    """Return the factor by which the distances between the points grew: the median over all pairs."""
    one, other = np.triu_indices(len(before), k=1)
    old = np.linalg.norm(before[one] - before[other], axis=1)
    new = np.linalg.norm(after[one] - after[other], axis=1)
    return float(np.median(new / np.maximum(old, 1e-6)))


class LearnedTracker(Tracker):
    """Tracks by a neural network that OpenCV runs on the CPU. The score comes from the network.

    Skyloop doesn't include the weights: the OpenCV Zoo offers object_tracking_vittrack_2023sep.onnx, and NanoTrack's
    repository has its two files.
    """

    def __init__(self, weights: Path | str, head: Path | str | None = None, *, lost_below: float = 0.3) -> None:
        """Load the weights.

        Args:
            weights: ONNX file of ViTTrack or, together with ``head``, of NanoTrack's backbone.
            head: ONNX file of NanoTrack's neck and head.
            lost_below: Score below which the target counts as lost.

        Raises:
            MissingExtraError: OpenCV is not installed.
            UnsupportedError: This OpenCV was built without that tracker.
            UsageError: A file does not exist.
            FileFormatError: A file has no weights for that tracker, or exceeds the limits for loading (tested in a
                child process, as in :func:`skyloop.vision.onnx.load_network`).
        """
        self._cv: Any = opencv("tracking")
        self._lost_below = lost_below
        name = "TrackerVit" if head is None else "TrackerNano"
        if not (hasattr(self._cv, f"{name}_create") and hasattr(self._cv, f"{name}_Params")):
            raise UnsupportedError(
                f"this OpenCV, {self._cv.__version__}, has no {name}: install opencv-python-headless 4.10 or newer"
            )
        self._name, files = name, [_existing(path) for path in (weights, head) if path is not None]
        self._given = ", ".join(files)
        onnx.try_alone(*files, tracker=name)
        try:
            self._tracker: Any = onnx.load_tracker(self._cv, name, files)
        except self._cv.error as error:
            raise FileFormatError(
                f"{self._given} can't be loaded as the weights of {name}: {onnx.reason(error)}"
            ) from error

    def _start(self, image: Image, box: Box) -> None:
        x, y, width, height = (round(part) for part in box)
        self._call("init", self._coloured(image), (x, y, width, height))

    def _update(self, image: Image) -> TrackResult:
        _, found = self._call("update", self._coloured(image))
        score = within(float(self._tracker.getTrackingScore()), 0.0, 1.0)
        x, y, width, height = (float(part) for part in found)
        lost = score < self._lost_below or width <= 0 or height <= 0
        return TrackResult(None if lost else (x, y, width, height), score)

    def _call(self, method: str, *arguments: Any) -> Any:
        """Call OpenCV's tracker. A file with a different network often loads without an error and fails only here."""
        try:
            return getattr(self._tracker, method)(*arguments)
        except self._cv.error as error:
            raise FileFormatError(
                f"{self._given} does not work as weights of {self._name}: {onnx.reason(error)}"
            ) from error

    def _coloured(self, image: Image) -> Any:
        return image if image.ndim == 3 else self._cv.cvtColor(image, self._cv.COLOR_GRAY2BGR)


def _existing(path: Path | str) -> str:
    if not Path(path).is_file():
        raise UsageError(f"there is no file {path}: give the ONNX file with the tracker's weights")
    return str(path)
