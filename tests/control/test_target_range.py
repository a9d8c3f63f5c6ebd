"""The range of a target that may not stand on the ground, learned from the vehicle's own motion alone."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path as File
from typing import Any

import numpy as np
import pytest

from skyloop.client.frame import Frame
from skyloop.clock import nanoseconds
from skyloop.control import ChaseSettings, FollowTarget
from skyloop.control.chase_law import TargetPhase
from skyloop.control.target_estimate import TRAITS, UNKNOWN, BoxView, CameraPose, TargetEstimator, TargetState, Traits
from skyloop.control.target_range import RangeEstimator, estimator_of
from skyloop.errors import UsageError
from skyloop.messages.relayed import Shape
from skyloop.stepping.rehearsal import rehearse
from skyloop.vision import simulated_detector
from skyloop.vision.tracking import Box
from tests.support.target_world import PERIOD_S, ChaseWorld, box_of, camera_at, walk

PICTURE, PERSON = (3.5, 1.7, 0.6), (5.0, 0.0, 1.7)  # distance, height of the lower edge, and height [m]


def still(at_s: float) -> float:
    return 0.0


def bobbing(at_s: float) -> float:
    """Up by 0.4 m and back, in four seconds."""
    return 0.2 - 0.2 * math.cos(math.pi / 2 * at_s)


class Watching:
    """A vehicle that watches a thing by a tracker's boxes, whose errors persist."""

    def __init__(
        self,
        thing: tuple[float, float, float],
        *,
        z: float = 2.1,
        speed_m_s: float = 0.0,
        seed: int = 1,
        estimator: TargetEstimator | None = None,
    ) -> None:
        self.away_m, self.foot_m, self.height_m = thing
        self.estimator = estimator or estimator_of(None, None)
        self.at_s, self._z, self._speed = 0.0, z, speed_m_s
        self._rng, self._error = np.random.default_rng(seed), np.zeros(2)
        self.misread = still  # error of its altimeter [m] by time [s]
        self.strayed: Callable[[float], float] | None = None  # error of its integrated velocity; None: unknown

    def view(self, up_m: float) -> tuple[BoxView, CameraPose]:
        self._error = 0.9 * self._error + self._rng.normal(0.0, 0.44, 2)
        foot = np.array([self.away_m, self._speed * self.at_s, self.foot_m])
        camera = camera_at(z=self._z + up_m, yaw=math.atan2(foot[1], foot[0]))
        box = box_of(camera, foot, self.height_m)
        assert box is not None
        x, y, width, height = box
        up, down = (self._error * (0.5 + 0.03 * height)).tolist()
        view = BoxView.of((x, y + up, width, height - up + down), camera, 0.06)
        assert view is not None
        rise_m = None if self.strayed is None else up_m + self.strayed(self.at_s)
        position = np.add(camera.position, (0.0, 0.0, self.misread(self.at_s)))
        return view, replace(camera, position=position, rise_m=rise_m)

    def run(self, seconds: float, motion: Callable[[float], float] = still) -> TargetState:
        for _ in range(round(seconds / PERIOD_S)):
            view, camera = self.view(motion(self.at_s))
            at_ns = nanoseconds(self.at_s)
            if self.estimator.seen_ns is None:
                self.estimator.start(view, camera, at_ns, ground=True)
            else:
                assert self.estimator.update(view, camera, at_ns)
            self.at_s += PERIOD_S
        return self.estimator.at(at_ns)


def test_a_picture_on_a_wall_is_not_assumed_to_stand_on_the_ground() -> None:
    """It seemed 14.7 ± 1.0 m away, in a room of 8 m."""
    by_ground = Watching(PICTURE, estimator=TargetEstimator(UNKNOWN)).run(1.0)
    assert by_ground.range_m > 3 * PICTURE[0], "the lower edge alone suggests that"
    assert by_ground.range_deviation_m < 0.25 * by_ground.range_m
    watching = Watching(PICTURE)
    for seconds in (PERIOD_S, 1.0, 3.0):
        found = watching.run(seconds)
        assert not found.range_known
        assert found.range_deviation_m > 0.3 * found.range_m
        assert found.range_m - 2.0 * found.range_deviation_m < PICTURE[0]


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_vehicles_own_climb_shows_that_a_picture_hangs_on_the_wall(seed: int) -> None:
    watching = Watching(PICTURE, seed=seed)
    found = watching.run(8.0, bobbing)
    assert found.range_known
    assert abs(found.range_m - PICTURE[0]) < 3.0 * found.range_deviation_m
    assert found.range_m == pytest.approx(PICTURE[0], rel=0.3)
    assert isinstance(watching.estimator, RangeEstimator)
    assert watching.estimator.on_ground is False, "that hypothesis is dropped"


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("speed_m_s", [0.0, 0.6])
def test_the_climb_confirms_the_range_of_a_target_on_the_ground(seed: int, speed_m_s: float) -> None:
    watching = Watching(PERSON, z=1.2, seed=seed, speed_m_s=speed_m_s)
    assert not watching.run(2.0).range_known, "not before the vehicle has moved"
    found = watching.run(10.0, bobbing)
    away_m = math.hypot(PERSON[0], speed_m_s * (watching.at_s - PERIOD_S))
    assert found.range_known
    assert abs(found.range_m - away_m) < 3.0 * found.range_deviation_m
    assert found.range_m == pytest.approx(away_m, rel=0.2)
    assert isinstance(watching.estimator, RangeEstimator)
    assert watching.estimator.on_ground is not False


