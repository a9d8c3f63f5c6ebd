"""Flying to a waypoint."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as some

from skyloop.control.waypoint import Waypoint, WaypointSettings, lacking, reached, velocity_to
from skyloop.errors import UsageError
from skyloop.messages import Feedback, Vector
from skyloop.messages.geometry import wrap_angle

SETTINGS = WaypointSettings()
metres = some.floats(-50, 50)
angles = some.floats(-10, 10)


def at(
    position: Vector | None = (0.0, 0.0, 0.0), yaw: float | None = 0.0, velocity: Vector | None = (0.0, 0.0, 0.0)
) -> Feedback:
    return Feedback(captured_ns=1, position_m=position, yaw_rad=yaw, velocity_m_s=velocity)


@pytest.mark.parametrize(
    ("goal", "yaw", "signs"),
    [
        (Waypoint(1, 0, 0), 0.0, (1, 0, 0)),
        (Waypoint(0, 1, 0), 0.0, (0, 1, 0)),
        (Waypoint(0, 0, 1), 0.0, (0, 0, 1)),
        (Waypoint(-1, 0, -1), 0.0, (-1, 0, -1)),
        (Waypoint(1, 0, 0), math.pi / 2, (0, -1, 0)),  # looking north, east is to the right
        (Waypoint(0, 1, 0), math.pi / 2, (1, 0, 0)),
        (Waypoint(1, 0, 0), math.pi, (-1, 0, 0)),
    ],
)
def test_it_flies_towards_the_place(goal: Waypoint, yaw: float, signs: tuple[int, int, int]) -> None:
    asked = velocity_to(goal, at(yaw=yaw))
    parts = (asked.forward, asked.left, asked.up)
    assert [round(part / abs(part)) if abs(part) > 1e-6 else 0 for part in parts] == list(signs)
    assert asked.yaw_rate == 0.0, "any yaw will do"


def test_it_turns_the_shorter_way() -> None:
    assert velocity_to(Waypoint(0, 0, 0, yaw=0.5), at()).yaw_rate > 0
    assert velocity_to(Waypoint(0, 0, 0, yaw=-3.0), at(yaw=3.0)).yaw_rate > 0
    assert velocity_to(Waypoint(0, 0, 0, yaw=3.0), at(yaw=-3.0)).yaw_rate < 0


@given(metres, metres, metres, angles, angles)
def test_limits_hold_everywhere(x: float, y: float, z: float, yaw: float, goal_yaw: float) -> None:
    asked = velocity_to(Waypoint(x, y, z, goal_yaw), at(yaw=yaw))
    speed = math.hypot(asked.forward, asked.left)
    assert speed <= SETTINGS.speed_m_s + 1e-9
    assert speed**2 <= 2 * SETTINGS.slow_down_m_s2 * math.hypot(x, y) + 1e-9, "it can stop there"
    assert abs(asked.up) <= SETTINGS.climb_m_s + 1e-9
    assert abs(asked.yaw_rate) <= SETTINGS.turn_rad_s + 1e-9
    assert asked.finite


@given(metres, metres, metres, angles, angles, angles)
def test_an_ideal_vehicle_gets_there(x: float, y: float, z: float, yaw: float, heading: float, turn: float) -> None:
    goal = Waypoint(x, y, z, turn)
    here = at((0.0, 0.0, 0.0), heading)
    step_s = 0.05
    for _ in range(round((200 + 20) / step_s)):
        if reached(goal, here):
            break
        v = velocity_to(goal, here)
        assert here.position_m is not None
        assert here.yaw_rad is not None
        c, s = math.cos(here.yaw_rad), math.sin(here.yaw_rad)
        moved = (c * v.forward - s * v.left, s * v.forward + c * v.left, v.up)
        east, north, up = (at_ + step_s * one for at_, one in zip(here.position_m, moved, strict=True))
        here = at((east, north, up), here.yaw_rad + step_s * v.yaw_rate, (v.forward, v.left, v.up))
    assert reached(goal, here)
    assert here.position_m is not None
    assert here.yaw_rad is not None
    assert math.dist(here.position_m, goal.position) <= SETTINGS.near_m
    assert abs(wrap_angle(here.yaw_rad - turn)) <= SETTINGS.near_rad


def test_there_means_at_rest() -> None:
    goal = Waypoint(0.05, 0, 0, yaw=0.05)
    assert reached(goal, at())
    assert reached(goal, at(velocity=None)), "without a known velocity the position decides"
    assert not reached(goal, at(velocity=(0.5, 0.0, 0.0)))
    assert not reached(Waypoint(0.2, 0, 0), at())
    assert not reached(Waypoint(0, 0, 0, yaw=0.2), at())


def test_missing_values_are_reported() -> None:
    assert lacking(at()) == ""
    for blind in (at(position=None), at(yaw=None)):
        assert lacking(blind)
        with pytest.raises(UsageError, match="does not report its"):
            velocity_to(Waypoint(1, 1, 1), blind)
        with pytest.raises(UsageError, match="does not report its"):
            reached(Waypoint(1, 1, 1), blind)


@pytest.mark.parametrize("values", [(math.nan, 0, 0, None), (0, math.inf, 0, None), (0, 0, 0, math.nan)])
def test_a_waypoint_must_be_finite(values: tuple[float, float, float, float | None]) -> None:
    with pytest.raises(UsageError, match="must be finite"):
        Waypoint(*values)
