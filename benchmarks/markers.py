"""Compare marker detection with the truth and, where it is installed, with pupil-apriltags.

Markers of the family 36h11 are rendered by tracing rays: 8 × 8 rays a pixel, through the lens and the marker's plane,
then blur, motion and noise. A pixel's centre has integer coordinates, so that the first pixel reaches from -0.5 to 0.5;
the figure *shift* is the mean error of all corners and would show another convention (about 0.5).

A row has 30 markers in images of 640×480 with random ids, places, turns and directions of tilt. Unless the row says
otherwise, a marker's side is 48 px when seen from the front, tilted by 20°, on a white card, and noise has a standard
deviation of 2 (of 255). The error of a marker is the mean distance of its four corners from the truth.

An example: ``python -m benchmarks.markers --output build/markers``. It takes a minute or two on one core.
pupil-apriltags is a development tool only: ``pip install pupil-apriltags``.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from benchmarks.measuring.tables import UNKNOWN, Table
from skyloop.files import write
from skyloop.messages import Intrinsics
from skyloop.vision import MarkerDetector
from skyloop.vision.lens import normalised, project
from skyloop.vision.planar import rectangle

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

FAMILY: Final = "apriltag_36h11"
SIZE_M: Final = 0.2
OURS, OTHER = "skyloop", "pupil-apriltags"
_WIDTH, _HEIGHT, _FOCAL_PX = 640, 480, 600.0
_FINER: Final = 8  # rays per pixel and axis
_CELLS: Final = 10  # cells per side of the card: 6 of data, the black border and the white margin
_TURNS: Final = 9  # repetitions of a timing, of which the least counts
_PUPIL_SHIFT_PX: Final = 0.5  # pupil-apriltags counts from the first pixel's outer corner: without this, *shift* is 0.5


class Case(NamedTuple):
    """How the markers of a row are shown."""

    name: str
    side_px: float = 48.0
    tilt_deg: float = 20.0
    blur_px: float = 0.5  #: standard deviation
    motion_px: float = 0.0
    noise: float = 2.0
    white: float = 210.0
    black: float = 30.0
    light: str = "even"  #: or "gradient", "shadow"
    distortion: tuple[float, ...] = ()


CASES: Final = (
    *(Case(f"side {side} px", side_px=side) for side in (12, 16, 24, 32, 48, 64, 96)),
    *(Case(f"tilt {tilt}°", tilt_deg=tilt) for tilt in (0, 40, 60, 75)),
    *(Case(f"blur {blur:g} px", blur_px=blur) for blur in (1.0, 2.0, 3.0)),
    *(Case(f"motion {motion} px", motion_px=motion) for motion in (3, 7, 11)),
    *(Case(f"noise {noise}", noise=noise) for noise in (8, 16)),
    Case("low contrast", white=135.0, black=95.0),
    Case("light falls to a quarter", light="gradient"),
    Case("half in shadow", light="shadow"),
    Case("barrel lens", side_px=96.0, distortion=(-0.3, 0.08, 0.001, -0.001, 0.0)),
    Case("24 px, blur 2 px", side_px=24.0, blur_px=2.0),
    Case("24 px, tilt 60°", side_px=24.0, tilt_deg=60.0),
)


class Shown(NamedTuple):
    """A rendered marker."""

    image: Image
    intrinsics: Intrinsics
    corners: Array  #: (4, 2) pixels, clockwise from the marker's top left
    distance_m: float


class Score(msgspec.Struct):
    """The results of one detector in one row."""

    case: str
    detector: str
    shown: int
    found: int
    errors_px: list[float]  #: of the markers found
    range_errors: list[float]  #: relative, of the markers found
    shift_px: tuple[float, float]  #: mean error of all corners


class MarkerResults(msgspec.Struct):
    """All results."""

    opencv: str
    scores: list[Score]
    ms: dict[str, dict[str, float]]  #: processor time for images of 1280×720 without a marker, by detector


#: Returns corners and distance of a marker in an image.
Detect = Callable[[Image, Intrinsics, int], tuple[Array, float] | None]


def show(case: Case, number: int, rng: np.random.Generator) -> Shown:
    """Render marker ``number`` as a case says."""
    lens = Intrinsics(_FOCAL_PX, _FOCAL_PX, _WIDTH / 2 - 0.5, _HEIGHT / 2 - 0.5, distortion=case.distortion)
    ray = np.array([*rng.uniform((-0.3, -0.2), (0.3, 0.2)), 1.0])
    place = ray * (_FOCAL_PX * SIZE_M / case.side_px)
    # Tilted about a random axis in the face, after a random turn, and faced to the ray rather than the optical axis.
    turn, axis, tilt = rng.uniform(0, 2 * math.pi), rng.uniform(0, 2 * math.pi), math.radians(case.tilt_deg)
    ahead = ray / np.linalg.norm(ray)
    right = np.cross([0.0, 1.0, 0.0], ahead)
    right /= np.linalg.norm(right)
    faced = np.column_stack([right, -np.cross(ahead, right), -ahead])
    tilted = cv2.Rodrigues(np.array([math.cos(axis), math.sin(axis), 0.0]) * tilt)[0]
    rotation = faced @ tilted @ cv2.Rodrigues(np.array([0.0, 0.0, turn]))[0]
    corners = project(rectangle(SIZE_M, SIZE_M) @ rotation.T + place, lens)
    image = np.full((_HEIGHT, _WIDTH), 0.5 * (case.white + case.black))
    reach = 0.7 * np.ptp(corners, axis=0).max() + 4 * case.blur_px + case.motion_px / 2 + 4
    low = np.maximum(0, np.floor(corners.mean(axis=0) - reach)).astype(int)
    high = np.minimum((_WIDTH, _HEIGHT), np.ceil(corners.mean(axis=0) + reach)).astype(int)
    drawn = _traced(case, number, lens, (rotation, place), (low, high))
    drawn = cv2.GaussianBlur(drawn, (0, 0), case.blur_px * _FINER)
    if case.motion_px:
        drawn = cv2.filter2D(drawn, -1, _smear(case.motion_px * _FINER, rng.uniform(0, math.pi)))
    shape = (high[1] - low[1], _FINER, high[0] - low[0], _FINER)
    image[low[1] : high[1], low[0] : high[0]] = drawn.reshape(shape).mean(axis=(1, 3))
    return Shown(_noisy(image, case.noise, rng), lens, corners, float(np.linalg.norm(place)))


def _traced(case: Case, number: int, lens: Intrinsics, pose: tuple[Any, Any], area: tuple[Any, Any]) -> Any:
    """Return the brightness along the rays of an area."""
    (left, top), (right, bottom) = area
    across = (np.arange((right - left) * _FINER) + 0.5) / _FINER - 0.5 + left
    down = (np.arange((bottom - top) * _FINER) + 0.5) / _FINER - 0.5 + top
    pixels = np.stack(np.meshgrid(across, down), axis=-1)
    straight = (pixels - (lens.cx, lens.cy)) / (lens.fx, lens.fy)
    flat = normalised(pixels.reshape(-1, 2), lens).reshape(pixels.shape) if lens.distortion else straight
    rotation, place = pose
    # The face's plane: position + x·right + y·up; solved for x and y of each ray.
    inverse = np.linalg.inv(np.column_stack([rotation[:, :2], place]))
    x, y, w = np.moveaxis(np.concatenate([flat, np.ones((*flat.shape[:2], 1))], axis=-1) @ inverse.T, -1, 0)
    cell = SIZE_M / (_CELLS - 2)
    column, row = np.floor(x / w / cell).astype(int) + _CELLS // 2, _CELLS // 2 - 1 - np.floor(y / w / cell).astype(int)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    card = np.pad(cv2.aruco.generateImageMarker(dictionary, number, _CELLS - 2) // 255, 1, constant_values=1)
    on_card = (column >= 0) & (column < _CELLS) & (row >= 0) & (row < _CELLS) & (w > 0)
    value = card[row.clip(0, _CELLS - 1), column.clip(0, _CELLS - 1)]
    bright = np.where(on_card, case.black + (case.white - case.black) * value, 0.5 * (case.white + case.black))
    if case.light == "gradient":
        bright *= np.clip(0.625 - 0.75 * x / w / SIZE_M, 0.15, 1.1)
    elif case.light == "shadow":
        bright *= np.where(x / w + 0.4 * y / w > 0.1 * SIZE_M, 0.4, 1.0)
    return bright.astype(np.float32)


def _smear(length: float, angle: float) -> NDArray[np.float32]:
    """Return the kernel of a straight motion."""
    reach = math.ceil(length / 2) + 1
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    along, aside = x * math.cos(angle) + y * math.sin(angle), y * math.cos(angle) - x * math.sin(angle)
    kernel = np.clip(length / 2 + 0.5 - np.abs(along), 0, 1) * np.clip(1.0 - np.abs(aside), 0, 1)
    return np.asarray(kernel / kernel.sum(), dtype=np.float32)


def empty_images() -> Iterator[tuple[str, Image]]:
    """Yield images of 1280×720 without a marker."""
    rng, shape = np.random.default_rng(5), (720, 1280)
    yield "evenly lit wall", _noisy(np.full(shape, 120.0), 3.0, rng)
    rough = cv2.resize(rng.normal(0, 25, (90, 160)), shape[::-1], interpolation=cv2.INTER_CUBIC)
    yield "texture", _noisy(120.0 + rough + cv2.resize(rng.normal(0, 12, (360, 640)), shape[::-1]), 2.0, rng)
    boxes = np.full(shape, 120, np.uint8)
    for _ in range(150):
        centre, size = rng.uniform((0, 0), shape[::-1]).tolist(), rng.uniform(8, 120, 2).tolist()
        box = cv2.boxPoints((centre, size, rng.uniform(0, 180)))
        cv2.fillConvexPoly(boxes, box.astype(np.int32), int(rng.integers(0, 255)), cv2.LINE_AA)
    yield "150 rectangles", _noisy(cv2.GaussianBlur(boxes, (0, 0), 0.7).astype(float), 2.0, rng)
    yield "noise 20", _noisy(np.full(shape, 120.0), 20.0, rng)


def _noisy(image: NDArray[Any], deviation: float, rng: np.random.Generator) -> Image:
    return np.asarray((image + rng.normal(0, deviation, image.shape)).round().clip(0, 255), np.uint8)


def detectors() -> dict[str, Detect]:
    """Return the detectors by name."""
    ours = MarkerDetector(FAMILY, SIZE_M)

    def by_ours(image: Image, lens: Intrinsics, number: int) -> tuple[Array, float] | None:
        return next(((one.corners, one.distance_m) for one in ours.detect(image, lens) if one.id == number), None)

    try:
        import pupil_apriltags
    except ImportError:
        print(f"without {OTHER}: it is not installed")
        return {OURS: by_ours}
    other = pupil_apriltags.Detector(families="tag36h11", nthreads=1, quad_decimate=1.0)

    def by_other(image: Image, lens: Intrinsics, number: int) -> tuple[Array, float] | None:
        for one in other.detect(image):
            if one.tag_id == number:
                corners = np.asarray(one.corners, dtype=np.float64)[::-1] - _PUPIL_SHIFT_PX
                square, rays = rectangle(SIZE_M, SIZE_M), normalised(corners, lens)
                place = cv2.solvePnP(square, rays, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE_SQUARE)[2]
                return corners, float(np.linalg.norm(place))
        return None

    return {OURS: by_ours, OTHER: by_other}


def measure(shown: int, report: Callable[[str], None], seed: int = 0) -> MarkerResults:
    """Measure all detectors; ``shown`` is the number of markers in each row."""
    cv2.setNumThreads(1)
    scores, by_name = [], detectors()
    for at, case in enumerate(CASES):
        report(f"{at + 1} of {len(CASES)}: {case.name}")
        rng = np.random.default_rng((seed, at))
        numbers = [int(rng.integers(587)) for _ in range(shown)]
        images = [show(case, number, rng) for number in numbers]
        for name, detect in by_name.items():
            found = [detect(one.image, one.intrinsics, number) for one, number in zip(images, numbers, strict=True)]
            scores.append(_score(case.name, name, zip(images, found, strict=True)))
    times = {}
    for what, image in empty_images():
        report(f"time: {what}")
        times[what] = {name: _least_ms(detect, image) for name, detect in by_name.items()}
    return MarkerResults(cv2.__version__, scores, times)


def _score(case: str, name: str, seen: Iterable[tuple[Shown, tuple[Array, float] | None]]) -> Score:
    shown, errors, ranges, shifts = 0, [], [], []
    for truth, found in seen:
        shown += 1
        if found is None:
            continue
        corners, distance_m = found
        # A library's first corner is its own affair: the nearest of the four turns counts.
        turned = min((np.roll(corners, n, axis=0) - truth.corners for n in range(4)), key=lambda d: (d**2).sum())
        errors.append(float(np.linalg.norm(turned, axis=1).mean()))
        ranges.append(abs(distance_m / truth.distance_m - 1.0))
        shifts.append(turned.mean(axis=0))
    across, down = np.mean(shifts, axis=0) if shifts else (math.nan, math.nan)
    return Score(case, name, shown, len(errors), errors, ranges, (float(across), float(down)))


def _least_ms(detect: Detect, image: Image) -> float:
    times, lens = [], Intrinsics(1000.0, 1000.0, 639.5, 359.5)
    for _ in range(_TURNS):
        began = time.process_time_ns()
        detect(image, lens, 0)
        times.append(time.process_time_ns() - began)
    return min(times) / 1e6


def tables(results: MarkerResults) -> tuple[Table, Table]:
    """Return errors and times as tables."""
    names = list(dict.fromkeys(score.detector for score in results.scores))
    cells: dict[str, list[str]] = {}
    for score in results.scores:
        cells.setdefault(score.case, []).extend(_cells(score))
    columns = [f"{name}: {what}" for name in names for what in ("found", "error, px", "range, %", "shift, px")]
    rows = [[case, *texts] for case, texts in cells.items()]
    times = [[image, *(f"{by[name]:.1f}" for name in names)] for image, by in results.ms.items()]
    corners = Table("Corners: median (90th percentile)", ["marker", *columns], rows)
    return corners, Table("1280×720 without a marker, ms on one core", ["image", *names], times)


def _cells(score: Score) -> list[str]:
    found = f"{score.found}/{score.shown}"
    if not score.found:
        return [found, UNKNOWN, UNKNOWN, UNKNOWN]
    error, ninth = np.percentile(score.errors_px, (50, 90))
    (across, down), off = score.shift_px, f"{100 * float(np.median(score.range_errors)):.2f}"
    return [found, f"{error:.3f} ({ninth:.2f})", off, f"{across:+.2f} {down:+.2f}"]


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print the tables, and write the figures as JSON."""
    parser = argparse.ArgumentParser(prog="benchmarks.markers", description=__doc__)
    parser.add_argument("--output", type=Path, help="folder for markers.json")
    parser.add_argument("--shown", type=int, default=30, help="markers in each row [default: 30]")
    parser.add_argument("--seed", type=int, default=0, help="which markers: those of 0 are for tuning [default: 0]")
    options = parser.parse_args(arguments)
    results = measure(options.shown, lambda what: print(f"… {what}", flush=True), options.seed)
    for each in tables(results):
        print(f"\n{each.title} (OpenCV {results.opencv})\n\n{each.markdown()}")
    if options.output is not None:
        options.output.mkdir(parents=True, exist_ok=True)
        write(options.output / "markers.json", msgspec.json.encode(results) + b"\n")


if __name__ == "__main__":
    main()
