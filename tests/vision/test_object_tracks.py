"""Objects keep their numbers: crossings, occlusions, low scores, and detections that must not start an object."""

from __future__ import annotations

import math
import sys
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.errors import MissingExtraError, UsageError
from skyloop.vision import Detection, ObjectTracks, TrackedObject

STEP_S = 0.05


def at(x: float, y: float = 100.0, score: float = 0.9, number: int = 0, size: float = 30.0) -> Detection:
    """A detection of something twice as high as wide, by its centre."""
    return Detection((x - size / 2, y - size, size, 2 * size), score, number, "person" if number == 0 else "car")


def run(tracks: ObjectTracks, scene: Any, frames: int, first: int = 0) -> list[list[TrackedObject]]:
    return [tracks.update(scene(k), k * STEP_S) for k in range(first, first + frames)]


def test_an_object_is_returned_once_confirmed_and_keeps_its_number() -> None:
    history = run(ObjectTracks(), lambda k: [at(100 + 5 * k)], 40)
    assert history[0] == []
    assert {each.id for objects in history[1:] for each in objects} == {1}
    last = history[-1][0]
    assert last.velocity == pytest.approx((100.0, 0.0), abs=3.0)
    assert last.box == pytest.approx((280.0, 70.0, 30.0, 60.0), abs=1.5)
    assert (last.seen, last.unseen_s, last.detection.class_name) == (True, 0.0, "person")
    assert last.age_s == pytest.approx(39 * STEP_S)


def test_two_that_cross_keep_their_numbers() -> None:
    def scene(k: int) -> list[Detection]:
        return [at(100 + 6 * k), at(400 - 6 * k, 108)]

    history = run(ObjectTracks(), scene, 50)
    for k, objects in enumerate(history[5:], start=5):
        places = {each.id: each.detection.centre[0] for each in objects if each.seen}
        assert places[1] == pytest.approx(99.5 + 6 * k, abs=1.0)
        assert places[2] == pytest.approx(399.5 - 6 * k, abs=1.0)


def test_an_object_hidden_for_a_second_is_predicted_where_it_reappears() -> None:
    tracks = ObjectTracks()
    history = run(tracks, lambda k: [] if 20 <= k < 40 else [at(100 + 5 * k)], 60)
    hidden = history[39][0]
    assert not hidden.seen
    assert hidden.unseen_s == pytest.approx(20 * STEP_S)
    assert hidden.box[0] + 15 == pytest.approx(100 + 5 * 39, abs=12)
    assert [(each.id, each.seen) for each in history[-1]] == [(1, True)]


def test_an_object_hidden_for_too_long_is_forgotten_and_its_number_not_reused() -> None:
    history = run(ObjectTracks(keep_s=0.5), lambda k: [] if 10 <= k < 30 else [at(100)], 40)
    assert history[25] == []
    assert [each.id for each in history[-1]] == [2]


def test_uncertain_detections_continue_an_object_but_start_none() -> None:
    history = run(ObjectTracks(), lambda k: [at(100 + k, score=0.9 if k < 10 else 0.15), at(400, score=0.2)], 60)
    assert [(each.id, each.seen) for each in history[-1]] == [(1, True)]
    assert history[-1][0].detection.score == 0.15


def test_a_single_stray_detection_is_not_an_object() -> None:
    history = run(ObjectTracks(confirm=3), lambda k: [at(100)] + ([at(300)] if k % 4 == 0 else []), 20)
    assert {each.id for objects in history for each in objects} == {1}


def test_another_class_in_the_same_place_is_another_object() -> None:
    tracks = ObjectTracks()
    run(tracks, lambda k: [at(100)], 5)
    history = run(tracks, lambda k: [at(100, number=1)], 5, first=5)
    assert {(each.id, each.detection.class_id) for each in history[-1] if each.seen} == {(2, 1)}


def test_missing_frames_do_no_harm() -> None:
    tracks = ObjectTracks()
    run(tracks, lambda k: [at(100 + 5 * k)], 20)
    (later,) = tracks.update([at(100 + 5 * 30)], 30 * STEP_S)
    assert (later.id, later.seen) == (1, True)


def test_detections_that_are_not_finite_or_empty_are_skipped() -> None:
    tracks = ObjectTracks(confirm=1)
    bad = [at(math.nan), at(100, math.inf), at(100, score=math.nan), at(100, size=0.0), at(1e9)]
    assert tracks.update(bad, 0.0) == []


@pytest.mark.parametrize(
    "options",
    [{"sure": 2}, {"overlap": -0.1}, {"overlap_unsure": "x"}, {"confirm": 0}, {"confirm": True}, {"keep_s": math.inf}],
)
def test_arguments_are_checked(options: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match=next(iter(options))):
        ObjectTracks(**options)


@pytest.mark.parametrize("time_s", [math.nan, "1", True, 0.5])
def test_times_are_finite_and_in_order(time_s: Any) -> None:
    tracks = ObjectTracks()
    tracks.update([], 1.0)
    with pytest.raises(UsageError, match="time_s"):
        tracks.update([], time_s)


def test_a_missing_scipy_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "scipy.optimize", None)
    with pytest.raises(MissingExtraError, match="skyloop install detect"):
        ObjectTracks()


DETECTIONS = st.builds(
    at, st.floats(-50, 700), st.floats(-50, 500), st.floats(0, 1), st.integers(0, 1), st.floats(0.01, 300)
)


@given(st.lists(st.lists(DETECTIONS, max_size=5), max_size=8), st.floats(0.0, 3.0))
def test_numbers_are_unique_and_boxes_finite_for_any_detections(scenes: Any, step: float) -> None:
    tracks, taken = ObjectTracks(confirm=1), 0
    for k, scene in enumerate(scenes):
        objects = tracks.update(scene, k * step)
        numbers = [each.id for each in objects]
        assert len(set(numbers)) == len(numbers)
        assert all(math.isfinite(v) for each in objects for v in (*each.box, *each.velocity))
        assert all(each.box[2] > 0 and each.box[3] > 0 for each in objects)
        assert [each for each in numbers if each > taken] == sorted(each for each in numbers if each > taken)
        taken = max([taken, *numbers])
        assert sum(each.seen for each in objects) <= len(scene) or step == 0
