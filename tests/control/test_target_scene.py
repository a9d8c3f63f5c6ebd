"""Matching detections to things: people who cross, hide, return and look alike, without images."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from skyloop.clock import nanoseconds
from skyloop.control.target_estimate import CameraPose, Traits
from skyloop.control.target_scene import Scene, SceneObject, unlikeness
from skyloop.vision.object_tracks import Detection
from skyloop.vision.tracking import overlap
from tests.support.target_world import PERIOD_S, Path, box_of, camera_at, noisy, walk

Looks = NDArray[np.float32]
BLUE = np.array([40, 5, -40, 30, 0, -10], np.float32)
RED = np.array([45, 55, 35, 30, 0, 0], np.float32)


def detected(camera: CameraPose, x: float, y: float, *, name: str = "person", score: float = 0.9) -> Detection:
    box = box_of(camera, np.array([x, y, 0.0]))
    assert box is not None, "the test's thing is out of view"
    return Detection(box, score, 0, name)


class People:
    """A scene of people with paths and clothes, some of them hidden at times."""

    def __init__(self, *ways: tuple[Path, Looks], seed: int = 1, scene: Scene | None = None) -> None:
        self.scene = scene or Scene()
        self.camera = camera_at()
        self.steps = 0
        self._ways = ways
        self._rng = np.random.default_rng(seed)

    @property
    def time_s(self) -> float:
        return self.steps * PERIOD_S

    def run(self, seconds: float, *, hidden: frozenset[int] = frozenset(), one_box: float = 0.0) -> None:
        """Advance; if two boxes overlap by ``one_box``, the detector sees only the nearer one."""
        for _ in range(round(seconds / PERIOD_S)):
            self.steps += 1
            found = [
                (replace(each, box=noisy(each.box, self._rng)), looks)
                for n, (path, looks) in enumerate(self._ways)
                if n not in hidden
                for each in [detected(self.camera, *path(self.time_s))]
            ]
            if one_box:
                found.sort(key=lambda one: -one[0].box[3])
                found = [
                    one
                    for n, one in enumerate(found)
                    if all(overlap(one[0].box, other[0].box) < one_box for other in found[:n])
                ]
            order = self._rng.permutation(len(found))
            boxes, looks = [found[n][0] for n in order], [found[n][1] for n in order]
            self.scene.update(boxes, looks, self.camera, nanoseconds(self.time_s), ground=True)

    def who(self, n: int) -> SceneObject:
        """Return the thing nearest to a person."""
        x, y = self._ways[n][0](self.time_s)

        def off(each: SceneObject) -> float:
            foot = each.estimator.at(nanoseconds(self.time_s)).foot
            return math.hypot(foot[0] - x, foot[1] - y)

        best = min(self.scene.objects.values(), key=off)
        assert off(best) < 0.8
        return best


CROSSING = (walk(4.0, -1.6, 0.0, 0.8), walk(5.5, 1.8, 0.0, -0.9))


@pytest.mark.parametrize("clothes", [(BLUE, RED), (BLUE, BLUE)], ids=["two colours", "twins"])
@pytest.mark.parametrize("one_box", [0.0, 0.25], ids=["both seen", "one hides the other"])
def test_two_that_cross_keep_their_numbers(clothes: tuple[Looks, Looks], one_box: float) -> None:
    for seed in range(4):
        people = People(*zip(CROSSING, clothes, strict=True), seed=seed)
        people.run(1.0)
        before = [people.who(n).number for n in (0, 1)]
        assert sorted(people.scene.objects) == [1, 2]
        people.run(2.8, one_box=one_box)
        assert [people.who(n).number for n in (0, 1)] == before


@pytest.mark.parametrize("mistaken", [False, True])
def test_two_things_confused_while_merged_are_exchanged(mistaken: bool) -> None:
    people = People((walk(4.5, -1.6, 0.0, 0.8), BLUE), (walk(5.0, 1.8, 0.0, -0.9), BLUE))
    people.run(1.0)
    first, second = people.who(0), people.who(1)
    while not (first.contested and second.contested):
        people.run(PERIOD_S, one_box=0.1)
        assert people.time_s < 3.0
    people.run(0.2, one_box=0.1)
    if mistaken:
        first.exchange(second)
    people.run(4.0 - people.time_s, one_box=0.1)
    assert (people.who(0).number, people.who(1).number) == (first.number, second.number)


def test_an_occluder_is_not_taken_for_the_hidden_thing() -> None:
    """The one behind stays hidden for a second: its filter continues, and the other's is unaffected."""
    people = People((walk(4.0, 0.0), BLUE), (walk(5.5, 1.0, 0.0, -0.6), BLUE))
    people.run(1.0)
    before = [people.who(n).number for n in (0, 1)]
    people.run(1.2, hidden=frozenset({1}))
    assert people.scene.objects[before[1]].detection.box != people.scene.objects[before[0]].detection.box
    assert not people.scene.objects[before[1]].seen
    people.run(0.8)
    assert [people.who(n).number for n in (0, 1)] == before


def test_an_ambiguous_detection_updates_neither_thing() -> None:
    ways = (walk(5.0, -0.25), walk(5.0, 0.25))
    people = People((ways[0], BLUE), (ways[1], BLUE))
    people.run(1.0)
    first, second = (people.who(n) for n in (0, 1))
    before = [one.estimator.seen_ns for one in (first, second)]
    between, at_ns = detected(people.camera, 5.0, 0.0), nanoseconds(people.time_s + PERIOD_S)
    people.scene.update([between], [BLUE], people.camera, at_ns, ground=True)
    assert first.contested
    assert second.contested
    assert not first.seen
    assert not second.seen
    assert [one.estimator.seen_ns for one in (first, second)] == before
    assert sorted(people.scene.objects) == [1, 2], "nor does it start a third"
    people.run(0.2)
    assert first.seen
    assert not first.contested


