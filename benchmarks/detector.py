"""Measure the detector of the simulator's figures on images that it was not trained on.

The images show ``street`` and ``yard`` at places and times that training never used, as the camera sees them and
degraded. A figure counts if it is at least 14 pixels high, at least half visible and, at the image's edge, has 8 pixels
in view (pixels of an image 320 wide). Detections of other figures are neither right nor wrong. It takes about two
minutes on one core.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.detector_pictures import Image, Picture, as_jpeg, noisy, relit, smeared
from benchmarks.detector_scores import Matches, average_precision, false_alarms, match, precision, recall
from skyloop.sim import load_world
from skyloop.sim.camera import FRONT_CAMERA, CameraModel
from skyloop.sim.labels import CLASS_NAMES, TargetBox, pictures
from skyloop.sim.render import SensorEffects, use_one_core
from skyloop.vision import OnnxDetector
from skyloop.vision.simulated import SIMULATED_WEIGHTS

WORLDS: Final = ("street", "yard")
SEEDS: Final = (9001, 9002, 9003, 9004)
SCORE: Final = 0.4  #: minimum score of ``simulated_detector``
LEAST_PX, LEAST_VISIBLE, LEAST_CUT_PX = 14, 0.5, 8
_SEEN: Final = 0.02  # an object with a smaller visible fraction is not in the picture
_TILT: Final = math.radians(20)
_LOW: Final = 0.05  # minimum score of detections that count for the average precision
_HEIGHTS: Final = ((8, 14), (14, 24), (24, 48), (48, 96), (96, 1000))
_SHARES: Final = ((0.9, 1.01), (0.5, 0.9), (0.25, 0.5))

_WIDTH: Final = 320  # of the network's input

Judge = Callable[[TargetBox, float], bool]


def counts(box: TargetBox, scale: float = 1.0) -> bool:
    """Return whether an object must be found; ``scale`` is that from the picture to one 320 pixels wide."""
    return scale * box.box[3] >= LEAST_PX and box.visible >= LEAST_VISIBLE and _in_view(box, scale)


def _in_view(box: TargetBox, scale: float) -> bool:
    return not box.cut or scale * min(box.box[2:]) >= LEAST_CUT_PX


def held_back(count: int, **how: Any) -> Iterator[Picture]:
    """Yield pictures of each world and seed; ``how`` goes to :func:`skyloop.sim.labels.pictures`."""
    for name in WORLDS:
        for seed in SEEDS:
            for image, boxes in pictures(load_world(name, seed), seed, count, **how):
                yield Picture(image, boxes)


def matches(
    found: Sequence[Sequence[Any]], seen: Sequence[Picture], class_name: str, judge: Judge = counts
) -> list[Matches]:
    """Match the detections of one class in each picture with its true boxes."""
    made = []
    for detections, picture in zip(found, seen, strict=True):
        own = [each for each in detections if each.class_name == class_name]
        true = [box for box in picture.boxes if box.class_name == class_name and box.visible >= _SEEN]
        scores = np.array([each.score for each in own], np.float64)
        scale = _WIDTH / picture.image.shape[1]
        judged = np.array([judge(box, scale) for box in true], np.bool_)
        made.append(match(_corners([each.box for each in own]), scores, _corners([b.box for b in true]), judged))
    return made


def _corners(boxes: Sequence[Sequence[float]]) -> Any:
    table = np.array(boxes, np.float64).reshape(-1, 4)
    return np.hstack([table[:, :2], table[:, :2] + table[:, 2:]])


def conditions(count: int) -> Iterator[tuple[str, list[Picture]]]:
    """Yield descriptions of pictures, each with the pictures: ``count`` of each world and seed."""
    rng = np.random.default_rng(1)
    plain = list(held_back(count))

    def changed(way: Callable[[Image], Image]) -> list[Picture]:
        return [Picture(way(picture.image), picture.boxes) for picture in plain]

    yield "320×240", plain
    yield "JPEG of quality 20", changed(lambda image: as_jpeg(image, 20))
    yield "noise of σ = 10", changed(lambda image: noisy(image, 10.0, rng))
    yield "smeared over 6 px", changed(lambda image: smeared(image, 6.0, float(rng.uniform(0, math.pi))))
    yield "light × 0.5", changed(lambda image: relit(image, 0.5))
    yield "light × 1.4", changed(lambda image: relit(image, 1.4))
    few = max(1, count // 2)
    yield "pitch and roll within ±20°", list(held_back(few, tilt_rad=_TILT))
    yield "simulated AR.Drone", _of_camera(held_back(few, camera=FRONT_CAMERA), FRONT_CAMERA)
    yield "640×360", list(held_back(few, size=(640, 360)))


def _of_camera(seen: Iterator[Picture], model: CameraModel) -> list[Picture]:
    """Add the flaws of a camera's sensor, on a drone that turns by up to some 30° a second."""
    effects, rng = SensorEffects(model, 1), np.random.default_rng(2)
    return [
        Picture(effects.apply(picture.image, number, rng.normal(0.0, 0.5, 3)), picture.boxes)
        for number, picture in enumerate(seen)
    ]