def test_while_the_vehicle_stays_no_hypothesis_wins() -> None:
    """The one with the least motion won: a person seemed to hang in the air, and nearer."""
    watching = Watching(PERSON, z=1.2)
    watching.run(12.0, bobbing)
    found = watching.run(20.0)
    assert isinstance(watching.estimator, RangeEstimator)
    assert watching.estimator.on_ground is not False
    assert found.range_m == pytest.approx(PERSON[0], rel=0.2)


@pytest.mark.parametrize(
    "misread",
    [
        lambda at_s: -2.1 * (3.0 < at_s < 4.0),
        lambda at_s: -0.7 * (at_s > 3.0),
        lambda at_s: 0.7 * (at_s > 3.0),
        lambda at_s: -1.7 * min(1.0, max(0.0, 4.0 * (at_s - 3.0))),
    ],
    ids=["unknown for a second", "over a table", "beyond a table", "a person below, by a filtered altimeter"],
)
def test_a_jump_of_the_altimeter_does_not_reveal_the_range(misread: Callable[[float], float]) -> None:
    """A picture was "known" to be 40 m away and would have been flown into."""
    watching = Watching(PICTURE)
    watching.misread = lambda at_s: misread(at_s + 2.0)
    for _ in range(6):
        assert not watching.run(0.5).range_known
    found = watching.run(4.0, bobbing)
    assert not found.range_known or found.range_m == pytest.approx(PICTURE[0], rel=0.4)


@pytest.mark.parametrize("ramp_m_s", [-0.3, -0.2, -0.1, 0.05, 0.1, 0.2, 0.3])
@pytest.mark.parametrize("thing", [PICTURE, PERSON], ids=["picture", "person"])
def test_a_slow_drift_of_the_altimeter_does_not_reveal_the_range(
    thing: tuple[float, float, float], ramp_m_s: float
) -> None:
    """Over sloping ground, or with altimeter drift, a picture 3.5 m away was "known" to be 16 m away."""
    watching = Watching(thing, z=2.1 if thing is PICTURE else 1.2)
    watching.strayed = lambda at_s: 0.015 * at_s
    watching.misread = lambda at_s: ramp_m_s * max(0.0, at_s - 1.0) if at_s < 8.0 else 7.0 * ramp_m_s
    for _ in range(16):
        assert not watching.run(0.5).range_known, "the vehicle has not moved"
    found = watching.run(8.0, bobbing)
    assert not found.range_known or found.range_m == pytest.approx(thing[0], rel=0.4)


@pytest.mark.parametrize("thing", [PICTURE, PERSON], ids=["picture", "person"])
@pytest.mark.parametrize("drift_m_s", [-0.04, 0.04])
def test_a_climb_known_with_an_error_still_reveals_the_range(
    thing: tuple[float, float, float], drift_m_s: float
) -> None:
    watching = Watching(thing, z=2.1 if thing is PICTURE else 1.2)
    watching.strayed = lambda at_s: drift_m_s * at_s
    found = watching.run(12.0, bobbing)
    assert found.range_known
    assert found.range_m == pytest.approx(thing[0], rel=0.4)


def test_a_restarted_climb_does_not_reveal_the_range() -> None:
    """As after states stamped ahead."""
    watching = Watching(PICTURE)
    watching.strayed = lambda at_s: -4.0 * (at_s > 12.0)
    assert watching.run(12.0, bobbing).range_known
    assert not watching.run(1.0).range_known


def test_a_target_above_the_vehicle_does_not_stand_on_the_ground() -> None:
    watching = Watching((4.0, 2.2, 0.3), z=1.2)
    watching.run(PERIOD_S)
    assert isinstance(watching.estimator, RangeEstimator)
    assert watching.estimator.on_ground is False


