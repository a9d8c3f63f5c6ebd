"""Learned trackers: errors without weights or OpenCV's tracker, and the results passed on."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from skyloop.errors import FileFormatError, UnsupportedError, UsageError
from skyloop.vision import LearnedTracker

IMAGE = np.zeros((120, 160, 3), np.uint8)


class Network:
    """Stands in for OpenCV's tracker."""

    def __init__(self, settings: Any) -> None:
        self.settings = settings
        self.boxes: list[Any] = []
        self.score, self.found = 0.8, (10, 20, 30, 40)
        self.broken = False

    def init(self, image: Any, box: Any) -> None:
        if self.broken:
            raise cv2.error("no layer of this name")
        assert image.shape == IMAGE.shape
        self.boxes.append(box)

    def update(self, image: Any) -> tuple[bool, Any]:
        assert image.shape == IMAGE.shape
        return True, self.found

    def getTrackingScore(self) -> float:  # noqa: N802 - OpenCV's name
        return self.score


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[Network]:
    networks: list[Network] = []

    def make(settings: Any) -> Network:
        networks.append(Network(settings))
        return networks[-1]

    for name in ("TrackerVit", "TrackerNano"):
        monkeypatch.setattr(cv2, f"{name}_create", make, raising=False)
        monkeypatch.setattr(cv2, f"{name}_Params", SimpleNamespace, raising=False)
    return networks


@pytest.fixture
def weights(tmp_path: Path) -> Path:
    path = tmp_path / "weights.onnx"
    path.write_bytes(b"no weights")
    return path


def test_one_file_is_a_vit_and_two_are_a_nano(made: list[Network], weights: Path) -> None:
    LearnedTracker(weights)
    LearnedTracker(str(weights), weights)
    assert vars(made[0].settings) == {"net": str(weights)}
    assert vars(made[1].settings) == {"backbone": str(weights), "neckhead": str(weights)}


def test_box_and_score_are_the_networks(made: list[Network], weights: Path) -> None:
    tracker = LearnedTracker(weights)
    tracker.start(IMAGE, (10.4, 19.6, 30, 40))
    assert made[0].boxes == [(10, 20, 30, 40)]
    found = tracker.update(IMAGE)
    assert (found.box, found.score) == ((10.0, 20.0, 30.0, 40.0), 0.8)
    made[0].score = 0.29
    assert tracker.update(IMAGE).lost
    made[0].score, made[0].found = 1.2, (10, 20, 0, 40)
    found = tracker.update(IMAGE)
    assert (found.lost, found.score) == (True, 1.0)
    made[0].score, made[0].found = math.nan, (10, 20, 30, 40)
    found = tracker.update(IMAGE)
    assert (found.lost, found.score) == (True, 0.0)


def test_grey_images_are_coloured(made: list[Network], weights: Path) -> None:
    tracker = LearnedTracker(weights)
    tracker.start(IMAGE[..., 0], (10, 20, 30, 40))
    assert not tracker.update(IMAGE[..., 0]).lost


def test_weights_of_another_network(made: list[Network], weights: Path) -> None:
    tracker = LearnedTracker(weights)
    made[0].broken = True
    with pytest.raises(FileFormatError, match=r"weights\.onnx does not work as weights of TrackerVit: .*layer"):
        tracker.start(IMAGE, (10, 20, 30, 40))
    with pytest.raises(UsageError, match="was not started"):
        tracker.update(IMAGE)


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"there is no file .*none\.onnx"):
        LearnedTracker(tmp_path / "none.onnx")


@pytest.mark.parametrize("head", [False, True])
def test_a_damaged_file(weights: Path, head: bool) -> None:
    with pytest.raises(FileFormatError, match=r"weights\.onnx can't be loaded as the weights of Tracker(Vit|Nano)"):
        LearnedTracker(weights, weights if head else None)


def test_an_opencv_without_it(monkeypatch: pytest.MonkeyPatch, weights: Path) -> None:
    monkeypatch.delattr(cv2, "TrackerVit_create")
    with pytest.raises(UnsupportedError, match=r"has no TrackerVit: install opencv-python-headless 4\.10 or newer"):
        LearnedTracker(weights)
