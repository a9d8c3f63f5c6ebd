"""The path's law alone: directions, yaw, limits, waiting."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.clock import nanoseconds
from skyloop.control.limiting import SetpointLimits
from skyloop.control.path import Circle, Polyline
from skyloop.control.path_law import AlongPath, FixedYaw, LookAt, PathLaw, PathSettings
from skyloop.control.pid import Gains
from skyloop.control.waypoint import Fix, fix_of
from skyloop.errors import UsageError
from skyloop.messages import Feedback, Velocity

EAST = Polyline([(0, 0, 1), (4, 0, 1)])


def fix(at_s: float, x: float, y: float, z: float, yaw: float = 0.0) -> Fix:
    return Fix(nanoseconds(at_s), (x, y, z), yaw)


def test_errors_are_turned_into_the_body_s_axes() -> None:
    law = PathLaw(EAST, PathSettings(gains=Gains(p=1.0)))
    wanted = law.step(fix(1.0, 0.0, -0.3, 0.9, yaw=math.pi / 2))  # looks north; the path is 0.3 m ahead and 0.1 m above
    assert wanted.forward == pytest.approx(0.3)
    assert wanted.left == pytest.approx(-EAST.velocity(0.25)[0]), "fed forward to the east, which is to the right"
    assert wanted.up == pytest.approx(0.1)
    assert wanted.yaw_rate == pytest.approx(0.0), "the yaw that it had is kept"


def test_the_integral_removes_a_wind_that_the_vehicle_does_not() -> None:
    law = PathLaw(Polyline([(0, 0, 1), (0.1, 0, 1)]))
    place, t, wind = np.array([0.0, 0.0, 1.0]), 0.0, np.array([0.2, -0.3, 0.05])
    for _ in range(3000):
        t += 0.02
        wanted = law.step(Fix(nanoseconds(t), (place[0], place[1], place[2]), 0.0))
        place += (np.array([wanted.forward, wanted.left, wanted.up]) + wind) * 0.02
    assert place == pytest.approx([0.1, 0.0, 1.0], abs=0.02)


@pytest.mark.parametrize("velocity_gain", [0.0, 1.0, 2.0])
@pytest.mark.parametrize("wind", [0.3, -0.6])
def test_the_integral_removes_a_wind_with_any_velocity_gain(velocity_gain: float, wind: float) -> None:
    """It mirrored the wind's error, -0.264 m for good, because more was reported applied than requested."""
    law = PathLaw(Polyline([(0, 0, 1), (0.1, 0, 1)]), PathSettings(velocity_gain=velocity_gain))
    x = v = t = 0.0
    for _ in range(4000):
        t += 0.02
        v += 0.02 / 0.3 * (law.step(Fix(nanoseconds(t), (x, 0.0, 1.0), 0.0, (v, 0.0, 0.0))).forward + wind - v)
        x += 0.02 * v
    assert x == pytest.approx(0.1, abs=0.01)


def held_beside(law: PathLaw, held_s: float, *, taken_over: bool) -> tuple[float, float]:
    """Hold a vehicle 0.4 m beside its place for a while; return its greatest speed and overshoot afterwards."""
    x = v = fastest = farthest = 0.0
    for k in range(round((held_s + 20.0) / 0.025)):
        t = k * 0.025
        held = 2.0 < t < 2.0 + held_s
        if held:
            x, v = 0.4, 0.0
        wanted = law.step(Fix(nanoseconds(t), (x, 0.0, 1.0), 0.0, (v, 0.0, 0.0)))
        if held:
            if taken_over:
                law.pause()
            continue
        v += (wanted.forward - v) * 0.025 / 0.3
        x += v * 0.025
        fastest, farthest = max(fastest, abs(v)), min(farthest, x)
    return fastest, farthest


@pytest.mark.parametrize("held_s", [10.0, 60.0])
def test_errors_during_a_takeover_are_not_integrated(held_s: float) -> None:
    """After a minute it came back at 1.5 m/s and far beyond its place."""
    still = Polyline([(0, 0, 1), (0.001, 0, 1)])
    fastest, farthest = held_beside(PathLaw(still), held_s, taken_over=True)
    assert fastest < 0.8
    assert farthest > -0.1
    fastest, farthest = held_beside(PathLaw(still), held_s, taken_over=False)  # by a wall: nothing reports it
    assert farthest > -1.2, "the integral is bounded"


