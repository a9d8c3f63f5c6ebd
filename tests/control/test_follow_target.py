"""The behaviour around the following law: a rehearsed flight, its events and drawings, and refused arguments."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self

import pytest

from skyloop.client import Drone
from skyloop.client.frame import Frame
from skyloop.clock import nanoseconds
from skyloop.control import ChaseSettings, FollowTarget
from skyloop.control.chase_law import FollowMode, TargetPhase
from skyloop.control.target_estimate import Traits
from skyloop.control.target_follower import TargetFollower, detections_of
from skyloop.errors import UnknownNameError, UsageError
from skyloop.messages import (
    Attitude,
    CameraInfo,
    Capabilities,
    EventKind,
    Points,
    Polyline,
    Severity,
    Text,
    Velocity,
)
from skyloop.sim.camera import FRONT_CAMERA
from skyloop.stepping.rehearsal import rehearse
from skyloop.vision import simulated_detector
from skyloop.vision.object_tracks import Detection
from skyloop.vision.tracking import Box
from tests.support.shown_target import flown, follower_of, picture, state, the_box
from tests.support.target_world import PERIOD_S

WORLD = """
[room]
size = [30, 24, 10]
floor = "grass"
enclosed = false
[[spawn]]
position = [0, 0, 0]
[[target]]
name = "walker"
kind = "figure"
shape = "person"
look = 4
path = { kind = "waypoints", points = [[5, -2, 0], [5, 9, 0], [5.5, 9, 0], [5.5, -2, 0]], speed = 0.9 }
"""


@contextmanager
def yard(folder: Path, options: str = "") -> Iterator[Drone]:
    file = folder / "world.toml"
    file.write_text(WORLD)
    with rehearse(f"sim://?world={file}&cameras=front&fps=10&seed=1&wind=0{options}") as drone:
        drone.takeoff()
        yield drone


def truth(frame: Frame) -> tuple[float, float]:
    """Return distance and bearing from the vehicle to the walker on the first leg."""
    assert frame.feedback is not None
    native = frame.feedback.native
    assert native is not None
    x, y, yaw, at_s = (float(native[name]) for name in ("truth.x", "truth.y", "truth.yaw", "sim.time_s"))  # type: ignore[arg-type]
    dx, dy = 5.0 - x, -2.0 + 0.9 * at_s - y
    return math.hypot(dx, dy), math.atan2(dy, dx) - yaw


class Watched(FollowTarget):
    """Records the truth and the drawings of each frame."""

    def __init__(self, *args: Any, **values: Any) -> None:
        self.seen: list[tuple[float, float]] = []
        self.drawn: list[Any] = []
        super().__init__(*args, **values)

    def look(self, frame: Frame) -> list[Any]:
        self.drawn = super().look(frame)
        self.seen.append(truth(frame))
        return self.drawn


@pytest.mark.slow
def test_a_person_is_followed_from_a_box(tmp_path: Path) -> None:
    detector = simulated_detector()
    with yard(tmp_path) as drone:
        pick: Box | None = None
        for frame in drone.frames():
            people = [one for one in detector.detect(frame) if one.class_name == "person" and one.box[3] > 30]
            if people:
                pick = people[0].box
                break
        assert pick is not None
        pilot = Watched(drone, pick, detector=detector, distance_m=3.5)
        assert pilot.status.range_m is None
        pilot.run(seconds=6.0)
        assert pilot.phase is TargetPhase.FOLLOWING
        status = pilot.status
    assert status.class_name == "person"
    distance_m, bearing_rad = pilot.seen[-1]
    assert distance_m == pytest.approx(3.5, abs=0.6)
    assert all(abs(bearing) < 0.5 for _, bearing in pilot.seen), "it stays in view"
    assert status.range_m == pytest.approx(distance_m, abs=0.6)
    assert status.bearing_rad == pytest.approx(bearing_rad, abs=0.15)
    assert status.speed_m_s == pytest.approx(0.9, abs=0.5)
    assert status.box is not None
    assert status.predicted_px is not None
    assert status.box[0] < status.predicted_px[0] < status.box[0] + status.box[2]
    assert (status.lost_s, status.problem) == (0.0, "")
    texts = [one.text for one in pilot.drawn if isinstance(one, Text)]
    assert len(texts) == 1
    assert texts[0].startswith("person ")
    assert "following" in texts[0]
    assert any(isinstance(one, Polyline) and one.closed for one in pilot.drawn)
    assert any(isinstance(one, Polyline) and not one.closed for one in pilot.drawn), "its track"


def test_invalid_arguments_are_refused() -> None:
    detector = simulated_detector()
    box = (100.0, 50.0, 40.0, 90.0)
    bad: list[tuple[dict[str, Any], str]] = [
        ({"class_name": "person"}, "needs a detector"),
        ({"box": box, "mode": "chase"}, "mode is 'chase' and must be one of follow, orbit, look"),
        ({"box": box, "mode": None}, "mode is None"),
        ({"box": box, "detector": 7}, "detector is 7 and must have a detect"),
        ({"box": (math.nan, 1, 20, 20)}, "must consist of finite numbers"),
        ({"box": (1, 2, 3)}, "must be x, y, width and height"),
        ({"box": "here"}, "must be x, y, width and height"),
        ({"box": 4}, "must be x, y, width and height"),
        ({"box": box, "distance_m": 1.0}, "distance_m is 1 and must be above nearest_m"),
        ({"box": box, "distance_m": math.nan}, "distance_m is nan"),
        ({"box": box, "bearing_rad": math.inf}, "bearing_rad is inf"),
        ({"box": box, "height_m": -1.0}, "height_m is -1.0"),
        ({"box": box, "camera": "bottom"}, "does not face forward"),
    ]
    with rehearse("sim://?world=empty&cameras=front,bottom") as drone:
        for given, why in bad:
            with pytest.raises(UsageError, match=why):
                FollowTarget(drone, **given)
        with pytest.raises(UnknownNameError, match="rear"):
            FollowTarget(drone, box, camera="rear")
        named = FollowTarget(drone, class_name="person", detector="detect", height_m=1.6)
        assert named.processors == ("detect",)
        assert FollowTarget(drone, box, detector=detector).processors == ()


def test_a_target_is_needed() -> None:
    with rehearse("sim://?world=empty&cameras=front") as drone, pytest.raises(UsageError, match="needs a box"):
        FollowTarget(drone)


@pytest.mark.parametrize(
    "value",
    [
        None,
        7,
        [],
        "detections",
        {},
        {"detections": None},
        {"detections": 5},
        {"detections": "abc"},
        {"detections": [None, 4, "x", [], {}]},
        {"detections": [{"box": [1, 2, 3], "score": 0.5, "class_id": 0, "class_name": "person"}]},
        {"detections": [{"box": [1, 2, 3, "x"], "score": 0.5, "class_id": 0, "class_name": "person"}]},
        {"detections": [{"box": [1, 2, 3, math.nan], "score": 0.5, "class_id": 0, "class_name": "person"}]},
        {"detections": [{"box": [1, 2, 0, 4], "score": 0.5, "class_id": 0, "class_name": "person"}]},
        {"detections": [{"box": [1, 2, 3, -4], "score": 0.5, "class_id": 0, "class_name": "person"}]},
        {"detections": [{"box": [1, 2, 3, 4], "score": math.inf, "class_id": 0, "class_name": "person"}]},
        {"detections": [{"box": [1, 2, 3, 4], "score": 0.5, "class_id": math.inf, "class_name": "person"}]},
        {"detections": [{"box": None, "score": 0.5, "class_id": 0, "class_name": "person"}]},
    ],
)
def test_malformed_detections_are_skipped(value: Any) -> None:
    assert detections_of(value) == []


def test_detections_of_a_processor_are_used() -> None:
    one = {"box": [1, 2.5, 3, 4], "score": 0.5, "class_id": 1, "class_name": "car"}
    assert detections_of({"detections": [one, {"box": 3}]}) == [Detection((1.0, 2.5, 3.0, 4.0), 0.5, 1, "car")]


# Without a drone ---------------------------------------------------------------------------------------------------


def test_a_vehicle_without_velocity_is_flown_by_attitude() -> None:
    follower = follower_of(settings=ChaseSettings(distance_m=3.0, nearest_m=1.0), traits=Traits(height_m=1.72))
    command, drawn = flown(follower, 1.5, velocity_m_s=None)
    assert isinstance(command, Attitude)
    assert command.pitch > 0.01, "forward, because it is a metre too far away"
    assert command.yaw_rate < -0.05, "to the right"
    assert follower.status.speed_m_s is None
    assert follower.status.range_m == pytest.approx(4.0 - 0.12, abs=0.5)
    assert not any(isinstance(one, Polyline) and not one.closed for one in drawn), "it would drift with the vehicle"
    assert follower.step(nanoseconds(9.0)) == Attitude(), "the vehicle's motion is no longer known"


def test_the_vehicle_is_held_while_nothing_is_known() -> None:
    follower = follower_of()
    assert follower.step(nanoseconds(1.0)) == Velocity()
    assert follower.finder is None
    for frame in (picture(1.0), picture(1.0, known=False)):
        shapes = follower.look(frame)
        assert [one.text for one in shapes if isinstance(one, Text)] == ["the vehicle's attitude is not known yet"]
    follower.feedback(state(1.0))
    shapes = follower.look(picture(1.0, roll_rad=None))
    assert [one.text for one in shapes if isinstance(one, Text)] == ["the vehicle's attitude is not known yet"]
    status = follower.status
    assert (status.range_m, status.box, status.lost_s, status.problem) == (None, None, 0.0, "")
    assert status.phase == TargetPhase.LOOKING.value
    assert not follower.over
    flown(follower, 1.0)
    assert follower.step(nanoseconds(9.0)) == Velocity(), "the vehicle's motion is no longer known"


@pytest.mark.parametrize("mode", [FollowMode.FOLLOW, FollowMode.LOOK])
def test_a_velocity_that_goes_missing_holds_the_vehicle_and_keeps_the_target(mode: FollowMode) -> None:
    """It kept its last velocity for good and turned away from the target."""
    follower = follower_of(mode=mode)
    flown(follower, 1.5, velocity_m_s=(0.5, 0.0, 0.0))
    assert follower.sighting.box is not None
    command, _ = flown(follower, 1.0, start=2.5, velocity_m_s=None)
    assert command == Velocity()
    assert follower.status.problem == "the vehicle's velocity is not known"
    assert follower.sighting.box is not None
    command, _ = flown(follower, 0.5, start=3.5)
    assert command != Velocity(), "it continues"
    assert follower.status.problem == ""


def test_it_reports_how_long_the_target_is_lost_and_its_expected_place() -> None:
    follower = follower_of()
    flown(follower, 1.5)
    assert follower.sighting.box is not None
    assert follower.finder is not None
    _, drawn = flown(follower, 1.2, start=2.5, shown=False)
    assert follower.phase is TargetPhase.PREDICTING
    status = follower.status
    assert status.box is None
    assert status.lost_s == pytest.approx(1.2, abs=0.15)
    assert any(isinstance(one, Polyline) and one.closed for one in drawn), "its expected place"
    assert any(isinstance(one, Points) for one in drawn)


class Recorder:
    """Stands in for the drone and records calls."""

    def __init__(self) -> None:
        self.capabilities = Capabilities("sim", frozenset({"velocity"}), (FRONT_CAMERA.info(),))
        self.config = {"limits.speed": 2.0, "limits.tilt": 0.3, "autopilot.kind": "sim"}
        self.authority = SimpleNamespace(state="held")
        self.velocities: list[dict[str, float]] = []
        self.attitudes: list[Attitude] = []
        self.hovers = 0
        self.drawn: list[Any] = []
        self.told: list[tuple[str, Severity]] = []

    def velocity(self, **values: float) -> None:
        self.velocities.append(values)

    def command(self, attitude: Attitude) -> None:
        self.attitudes.append(attitude)

    @property
    def _piloting(self) -> Self:
        return self

    def let_go(self, reason: str, *, land: bool) -> None:
        assert reason
        self.hovers += 1

    def emit(self, kind: EventKind, text: str, severity: Severity) -> None:
        self.told.append((text, severity))

    def annotate(self, frame: Frame, shapes: list[Any], source: str) -> None:
        self.drawn = shapes


def given(pilot: FollowTarget, seconds: float, *, start: float = 1.0, shown: bool = True, **values: Any) -> None:
    for n in range(round(seconds / PERIOD_S)):
        pilot.on_feedback(state(start + n * PERIOD_S, **values))
        pilot.on_frame(picture(start + n * PERIOD_S, shown=shown, **values))


@pytest.fixture
def _no_age(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Frame, "age_s", 0.0)


@pytest.mark.usefixtures("_no_age")
def test_the_behaviour_flies_reports_and_ends_after_the_loss() -> None:
    drone = Recorder()
    settings = ChaseSettings(distance_m=3.0, give_up_s=1.5, predict_s=0.4, hover_s=0.3)
    pilot = FollowTarget(drone, the_box(), height_m=1.72, settings=settings)  # type: ignore[arg-type]
    given(pilot, 1.0)
    assert pilot.phase is TargetPhase.FOLLOWING
    assert drone.velocities[-1]["forward"] > 0.2
    assert drone.velocities[-1]["yaw_rate"] < -0.05
    assert pilot.status.range_m == pytest.approx(4.0 - 0.12, abs=0.5)
    assert drone.drawn
    given(pilot, 2.5, start=2.0, shown=False)
    assert pilot.done
    assert drone.hovers == 1
    assert drone.told == [
        ("follow target: following", Severity.INFO),
        ("follow target: hidden: following its predicted motion", Severity.WARNING),
        ("follow target: lost: hovering where it went out of sight", Severity.WARNING),
        ("follow target: lost: looking around", Severity.WARNING),
        ("follow target: lost for too long: given up", Severity.WARNING),
        ("follow target: gave up: the target was lost for too long", Severity.INFO),
    ]


@pytest.mark.usefixtures("_no_age")
def test_the_behaviour_sends_attitudes_without_a_velocity() -> None:
    drone = Recorder()
    pilot = FollowTarget(drone, the_box(), mode="look")  # type: ignore[arg-type]
    given(pilot, 0.5, velocity_m_s=None)
    assert not drone.velocities
    assert drone.attitudes[-1].yaw_rate < -0.05
    assert pilot.phase is TargetPhase.WATCHING


@pytest.mark.usefixtures("_no_age")
def test_frames_that_stop_after_one_stamped_ahead_are_noticed() -> None:
    pilot = FollowTarget(Recorder(), the_box(), mode="look")  # type: ignore[arg-type]
    given(pilot, 0.5)
    assert not pilot.blind
    pilot.on_frame(picture(10.0))
    pilot.on_feedback(state(2.2))
    assert pilot.blind, "otherwise it flies blind for eight seconds"


@pytest.mark.usefixtures("_no_age")
@pytest.mark.parametrize(("camera", "phase"), [("front", TargetPhase.FOLLOWING), ("bottom", TargetPhase.LOOKING)])
def test_the_behaviour_uses_the_results_of_a_processor(camera: str, phase: TargetPhase) -> None:
    """Only results of the same camera count: a box in another camera's frame is elsewhere."""
    drone = Recorder()
    pilot = FollowTarget(drone, class_name="person", detector="detect")  # type: ignore[arg-type]
    one = {"box": list(the_box()), "score": 0.9, "class_id": 0, "class_name": "person"}
    for n in range(6):
        at_s = 1.0 + n * PERIOD_S
        given(pilot, PERIOD_S, start=at_s)
        value: Any = {"detections": [one]}
        pilot.on_result(SimpleNamespace(camera=camera, value=value, captured_ns=nanoseconds(at_s)))  # type: ignore[arg-type]
    given(pilot, 0.2, start=1.4)
    assert pilot.phase is phase
    assert pilot.status.class_name == "person"


