"""Calibration boards, drawn for printing and detected in images, and camera calibration from views of a board.

ChArUco: a chessboard with a marker in each white square, so that every corner has a number and a partial view suffices
(Garrido-Jurado et al., "Automatic generation and detection of highly reliable fiducial markers under occlusion",
Pattern Recognition 47(6), 2014; detection is OpenCV's). A plain chessboard must be entirely in view (Duda and Frese,
"Accurate Detection and Localization of Checkerboard Corners for Calibration", BMVC 2018).

Method: Zhang, "A Flexible New Technique for Camera Calibration", IEEE PAMI 22(11), 2000, as implemented by OpenCV
for both models. Outliers (views with a wrong corner, a blurred or bent board) are removed one by one, worst first.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from skyloop.calibration import Calibration
from skyloop.errors import MissingExtraError, UsageError
from skyloop.files import replacing
from skyloop.vision.lens import Array
from skyloop.vision.opencv import marker_dictionary, opencv

Kind = Literal["charuco", "chessboard"]
MM_PER_INCH = 25.4  # exact by definition
_MARKER_SHARE = 0.74  # marker's side as a fraction of the square's side
_LEAST_CORNERS = 8  # minimum number of a ChArUco board's corners in an image
Model = Literal["pinhole", "fisheye"]

LEAST_VIEWS: Final = 6  #: minimum number of views for a calibration
GRID: Final = (8, 6)  #: number of cells across and down for measuring coverage
_WORST_SHARE: Final = 2.5  # views whose error exceeds this many times the median are removed ...
_WORST_PX: Final = 0.3  # ... and above this
_NEW_SHARE: Final = 0.08  # a view counts as new if its corners have moved by this fraction of the image's width
_STEPS: Final = (60, 1e-8)  # iterations and accuracy of OpenCV's optimisation


@dataclass(frozen=True, slots=True, eq=False)
class BoardView:
    """A board's corners in one image."""

    points: Array  #: corners on the board, (n, 3) [m]
    pixels: Array  #: corners in the image, (n, 2) [px]
    name: str = ""  #: name of the image, for messages

    @property
    def centre(self) -> Array:
        """Mean of the corners, (2,) [px]."""
        return np.asarray(self.pixels.mean(axis=0))


