from __future__ import annotations

import math

import numpy as np
import pytest

from skyloop.errors import UsageError
from skyloop.sim.targets import TargetTrack, top_speed
from skyloop.sim.world import (
    AlongYaw,
    BoardTarget,
    CirclePath,
    FixedYaw,
    LissajousPath,
    MarkerPattern,
    OvalPath,
    Path,
    RingWalkPath,
    TowardsYaw,
    WalkPath,
    WaypointPath,
    Yaw,
)

PATTERN = MarkerPattern("DICT_4X4_50", 1, 0.3, 0.05)
PATHS: list[Path] = [
    WaypointPath(((0, 0, 1), (2, 0, 1), (2, 1, 1.5)), 0.7),
    WaypointPath(((0, 0, 1), (2, 0, 1), (2, 1, 1.5)), 0.7, closed=False),
    CirclePath((0, 0, 1), 1.5, 0.6, 0.3, clockwise=True),
    LissajousPath((0, 0, 1), (1, 2, 0.3), (1, 2, 3), (0, 0.5, 0), 30.0),
    WalkPath((-1, -2, 0.5), (1, 2, 1.5), (0.3, 0.8)),
    RingWalkPath((0.5, 0.2), (1.8, 2.2), (1.2, 1.6), (0.3, 0.5)),
    OvalPath((0, 0, 0.2), 2.0, 0.8, 0.9, start_m=1.5),
    OvalPath((0, 0, 0.2), 2.0, 0.8, 0.9, clockwise=True),
]


def track(path: Path, yaw: Yaw = FixedYaw(0.0), seed: int = 1) -> TargetTrack:  # noqa: B008
    return TargetTrack(BoardTarget("board", PATTERN, path, yaw), seed, 0)


@pytest.mark.parametrize("path", PATHS)
def test_motion_is_continuous_and_within_its_speed(path: Path) -> None:
    moving = track(path)
    points = np.array([moving.at(0.01 * k).position_m for k in range(5000)])
    speeds = np.linalg.norm(np.diff(points, axis=0), axis=1) / 0.01
    assert speeds.max() <= top_speed(path) * 1.001
    assert speeds.max() > 0.1


@pytest.mark.parametrize("path", PATHS)
def test_the_velocity_matches_the_motion(path: Path) -> None:
    moving = track(path)
    for time in (1.0, 4.3, 7.77):
        before, after = moving.at(time - 0.02), moving.at(time + 0.02)
        measured = (np.array(after.position_m) - np.array(before.position_m)) / 0.04
        assert moving.at(time).velocity_m_s == pytest.approx(measured, abs=0.02)


@pytest.mark.parametrize(("clockwise", "side"), [(False, -1.0), (True, 1.0)])
def test_an_oval_has_two_straights_and_two_half_circles(clockwise: bool, side: float) -> None:
    oval = track(OvalPath((1.0, 2.0, 0.2), 4.0, 1.0, 1.0, clockwise=clockwise), AlongYaw(0.0, 10.0))
    assert oval.at(1.0).position_m == pytest.approx((0.0, 2.0 + side, 0.2), abs=1e-3)
    assert oval.at(1.0).velocity_m_s == pytest.approx((1.0, 0.0, 0.0), abs=1e-9)
    assert oval.at(1.0).yaw_rate_rad_s == pytest.approx(0.0, abs=1e-9)
    half_turn = oval.at(4.0 + math.pi / 2)
    assert half_turn.position_m == pytest.approx((4.0, 2.0, 0.2), abs=1e-3)
    assert half_turn.velocity_m_s == pytest.approx((0.0, -side, 0.0), abs=0.02)
    assert half_turn.yaw_rate_rad_s == pytest.approx(-side, abs=0.01)
    assert oval.at(2 * (4.0 + math.pi)).position_m == pytest.approx(oval.at(0.0).position_m, abs=1e-3)


def test_a_targets_position_depends_only_on_time_and_seed() -> None:
    walk = PATHS[4]
    late, early = track(walk), track(walk)
    late.at(50.0)
    assert late.at(20.5) == early.at(20.5)
    assert early.at(50.0) == late.at(50.0)
    assert track(walk, seed=2).at(20.5) != early.at(20.5)


def test_walks_stay_within_their_area() -> None:
    walk, ring = track(PATHS[4]), track(PATHS[5])
    for k in range(2000):
        x, y, z = walk.at(k * 0.05).position_m
        assert abs(x) <= 1.15
        assert abs(y) <= 2.15
        assert 0.35 <= z <= 1.65
        x, y, z = ring.at(k * 0.05).position_m
        assert 1.5 <= math.hypot(x - 0.5, y - 0.2) <= 2.3
        assert 1.1 <= z <= 1.7


def test_an_open_path_is_followed_back_and_forth() -> None:
    moving = track(WaypointPath(((0, 0, 1), (1, 0, 1)), 0.5, closed=False))
    assert moving.at(1.0).position_m == pytest.approx((0.5, 0, 1))
    assert moving.at(2.0).position_m == pytest.approx((1, 0, 1))
    assert moving.at(3.0).position_m == pytest.approx((0.5, 0, 1))
    assert moving.at(4.0).position_m == pytest.approx((0, 0, 1))


def test_yaw_follows_its_mode_no_faster_than_its_limit() -> None:
    square = WaypointPath(((0, 0, 1), (2, 0, 1), (2, 2, 1), (0, 2, 1)), 0.5)
    rate = 0.6
    for yaw in (AlongYaw(math.pi, rate), TowardsYaw((1.0, 1.0), rate)):
        moving = track(square, yaw)
        yaws = np.unwrap([moving.at(0.02 * k).yaw_rad for k in range(1500)])
        assert np.abs(np.diff(yaws)).max() <= rate * 0.02 + 1e-9
    back = track(square, AlongYaw(math.pi, rate)).at(3.9)
    assert abs(back.yaw_rad) == pytest.approx(math.pi)
    towards = track(square, TowardsYaw((1.0, 1.0), 3.0)).at(2.0)
    assert towards.yaw_rad == pytest.approx(math.pi / 2)


@pytest.mark.parametrize("time", [-1.0, math.nan, math.inf])
def test_an_invalid_time_is_refused(time: float) -> None:
    with pytest.raises(UsageError, match="time"):
        track(PATHS[0]).at(time)


def test_the_far_past_is_refused() -> None:
    moving = track(PATHS[0])
    moving.at(100.0)
    with pytest.raises(UsageError, match="remembered"):
        moving.at(1.0)
