"""The follower's law in a small world with lag, delay and noise; and its parts alone."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.clock import NS_PER_S, nanoseconds
from skyloop.control.airframe import Airframe
from skyloop.control.follow import FollowLaw, FollowPhase, FollowSettings, TargetFilter
from skyloop.messages import Feedback
from tests.control.follow_world import FollowWorld


def still(at_s: float, **values: object) -> Feedback:
    known: dict[str, object] = {
        "roll_rad": 0.0,
        "pitch_rad": 0.0,
        "yaw_rad": 0.0,
        "altitude_m": 1.0,
        "velocity_m_s": (0.0, 0.0, 0.0),
    }
    return Feedback(captured_ns=nanoseconds(at_s), **(known | values))  # type: ignore[arg-type]


def law_that_sees(position: list[float], normal: list[float], **values: object) -> FollowLaw:
    law = FollowLaw()
    feedback = still(1.0, **values)
    law.feedback(feedback)
    law.see(np.array(position), np.array(normal), feedback, feedback.captured_ns)
    return law


@pytest.mark.parametrize("fps", [15.0, 30.0])
@pytest.mark.parametrize("seed", range(5))
def test_moving_board_is_found_and_kept(seed: int, fps: float) -> None:
    world = FollowWorld(seed, fps=fps)
    world.run(25.0)
    assert world.first_seen_ns is not None
    assert world.seen / world.frames > 0.9
    errors = np.array(world.range_errors)
    assert np.sqrt(np.mean(errors**2)) < 0.25
    assert np.abs(errors).max() < 0.8


def test_fast_board_is_kept() -> None:
    world = FollowWorld(3, speed=0.75)
    world.run(25.0)
    assert world.seen / world.frames > 0.9


def test_loss_is_followed_by_search_and_recovery() -> None:
    world = FollowWorld(1)
    world.run(12.0)
    modes = [world.law.mode]
    world.board.hidden = True
    world.run(1.0)
    modes.append(world.law.mode)
    stopped = world.position.copy()
    world.run(4.0)
    modes.append(world.law.mode)
    assert np.linalg.norm(world.position - stopped) < 1.2, "it must not fly blind"
    world.board.hidden = False
    world.run(12.0)
    modes.append(world.law.mode)
    assert modes == [FollowPhase.FOLLOWING, FollowPhase.RECOVERING, FollowPhase.SEARCHING, FollowPhase.FOLLOWING]


@pytest.mark.parametrize(
    ("position", "axis", "sign"),
    [
        ([2.5, 0.0, 0.0], "forward", 1),
        ([0.8, 0.0, 0.0], "forward", -1),
        ([1.5, 0.0, 0.5], "up", 1),
        ([1.5, 0.0, -0.5], "up", -1),
        ([1.4, 0.5, 0.0], "yaw_rate", 1),
        ([1.4, -0.5, 0.0], "yaw_rate", -1),
    ],
)
def test_directions(position: list[float], axis: str, sign: int) -> None:
    law = law_that_sees(position, [-1.0, 0.0, 0.0])
    wanted = law.step(nanoseconds(1.05))
    assert getattr(wanted, axis) * sign > 0.1


def test_a_marker_at_the_goal_needs_no_motion() -> None:
    wanted = law_that_sees([1.5, 0.0, 0.0], [-1.0, 0.0, 0.0]).step(nanoseconds(1.05))
    assert max(map(abs, (wanted.forward, wanted.left, wanted.up, wanted.yaw_rate))) < 0.02


@pytest.mark.parametrize("side", [1, -1])
def test_moves_around_to_the_face(side: int) -> None:
    # The face points to the vehicle's left (side 1): the vehicle must go left to be in front of it.
    normal = [-math.cos(1.0), side * math.sin(1.0), 0.0]
    assert law_that_sees([1.5, 0.0, 0.0], normal).step(nanoseconds(1.05)).left * side > 0.2


def test_tilt_is_compensated() -> None:
    # Nose down by 0.2 rad (positive pitch): a marker at the vehicle's own height is seen above the body's axis.
    law = law_that_sees([1.5 * math.cos(0.2), 0.0, 1.5 * math.sin(0.2)], [-1.0, 0.0, 0.0], pitch_rad=0.2)
    assert abs(law.step(nanoseconds(1.05)).up) < 0.02


def test_own_motion_since_the_capture_counts() -> None:
    law = law_that_sees([2.0, 0.0, 0.0], [-1.0, 0.0, 0.0])
    for k in range(1, 6):  # flew 0.5 m nearer since
        law.feedback(still(1.0 + 0.06 * k, velocity_m_s=(1.85, 0.0, 0.0)))
    assert law.step(nanoseconds(1.3)).forward < 0.1


def test_without_known_motion_the_set_point_is_zero() -> None:
    law = FollowLaw()
    law.feedback(Feedback(captured_ns=NS_PER_S))
    law.see(np.array([3.0, 0, 0]), np.array([-1.0, 0, 0]), Feedback(captured_ns=NS_PER_S), NS_PER_S)
    wanted = law.step(NS_PER_S)
    assert (wanted.forward, wanted.left, wanted.up, wanted.yaw_rate) == (0.0, 0.0, 0.0, 0.0)


def test_search_turns_and_goes_to_other_heights() -> None:
    law = FollowLaw(FollowSettings(search_heights_m=(0.0, 0.5)))
    yaw, altitude, heights = 0.0, 1.0, []
    for k in range(1200):
        now = 1.0 + 0.02 * k
        law.feedback(still(now, yaw_rad=yaw, altitude_m=altitude))
        wanted = law.step(nanoseconds(now))
        assert wanted.forward == wanted.left == 0.0
        yaw, altitude = math.remainder(yaw + wanted.yaw_rate * 0.02, 2 * math.pi), altitude + wanted.up * 0.02
        heights.append(altitude)
    assert law.mode is FollowPhase.SEARCHING
    assert heights[300] == pytest.approx(1.0, abs=0.02)
    assert max(heights) == pytest.approx(1.5, abs=0.05)


@given(
    position=st.lists(st.floats(-20, 20), min_size=3, max_size=3),
    normal=st.lists(st.floats(-1, 1), min_size=3, max_size=3),
    angles=st.lists(st.floats(-3.2, 3.2), min_size=3, max_size=3),
    altitude=st.one_of(st.none(), st.floats(-1, 10)),
    wait_s=st.floats(0, 5),
)
def test_any_sighting_gives_a_finite_set_point_within_limits(
    position: list[float], normal: list[float], angles: list[float], altitude: float | None, wait_s: float
) -> None:
    roll, pitch, yaw = angles
    law = law_that_sees(position, normal, roll_rad=roll, pitch_rad=pitch, yaw_rad=yaw, altitude_m=altitude)
    limits = law.settings
    wanted = law.step(nanoseconds(1.0 + wait_s))
    assert wanted.finite
    assert math.hypot(wanted.forward, wanted.left) <= limits.speed_m_s + 1e-9
    assert abs(wanted.up) <= limits.climb_m_s
    assert abs(wanted.yaw_rate) <= limits.turn_rad_s


def test_odometry_places_a_capture_between_samples() -> None:
    odometry = Airframe()
    for k in range(11):
        odometry.add(still(1.0 + 0.1 * k, yaw_rad=math.pi / 2, velocity_m_s=(0.5, 0.0, 0.1)))
    motion = odometry.at(nanoseconds(1.55))
    assert motion is not None
    assert motion.position == pytest.approx([0.0, 0.275, 0.055])
    assert Airframe().at(0) is None


def test_odometry_skips_old_and_incomplete_samples() -> None:
    odometry = Airframe()
    odometry.add(still(1.0, velocity_m_s=(1.0, 0.0, 0.0)))
    odometry.add(still(0.9, velocity_m_s=(9.0, 0.0, 0.0)))
    odometry.add(still(1.1, velocity_m_s=None))
    motion = odometry.at(nanoseconds(1.0))
    assert motion is not None
    assert motion.velocity == pytest.approx([1.0, 0.0, 0.0])


def test_filter_learns_a_steady_velocity() -> None:
    rng = np.random.default_rng(2)
    target = TargetFilter()
    for k in range(60):
        t = k / 15
        target.see(np.array([0.5 * t, 1.0, 0.0]) + rng.normal(0, 0.02, 3), 0.03, nanoseconds(t))
    place, velocity = target.at(nanoseconds(4.2))
    assert velocity == pytest.approx([0.5, 0.0, 0.0], abs=0.1)
    assert place == pytest.approx([2.1, 1.0, 0.0], abs=0.06)


def test_filter_restarts_after_a_jump() -> None:
    target = TargetFilter()
    target.see(np.zeros(3), 0.03, 0)
    target.see(np.array([5.0, 0.0, 0.0]), 0.03, nanoseconds(0.1))
    place, velocity = target.at(nanoseconds(0.1))
    assert place == pytest.approx([5.0, 0.0, 0.0])
    assert velocity == pytest.approx([0.0, 0.0, 0.0])
    with pytest.raises(ValueError, match="never seen"):
        TargetFilter().at(0)
