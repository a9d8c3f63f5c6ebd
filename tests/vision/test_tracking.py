"""Trackers of a box: on rendered sequences with known boxes, and with invalid images and boxes."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import islice
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from benchmarks.tracking_film import read_film, read_labels
from benchmarks.tracking_scenes import Sequence, Truth, fixed, moved, scene, texture
from skyloop.errors import UsageError
from skyloop.vision import CorrelationTracker, LongTermTracker, MedianFlowTracker, Tracker, TrackResult
from skyloop.vision.appearance import colours
from skyloop.vision.tracking import Box, Image, overlap
from tests.support.recordings import recorded

EACH = pytest.mark.parametrize("make", [CorrelationTracker, MedianFlowTracker, LongTermTracker])
Make = Callable[[], Tracker]
BOX = (60, 40, 30, 40)


def picture(channels: int = 3) -> Image:
    drawn = texture(np.random.default_rng(1), 160, 120)
    return drawn if channels == 3 else np.asarray(cv2.cvtColor(drawn, cv2.COLOR_BGR2GRAY), np.uint8)


def run(
    tracker: Tracker, sequence: Sequence, *, most: int | None = None, grey: bool = False
) -> list[tuple[TrackResult, Truth]]:
    """Return the results and true boxes of the counted images after the first."""
    found: list[tuple[TrackResult, Truth]] = []
    for n, (image, truth, counts) in enumerate(islice(sequence.frames(), most)):
        seen = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8) if grey else image
        if n == 0:
            assert truth is not None
            tracker.start(seen, truth)
        else:
            result = tracker.update(seen)
            assert 0.0 <= result.score <= 1.0
            found += [(result, truth)] if counts else []
    return found


def agreement(result: TrackResult, truth: Truth) -> float:
    return overlap(result.box, truth) if result.box is not None and truth is not None else 0.0


@EACH
@pytest.mark.parametrize("grey", [False, True], ids=["colour", "grey"])
def test_a_target_that_moves_and_grows_is_tracked(make: Make, grey: bool) -> None:
    found = run(make(), scene("plain", 3, 120), most=30, grey=grey)
    assert min(agreement(*one) for one in found) > 0.6


def test_changing_light_does_not_matter() -> None:
    assert min(agreement(*one) for one in run(LongTermTracker(), scene("light", 3, 60))) > 0.7


@pytest.mark.parametrize("kind", ["hidden", "look-alike", "leaves"])
def test_a_target_out_of_view_is_lost_and_found_again(kind: str) -> None:
    found = run(LongTermTracker(), scene(kind, 4, 80))
    assert all(result.lost for result, truth in found if truth is None)
    assert any(truth is None for _, truth in found)
    assert all(agreement(*one) > 0.5 for one in found if not one[0].lost)
    assert not any(result.lost for result, _ in found[-10:])


def test_median_flow_stays_lost_until_restarted() -> None:
    steps = list(islice(scene("hidden", 4, 60).frames(), 24, None))
    tracker = MedianFlowTracker()
    found = run(tracker, Sequence("hidden", lambda: iter(steps)))
    assert all(result.lost and result.score == 0.0 for result, _ in found[-5:])
    image, truth, _ = steps[-1]
    assert truth is not None
    tracker.start(image, truth)
    assert tracker.update(image).box == pytest.approx(truth, abs=0.5)


def twins(count: int, *, hidden: range, target_after: bool) -> Sequence:
    """Return a target and its exact twin; a plain wall hides the target, and perhaps only the twin returns."""
    rng = np.random.default_rng(8)
    background, what = texture(rng, 320, 240), texture(rng, 40, 40, (60, 120, 180))

    def frames() -> Any:
        for n in range(count):
            image = background.copy()
            image[150:190, 250:290] = what
            if n < hidden.start or (n >= hidden.stop and target_after):
                image[60:100, 60 + n // 4 : 100 + n // 4] = what
                yield image, (60.0 + n // 4, 60.0, 40.0, 40.0), True
            else:
                image[50:110, 40:140] = 90
                yield image, None, True

    return Sequence("twins", frames)


def test_an_exact_twin_is_not_adopted() -> None:
    found = run(LongTermTracker(), twins(60, hidden=range(25, 60), target_after=False))
    assert not any(result.lost for result, _ in found[:23])
    assert all(result.lost for result, _ in found[25:])


def test_a_target_with_an_exact_twin_stays_lost_after_a_long_occlusion() -> None:
    found = run(LongTermTracker(), twins(65, hidden=range(25, 42), target_after=True))
    assert all(result.lost for result, _ in found[42:])


def test_the_long_term_tracker_accepts_any_tracker() -> None:
    found = run(LongTermTracker(MedianFlowTracker), scene("hidden", 4, 80))
    assert all(result.lost for result, truth in found if truth is None)
    assert not any(result.lost for result, _ in found[-10:])


def changing(roll_deg: float, narrowed: float, faded: float) -> Sequence:
    """A target that rolls back and forth, narrows as if turning sideways, and fades into other texture."""
    rng = np.random.default_rng(2)
    background, one, other = texture(rng, 320, 240), texture(rng, 60, 60), texture(rng, 60, 60)

    def frames() -> Any:
        for share in np.arange(60) / 60:
            what = cv2.addWeighted(one, 1 - faded * share, other, faded * share, 0)
            roll, narrow = (
                math.radians(roll_deg) * math.sin(2 * math.pi * share),
                1 - narrowed * math.sin(math.pi * share),
            )
            turn = np.array([[math.cos(roll), math.sin(roll)], [-math.sin(roll), math.cos(roll)]])
            middle = (150 + 50 * math.sin(4 * share), 120 + 40 * math.sin(7 * share))
            corners = np.array([[-narrow, -1], [narrow, -1], [narrow, 1], [-narrow, 1]]) * 30 @ turn + middle
            image = background.copy()
            at = cv2.getPerspectiveTransform(
                np.array([[0, 0], [60, 0], [60, 60], [0, 60]], np.float32), corners.astype(np.float32)
            )
            cv2.warpPerspective(what, at, (320, 240), dst=image, borderMode=cv2.BORDER_TRANSPARENT)
            (left, top), (right, bottom) = corners.min(axis=0).tolist(), corners.max(axis=0).tolist()
            yield image, (left, top, right - left, bottom - top), True

    return Sequence("changing", frames)


@pytest.mark.parametrize(("roll_deg", "narrowed", "faded"), [(20.0, 0.0, 0.0), (0.0, 0.4, 0.0), (0.0, 0.0, 1.0)])
def test_a_target_that_changes_slowly_is_learned(roll_deg: float, narrowed: float, faded: float) -> None:
    found = run(LongTermTracker(), changing(roll_deg, narrowed, faded))
    assert min(agreement(*one) for one in found) > 0.5


def test_a_target_too_small_to_start_with_is_not_found_again() -> None:
    """The search also tries smaller sizes than the last one."""
    blank = np.full((120, 160, 3), 90, np.uint8)
    first, later = blank.copy(), blank.copy()
    first[42:46, 62:66] = later[82:84, 102:104] = (40, 60, 230)
    tracker = LongTermTracker()
    tracker.start(first, (60, 40, 8, 8))
    assert all(tracker.update(blank).lost for _ in range(10))
    assert all(tracker.update(later).lost for _ in range(12))


class Scripted(Tracker):
    """Returns given boxes."""

    def __init__(self, boxes: list[Box]) -> None:
        self._boxes = boxes
        self.started: list[Box] = []

    def _start(self, image: Image, box: Box) -> None:
        self.started.append(box)

    def _update(self, image: Image) -> TrackResult:
        return TrackResult(self._boxes.pop(0), 1.0)


def test_a_box_with_other_content_is_not_returned() -> None:
    aside = (20.0, 70.0, 30.0, 40.0)
    right = tuple(map(float, BOX))
    inner = Scripted([right, aside, right, *[aside] * 10, right, right, right, right])  # type: ignore[list-item]
    tracker = LongTermTracker(lambda: inner)
    tracker.start(picture(), BOX)
    lost = [tracker.update(picture()).lost for _ in range(18)]
    assert lost == [False, True, False, *[True] * 10, True, True, True, False, False]
    assert len(inner.started) == 2  # one search, in the image after the tenth without verification
    assert overlap(inner.started[1], right) > 0.8  # type: ignore[arg-type]


@EACH
def test_a_low_score_means_that_the_target_is_absent(make: Make) -> None:
    tracker = make()
    tracker.start(picture(), BOX)
    blank = np.full((120, 160, 3), 127, np.uint8)
    assert [tracker.update(blank).lost for _ in range(15)] == [True] * 15


@EACH
@pytest.mark.parametrize(
    ("box", "why"),
    [
        ((60, 40, 0, 40), "at least 6 pixels"),
        ((60, 40, -30, 40), "at least 6 pixels"),
        ((60, math.nan, 30, 40), "finite"),
        ((60, 40, math.inf, 40), "finite"),
        ((200, 40, 30, 40), "at least half"),
        ((-16, 40, 30, 40), "at least half"),
        ((60, 40, 30), "x, y, width and height"),
        (("a", 40, 30, 40), "x, y, width and height"),
        (None, "x, y, width and height"),
    ],
)
def test_an_invalid_box_is_refused(make: Make, box: Any, why: str) -> None:
    tracker = make()
    with pytest.raises(UsageError, match=why):
        tracker.start(picture(), box)
    with pytest.raises(UsageError, match="was not started"):
        tracker.update(picture())


@EACH
def test_an_invalid_image_is_refused(make: Make) -> None:
    tracker = make()
    wrong: Any
    for wrong in (
        picture().astype(np.float32),
        picture()[..., :2],
        np.zeros((0, 4, 3), np.uint8),
        np.zeros(5, np.uint8),
    ):
        with pytest.raises(UsageError, match="the image"):
            tracker.start(wrong, BOX)
    tracker.start(picture(), BOX)
    for other in (picture()[:-1], picture(channels=1)):
        with pytest.raises(UsageError, match="as at the start"):
            tracker.update(other)
    assert not tracker.update(picture()).lost


@EACH
def test_a_box_half_outside_is_tracked(make: Make) -> None:
    tracker = make()
    tracker.start(picture(), (-14, 40, 30, 40))
    result = tracker.update(picture())
    assert agreement(result, (-14, 40, 30, 40)) > 0.9


def test_a_result_knows_its_middle_and_its_corners() -> None:
    found = TrackResult((10.0, 20.0, 5.0, 7.0), 0.9)
    assert (found.lost, found.centre) == (False, (12.0, 23.0))
    assert found.outline == ((10.0, 20.0), (15.0, 20.0), (15.0, 27.0), (10.0, 27.0))
    lost = TrackResult(None, 0.1)
    assert (lost.lost, lost.centre, lost.outline) == (True, None, ())


def test_things_on_a_recorded_film_keep_their_boxes() -> None:
    labels = read_labels()
    film = read_film(recorded(labels.film), 61)
    assert film.shape[1:] == (labels.size[1], labels.size[0], 3)
    for name, boxes in labels.objects.items():
        found = run(LongTermTracker(), fixed(name, film[::10], {n // 10: box for n, box in boxes.items()}))
        assert len(found) == 6
        assert min(agreement(*one) for one in found) > 0.8, name


def test_a_thing_on_a_recorded_film_is_tracked_by_a_moving_camera() -> None:
    labels = read_labels()
    boxes = labels.objects["upper label"]
    found = run(LongTermTracker(), moved("upper label", read_film(recorded(labels.film), 80), boxes, 80, 0))
    assert min(agreement(*one) for one in found) > 0.7


def test_every_tenth_frame_of_the_film_is_labelled() -> None:
    labels = read_labels()
    assert len(labels.objects) >= 3
    assert all(sorted(boxes) == list(range(0, 240, 10)) for boxes in labels.objects.values())
    assert labels.how


# External knowledge of the target ---------------------------------------------------------------------------------


def at(x: int, y: int, what: int | None = 5) -> Image:
    """Draw a textured thing of 30×40 pixels at a place; None: without it."""
    image = texture(np.random.default_rng(8), 320, 240)
    if what is not None:
        image[y : y + 40, x : x + 30] = texture(np.random.default_rng(what), 30, 40, (60, 120, 180))
    return image


@pytest.mark.parametrize("make", [CorrelationTracker, LongTermTracker])
def test_a_target_that_jumps_with_the_camera_is_found_after_a_shift(make: Make) -> None:
    told, untold = make(), make()
    for tracker in (told, untold):
        tracker.start(at(60, 40), BOX)
    told.shift(120.0, 70.0)
    moved = (182.0, 108.0, 30.0, 40.0)
    assert agreement(told.update(at(182, 108)), moved) > 0.7
    assert agreement(untold.update(at(182, 108)), moved) == 0.0


def test_a_tracker_by_the_images_own_motion_ignores_shifts() -> None:
    tracker = MedianFlowTracker()
    tracker.start(at(60, 40), BOX)
    tracker.shift(120.0, 70.0)
    assert agreement(tracker.update(at(62, 41)), (62.0, 41.0, 30.0, 40.0)) > 0.7


def test_the_similarity_measures_appearance() -> None:
    tracker = LongTermTracker()
    tracker.start(at(60, 40), BOX)
    assert tracker.similarity(at(150, 100), (150, 100, 30, 40)) > 0.8
    assert tracker.similarity(at(150, 100, 6), (150, 100, 30, 40)) < 0.45
    assert tracker.similarity(at(0, 0, None), (150, 100, 30, 40)) < 0.45


def test_a_better_match_of_a_known_look_alike_has_no_similarity() -> None:
    mixed = np.asarray(cv2.addWeighted(at(60, 40, 5), 0.6, at(60, 40, 6), 0.4, 0), np.uint8)
    tracker = LongTermTracker()
    tracker.start(at(60, 40), BOX)
    assert tracker.similarity(mixed, BOX) > 0.0
    tracker._memory.learn_look_alike(mixed, tuple(map(float, BOX)))  # type: ignore[arg-type]
    assert tracker.similarity(mixed, BOX) == 0.0
    assert tracker.similarity(at(60, 40), BOX) > 0.9


def test_it_continues_from_a_box_found_elsewhere() -> None:
    tracker = LongTermTracker()
    tracker.start(at(60, 40), BOX)
    assert all(tracker.update(at(0, 0, None)).lost for _ in range(15))
    tracker.resume(at(200, 120), (200, 120, 30, 40))
    result = tracker.update(at(203, 121))
    assert agreement(result, (203.0, 121.0, 30.0, 40.0)) > 0.7, "at once, without a trial"
    assert tracker.similarity(at(60, 40), BOX) > 0.9, "its appearance is remembered"


def test_a_refused_target_is_lost_until_found_again() -> None:
    tracker = LongTermTracker()
    tracker.start(at(60, 40), BOX)
    assert not tracker.update(at(60, 40)).lost
    tracker.refuse()
    tracker.shift(500.0, 500.0)  # a lost target is searched for everywhere
    assert tracker.update(at(60, 40)).lost
    assert not all(tracker.update(at(60, 40)).lost for _ in range(12))


def test_a_tracker_not_started_can_not_continue() -> None:
    tracker = LongTermTracker()
    tracker.shift(3.0, 4.0)
    for call in (tracker.refuse, lambda: tracker.resume(picture(), BOX), lambda: tracker.similarity(picture(), BOX)):
        with pytest.raises(UsageError, match="was not started"):
            call()
    tracker.start(picture(), BOX)
    for wrong in ((60, 40, 0, 40), (60, math.nan, 30, 40), (500, 40, 30, 40), None):
        with pytest.raises(UsageError, match="the box is"):
            tracker.resume(picture(), wrong)  # type: ignore[arg-type]
        with pytest.raises(UsageError, match="the box is"):
            tracker.similarity(picture(), wrong)  # type: ignore[arg-type]
    assert not tracker.update(picture()).lost, "it continues as before"


# Colours -----------------------------------------------------------------------------------------------------------


def dressed(shirt: tuple[int, int, int], trousers: tuple[int, int, int]) -> Image:
    image = np.full((120, 160, 3), 127, np.uint8)
    image[20:60, 60:90], image[60:100, 60:90] = shirt, trousers
    return image


@pytest.mark.parametrize(
    ("colour", "lab"),
    [
        ((255, 255, 255), (100, 0, 0)),
        ((0, 0, 0), (0, 0, 0)),
        ((0, 0, 255), (53, 80, 67)),
        ((255, 0, 0), (32, 79, -108)),
    ],
    ids=["white", "black", "red", "blue"],
)
def test_the_colours_are_of_the_upper_and_lower_half(colour: tuple[int, int, int], lab: tuple[int, int, int]) -> None:
    """CIELAB values from the standard's formulas, for D65."""
    for image, half in ((dressed(colour, (90, 90, 90)), slice(0, 3)), (dressed((90, 90, 90), colour), slice(3, 6))):
        found = colours(image, (60.0, 20.0, 30.0, 80.0))
        assert found.shape == (5, 6)
        assert found.dtype == np.float32
        for place in found:
            assert place[half] == pytest.approx(lab, abs=1.5)