def print_scores(path: Path = SIMULATED_WEIGHTS, count: int = 30) -> None:
    """Print the tables of an ONNX file: ``count`` pictures of each world and seed."""
    use_one_core()
    detector = OnnxDetector(path, score=_LOW)
    print(f"\nAverage precision at overlap 0.5; recall / precision at score {SCORE}; false alarms a picture")
    print("| pictures | " + " | ".join(CLASS_NAMES) + " | false alarms |")
    print("|---|" + "---|" * (len(CLASS_NAMES) + 1))
    details: list[str] = []
    for what, seen in conditions(count):
        found = [detector.detect(picture.image) for picture in seen]
        cells, wrong = [], 0
        for name in CLASS_NAMES:
            all_ = matches(found, seen, name)
            cells.append(f"{average_precision(all_):.3f}; {recall(all_, SCORE):.2f} / {precision(all_, SCORE):.2f}")
            wrong += false_alarms(all_, SCORE)
        print(f"| {what}, {len(seen)} | " + " | ".join(cells) + f" | {wrong / len(seen):.3f} |", flush=True)
        details = details or _details(found, seen)
    print(f"\nRecall at score {SCORE} and number of figures, of the first row's pictures, by height and share visible")
    print("\n".join(details), flush=True)


def _details(found: Sequence[Sequence[Any]], seen: Sequence[Picture]) -> list[str]:
    lines = ["| class | visible | " + " | ".join(f"{low} to {high} px" for low, high in _HEIGHTS) + " |"]
    lines.append("|---|---|" + "---|" * len(_HEIGHTS))
    for name in CLASS_NAMES:
        for least, most in _SHARES:
            cells = []
            for low, high in _HEIGHTS:
                all_ = matches(found, seen, name, _within(low, high, least, most))
                number = sum(len(each.best) for each in all_)
                cells.append(f"{recall(all_, SCORE):.2f} ({number})" if number else "–")
            lines.append(f"| {name} | {least:.0%} to {min(most, 1.0):.0%} | " + " | ".join(cells) + " |")
    return lines


def _within(low: int, high: int, least: float, most: float) -> Judge:
    def judge(box: TargetBox, scale: float) -> bool:
        return low <= scale * box.box[3] < high and least <= box.visible < most and _in_view(box, scale)

    return judge


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.detector", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "file", type=Path, nargs="?", default=SIMULATED_WEIGHTS, help="ONNX file [default: the shipped one]"
    )
    parser.add_argument("--count", type=int, default=30, help="pictures of each world and seed [default: 30]")
    options = parser.parse_args()
    print_scores(options.file, options.count)


if __name__ == "__main__":
    main()
