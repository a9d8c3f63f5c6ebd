"""Calibration of a camera from views of a board.

Zhang, "A Flexible New Technique for Camera Calibration", IEEE PAMI 22(11), 2000, as implemented by OpenCV for both
models. Outliers among the views (a wrong corner, a blurred or bent board) are removed one by one, worst first.
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
_WORST_SHARE: Final = 2.5  # a view whose error is more than so many times the median is removed,
_WORST_PX: Final = 0.3  # if it is larger than this
_NEW_SHARE: Final = 0.08  # of the image's width: a view whose corners moved less than this is no new one
_STEPS: Final = (60, 1e-8)


class Collector:
    """Selects, from many images of a board, views that differ enough from the ones selected before. Pure.

    Attributes:
        views: The selected views.
        size: Width and height of the images [px].
    """

    def __init__(self, width: int, height: int) -> None:
        """Initialise an empty collection for images of one size [px]."""
        self.views: list[BoardView] = []
        self.size = (width, height)  #: of the images
        self._marks: list[Array] = []

    def offer(self, view: BoardView) -> bool:
        """Select a view if it shows the board elsewhere, nearer, farther or at another tilt.

        Returns:
            Whether it was selected.
        """
        mark = _mark(view)
        nearest = min((float(np.abs(mark - other).max()) for other in self._marks), default=math.inf)
        if nearest < _NEW_SHARE * self.size[0]:
            return False
        self.views.append(view)
        self._marks.append(mark)
        return True

    @property
    def coverage(self) -> float:
        """Share of the image area in which corners were seen, 0 to 1."""
        return coverage(self.views, *self.size)


def coverage(views: Sequence[BoardView], width: int, height: int) -> float:
    """Return the share of the cells of a grid over the image that hold a corner, 0 to 1.

    Args:
        views: Of one camera.
        width: Of the images [px].
        height: Of the images [px].
    """
    cells = np.zeros(GRID, dtype=bool)
    for view in views:
        column = np.clip((view.pixels[:, 0] / width * GRID[0]).astype(int), 0, GRID[0] - 1)
        row = np.clip((view.pixels[:, 1] / height * GRID[1]).astype(int), 0, GRID[1] - 1)
        cells[column, row] = True
    return float(cells.mean())


def calibrate(
    views: Sequence[BoardView], width: int, height: int, *, model: Model = "pinhole", camera: str = ""
) -> tuple[Calibration, list[BoardView]]:
    """Compute a camera's calibration.

    Args:
        views: At least 6, with the board at different places and tilts.
        width: Of the images [px].
        height: Of the images [px].
        model: ``"pinhole"`` or ``"fisheye"``.
        camera: The camera's name, which the calibration keeps.

    Returns:
        The calibration, and the views that were removed as outliers.

    Raises:
        UsageError: There are too few views, or they do not determine the model.
        MissingExtraError: OpenCV is not installed.
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
            f"these views don't determine the camera's {model} model; show the board tilted more: {reason}"
        ) from error
    if not (np.isfinite(found.matrix).all() and np.isfinite(found.distortion).all() and np.isfinite(found.rms)):
        raise UsageError(f"these views don't determine the camera's {model} model: show the board tilted more")
    return found


def _fit_pinhole(cv: Any, views: Sequence[BoardView], size: tuple[int, int], criteria: Any) -> _Fit:
    points = [view.points.astype(np.float32) for view in views]
    pixels = [view.pixels.astype(np.float32) for view in views]
    # Without k3: from few images it is mostly noise, and bends the corners, where nothing was seen. Lenses that need it
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
    """Return what distinguishes two views: where four points of the board are in the image, (8,) [px]."""
    cv = opencv("calibration")
    ends = np.array([view.points.min(axis=0)[:2], view.points.max(axis=0)[:2]])
    homography, _ = cv.findHomography(view.points[:, :2], view.pixels)
    if homography is None:
        return np.tile(view.centre, 4)
    square = np.array([[ends[i, 0], ends[j, 1], 1.0] for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))])
    flat = square @ np.asarray(homography).T
    return np.ravel(flat[:, :2] / flat[:, 2:])