def test_the_integral_does_not_grow_beyond_the_limits() -> None:
    settings = PathSettings(limits=SetpointLimits(speed_m_s=0.3), leash_m=5.0)
    law, x, v, farthest = PathLaw(Polyline([(0, 0, 1), (6, 0, 1)], speed_m_s=0.8), settings), 0.0, 0.0, 0.0
    for k in range(2400):
        v += (law.step(Fix(nanoseconds(k * 0.025), (x, 0.0, 1.0), 0.0, (v, 0.0, 0.0))).forward - v) * 0.025 / 0.3
        x += v * 0.025
        farthest = max(farthest, x)
    assert x == pytest.approx(6.0, abs=0.05)
    assert farthest < 6.1


def test_the_drones_own_limits_are_those_of_the_set_points() -> None:
    within = PathSettings().within({"limits.speed": 0.3, "limits.climb": 9.0, "limits.yaw_rate": True})
    assert (within.limits.speed_m_s, within.limits.climb_m_s, within.limits.turn_rad_s) == (0.3, 0.6, 1.2)


@given(
    st.lists(
        st.tuples(*[st.one_of(st.floats(-2, 2), st.sampled_from([math.nan, math.inf]))] * 7, st.floats(0, 0.6)),
        min_size=1,
        max_size=20,
    )
)
def test_a_fix_with_nan_pauses_and_leaves_no_trace(fixes: list[tuple[float, ...]]) -> None:
    """One NaN from a position source made it climb forever."""
    law, t = PathLaw(EAST), 0.0
    for x, y, z, yaw, vx, vy, vz, dt in fixes:
        t += dt
        one = Fix(nanoseconds(t), (x, y, z), yaw, (vx, vy, vz))
        wanted = law.step(one)
        assert wanted.finite
        if not one.finite:
            assert wanted == Velocity()
    law.pause()
    here, _ = law.target
    assert law.step(Fix(nanoseconds(t + 1.0), (here[0], here[1], here[2]), 0.0, (0.0, 0.0, 0.0))).up == 0.0


def test_a_known_velocity_is_used() -> None:
    law = PathLaw(EAST, PathSettings(gains=Gains(p=1.0), velocity_gain=0.5, lead_s=0.0))
    wanted = law.step(Fix(0, (0.0, -0.3, 1.0), 0.0, (0.0, -0.2, 0.0)))
    assert wanted.left == pytest.approx(0.3 + 0.5 * (0.3 + 0.2))


def test_time_advances_with_fixes_and_waits_for_a_distant_vehicle() -> None:
    law = PathLaw(EAST, PathSettings(leash_m=0.5))
    law.step(fix(1.0, 0.0, 0.0, 1.0))
    law.step(fix(1.2, 0.0, 0.0, 1.0))
    assert law.time_s == pytest.approx(0.2)
    law.step(fix(1.2, 0.0, 0.0, 1.0))  # the same again
    assert law.time_s == pytest.approx(0.2)
    law.step(fix(1.3, 0.0, 5.0, 1.0))
    assert law.time_s == pytest.approx(0.2), "beyond twice the leash the path waits"
    law.step(fix(1.4, 0.0, 0.75, 1.0))
    assert law.time_s == pytest.approx(0.25, abs=0.01)
    law.step(fix(60.0, 0.0, 0.0, 1.0))
    assert law.time_s < 0.8, "a gap is no leap"


def test_there_means_ended_near_and_turned() -> None:
    law = PathLaw(Polyline([(0, 0, 1), (0.1, 0, 1)]), yaw=FixedYaw(1.0))
    here = fix(1.0, 0.1, 0.0, 1.0, yaw=1.0)
    law.step(here)
    assert not law.there(here)
    for k in range(20):
        law.step(fix(1.0 + 0.1 * k, 0.1, 0.0, 1.0, yaw=1.0))
    assert law.over
    assert law.there(here)
    assert not law.there(here._replace(yaw_rad=1.5))
    assert not law.there(here._replace(position_m=(0.1, 0.2, 1.0)))
    law.follow(EAST)
    assert law.time_s == 0.0
    assert not law.over


