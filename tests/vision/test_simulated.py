"""Skyloop's own detector: its findings in images outside its training set."""

from __future__ import annotations

import sys

import pytest

from benchmarks.detector import matches
from benchmarks.detector_pictures import Picture
from benchmarks.detector_scores import false_alarms, precision, recall
from skyloop.errors import MissingExtraError, UsageError
from skyloop.sim import load_world
from skyloop.sim.labels import CLASS_NAMES, pictures
from skyloop.vision import Detection, Layout, OnnxDetector, simulated_detector
from skyloop.vision.simulated import SIMULATED_WEIGHTS

SEED = 77_003  # of places and times; no training uses it


@pytest.fixture(scope="module")
def detector() -> OnnxDetector:
    return simulated_detector()


def seen(world: str, count: int) -> list[Picture]:
    return [Picture(image, boxes) for image, boxes in pictures(load_world(world, SEED), SEED, count)]


def test_the_file_is_small_and_names_its_layout_and_classes(detector: OnnxDetector) -> None:
    assert SIMULATED_WEIGHTS.stat().st_size <= 2_000_000
    assert detector.names == dict(enumerate(CLASS_NAMES))
    assert detector.layout is Layout.YOLO8
    with pytest.raises(UsageError, match="score"):
        simulated_detector(score=2.0)


def test_people_and_cars_are_found(detector: OnnxDetector) -> None:
    known = seen("street", 15) + seen("yard", 15)
    found = [detector.detect(picture.image) for picture in known]
    for name in ("person", "car"):
        all_ = matches(found, known, name)
        assert sum(len(each.best) for each in all_) >= 10
        assert recall(all_, 0.0) >= 0.2
        assert precision(all_, 0.0) >= 0.6


@pytest.mark.parametrize("world", ["empty", "pillars"])
def test_nothing_is_found_in_empty_worlds(detector: OnnxDetector, world: str) -> None:
    known = seen(world, 8)
    found: list[list[Detection]] = [detector.detect(picture.image) for picture in known]
    assert sum(false_alarms(matches(found, known, name), 0.0) for name in CLASS_NAMES) <= 2


def test_without_onnx_runtime_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(MissingExtraError, match=r"skyloop install detect"):
        simulated_detector()