def test_mode_and_settings_can_change_in_flight() -> None:
    follower = follower_of(class_name="person")
    flown(follower, 0.5)
    follower.mode = FollowMode("orbit")
    follower.settings = ChaseSettings(distance_m=3.0)
    assert follower.mode is FollowMode.ORBIT
    assert follower.settings.distance_m == 3.0
    command, _ = flown(follower, 0.5, start=1.5)
    assert follower.phase is TargetPhase.ORBITING
    assert isinstance(command, Velocity)
    assert command.left < -0.1, "counter-clockwise: it goes to the right"


def test_late_detections_are_used() -> None:
    follower = follower_of(box=None, class_name="person", detects=True)
    follower.detected([], nanoseconds(1.0))
    assert follower.finder is None
    for n in range(8):
        at_s = 1.0 + n * PERIOD_S
        follower.feedback(state(at_s))
        drawn = follower.look(picture(at_s))
        follower.detected([Detection(the_box(), 0.9, 0, "person")], nanoseconds(at_s))
    assert [one.text for one in drawn if isinstance(one, Text)] != []
    assert sum(isinstance(one, Polyline) and one.closed for one in drawn) == 1, "the processor draws its own"
    assert follower.status.class_name == "person"
    assert follower.finder is not None
    assert follower.finder.target is not None
    assert follower.status.range_m == pytest.approx(4.0 - 0.12, abs=0.5)


