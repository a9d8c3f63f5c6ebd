"""Calibration of a camera from views of a board.

Zhang, "A Flexible New Technique for Camera Calibration", IEEE PAMI 22(11), 2000, as OpenCV has it for both models.
Views that do not go with the others (a wrong corner, a blurred or bent board) are taken out one by one, worst first.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skyloop.calibration import Calibration
from skyloop.errors import UsageError
from skyloop.vision.board import BoardView
from skyloop.vision.opencv import opencv

Array = NDArray[np.float64]
Model = Literal["pinhole", "fisheye"]

LEAST_VIEWS: Final = 6
GRID: Final = (8, 6)  #: cells across and down in which coverage is counted
_WORST_SHARE: Final = 2.5  # a view whose error is so many times the median's is taken out,
_WORST_PX: Final = 0.3  # if it is larger than this
_NEW_SHARE: Final = 0.08  # of the picture's width: a view whose corners moved less than this on average is no new one
_STEPS: Final = (60, 1e-8)


class Collector:
    """Chooses from many pictures of a board those that differ enough from the ones chosen before. Pure."""

    def __init__(self, width: int, height: int) -> None:
        self.views: list[BoardView] = []
        self.size = (width, height)  #: of the pictures
        self._marks: list[Array] = []

    def offer(self, view: BoardView) -> bool:
        """Take a view if it shows the board elsewhere, nearer, farther or otherwise tilted; whether it was taken."""
        mark = _mark(view)
        nearest = min((float(np.abs(mark - other).max()) for other in self._marks), default=math.inf)
        if nearest < _NEW_SHARE * self.size[0]:
            return False
        self.views.append(view)
        self._marks.append(mark)
        return True

    @property
    def coverage(self) -> float:
        """Share of the picture's area in which corners were seen, 0 to 1."""
        return coverage(self.views, *self.size)


def coverage(views: Sequence[BoardView], width: int, height: int) -> float:
    """Share of the cells of a grid over the picture that hold a corner, 0 to 1."""
    cells = np.zeros(GRID, dtype=bool)
    for view in views:
        column = np.clip((view.pixels[:, 0] / width * GRID[0]).astype(int), 0, GRID[0] - 1)
        row = np.clip((view.pixels[:, 1] / height * GRID[1]).astype(int), 0, GRID[1] - 1)
        cells[column, row] = True
    return float(cells.mean())


def calibrate(
    views: Sequence[BoardView], width: int, height: int, *, model: Model = "pinhole", camera: str = ""
) -> tuple[Calibration, list[BoardView]]:
    """The calibration, and the views that were taken out. ``width``, ``height``: of the pictures.

    Raises :class:`UsageError` for too few views, or ones from which nothing can be told.
    """
    if model not in ("pinhole", "fisheye"):
        raise UsageError(f"model is {model!r} and must be 'pinhole' or 'fisheye'")
    kept, rejected = list(views), list[BoardView]()
    while True:
        if len(kept) < LEAST_VIEWS:
            more = f" ({len(rejected)} did not go with the others)" if rejected else ""
            raise UsageError(
                f"{len(kept)} views of the board are too few{more}: show it at least {LEAST_VIEWS} times, tilted"
            )
        fit = _fit(kept, width, height, model)
        worst = int(np.argmax(fit.errors))
        if fit.errors[worst] <= max(_WORST_PX, _WORST_SHARE * float(np.median(fit.errors))):
            break
        rejected.append(kept.pop(worst))
    k, d = fit.matrix, fit.distortion
    found = Calibration(
        width=width,
        height=height,
        model=model,
        fx=float(k[0, 0]),
        fy=float(k[1, 1]),
        cx=float(k[0, 2]),
        cy=float(k[1, 2]),
        distortion=tuple(float(value) for value in np.ravel(d)),
        rms_px=fit.rms,
        views=len(kept),
        rejected=len(rejected),
        coverage=coverage(kept, width, height),
        fx_deviation=fit.fx_deviation,
        camera=camera,
    )
    return found, rejected


class _Fit(NamedTuple):
    rms: float
    matrix: Array
    distortion: Array
    errors: Array  # of each view [px], RMS
    fx_deviation: float | None


def _fit(views: Sequence[BoardView], width: int, height: int, model: Model) -> _Fit:
    cv = opencv("calibration")
    criteria = (cv.TERM_CRITERIA_COUNT | cv.TERM_CRITERIA_EPS, *_STEPS)
    try:
        fit = _fit_fisheye if model == "fisheye" else _fit_pinhole
        found = fit(cv, views, (width, height), criteria)
    except cv.error as error:
        reason = str(error).strip().splitlines()[-1][:200]
        raise UsageError(
            f"these views don't tell the camera's {model} model; show the board tilted more: {reason}"
        ) from error
    if not (np.isfinite(found.matrix).all() and np.isfinite(found.distortion).all() and np.isfinite(found.rms)):
        raise UsageError(f"these views don't tell the camera's {model} model: show the board tilted more")
    return found


def _fit_pinhole(cv: Any, views: Sequence[BoardView], size: tuple[int, int], criteria: Any) -> _Fit:
    points = [view.points.astype(np.float32) for view in views]
    pixels = [view.pixels.astype(np.float32) for view in views]
    # Without k3: of few pictures it is mostly noise, and bends the corners, where nothing was seen. Lenses that need it
    # are fisheyes.
    rms, k, d, _, _, deviations, _, errors = cv.calibrateCameraExtended(
        points, pixels, size, None, None, flags=cv.CALIB_FIX_K3, criteria=criteria
    )
    return _Fit(float(rms), k, np.ravel(d)[:4], np.ravel(errors), float(np.ravel(deviations)[0]))


def _fit_fisheye(cv: Any, views: Sequence[BoardView], size: tuple[int, int], criteria: Any) -> _Fit:
    points = [view.points.reshape(1, -1, 3) for view in views]
    pixels = [view.pixels.reshape(1, -1, 2) for view in views]
    flags = _fisheye_flag(cv, "CALIB_RECOMPUTE_EXTRINSIC") | _fisheye_flag(cv, "CALIB_FIX_SKEW")
    rms, k, d, turns, places = cv.fisheye.calibrate(
        points, pixels, size, np.zeros((3, 3)), np.zeros(4), flags=flags, criteria=criteria
    )
    errors = []
    for view, turn, place in zip(views, turns, places, strict=True):
        back, _ = cv.fisheye.projectPoints(view.points.reshape(1, -1, 3), turn, place, k, d)
        off = np.asarray(back).reshape(-1, 2) - view.pixels
        errors.append(math.sqrt(float((off**2).sum(axis=1).mean())))
    return _Fit(float(rms), np.asarray(k), np.ravel(d), np.array(errors), None)


def _fisheye_flag(cv: Any, name: str) -> int:
    """OpenCV 4 has flags of its own for fisheyes, with other values; OpenCV 5 has one set."""
    return int(getattr(cv.fisheye, name, getattr(cv, name, 0)))


def _mark(view: BoardView) -> Array:
    """What tells two views apart: where four points of the board are in the picture, corners seen or not."""
    cv = opencv("calibration")
    ends = np.array([view.points.min(axis=0)[:2], view.points.max(axis=0)[:2]])
    homography, _ = cv.findHomography(view.points[:, :2], view.pixels)
    if homography is None:
        return np.tile(view.centre, 4)
    square = np.array([[ends[i, 0], ends[j, 1], 1.0] for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))])
    flat = square @ np.asarray(homography).T
    return np.ravel(flat[:, :2] / flat[:, 2:])