@dataclass(frozen=True, slots=True)
class Board:
    """A board of ``columns`` × ``rows`` squares.

    Raises:
        UsageError: A number is out of its range, or the kind is unknown.
    """

    columns: int = 7
    rows: int = 5
    square_m: float = 0.033  #: side of a square as printed; measure it
    kind: Kind = "charuco"
    dictionary: str = "4x4_50"  #: dictionary of a ChArUco board's markers

    def __post_init__(self) -> None:
        for name, least in (("columns", 3), ("rows", 3)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= 40:
                raise UsageError(f"{name} is {value!r} and must be a whole number from {least} to 40")
        if not 0.0 < self.square_m < math.inf:
            raise UsageError(f"square_m is {self.square_m!r} and must be the side of a square in metres, above 0")
        if self.kind not in ("charuco", "chessboard"):
            raise UsageError(f"kind is {self.kind!r} and must be 'charuco' or 'chessboard'")

    @property
    def corners(self) -> int:
        """The number of inner corners."""
        return (self.columns - 1) * (self.rows - 1)

    def picture(self, square_px: int = 100) -> NDArray[np.uint8]:
        """Draw the board with a white margin of half a square.

        Args:
            square_px: Side of a square.

        Returns:
            Grey image, shape (h, w), uint8.

        Raises:
            UsageError: The dictionary has fewer markers than the board needs.
            UnknownNameError: OpenCV has no such dictionary.
            MissingExtraError: OpenCV is not installed.
        """
        cv = opencv("drawing a board")
        if self.kind == "charuco":
            size = (self.columns * square_px, self.rows * square_px)
            inner = np.asarray(self._charuco(cv).generateImage(size, marginSize=0), dtype=np.uint8)
        else:
            row, column = np.indices((self.rows, self.columns))
            squares = np.where((row + column) % 2, 255, 0).astype(np.uint8)
            inner = np.kron(squares, np.ones((square_px, square_px), np.uint8))
        return np.pad(inner, square_px // 2, constant_values=255)

    def save(self, path: str | Path, dpi: int = 300) -> None:
        """Write the board at its true size for printing.

        Args:
            path: A file name that ends in ``.png`` or ``.pdf``.
            dpi: Resolution, which is adjusted slightly so that a square has an integer number of pixels.

        Raises:
            UsageError: The file name has a different ending, or a square is smaller than 20 pixels or larger than 2000.
            MissingExtraError: Pillow or OpenCV is not installed.
        """
        file = Path(path)
        if file.suffix.lower() not in (".png", ".pdf"):
            raise UsageError(f"{file} must end with .png or .pdf")
        try:
            from PIL import Image
        except ImportError as error:
            raise MissingExtraError("writing a board", "vision", cause=str(error)) from error
        square_px = round(self.square_m * 1000 / MM_PER_INCH * dpi)
        if not 20 <= square_px <= 2000:
            raise UsageError(
                f"squares of {self.square_m * 1000:g} mm at {dpi} dpi are {square_px} pixels, and must be 20 to 2000"
            )
        true_dpi = square_px / (self.square_m * 1000 / MM_PER_INCH)  # resolution at which squares are exactly to size
        with replacing(file) as part:
            if file.suffix.lower() == ".pdf":
                Image.fromarray(self.picture(square_px)).save(part, resolution=true_dpi)
            else:
                Image.fromarray(self.picture(square_px)).save(part, dpi=(true_dpi, true_dpi))

    def _charuco(self, cv: Any) -> Any:
        markers = marker_dictionary(cv, self.dictionary)
        needed, there = self.columns * self.rows // 2, markers.bytesList.shape[0]
        if needed > there:
            raise UsageError(
                f"a board of {self.columns}x{self.rows} squares needs {needed} markers, but the dictionary has {there}"
            )
        side = self.square_m * _MARKER_SHARE
        return cv.aruco.CharucoBoard((self.columns, self.rows), self.square_m, side, markers)


class BoardFinder:
    """Detects one board in images. A finder keeps OpenCV's working memory, so use one per thread.

    Attributes:
        board: The board to detect.
    """

    def __init__(self, board: Board) -> None:
        """Prepare the detector.

        Raises:
            UsageError: The dictionary has fewer markers than the board needs.
            UnknownNameError: OpenCV has no such dictionary.
            MissingExtraError: OpenCV is not installed.
        """
        self.board = board
        self._cv = opencv("finding a board")
        self._charuco = self._detector = None
        if board.kind == "charuco":
            self._charuco = board._charuco(self._cv)
            self._detector = self._cv.aruco.CharucoDetector(self._charuco)

    def find(self, image: NDArray[np.uint8], name: str = "") -> BoardView | None:
        """Detect the board.

        Args:
            image: (h, w, 3) BGR or (h, w) grey, uint8.
            name: Name of the image, kept in the view.

        Returns:
            The board's corners; None if too little of it is visible.

        Raises:
            UsageError: The array has a wrong shape or type, or is empty.
        """
        pixels = np.asarray(image)
        if pixels.dtype != np.uint8 or pixels.ndim not in (2, 3) or pixels.size == 0:
            raise UsageError(f"the image must be uint8, (h, w, 3) or (h, w), got {pixels.dtype} {pixels.shape}")
        grey = self._cv.cvtColor(pixels, self._cv.COLOR_BGR2GRAY) if pixels.ndim == 3 else np.ascontiguousarray(pixels)
        return self._find_charuco(grey, name) if self._detector is not None else self._find_chessboard(grey, name)

    def _find_charuco(self, grey: NDArray[np.uint8], name: str) -> BoardView | None:
        assert self._detector is not None
        assert self._charuco is not None
        corners, ids, _, _ = self._detector.detectBoard(grey)
        if ids is None or len(ids) < _LEAST_CORNERS:
            return None
        points = np.asarray(self._charuco.getChessboardCorners(), dtype=np.float64)[np.ravel(ids)]
        if np.linalg.matrix_rank(points[:, :2] - points[0, :2], tol=1e-6) < 2:
            return None  # collinear corners do not define a plane
        return BoardView(points, np.asarray(corners, dtype=np.float64).reshape(-1, 2), name)

    def _find_chessboard(self, grey: NDArray[np.uint8], name: str) -> BoardView | None:
        board = self.board
        inner = (board.columns - 1, board.rows - 1)
        found, corners = self._cv.findChessboardCornersSB(grey, inner, flags=self._cv.CALIB_CB_ACCURACY)
        if not found:
            return None
        row, column = np.indices((inner[1], inner[0]))
        places = np.column_stack([column.ravel(), row.ravel(), np.zeros(row.size)]).astype(np.float64)
        points: Array = places * board.square_m
        return BoardView(points, np.asarray(corners, dtype=np.float64).reshape(-1, 2), name)


class Collector:
    """Selects views of a board that differ enough from the views selected before. Pure.

    Attributes:
        views: The selected views.
        size: Width and height of the images [px].
    """

    def __init__(self, width: int, height: int) -> None:
        """Initialise an empty collection for images of a fixed size [px]."""
        self.views: list[BoardView] = []
        self.size = (width, height)
        self._marks: list[Array] = []

    def offer(self, view: BoardView) -> bool:
        """Select a view if it shows the board at a new place, at a new distance or with a new tilt.

        Returns:
            Whether the view was selected.
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
        """Fraction of the image area in which corners were seen, 0 to 1."""
        return coverage(self.views, *self.size)


def coverage(views: Sequence[BoardView], width: int, height: int) -> float:
    """Return the fraction of a grid's cells over one camera's images [px] that contain a corner, 0 to 1."""
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
        width: Width of the images [px].
        height: Height of the images [px].
        model: ``"pinhole"`` or ``"fisheye"``.
        camera: The camera's name, stored in the calibration.

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
            more = f" ({len(rejected)} did not fit the others)" if rejected else ""
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
    errors: Array  # RMS error of each view [px]
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
    # k3 is left out: when estimated from few images, it is mostly noise and distorts the image's corners, where there
    # are no data. Lenses that need k3 are fisheye lenses.
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
    """Return OpenCV's fisheye flag. OpenCV 4 has separate flags with different values; OpenCV 5 shares one set."""
    return int(getattr(cv.fisheye, name, getattr(cv, name, 0)))


def _mark(view: BoardView) -> Array:
    """Return a signature for comparing views: the pixels of four points on the board, (8,) [px]."""
    cv = opencv("calibration")
    ends = np.array([view.points.min(axis=0)[:2], view.points.max(axis=0)[:2]])
    homography, _ = cv.findHomography(view.points[:, :2], view.pixels)
    if homography is None:
        return np.tile(view.centre, 4)
    square = np.array([[ends[i, 0], ends[j, 1], 1.0] for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))])
    flat = square @ np.asarray(homography).T
    return np.ravel(flat[:, :2] / flat[:, 2:])