def test_a_target_in_late_detections_only_is_followed() -> None:
    follower = follower_of(box=None, class_name="person", detects=True)
    for n in range(12):
        at_s = 1.0 + n * PERIOD_S
        follower.feedback(state(at_s))
        follower.look(picture(at_s))
        follower.detected([Detection((158.0, 112.0, 4.0, 14.0), 0.9, 0, "person")], nanoseconds(at_s))
        follower.step(nanoseconds(at_s))
    assert follower.status.box is None, "too small for the tracker"
    assert follower.phase is TargetPhase.FOLLOWING
    at_s += 1.0
    follower.feedback(state(at_s))
    follower.look(picture(at_s))
    follower.detected([], nanoseconds(at_s))
    follower.step(nanoseconds(at_s))
    assert follower.phase is not TargetPhase.FOLLOWING


def test_other_things_are_drawn_and_a_contested_target_is_reported() -> None:
    class Both:
        def detect(self, image: Any) -> list[Detection]:
            return [Detection(the_box(), 0.9, 0, "person"), Detection((20.0, 60.0, 30.0, 90.0), 0.8, 0, "person")]

    follower = follower_of(detector=Both())
    _, drawn = flown(follower, 0.6)
    assert sum(isinstance(one, Polyline) and one.closed for one in drawn) == 2
    assert follower.finder is not None
    assert follower.status.problem == ""
    target = follower.finder.target
    assert target is not None


