"""A correlation-filter tracker with scale.

A filter is learned whose correlation with the patch around the target is a narrow peak at its middle. It is a product
in the Fourier domain (Bolme, Beveridge, Draper and Lui, "Visual object tracking using adaptive correlation filters",
CVPR 2010), over several channels of gradients and colours and a patch larger than the target (Henriques, Caseiro,
Martins and Batista, "High-speed tracking with kernelized correlation filters", TPAMI 37, 2015; its linear kernel). The
size is tracked by a second, one-dimensional filter over patches of 17 sizes (Danelljan, Häger, Khan and Felsberg,
"Accurate scale estimation for robust visual tracking", BMVC 2014).
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skyloop.messages.geometry import within
from skyloop.vision.opencv import opencv
from skyloop.vision.tracking import CELL, Box, Floats, Image, Tracker, TrackResult, features, patch

Spectrum = NDArray[np.complex64]

_AREA_PX: Final = 128.0**2  # of the patch around the target, sampled
_CONTEXT: Final = 1.5  # times the root of the target's area, added to its width and height
_RATE: Final = 0.02  # how much of each image is learned
_SCALE_RATE: Final = 0.02
_REGULARISATION: Final = 0.02  # of the mean energy of the spectrum
_SPREAD: Final = 0.08  # of the peak, of the target's size
_SCALES: Final = 17
_SCALE_STEP: Final = 1.03
_SCALE_SPREAD: Final = 1.0  # steps
_SCALE_AREA_PX: Final = 32.0**2
_SMALLEST: Final = 0.2  # times the size at the start
_LARGEST: Final = 6.0  # times the size at the start
_LEAST_PX: Final = 4.0


class _Filter:
    """A ridge regression in the Fourier domain, with all channels sharing one denominator."""

    def __init__(self, wanted: Spectrum, rate: float) -> None:
        self._wanted = wanted
        self._rate = rate
        self._above: Spectrum | None = None
        self._below: Floats | None = None

    def learn(self, spectrum: Spectrum) -> None:
        """Learn from a patch's spectrum, channels first: the first one wholly, the others a little."""
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
    """Tracks place and size of a target by correlation filters: fast, and the default.

    It follows what changes slowly, and moves by less than half of its size from image to image. The score is the height
    of the correlation peak: about 1 on the image that it was learned from, and below ``lost_below`` the target counts
    as lost. While it is lost it is looked for where it was last. For loss, memory and search, see
    :class:`LongTermTracker`.
    """

    def __init__(self, *, lost_below: float = 0.3, learn_above: float = 0.4) -> None:
        """Prepare the tracker.

        Args:
            lost_below: Score below which the target is lost.
            learn_above: Score below which nothing is learned.

        Raises:
            MissingExtraError: OpenCV is not installed.
        """
        self._cv: Any = opencv("tracking")
        self._lost_below, self._learn_above = lost_below, learn_above
        self._centre: NDArray[np.float64] = np.zeros(2)  # of the target [px]

    def shift(self, right: float, down: float) -> None:
        """Look for the target so much farther right and down in the next image [px]; it was started before."""
        self._centre = np.add(self._centre, (right, down))

    def _start(self, image: Image, box: Box) -> None:
        x, y, width, height = box
        self._centre = np.array([x + width / 2, y + height / 2])
        self._size = np.array([width, height])
        self._scale = 1.0
        extra = _CONTEXT * math.sqrt(width * height)
        self._around = self._size + extra  # the patch in the image, at scale 1
        self._sampled = _in_cells(self._around, _AREA_PX)
        self._scale_sampled = _in_cells(self._size, _SCALE_AREA_PX)
        columns, rows = self._sampled[0] // CELL, self._sampled[1] // CELL
        self._window = np.outer(np.hanning(rows + 2)[1:-1], np.hanning(columns + 2)[1:-1]).astype(np.float32)
        cells = np.array([columns, rows]) * self._size / self._around  # of the target
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
        """The spectrum over the sizes of each feature of the target, (features, _SCALES // 2 + 1)."""
        width, height = self._scale_sampled
        largest = float(self._steps[-1])
        finer = (round(width * largest * 1.5), round(height * largest * 1.5))
        whole = patch(self._cv, image, self._box(self._size * self._scale * largest), finer)
        sizes = []
        for step in self._steps / largest:
            part = (finer[0] * (1 - step) / 2, finer[1] * (1 - step) / 2, finer[0] * step, finer[1] * step)
            sizes.append(patch(self._cv, whole, part, self._scale_sampled))
        cells = features(self._cv, np.concatenate(sizes))  # all sizes one below the other
        each = cells.reshape(len(cells), _SCALES, -1).transpose(0, 2, 1).reshape(-1, _SCALES)
        return np.asarray(np.fft.rfft(each * self._scale_window, axis=1), np.complex64)


def _in_cells(size: NDArray[np.float64], area_px: float) -> tuple[int, int]:
    """Return width and height with about this area and the shape of a size, in whole cells, an even number of them."""
    share = math.sqrt(area_px / float(size[0] * size[1]))
    width, height = (max(2, round(float(side) * share / CELL / 2) * 2) * CELL for side in size)
    return width, height


def _peak(count: int, spread: float) -> NDArray[np.float64]:
    """Return a Gaussian whose middle is the first of a ring of values."""
    away = np.minimum(np.arange(count), count - np.arange(count))
    return np.asarray(np.exp(-0.5 * (away / spread) ** 2))


def _signed(place: float, count: int) -> float:
    return place - count if place > count / 2 else place


def _refined(values: NDArray[np.floating[Any]], at: int) -> float:
    """Return the place of a peak between the values of a ring, from the parabola through it and its neighbours."""
    before, here, after = float(values[at - 1]), float(values[at]), float(values[(at + 1) % len(values)])
    bend = before - 2 * here + after
    return at if bend >= 0 else at + 0.5 * (before - after) / bend
