"""The controller around the law: frames in; commands, drawings and counts out. No simulator, no process."""

from __future__ import annotations

import time

import msgspec
import pytest

from skyloop.client.frame import Frame
from skyloop.control.follow import FollowMarker, FollowPhase, FollowScore
from skyloop.errors import UnknownNameError
from skyloop.messages import (
    Polyline,
    Severity,
    Text,
)
from tests.control.recorder import Recorder, frame, state


@pytest.fixture
def drone() -> Recorder:
    return Recorder()


@pytest.fixture
def follower(drone: Recorder) -> FollowMarker:
    return FollowMarker(drone, 7)  # type: ignore[arg-type]


def test_goes_to_its_own_marker_and_draws_it(follower: FollowMarker, drone: Recorder) -> None:
    now = time.monotonic_ns()
    follower.on_feedback(state(now))
    follower.on_frame(frame(now, [(7, [0.3, 0.0, 2.5]), (3, [-0.5, 0.0, 2.0])]))
    assert follower.mode is FollowPhase.FOLLOWING
    assert drone.velocities[-1]["forward"] > 0.2
    assert drone.velocities[-1]["yaw_rate"] < -0.05, "the marker is to the right"
    texts = [shape.text for shape in drone.drawn[-1] if isinstance(shape, Text)]
    assert texts == ["marker 7  2.52 m"]
    assert sum(isinstance(shape, Polyline) and shape.closed for shape in drone.drawn[-1]) == 2
    assert follower.score.range_errors_m() == [pytest.approx(1.018, abs=0.05)]


def test_searches_for_its_own_marker_only(follower: FollowMarker, drone: Recorder) -> None:
    now = time.monotonic_ns()
    follower.on_feedback(state(now))
    follower.on_frame(frame(now, [(3, [0.0, 0.0, 2.0])]))
    assert follower.mode is FollowPhase.SEARCHING
    assert drone.velocities[-1]["yaw_rate"] == pytest.approx(0.7)
    assert drone.velocities[-1]["forward"] == 0.0
    assert follower.score.share_in_view is None
    assert follower.score.frames_before == 1
    assert any(isinstance(s, Text) and s.text == "searching marker 7" for s in drone.drawn[-1])


def test_a_frame_without_state_is_searched_but_not_flown_by(follower: FollowMarker, drone: Recorder) -> None:
    now = time.monotonic_ns()
    follower.on_feedback(state(now))
    follower.on_frame(frame(now, [(7, [0.0, 0.0, 2.5])], known=False))
    assert drone.velocities[-1]["forward"] == 0.0
    assert follower.score.share_in_view == 1.0


def test_holds_its_position_when_frames_stop(follower: FollowMarker, drone: Recorder) -> None:
    now = time.monotonic_ns()
    follower.on_feedback(state(now))
    follower.on_frame(frame(now, [(7, [0.0, 0.0, 2.5])]))
    follower.on_feedback(state(now + 300_000_000))
    assert drone.hovers == 0
    follower.on_feedback(state(now + 600_000_000))
    assert drone.hovers == 1


def test_holds_its_position_and_reports_an_unknown_velocity(
    follower: FollowMarker, drone: Recorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Frame, "age_s", 0.0)
    now = time.monotonic_ns()
    follower.on_feedback(state(now))
    follower.on_frame(frame(now, [(7, [0.3, 0.0, 2.5])]))
    flown = len(drone.velocities)
    for ms in (300, 600, 900):
        later = now + ms * 1_000_000
        follower.on_feedback(msgspec.structs.replace(state(later), velocity_m_s=None))
        follower.on_frame(frame(later, [(7, [0.3, 0.0, 2.5])]))
    assert drone.hovers == 2
    assert len(drone.velocities) == flown + 1
    assert follower.problem == "the vehicle's velocity is not known"
    follower.on_feedback(state(now + 1_000_000_000))
    follower.on_frame(frame(now + 1_000_000_000, [(7, [0.3, 0.0, 2.5])]))
    assert drone.told[-2:] == [
        ("follow: the vehicle's velocity is not known: hovering", Severity.WARNING),
        ("follow: the vehicle's motion is known again: continuing", Severity.INFO),
    ]


def test_set_points_restart_from_rest_after_another_client_flew(
    follower: FollowMarker, drone: Recorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Frame, "age_s", 0.0)
    now = time.monotonic_ns()
    for k in range(31):
        at_ns = now + k * 100_000_000
        drone.authority.state = "lost" if k in range(10, 30) else "held"
        follower.on_feedback(state(at_ns))
        follower.on_frame(frame(at_ns, [(7, [0.3, 0.0, 4.5])]))
    assert drone.velocities[9]["forward"] > 0.5
    assert all(sent["forward"] == 0.0 for sent in drone.velocities[10:30])
    assert 0.0 < drone.velocities[30]["forward"] <= 0.2 + 1e-9, "0.1 s of acceleration"


def test_unknown_camera(drone: Recorder) -> None:
    with pytest.raises(UnknownNameError, match="front"):
        FollowMarker(drone, 7, camera="frnt")  # type: ignore[arg-type]


def test_score_counts_from_the_first_sighting() -> None:
    score = FollowScore()
    for at_s, error in enumerate([None, None, 0.9, 0.2, None, -0.1]):
        score.count(at_s * 10**9, error)
    assert (score.frames_before, score.frames, score.in_view) == (2, 4, 3)
    assert score.share_in_view == pytest.approx(0.75)
    assert score.range_errors_m() == [0.9, 0.2, -0.1]
    assert score.range_errors_m(after_s=1.0) == [0.2, -0.1]