def test_the_end_of_the_leash_is_a_problem() -> None:
    follower = follower_of(settings=ChaseSettings(distance_m=3.0, leash_m=0.5))
    for n in range(30):
        at_s = 1.0 + n * PERIOD_S
        follower.feedback(state(at_s, velocity_m_s=(0.4, 0.0, 0.0)))
        follower.step(nanoseconds(at_s))
        if n == 0:
            follower.look(picture(at_s))
        else:
            follower._seen_ns = nanoseconds(at_s)
    assert follower.status.problem == "at the end of the leash"


def test_with_only_a_box_it_turns_and_reports_an_unknown_range() -> None:
    follower = follower_of(settings=ChaseSettings(distance_m=3.0))
    command, drawn = flown(follower, 1.0)
    assert follower.phase is TargetPhase.RANGING
    assert isinstance(command, Velocity)
    assert command.yaw_rate < -0.05, "to the right"
    assert (command.forward, command.left) == pytest.approx((0.0, 0.0), abs=0.02)
    assert command.up > 0.1, "to see it from another height"
    status = follower.status
    assert status.phase == "range not yet known: turns only"
    assert status.range_deviation_m is not None
    assert status.range_deviation_m > 0.3 * (status.range_m or 0.0)
    assert any(status.phase in one.text for one in drawn if isinstance(one, Text))


