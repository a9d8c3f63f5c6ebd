"""Limits: values within them stay unchanged, others are shortened and reported once."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.clock import NS_PER_S
from skyloop.messages import Attitude, Velocity
from skyloop.proxy.core.airspace import SLACK_M, Clamp, Limits
from skyloop.proxy.events import Episodes

LIMITS = Limits(tilt=0.3, climb=1.0, yaw_rate=1.5, speed=2.0, altitude=5.0)
numbers = st.floats(-1e6, 1e6)
altitudes = st.none() | st.floats(-10, 1000)


def test_a_set_point_within_the_limits_is_the_same_object() -> None:
    for action in (Velocity(1.0, -1.0, 1.0, -1.5), Attitude(0.2, 0.2, -1.0, 1.5)):
        allowed, clamps = LIMITS.clamp(action, 1.0)
        assert allowed is action
        assert clamps == ()


@pytest.mark.parametrize(
    ("action", "altitude", "expected", "limits"),
    [
        (Velocity(4.0), 1.0, Velocity(2.0), ["limits.speed"]),
        (Velocity(3.0, 4.0), 1.0, Velocity(1.2, 1.6), ["limits.speed"]),
        (Velocity(up=3.0), 1.0, Velocity(up=1.0), ["limits.climb"]),
        (Velocity(up=-3.0), 9.0, Velocity(up=-1.0), ["limits.climb"]),
        (Velocity(up=0.8), 4.5, Velocity(up=0.5), ["limits.altitude"]),
        (Velocity(up=0.8), 5.1, Velocity(), ["limits.altitude"]),
        (Velocity(), 5.1, Velocity(), []),
        (Velocity(up=0.8), 5.5, Velocity(up=-0.5), ["limits.altitude"]),
        (Velocity(1.0), 7.0, Velocity(1.0, up=-1.0), ["limits.altitude"]),
        (Velocity(up=-0.2), 5.5, Velocity(up=-0.5), ["limits.altitude"]),
        (Velocity(up=-0.8), 5.5, Velocity(up=-0.8), []),
        (Attitude(0.1), 7.0, Attitude(0.1, climb=-1.0), ["limits.altitude"]),
        (Velocity(up=0.8), None, Velocity(up=0.8), []),
        (Velocity(yaw_rate=-2.0), 1.0, Velocity(yaw_rate=-1.5), ["limits.yaw_rate"]),
        (Attitude(roll=0.6), 1.0, Attitude(roll=0.3), ["limits.tilt"]),
        (Attitude(-0.3, 0.4), 1.0, Attitude(-0.18, 0.24), ["limits.tilt"]),
        (
            Attitude(-3.0, 0.0, 9.0, 9.0),
            1.0,
            Attitude(-0.3, 0.0, 1.0, 1.5),
            ["limits.tilt", "limits.climb", "limits.yaw_rate"],
        ),
    ],
)
def test_set_points_beyond_the_limits_are_shortened(
    action: Velocity | Attitude, altitude: float | None, expected: Velocity | Attitude, limits: list[str]
) -> None:
    allowed, clamps = LIMITS.clamp(action, altitude)
    assert type(allowed) is type(expected)
    assert [getattr(allowed, name) for name in allowed.__struct_fields__] == pytest.approx(
        [getattr(expected, name) for name in expected.__struct_fields__]
    )
    assert [clamp.limit for clamp in clamps] == limits


def test_the_clamp_names_the_requested_value() -> None:
    assert LIMITS.clamp(Velocity(3.0, 4.0), 1.0)[1] == (Clamp("limits.speed", 5.0, 2.0),)


@given(numbers, numbers, numbers, numbers, altitudes)
def test_nothing_exceeds_the_limits_and_directions_stay(
    forward: float, left: float, up: float, yaw_rate: float, altitude: float | None
) -> None:
    asked = Velocity(forward, left, up, yaw_rate)
    allowed, clamps = LIMITS.clamp(asked, altitude)
    assert isinstance(allowed, Velocity)
    assert math.hypot(allowed.forward, allowed.left) <= LIMITS.speed * (1 + 1e-9)
    assert abs(allowed.up) <= LIMITS.climb
    assert abs(allowed.yaw_rate) <= LIMITS.yaw_rate
    if altitude is None or altitude <= LIMITS.altitude + SLACK_M:
        assert allowed.up * up >= 0
    else:
        assert allowed.up <= max(LIMITS.altitude - altitude, -LIMITS.climb) * (1 - 1e-9), "it descends"
    assert allowed.forward * left == pytest.approx(allowed.left * forward, rel=1e-6, abs=1e-6)
    if altitude is not None and altitude >= LIMITS.altitude:
        assert allowed.up <= 0
    if not clamps:
        assert allowed == asked


def test_an_episode_is_reported_once_until_the_limit_was_untouched_for_a_second() -> None:
    episodes, clamp = Episodes(), (Clamp("limits.tilt", 1.0, 0.3),)
    second = NS_PER_S
    assert episodes.begun(clamp, 0) == [*clamp]
    for step in range(1, 100):
        assert episodes.begun(clamp, step * second // 32) == []
    last = 99 * second // 32
    assert episodes.begun((), last + second // 2) == []
    assert episodes.begun(clamp, last + second - 1) == []
    assert episodes.begun(clamp, last + 2 * second) == [*clamp]


def test_limits_have_episodes_of_their_own() -> None:
    episodes = Episodes()
    tilt, climb = Clamp("limits.tilt", 1.0, 0.3), Clamp("limits.climb", 2.0, 1.0)
    assert episodes.begun((tilt,), 0) == [tilt]
    assert episodes.begun((tilt, climb), 1) == [climb]