def test_a_known_size_gives_the_range_and_whether_it_stands_on_the_ground() -> None:
    tall, flat = Traits(height_m=1.7, height_share=0.05), Traits(height_m=0.6, height_share=0.05)
    assert Watching(PERSON, z=1.2, estimator=estimator_of(None, tall)).run(PERIOD_S).range_known, "both agree"
    watching = Watching(PICTURE, estimator=estimator_of(None, flat))
    found = watching.run(2.0)
    assert found.range_known
    assert found.range_m == pytest.approx(PICTURE[0], rel=0.15)


def test_a_lost_target_is_found_again_where_it_can_be() -> None:
    watching = Watching(PICTURE)
    watching.run(8.0, bobbing)
    again = watching.estimator.again(nanoseconds(watching.at_s))
    watching.estimator, watching.at_s = again, watching.at_s + 3.0
    found = watching.run(1.0)
    assert isinstance(again, RangeEstimator)
    assert again.on_ground is False, "it does not stand there now"
    assert not found.range_known, "it may be another one, or someone moved it"
    assert found.range_m == pytest.approx(PICTURE[0], rel=0.5)


def test_a_target_seen_standing_on_the_ground_does_so_again() -> None:
    watching = Watching(PERSON, z=1.2, seed=2)
    watching.run(12.0, bobbing)
    assert isinstance(watching.estimator, RangeEstimator)
    assert watching.estimator.on_ground
    again = watching.estimator.again(nanoseconds(watching.at_s))
    watching.estimator, watching.at_s = again, watching.at_s + 3.0
    assert watching.run(PERIOD_S).range_known


def test_a_target_known_to_be_a_person_is_followed_at_once() -> None:
    for name, traits in (("person", TRAITS["person"]), (None, replace(UNKNOWN, on_ground=True))):
        estimator = estimator_of(name, traits)
        assert type(estimator) is TargetEstimator
        assert Watching(PERSON, z=1.2, estimator=estimator).run(PERIOD_S).range_known
    assert isinstance(estimator_of("clock", None), RangeEstimator), "many detectable things hang on walls"


def test_a_vehicle_that_does_not_know_its_height_keeps_the_apparent_size() -> None:
    view, camera = Watching(PICTURE).view(0.0)
    estimator = estimator_of(None, None, nominal_m=3.0)
    estimator.start(view, camera, 0, ground=False)
    found = estimator.at(0)
    assert found.range_known
    assert found.range_m == pytest.approx(3.0)
    assert found.range_deviation_m > 1.0


def test_a_box_in_another_direction_is_refused() -> None:
    watching = Watching(PERSON, z=1.2)
    watching.run(1.0)
    camera = camera_at()
    box = box_of(camera, np.array([5.0, 2.5, 0.0]))
    assert box is not None
    elsewhere = BoxView.of(box, camera)
    assert elsewhere is not None
    assert not watching.estimator.update(elsewhere, camera, nanoseconds(1.1))
    assert watching.estimator.refused == 1
    assert watching.estimator.distance(elsewhere, camera, nanoseconds(1.1))[0] > 20.0


def test_a_filter_not_started_raises() -> None:
    view, camera = Watching(PERSON).view(0.0)
    with pytest.raises(UsageError, match="no target yet"):
        estimator_of(None, None).at(0)
    with pytest.raises(UsageError, match="no target yet"):
        estimator_of(None, None).update(view, camera, 0)


# The law -----------------------------------------------------------------------------------------------------------


def test_it_turns_and_rises_a_little_until_the_range_is_known() -> None:
    world = ChaseWorld(walk(6.0, 1.5), traits=UNKNOWN, settings=ChaseSettings(distance_m=3.5))
    world.run(1.0)
    assert set(world.phases[1:]) == {TargetPhase.RANGING}
    world.run(19.0)
    ranging = [place for place, phase in zip(world.places, world.phases, strict=True) if phase is TargetPhase.RANGING]
    assert max(float(np.hypot(*place[:2])) for place in ranging) < 0.1, "it holds its position"
    assert max(float(place[2]) for place in ranging) < 1.2 + 0.45
    assert min(float(place[2]) for place in ranging) > 1.2 - 0.1
    assert world.phases[-1] is TargetPhase.FOLLOWING
    assert world.ranges[-1] == pytest.approx(3.5, abs=0.6)
    assert max(abs(one) for one in world.azimuths[-30:]) < 0.1