def test_a_frame_stamped_ahead_is_not_flown_by() -> None:
    """It counted as fresh for eight seconds, and the vehicle flew to the target's old place."""
    follower = follower_of(class_name="person", settings=ChaseSettings(distance_m=2.5))
    flown(follower, 1.0)
    follower.look(picture(10.0))
    flown(follower, 3.5, start=2.0, shown=False)
    assert follower.phase is TargetPhase.HOVERING


def test_sightings_before_a_clock_correction_are_not_flown_by() -> None:
    follower = follower_of(class_name="person", settings=ChaseSettings(distance_m=2.5))
    flown(follower, 1.0, start=10.0)
    flown(follower, 2.5, start=2.0, shown=False)
    assert follower.phase is TargetPhase.LOOKING


def test_a_camera_without_intrinsics_is_refused() -> None:
    follower = follower_of()
    follower.feedback(state(1.0))
    with pytest.raises(UsageError, match="'front' has no intrinsics: calibrate it"):
        follower.look(picture(1.0, intrinsics=None))


def test_a_camera_must_look_forward_with_a_known_mounting() -> None:
    with pytest.raises(UsageError, match="mounted"):
        TargetFollower(CameraInfo("front", 320, 240, 15.0), box=the_box())
    down = (0.0, -1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, -1.0)
    with pytest.raises(UsageError, match="'bottom' does not face forward"):
        TargetFollower(CameraInfo("bottom", 320, 240, 15.0, rotation=down), box=the_box())