@pytest.mark.parametrize("box", [(52, 20, 46, 80), (30, 20, 60, 80), (60, 20, 60, 80)], ids=["both", "left", "right"])
def test_the_background_beside_a_thing_is_not_in_its_colours(box: Box) -> None:
    image = dressed((40, 60, 190), (150, 80, 30))
    inside = colours(image, (60, 20, 30, 80))[2]
    assert min(np.abs(place - inside).max() for place in colours(image, box)) < 2.5


@pytest.mark.parametrize("box", [(-50, -50, 20, 20), (150, 110, 400, 400), (60, 20, 0.1, 0.1), (-10, -10, 500, 500)])
def test_colours_of_any_box_are_finite(box: Box) -> None:
    for image in (dressed((40, 60, 190), (150, 80, 30)), picture(channels=1)):
        assert np.isfinite(colours(image, box)).all()


def test_a_grey_image_has_only_lightness() -> None:
    found = colours(picture(channels=1), tuple(map(float, BOX)))  # type: ignore[arg-type]
    assert found[:, [1, 2, 4, 5]] == pytest.approx(0.0, abs=0.1)
    assert found[2, 0] > 10.0


def test_trackers_of_other_programs_can_be_used_with_frames() -> None:
    """A Frame is an array with attributes: only its pixels count."""

    class Framed(np.ndarray[Any, Any]):
        header = SimpleNamespace(camera="front")

    tracker = CorrelationTracker()
    tracker.start(picture().view(Framed), BOX)
    assert agreement(tracker.update(picture().view(Framed)), (60, 40, 30, 40)) > 0.9
