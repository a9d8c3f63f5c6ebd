"""``python -m benchmarks.markers``: its truth, and its table."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from benchmarks import markers
from skyloop.vision import MarkerDetector


@pytest.mark.parametrize(
    "case", [case for case in markers.CASES if case.name in ("side 24 px", "tilt 60°", "barrel lens")]
)
def test_rendered_corners_are_where_they_are_said_to_be(case: markers.Case) -> None:
    """With pixels' centres at integers: OpenCV's corners, which use them too, are off by less than a quarter."""
    detector = MarkerDetector(markers.FAMILY, markers.SIZE_M)
    shown = markers.show(case, 7, np.random.default_rng(3))
    (sighting,) = detector.detect(shown.image, shown.intrinsics)
    assert np.abs(sighting.corners - shown.corners).max() < 0.2
    assert sighting.distance_m == pytest.approx(shown.distance_m, rel=0.005)


def test_a_square_shows_the_convention_by_its_centre_of_brightness() -> None:
    """Independent of any detector: the darkness of the card's inner square is centred between the corners."""
    case = markers.Case("frontal", side_px=48.0, tilt_deg=0.0, noise=0.0)
    shown = markers.show(case, 7, np.random.default_rng(4))
    filled = cv2.fillConvexPoly(np.zeros(shown.image.shape, np.uint8), shown.corners.round().astype(np.int32), 255)
    inside = np.asarray(cv2.dilate(filled, np.ones((5, 5), np.uint8)) > 0)
    outline = np.abs(shown.image.astype(float) - 210.0) > 90.0  # border and dark data
    y, x = np.nonzero(outline & inside)
    middle = np.array([x.min() + x.max(), y.min() + y.max()]) / 2
    assert np.abs(middle - (shown.corners.min(axis=0) + shown.corners.max(axis=0)) / 2).max() < 0.51


def test_the_table_has_a_row_for_each_case() -> None:
    score = markers.Score("side 12 px", markers.OURS, 30, 2, [0.1, 0.2], [0.001, 0.002], (0.01, -0.02))
    missed = markers.Score("side 24 px", markers.OURS, 30, 0, [], [], (float("nan"), float("nan")))
    results = markers.MarkerResults("5", [score, missed], {"wall": {markers.OURS: 3.21}})
    corners, times = markers.tables(results)
    assert corners.rows == [
        ["side 12 px", "2/30", "0.150 (0.19)", "0.15", "+0.01 -0.02"],
        ["side 24 px", "0/30", "–", "–", "–"],
    ]
    assert times.rows == [["wall", "3.2"]]