@pytest.mark.parametrize(
    ("given", "low_m", "high_m"),
    [({"highest_m": 1.3}, 0.8, 1.3), ({"parallax_m": None}, 1.15, 1.25)],
    ids=["below a ceiling", "not at all"],
)
def test_it_stays_within_its_heights(given: dict[str, float | None], low_m: float, high_m: float) -> None:
    world = ChaseWorld(walk(30.0, 0.0), traits=UNKNOWN, settings=ChaseSettings(**given))  # type: ignore[arg-type]
    world.run(6.0)
    heights = [float(place[2]) for place in world.places]
    assert low_m - 0.05 < min(heights)
    assert max(heights) < high_m + 0.05


# In the simulator --------------------------------------------------------------------------------------------------

ROOM = """
[room]
size = [8, 6, 3]
floor = "parquet"
walls = "plaster"
[[spawn]]
position = [0.3, 0, 0]
[[panel]]
name = "picture"
on = "east"
at = [0, 2.0]
size = [0.8, 0.6]
texture = "poster_landscape"
"""
LAWN = """
[room]
size = [30, 24, 10]
floor = "grass"
enclosed = false
[[spawn]]
position = [0, 0, 0]
[[target]]
name = "somebody"
kind = "figure"
shape = "person"
look = 4
path = { kind = "still", position = [6, -0.5, 0] }
"""


class Noted(FollowTarget):
    """Records its true position and its status at each frame."""

    def __init__(self, *args: Any, **values: Any) -> None:
        self.places: list[tuple[float, float]] = []
        self.said: list[tuple[str, float, float]] = []
        super().__init__(*args, **values)

    def look(self, frame: Frame) -> list[Shape]:
        drawn = super().look(frame)
        assert frame.feedback is not None
        native = frame.feedback.native
        assert native is not None
        x, y = (float(native[name]) for name in ("truth.x", "truth.y"))  # type: ignore[arg-type]
        status = self.status
        self.places.append((x, y))
        self.said.append((status.phase, status.range_m or 0.0, status.range_deviation_m or 0.0))
        return drawn


@pytest.mark.slow
def test_a_picture_on_a_wall_is_not_flown_into(tmp_path: File) -> None:
    """It flew to within 0.5 m of the wall."""
    file, distance_m = tmp_path / "room.toml", 2.0
    file.write_text(ROOM)
    with rehearse(f"sim://?world={file}&cameras=front&fps=10&seed=1&wind=0") as drone:
        drone.takeoff()
        drone.go_to(x=0.3, y=0.0, z=2.1)
        frame = next(iter(drone.frames()))
        assert frame.feedback is not None
        assert frame.intrinsics is not None
        body, size = np.array(frame.feedback.position_m), (frame.shape[1], frame.shape[0])
        camera = CameraPose.at(drone.capabilities.cameras[0], frame.feedback, body, frame.intrinsics, size)
        assert camera is not None
        corners = [camera.pixel(np.array([4.0, y, z])) for y, z in ((0.4, 2.3), (-0.4, 1.7))]
        (left, top), (right, bottom) = (corner for corner in corners if corner is not None)
        settings = ChaseSettings(distance_m=distance_m, nearest_m=1.0)
        pilot = Noted(drone, (left, top, right - left, bottom - top), settings=settings)
        pilot.run(seconds=20.0)
        drone.land()
    wall_m, phases = [4.0 - x for x, _ in pilot.places], [phase for phase, _, _ in pilot.said]
    known = phases.index(TargetPhase.FOLLOWING) if TargetPhase.FOLLOWING in phases else len(phases)
    assert TargetPhase.RANGING in phases[:known], "the phase says why it does not approach"
    assert min(wall_m[:known]) > 3.3, "it holds its position"
    for at_m, (_, range_m, deviation_m) in zip(wall_m, pilot.said, strict=True):
        assert at_m > distance_m - deviation_m
        assert range_m - 3.0 * deviation_m < at_m, "the reported range is honest"


@pytest.mark.slow
def test_a_person_on_the_ground_is_followed_by_a_box_alone(tmp_path: File) -> None:
    file = tmp_path / "lawn.toml"
    file.write_text(LAWN)
    detector = simulated_detector()
    with rehearse(f"sim://?world={file}&cameras=front&fps=10&seed=1&wind=0") as drone:
        drone.takeoff()
        box: Box | None = None
        for frame in drone.frames():
            people = [one for one in detector.detect(frame) if one.class_name == "person"]
            if people:
                box = people[0].box
                break
        pilot = Noted(drone, box, distance_m=3.5)
        pilot.run(seconds=20.0)
        drone.land()
    x, y = pilot.places[-1]
    assert pilot.said[-1][0] == TargetPhase.FOLLOWING
    assert math.hypot(6.0 - x, -0.5 - y) == pytest.approx(3.5, abs=0.7)
