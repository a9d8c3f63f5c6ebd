"""Training and scoring the detector of the simulator's figures: the pure parts, and the programs' help."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.detector_pictures import as_jpeg, coarse, noisy, relit, smeared, spoil, training_pictures
from benchmarks.detector_scores import average_precision, balanced_score, false_alarms, match, precision, recall
from benchmarks.detector_targets import IGNORED, NOTHING, assign, places
from skyloop.sim.labels import CLASS_NAMES

ROOT = Path(__file__).resolve().parents[2]
TRUE = np.array([[0, 0, 10, 10], [20, 0, 30, 10], [40, 0, 50, 10]], np.float64)
COUNT = np.array([True, True, False])


def test_each_true_box_is_found_once_and_one_that_does_not_count_is_neither_right_nor_wrong() -> None:
    found = np.array([[0, 0, 10, 9], [0, 0, 10, 10], [20, 6, 30, 16], [40, 0, 50, 10]], np.float64)
    result = match(found, np.array([0.6, 0.9, 0.8, 0.7]), TRUE, COUNT)
    assert result.right.tolist() == [
        False,
        True,
        False,
        False,
    ]  # the most certain one took the box; an overlap of 0.25 is too little
    assert result.ignored.tolist() == [False, False, False, True]
    assert result.best.tolist() == [0.9, -1.0]
    assert recall([result], 0.5) == 0.5
    assert recall([result], 0.95) == 0.0
    assert precision([result], 0.5) == pytest.approx(1 / 3)
    assert precision([result], 0.85) == 1.0
    assert false_alarms([result], 0.7) == 1
    assert 0.8 < balanced_score([result]) <= 0.9  # below, a second detection is wrong, and no other box is found


def test_average_precision_of_known_rankings() -> None:
    perfect = match(TRUE[:2], np.array([0.9, 0.8]), TRUE, COUNT)
    assert average_precision([perfect]) == 1.0
    wrong_first = match(np.vstack([TRUE[:1] + 100, TRUE[:2]]), np.array([0.95, 0.9, 0.8]), TRUE, COUNT)
    assert average_precision([wrong_first]) == pytest.approx(2 / 3)  # precision 1/2, then 2/3: made monotone
    half = match(TRUE[:1], np.array([0.9]), TRUE, COUNT)
    assert average_precision([half]) == 0.5
    assert average_precision([perfect, half]) == pytest.approx(0.75)
    assert np.isnan(average_precision([]))
    nothing = match(np.zeros((0, 4)), np.zeros(0), TRUE, COUNT)
    assert average_precision([nothing]) == 0.0


def test_places_are_assigned_the_objects_around_them() -> None:
    grid = places(64, 32)
    middles, strides = grid
    assert len(middles) == 8 * 4 + 4 * 2 + 2
    assert middles[0].tolist() == [4, 4]
    assert strides[-1] == 32
    assert middles[-1].tolist() == [48, 16]
    small = np.array([20, 12, 5, 14], np.float32)  # the centre of a place of the finest grid
    answer, target = assign(small[None], np.array([1]), grid)
    mine = answer == 1
    assert mine.any()
    assert (strides[mine] == 8).all()  # a small thing belongs to the finest grid alone
    assert (abs(middles[mine] - small[:2]) < (6, 7)).all()
    assert (target[mine] == small).all()
    assert (answer[~mine] == NOTHING).all()


def test_a_smaller_object_takes_precedence_and_ignored_objects_take_none_of_its_places() -> None:
    grid = places(64, 32)
    boxes = np.array([[22, 14, 30, 30], [20, 12, 6, 8], [24, 16, 40, 30]], np.float32)
    answer, _ = assign(boxes, np.array([0, 2, IGNORED]), grid)
    at = int(np.flatnonzero((grid[0] == (20, 12)).all(axis=1))[0])
    assert answer[at] == 2
    assert (answer == 0).any()
    assert (answer == IGNORED).any()
    alone, _ = assign(boxes[:2], np.array([0, 2]), grid)
    assert (answer[alone >= 0] == alone[alone >= 0]).all()


def test_large_objects_belong_to_coarse_grids() -> None:
    grid = places(320, 256)
    answer, _ = assign(np.array([[160, 128, 90, 230]], np.float32), np.array([0]), grid)
    assert set(grid[1][answer == 0].tolist()) == {32}


def test_training_pictures_are_labelled_and_repeatable() -> None:
    first, again = (list(training_pictures(3, 4)) for _ in range(2))
    assert len(first) == 4
    for one, other in zip(first, again, strict=True):
        assert (one.image == other.image).all()
        assert one.boxes == other.boxes
        assert one.image.shape[1:] == (320, 3)
    assert {box.class_name for each in first for box in each.boxes} & set(CLASS_NAMES)


def test_spoilt_pictures_keep_their_size() -> None:
    rng = np.random.default_rng(0)
    image = np.full((60, 80, 3), 128, np.uint8)
    image[20:40, 30:50] = (40, 80, 200)
    for spoilt in (
        as_jpeg(image, 20),
        coarse(image, 0.5),
        noisy(image, 5.0, rng),
        relit(image, 0.5),
        smeared(image, 6.0, 1.0),
        *(spoil(image, rng) for _ in range(8)),
    ):
        assert spoilt.shape == image.shape
        assert spoilt.dtype == np.uint8
    assert relit(image, 0.5)[0, 0].tolist() == [64, 64, 64]
    assert 4.0 < noisy(image, 5.0, rng)[:10].std() < 6.0
    assert (smeared(image, 6.0, 0.0)[0] == image[0]).all()


@pytest.mark.process
@pytest.mark.parametrize("module", ["scripts.train_detector", "benchmarks.detector"])
def test_the_programs_explain_themselves(module: str) -> None:
    command = [sys.executable, "-m", module, "--help"]
    told = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert told.returncode == 0, told.stderr
    assert f"python -m {module}" in told.stdout
