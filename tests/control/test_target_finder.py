"""One target in rendered images: by box, by class, hidden and returning, among look-alikes, with a drifting tracker."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest

from benchmarks.tracking_scenes import texture
from skyloop.clock import nanoseconds
from skyloop.control.target_estimate import CameraPose, Traits
from skyloop.control.target_finder import Sighting, TargetFinder
from skyloop.control.target_range import RangeEstimator
from skyloop.errors import UsageError
from skyloop.vision.object_tracks import Detection
from skyloop.vision.tracking import Box, Image, TrackResult, overlap
from tests.support.target_world import PERIOD_S, SIZE, Path, box_of, camera_at, walk

WIDTH, HEIGHT = SIZE
BLUE, RED = (180, 90, 40), (40, 60, 190)
STANDS = Traits(radius_m=0.1, on_ground=True)


class Walker:
    """A textured, upright thing on a path."""

    def __init__(self, path: Path, colour: tuple[int, int, int], seed: int) -> None:
        self.path = path
        self.cloth = texture(np.random.default_rng(seed), 40, 120, colour)

    def box(self, camera: CameraPose, at_s: float) -> Box:
        box = box_of(camera, np.array([*self.path(at_s), 0.0]))
        assert box is not None, "the test's thing is out of view"
        return box

    def draw(self, image: Image, box: Box) -> None:
        x, y, width, height = (round(part) for part in box)
        rows = np.arange(height) * len(self.cloth) // height
        columns = np.arange(width) * self.cloth.shape[1] // width
        part = image[y : y + height, x : x + width]
        part[:] = self.cloth[rows][:, columns][: len(part), : part.shape[1]]


class Film:
    """Images of walkers, a detector's findings in them, and a finder that gets both.

    If two overlap, the detector finds only the nearer one.

    Attributes:
        sightings: One per image, each with the true box of the first walker.
    """

    def __init__(self, finder: TargetFinder, *walkers: Walker, detects: bool = True) -> None:
        self.finder, self.walkers, self.detects = finder, walkers, detects
        self.steps = -1
        self.sightings: list[tuple[Sighting, Box]] = []
        self._background = texture(np.random.default_rng(7), WIDTH, HEIGHT)

    @property
    def at_ns(self) -> int:
        return nanoseconds(1.0 + self.steps * PERIOD_S)

    @property
    def time_s(self) -> float:
        return self.steps * PERIOD_S

    def picture(self, hidden: Sequence[int] = ()) -> tuple[Image, list[Detection]]:
        camera, image = camera_at(), self._background.copy()
        boxes = [(n, each.box(camera, self.time_s)) for n, each in enumerate(self.walkers) if n not in hidden]
        boxes.sort(key=lambda one: one[1][3])  # the farthest first
        for n, box in boxes:
            self.walkers[n].draw(image, box)
        shown = [
            box for k, (_, box) in enumerate(boxes) if all(overlap(box, nearer) < 0.2 for _, nearer in boxes[k + 1 :])
        ]
        return image, [Detection(box, 0.9, 0, "person") for box in shown]

    def run(self, seconds: float, hidden: Sequence[int] = ()) -> None:
        for _ in range(round(seconds / PERIOD_S)):
            self.steps += 1
            image, detections = self.picture(hidden)
            found = self.finder.see(
                image, camera_at(), self.at_ns, ground=True, detections=detections if self.detects else None
            )
            self.sightings.append((found, self.walkers[0].box(camera_at(), self.time_s)))

    def agreement(self, last: int = 10) -> float:
        """Return the worst overlap with the true box in the last images."""
        return min(0.0 if one.box is None else overlap(one.box, truth) for one, truth in self.sightings[-last:])

    def is_kept(self, n: int = 0) -> bool:
        """Return whether the finder's target is at a walker's place."""
        assert self.finder.estimator is not None
        foot = self.finder.estimator.at(self.at_ns).foot
        return math.dist(foot[:2], self.walkers[n].path(self.time_s)) < 0.6


def start_box(walker: Walker) -> Box:
    return walker.box(camera_at(), 0.0)


@pytest.mark.parametrize("traits", [None, STANDS])
def test_a_box_suffices(traits: Traits | None) -> None:
    walker = Walker(walk(4.0, -1.0, 0.0, 0.8), BLUE, 1)
    film = Film(TargetFinder(box=start_box(walker), traits=traits), walker, detects=False)
    film.run(2.0)
    assert film.agreement(28) > 0.6
    assert film.is_kept() or traits is None, "without traits its range is not known before the vehicle moves"
    assert film.finder.target is None
    assert film.finder.others(film.at_ns) == []
    assert film.finder.class_name is None
    first = film.sightings[0][0]
    assert first.box == start_box(walker)
    assert first.confidence == 1.0
    assert all(0.0 < (one.confidence or 0.0) <= 1.0 for one, _ in film.sightings)


def test_a_box_on_a_detection_selects_it_at_once() -> None:
    walker, other = Walker(walk(4.0, -0.8, 0.0, 0.6), BLUE, 1), Walker(walk(4.5, 1.4), RED, 2)
    x, y, width, height = start_box(walker)
    film = Film(TargetFinder(box=(x - 5, y - 4, width + 8, height + 6)), walker, other)
    film.run(1 / 15)
    assert film.finder.class_name == "person"
    film.run(1.6)
    assert film.finder.target is not None
    assert film.agreement(20) == pytest.approx(1.0), "the box is the detection's"
    assert len(film.finder.detections) == 2
    assert film.is_kept()
    (beside,) = film.finder.others(film.at_ns)
    assert beside.foot[:2] == pytest.approx([4.5, 1.4], abs=0.4)
    assert film.finder.others(film.at_ns + nanoseconds(1.5)) == []


def test_a_box_suffices_until_the_detector_agrees() -> None:
    walker = Walker(walk(4.0, -0.8, 0.0, 0.6), BLUE, 1)
    film = Film(TargetFinder(box=start_box(walker)), walker, detects=False)
    film.run(0.5)
    assert film.finder.target is None
    film.detects = True
    film.run(2 / 15)
    assert film.finder.target is None, "a detection or two may be a chance"
    film.run(0.3)
    assert film.finder.target is not None
    assert film.agreement(2) == pytest.approx(1.0)


@pytest.mark.parametrize("class_name", [None, "person"])
@pytest.mark.parametrize("detects_s", [0.0, 0.5])
def test_given_traits_take_precedence_over_the_class(class_name: str | None, detects_s: float) -> None:
    walker = Walker(walk(4.0, -0.8, 0.0, 0.4), BLUE, 1)
    small = Traits(height_m=0.86, height_share=0.02, on_ground=False)
    film = Film(TargetFinder(box=start_box(walker), class_name=class_name, traits=small), walker, detects=False)
    film.run(detects_s)
    film.detects = True
    film.run(1.0)
    assert film.finder.target is not None
    assert film.finder.target.estimator.traits is small
    assert film.finder.estimator is film.finder.target.estimator
    assert film.finder.estimator.at(film.at_ns).range_m == pytest.approx(2.0, abs=0.4), "half as high is half as far"
    film.run(2.5, hidden=[0])
    film.run(0.7)
    assert film.finder.target is not None
    assert film.finder.target.estimator.traits is small, "even after it was recognised"


@pytest.mark.parametrize("box", [None, (138.0, 82.0, 40.0, 40.0)])
def test_a_target_of_an_unknown_class_may_hang_on_a_wall(box: Box | None) -> None:
    finder = TargetFinder(box=box, class_name=None if box else "clock")
    image, camera = texture(np.random.default_rng(7), WIDTH, HEIGHT), camera_at()
    clock, other = (Detection((x, 85.0, 40.0, 40.0), 0.9, 0, "clock") for x in (140.0, 30.0))
    for n in range(6):
        finder.see(image, camera, nanoseconds(1.0 + n * PERIOD_S), ground=True, detections=[clock, other])
    assert finder.target is not None
    assert finder.estimator is finder.target.estimator
    assert isinstance(finder.estimator, RangeEstimator)
    assert not finder.estimator.at(nanoseconds(1.4)).range_known
    (beside,) = finder.others(nanoseconds(1.4))
    assert beside.range_known, "other things count as standing on the ground"


def test_the_largest_of_a_class_is_chosen_once_confirmed() -> None:
    near, far = Walker(walk(3.5, 0.8), BLUE, 1), Walker(walk(5.0, -1.0), RED, 2)
    film = Film(TargetFinder(class_name="person"), near, far)
    film.run(2 / 15)
    assert film.finder.target is None
    assert film.sightings[-1][0] == Sighting(None, None)
    film.run(1.0)
    assert film.agreement() == pytest.approx(1.0)
    assert film.is_kept()
    assert film.sightings[-1][0].confidence is not None


def test_a_target_too_small_to_track_is_followed_by_detections() -> None:
    finder, image = TargetFinder(class_name="person"), texture(np.random.default_rng(7), WIDTH, HEIGHT)
    small = Detection((150.0, 115.0, 4.0, 12.0), 0.9, 0, "person")
    for n in range(6):
        found = finder.see(image, camera_at(), nanoseconds(1.0 + n * PERIOD_S), ground=False, detections=[small])
    assert found == Sighting(small.box, 0.9)
    nothing = finder.see(image, camera_at(), nanoseconds(1.5), ground=False, detections=[])
    assert nothing == Sighting(None, None)


def test_a_detection_against_the_tracker_is_not_used() -> None:
    walker, other = Walker(walk(4.0, 0.0), BLUE, 1), Walker(walk(4.5, 1.6), RED, 2)
    film = Film(TargetFinder(box=start_box(walker)), walker, other, detects=False)
    film.run(0.3)
    elsewhere = Detection(other.box(camera_at(), 0.0), 0.9, 0, "person")
    for _ in range(6):
        film.steps += 1
        image, _ = film.picture()
        found = film.finder.see(image, camera_at(), film.at_ns, ground=True, detections=[elsewhere])
    assert film.finder.target is None
    assert found.box is not None
    assert overlap(found.box, start_box(walker)) > 0.7


def test_other_classes_are_not_used() -> None:
    film = Film(TargetFinder(class_name="dog"), Walker(walk(3.5, 0.8), BLUE, 1))
    film.run(1.0)
    assert film.finder.estimator is None
    assert all(one.box is None for one, _ in film.sightings)


def test_a_crossing_thing_is_not_taken_for_the_target() -> None:
    for colour in (BLUE, RED):
        walker, other = Walker(walk(4.5, -0.9, 0.0, 0.6), BLUE, 1), Walker(walk(3.6, 0.9, 0.0, -0.6), colour, 1)
        film = Film(TargetFinder(box=start_box(walker)), walker, other)
        film.run(3.0)
        assert film.is_kept()
        assert film.agreement() == pytest.approx(1.0)


@pytest.mark.parametrize("detects", [True, False], ids=["detector", "tracker"])
def test_a_target_hidden_for_three_seconds_is_recognised(detects: bool) -> None:
    walker = Walker(walk(4.0, -1.0, 0.0, 0.4), BLUE, 1)
    film = Film(TargetFinder(box=start_box(walker), class_name="person"), walker, detects=detects)
    film.run(1.5)
    film.run(3.0, hidden=[0])
    assert all(one.box is None for one, _ in film.sightings[-40:])
    film.run(1.6)
    assert film.is_kept()
    assert film.agreement(5) > 0.6


def test_other_colours_are_not_recognised() -> None:
    walker = Walker(walk(4.0, 0.0), BLUE, 1)
    film = Film(TargetFinder(box=start_box(walker)), walker, Walker(walk(4.2, 0.4), RED, 2))
    film.run(1.5, hidden=[1])
    film.run(2.0, hidden=[0, 1])
    film.run(1.5, hidden=[0])
    assert all(one.box is None for one, _ in film.sightings[-45:])
    film.run(1.0)
    assert film.agreement(5) == pytest.approx(1.0)


def test_of_two_newcomers_that_look_alike_neither_is_recognised() -> None:
    walker = Walker(walk(4.0, 0.0), BLUE, 1)
    film = Film(TargetFinder(box=start_box(walker)), walker, Walker(walk(4.2, 0.8), BLUE, 1))
    film.run(1.5, hidden=[1])
    film.run(2.5, hidden=[0, 1])
    film.run(1.5)
    assert all(one.box is None for one, _ in film.sightings[-50:])


def jumping(t: float) -> tuple[float, float]:
    """Stands, and later somewhere else, two metres off."""
    return 4.0, -1.0 if t < 2.5 else 1.1


def test_the_tracker_recognises_a_target_that_could_have_moved_there() -> None:
    walker = Walker(jumping, BLUE, 1)
    slow = Traits(height_m=1.72, intensity_m2_s3=0.01)
    film = Film(TargetFinder(box=start_box(walker), traits=slow), walker, detects=False)
    film.run(2.0)
    film.run(2.5, hidden=[0])
    film.run(2.0)
    assert film.agreement(5) > 0.6
    assert film.is_kept()


def test_without_a_height_nothing_is_recognised_as_if_the_camera_were_on_the_ground() -> None:
    """It seemed 0.3 m away, and the vehicle backed off."""
    here, there = (start_box(Walker(walk(4.0, side), BLUE, 1)) for side in (-1.9, 1.9))
    finder, drifting = TargetFinder(box=here, class_name="box", nominal_m=4.0), Drifting()
    image, camera = texture(np.random.default_rng(7), WIDTH, HEIGHT), camera_at(z=0.1)
    finder._tracker = drifting  # type: ignore[assignment]
    for n in range(75):
        drifting.box = here if n < 30 else None if n < 60 else there
        found = finder.see(image, camera, nanoseconds(1.0 + n * PERIOD_S), ground=False, detections=None)
    assert found.box == there, "that may be it"
    assert finder.estimator is not None
    assert finder.estimator.at(nanoseconds(6.0)).range_m > 2.0


def test_a_newcomer_where_the_target_can_not_be_is_not_recognised() -> None:
    walker = Walker(walk(4.0, 1.6), BLUE, 1)
    slow = Traits(height_m=1.72, intensity_m2_s3=0.01)
    finder = TargetFinder(box=start_box(walker), class_name="person", traits=slow)
    film = Film(finder, walker, Walker(walk(4.0, -1.8), BLUE, 1))
    film.run(2.0, hidden=[1])
    film.run(1.2, hidden=[0, 1])
    film.run(0.8, hidden=[0])
    assert all(one.box is None for one, _ in film.sightings[-24:])


def test_detections_can_arrive_after_their_image() -> None:
    walker = Walker(walk(4.0, -0.8, 0.0, 0.6), BLUE, 1)
    finder = TargetFinder(class_name="person")
    film = Film(finder, walker, detects=False)
    late: list[tuple[int, list[Detection]]] = []
    for _ in range(24):
        film.run(PERIOD_S)
        late.append((film.at_ns, film.picture()[1]))
        if len(late) > 3:
            at_ns, detections = late[-4]
            finder.detected(detections, at_ns, ground=True)
    assert finder.target is not None
    assert film.is_kept()
    assert film.agreement(10) > 0.6, "between the detections it is tracked"


def test_late_detections_confirm_a_box_like_prompt_ones() -> None:
    walker = Walker(walk(4.0, -0.8, 0.0, 0.6), BLUE, 1)
    finder = TargetFinder(box=start_box(walker))
    film = Film(finder, walker, detects=False)
    film.run(3 * PERIOD_S)
    for n in range(3):
        assert finder.target is None, "a detection or two may be a chance"
        at_ns, detections = film.at_ns, film.picture()[1]
        film.run(PERIOD_S)
        assert finder.detected(detections, at_ns, ground=True) is (n == 2)
    assert finder.target is not None


def test_a_target_too_small_to_track_is_seen_by_late_detections() -> None:
    finder, image = TargetFinder(class_name="person"), texture(np.random.default_rng(7), WIDTH, HEIGHT)
    small = Detection((150.0, 115.0, 4.0, 12.0), 0.9, 0, "person")
    seen = []
    for at_ns in (nanoseconds(1.0 + n * PERIOD_S) for n in range(4)):
        finder.see(image, camera_at(), at_ns, ground=False, detections=None)
        seen.append(finder.detected([small], at_ns, ground=False))
    assert seen == [False, False, True, True]
    assert not finder.detected([], at_ns, ground=False)


def test_detections_of_an_unknown_image_are_ignored() -> None:
    walker = Walker(walk(4.0, 0.0), BLUE, 1)
    finder = TargetFinder(class_name="person")
    film = Film(finder, walker, detects=False)
    film.run(1.5)
    _, detections = film.picture()
    for at_ns in (0, film.at_ns + 1, film.at_ns - nanoseconds(1.2)):
        assert not finder.detected(detections, at_ns, ground=True)
    assert finder.detections == ()


class Drifting:
    """Stands in for the tracker: returns a given box and counts calls."""

    def __init__(self) -> None:
        self.box: Box | None = None
        self.refused, self.resumed, self.started = 0, 0, 0

    def update(self, image: Image) -> TrackResult:
        return TrackResult(self.box, 0.8, 0.9)

    def shift(self, right: float, down: float) -> None:
        pass

    def refuse(self) -> None:
        self.refused += 1

    def resume(self, image: Image, box: Box) -> None:
        self.resumed += 1

    def start(self, image: Image, box: Box) -> None:
        self.started += 1


def test_a_drifted_tracker_is_refused() -> None:
    walker = Walker(walk(4.0, 0.0), BLUE, 1)
    finder, drifting = TargetFinder(box=start_box(walker), traits=Traits(height_m=1.72)), Drifting()
    film = Film(finder, walker, detects=False)
    film.run(1.0)
    finder._tracker = drifting  # type: ignore[assignment]
    drifting.box = (5.0, 40.0, 20.0, 60.0)
    film.run(0.8)
    assert drifting.refused >= 1
    assert all(one.box is None for one, _ in film.sightings[-12:])
    assert film.is_kept(), "its estimate is unaffected"


def test_late_detections_bring_back_a_lost_or_drifted_tracker() -> None:
    walker = Walker(walk(4.0, 0.0), BLUE, 1)
    finder, drifting = TargetFinder(class_name="person"), Drifting()
    film = Film(finder, walker, detects=False)
    for _ in range(4):
        film.run(PERIOD_S)
        finder.detected(film.picture()[1], film.at_ns, ground=True)
    finder._tracker = drifting  # type: ignore[assignment]
    x, y, width, height = start_box(walker)
    elsewhere, there = (x + 0.7 * width, y, width, height), (x + 1.0, y, width, height)
    for box, counts in ((None, (1, 0)), (elsewhere, (1, 1)), (there, (1, 1)), (None, (2, 1))):
        drifting.box = box
        film.run(PERIOD_S)
        assert finder.detected(film.picture()[1], film.at_ns, ground=True)
        assert (drifting.started, drifting.resumed) == counts, "with a new appearance where it was lost"


def test_late_detections_give_the_size_instead_of_the_tracker() -> None:
    walker = Walker(walk(4.0, 0.0), BLUE, 1)
    finder, drifting = TargetFinder(class_name="person"), Drifting()
    film = Film(finder, walker, detects=False)
    x, y, width, height = start_box(walker)
    drifting.box = (x, y + 0.1 * height, 0.8 * width, 0.85 * height)
    for n in range(40):
        film.run(PERIOD_S)
        finder.detected(film.picture()[1], film.at_ns, ground=True)
        if n == 4:
            finder._tracker = drifting  # type: ignore[assignment]
    assert film.sightings[-1][0].box == drifting.box
    assert finder.estimator is not None
    assert finder.estimator.at(film.at_ns).range_m == pytest.approx(4.0, abs=0.25)


@pytest.mark.parametrize(("hidden_s", "taken"), [(0.5, False), (1.2, True)])
def test_a_hidden_target_can_be_anywhere_within_reach(hidden_s: float, taken: bool) -> None:
    """Its motion does not predict it there, but the tracker recognised it."""
    walker, there = Walker(walk(4.0, -1.9), BLUE, 1), Walker(walk(4.0, 1.9), BLUE, 1)
    slow = Traits(height_m=1.72, intensity_m2_s3=0.001)
    finder, drifting = TargetFinder(box=start_box(walker), traits=slow), Drifting()
    film = Film(finder, walker, there, detects=False)
    film.run(1.5, hidden=[1])
    finder._tracker = drifting  # type: ignore[assignment]
    film.run(hidden_s)
    drifting.box = there.box(camera_at(), 0.0)
    film.run(0.3)
    assert (film.sightings[-1][0].box == drifting.box) is taken
    assert film.is_kept(1 if taken else 0)


def test_the_box_of_another_thing_is_not_the_target() -> None:
    walker, other = Walker(walk(4.0, 0.0), BLUE, 1), Walker(walk(4.0, 1.2), RED, 2)
    finder, drifting = TargetFinder(box=start_box(walker)), Drifting()
    film = Film(finder, walker, other)
    film.run(1.0)
    finder._tracker = drifting  # type: ignore[assignment]
    drifting.box = other.box(camera_at(), 0.0)
    film.run(0.2)
    assert film.agreement(3) == pytest.approx(1.0)
    assert drifting.resumed == 3, "the detection corrects the tracker"
    film.run(0.5, hidden=[0])
    assert all(one.box is None for one, _ in film.sightings[-7:])


def test_with_a_detected_target_the_tracker_counts_between_searched_images() -> None:
    walker = Walker(walk(4.0, 0.0), BLUE, 1)
    finder, drifting = TargetFinder(box=start_box(walker)), Drifting()
    film = Film(finder, walker)
    film.run(1.0)
    finder._tracker = drifting  # type: ignore[assignment]
    drifting.box = walker.box(camera_at(), 0.0)
    film.detects = False
    film.run(0.5)
    assert film.agreement(7) == pytest.approx(1.0)
    film.detects = True
    film.run(0.2, hidden=[0])
    assert all(one.box is None for one, _ in film.sightings[-3:]), "it sees what hides the target"
    film.run(1.2, hidden=[0])
    film.detects = False
    film.run(0.2)
    assert all(one.box is None for one, _ in film.sightings[-3:]), "nor later, until it was recognised"


def test_a_newcomer_is_observed_before_it_counts_as_the_target() -> None:
    walker, back = Walker(walk(4.0, -1.0), BLUE, 1), Walker(walk(4.0, 1.0), BLUE, 1)
    film = Film(TargetFinder(box=start_box(walker)), walker, back)
    film.run(1.0, hidden=[1])
    assert film.finder.candidate(film.at_ns) is None
    film.run(1.5, hidden=[0, 1])
    film.run(2 * PERIOD_S, hidden=[0])
    candidate = film.finder.candidate(film.at_ns)
    assert candidate is not None
    assert candidate.foot[:2] == pytest.approx([4.0, 1.0], abs=0.5)
    assert film.sightings[-1][0].box is None
    film.run(5 * PERIOD_S, hidden=[0])
    assert film.sightings[-1][0].box is not None
    assert film.finder.candidate(film.at_ns) is None


def test_a_person_in_other_clothes_is_not_even_considered() -> None:
    walker, other = Walker(walk(4.0, -1.0), BLUE, 1), Walker(walk(4.0, 1.0), RED, 1)
    film = Film(TargetFinder(box=start_box(walker)), walker, other)
    film.run(1.0, hidden=[1])
    film.run(1.5, hidden=[0, 1])
    film.run(1.0, hidden=[0])
    assert film.finder.candidate(film.at_ns) is None
    assert film.sightings[-1][0].box is None


def test_a_box_without_a_bearing_is_refused() -> None:
    finder = TargetFinder(box=(140.0, 100.0, 40.0, 40.0))
    picture = texture(np.random.default_rng(7), WIDTH, HEIGHT)
    with pytest.raises(UsageError, match="straight above or below"):
        finder.see(picture, camera_at(pitch=1.4), 1, ground=True, detections=None)


def test_a_box_outside_the_image_is_refused() -> None:
    finder = TargetFinder(box=(400.0, 100.0, 40.0, 40.0))
    with pytest.raises(UsageError, match="at least half"):
        finder.see(texture(np.random.default_rng(7), WIDTH, HEIGHT), camera_at(), 1, ground=True, detections=None)


def test_a_target_needs_a_box_or_a_class() -> None:
    with pytest.raises(UsageError, match="needs a box in the image, or the name of a class"):
        TargetFinder()