def test_an_ambiguous_detection_is_used_if_one_thing_looks_like_it() -> None:
    people = People((walk(5.0, -0.25), BLUE), (walk(5.0, 0.25), RED))
    people.run(1.0)
    first, second = (people.who(n) for n in (0, 1))
    between, at_ns = detected(people.camera, 5.0, 0.0), nanoseconds(people.time_s + PERIOD_S)
    people.scene.update([between], [RED], people.camera, at_ns, ground=True)
    assert second.seen
    assert not first.contested


def test_other_colours_mean_another_thing() -> None:
    people = People((walk(5.0, 0.0), BLUE))
    people.run(1.0)
    detection = detected(people.camera, 5.0, 0.05)
    people.scene.update([detection], [RED], people.camera, nanoseconds(people.time_s + PERIOD_S), ground=True)
    first, second = people.scene.objects.values()
    assert not first.seen
    assert second.seen
    assert second.looks.tolist() == RED.tolist()
    assert unlikeness(BLUE, RED) > 16.0 > 1.0 > unlikeness(BLUE, BLUE + 2.0)


def test_another_class_means_another_thing() -> None:
    people = People((walk(5.0, 0.0), BLUE))
    people.run(1.0)
    dog = detected(people.camera, 5.0, 0.05, name="dog")
    people.scene.update([dog], [BLUE], people.camera, nanoseconds(people.time_s + PERIOD_S), ground=True)
    assert [one.class_name for one in people.scene.objects.values()] == ["person", "dog"]


def test_slow_changes_of_light_are_learned() -> None:
    scene, camera = Scene(), camera_at()
    for n in range(120):
        looks = BLUE + np.float32(n) * np.array([0.5, 0, 0, 0.5, 0, 0], np.float32)
        detection = detected(camera, 5.0, 0.0)
        scene.update([detection], [looks], camera, nanoseconds(n * PERIOD_S), ground=True)
    assert list(scene.objects) == [1]
    assert scene.objects[1].hits == 120


def test_a_hidden_thing_is_forgotten_after_two_seconds_unless_kept() -> None:
    for kept in (False, True):
        people = People((walk(5.0, -1.0), BLUE), (walk(5.0, 1.0), RED))
        people.run(1.0)
        number = people.who(0).number
        people.scene.kept = {number} if kept else set()
        people.run(1.8, hidden=frozenset({0}))
        assert number in people.scene.objects
        people.run(0.4, hidden=frozenset({0}))
        assert (number in people.scene.objects) is kept
        people.run(4.0, hidden=frozenset({0}))
        assert (number in people.scene.objects) is kept


def test_a_thing_seen_once_is_forgotten_sooner_and_numbers_are_not_reused() -> None:
    people = People((walk(5.0, -1.0), BLUE), (walk(5.0, 1.0), RED))
    people.run(PERIOD_S)
    assert sorted(people.scene.objects) == [1, 2]
    assert not any(each.confirmed for each in people.scene.objects.values())
    gone = people.who(0).number
    people.run(0.7, hidden=frozenset({0}))
    assert gone not in people.scene.objects
    people.run(0.5)
    assert sorted(people.scene.objects) == [3 - gone, 3]
    assert all(each.confirmed for each in people.scene.objects.values())


def test_dormant_things_are_not_matched() -> None:
    people = People((walk(5.0, 0.0), BLUE))
    people.run(1.0)
    people.scene.kept = people.scene.dormant = {1}
    people.run(0.5)
    assert sorted(people.scene.objects) == [1, 2]
    assert not people.scene.objects[1].seen
    assert people.scene.objects[2].seen
    people.scene.dormant = set()
    people.scene.objects.pop(2)
    people.run(0.5)
    assert people.scene.objects[1].seen


def test_an_uncertain_detection_continues_a_thing_but_starts_none() -> None:
    scene, camera = Scene(), camera_at()
    unsure, sure = (detected(camera, 5.0, 0.0, score=score) for score in (0.2, 0.9))
    scene.update([unsure], [BLUE], camera, nanoseconds(0.0), ground=True)
    assert not scene.objects
    scene.update([sure], [BLUE], camera, nanoseconds(0.1), ground=True)
    scene.update([unsure], [BLUE], camera, nanoseconds(0.2), ground=True)
    assert scene.objects[1].hits == 2


def test_detections_without_a_bearing_are_skipped() -> None:
    scene, camera = Scene(), camera_at(pitch=1.4)
    scene.update([Detection((140, 100, 40, 40), 0.9, 0, "person")], [BLUE], camera, 0, ground=True)
    assert not scene.objects
    scene.update([], [], camera, 1, ground=True)


def test_traits_can_be_given_for_a_class() -> None:
    scene, camera = Scene(traits={"person": Traits(height_m=1.0)}), camera_at()
    detection = detected(camera, 5.0, 0.0)
    scene.update([detection, replace(detection, class_name="yeti")], [BLUE, RED], camera, 0, ground=False)
    person, yeti = scene.objects.values()
    assert person.estimator.at(0).height_m == pytest.approx(1.0)
    assert yeti.estimator.traits.height_m is None