def test_yaw_modes() -> None:
    place, velocity = np.array([1.0, 2.0, 1.0]), np.array([0.0, -0.4, 0.1])
    assert FixedYaw(0.3)(place, velocity) == 0.3
    assert AlongPath()(place, velocity) == pytest.approx(-math.pi / 2)
    assert AlongPath(math.pi)(place, velocity) == pytest.approx(math.pi / 2)
    assert AlongPath()(place, np.array([0.0, 0.0, 0.5])) is None
    assert LookAt(0.0, 2.0)(place, velocity) == pytest.approx(math.pi)
    assert LookAt(1.0, 2.1)(place, velocity) is None
    with pytest.raises(UsageError, match="finite"):
        FixedYaw(math.nan)


def test_the_turn_of_the_wanted_yaw_is_fed_forward() -> None:
    circle = Circle((0, 0, 1), 1.0, laps=2, speed_m_s=0.5)
    law = PathLaw(circle, yaw=AlongPath())
    turns = []
    for k in range(200):
        t = 0.02 * k
        place, velocity = circle.position(law.time_s), circle.velocity(law.time_s)
        yaw = math.atan2(velocity[1], velocity[0]) if t > 0.2 else math.pi / 2
        turns.append(law.step(Fix(nanoseconds(t), (place[0], place[1], 1.0), yaw)).yaw_rate)
    assert turns[-1] == pytest.approx(0.5, abs=0.03), "v/r, with no error of the yaw"


@given(
    st.lists(st.tuples(*[st.floats(-50, 50)] * 3, st.floats(-7, 7), st.floats(0, 2)), min_size=1, max_size=20),
)
def test_set_points_stay_within_the_limits(fixes: list[tuple[float, float, float, float, float]]) -> None:
    limits = SetpointLimits(speed_m_s=0.8, climb_m_s=0.4, turn_rad_s=1.0, acceleration_m_s2=1.0)
    law = PathLaw(EAST, PathSettings(limits=limits), LookAt(2.0, 3.0))
    t = 0.0
    for x, y, z, yaw, dt in fixes:
        t += dt
        wanted = law.step(Fix(nanoseconds(t), (x, y, z), yaw, (x / 10, y / 10, z / 10)))
        assert wanted.finite
        assert math.hypot(wanted.forward, wanted.left) <= 0.8 + 1e-9
        assert abs(wanted.up) <= 0.4 + 1e-9
        assert abs(wanted.yaw_rate) <= 1.0 + 1e-9


def test_a_fix_from_feedback_has_its_velocity_in_world_axes() -> None:
    known = Feedback(captured_ns=5, position_m=(1.0, 2.0, 3.0), yaw_rad=math.pi / 2, velocity_m_s=(0.5, 0.1, 0.2))
    found = fix_of(known)
    assert found is not None
    assert found.velocity_m_s == pytest.approx((-0.1, 0.5, 0.2))
    assert fix_of(Feedback(captured_ns=5, position_m=(1.0, 2.0, 3.0))) is None
    assert fix_of(Feedback(captured_ns=5, yaw_rad=0.0)) is None
    still = fix_of(Feedback(captured_ns=5, position_m=(1.0, 2.0, 3.0), yaw_rad=0.0))
    assert still == Fix(5, (1.0, 2.0, 3.0), 0.0, None)


@pytest.mark.parametrize(
    "wrong",
    [{"leash_m": 0.0}, {"near_m": -1.0}, {"lead_s": math.nan}, {"velocity_gain": -0.1}, {"gains": Gains(d=0.1)}],
)
def test_invalid_settings(wrong: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match=next(iter(wrong))):
        PathSettings(**wrong)


@pytest.mark.parametrize(
    ("wrong", "allowed"),
    [({"lead_s": -1.0}, "a finite number, 0 or more"), ({"near_m": 0.0}, "a finite number above 0")],
)
def test_errors_state_the_allowed_range(wrong: dict[str, float], allowed: str) -> None:
    with pytest.raises(UsageError, match=f"must be {allowed}"):
        PathSettings(**wrong)  # type: ignore[arg-type]
    assert PathSettings(velocity_gain=0.0, yaw_gain=0.0, lead_s=0.0).lead_s == 0.0
