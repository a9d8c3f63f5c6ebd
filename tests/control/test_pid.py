"""The PID loop against closed forms and against plants."""

from __future__ import annotations

import math

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from skyloop.control.pid import Gains, Pid
from skyloop.errors import UsageError

DT = 0.02


def fly(pid: Pid, seconds: float, *, goal: float = 1.0, push: float = 0.0, lag_s: float = 0.3) -> list[float]:
    """Fly a first-order lag with a constant push; return the measurements."""
    y, seen = 0.0, []
    for _ in range(round(seconds / DT)):
        u = pid.step(goal, y, DT)
        y += (u + push - y) * DT / lag_s
        seen.append(y)
    return seen


def test_terms_match_the_formula() -> None:
    pid = Pid(Gains(p=2.0, i=0.5, d=0.1, derivative_filter_s=0.0))
    assert pid.step(1.0, 0.0, DT) == pytest.approx(2.0)  # no slope and no integral yet
    slope = 0.1 / DT
    assert pid.step(1.0, 0.1, DT, feed_forward=3.0) == pytest.approx(3.0 + 2.0 * 0.9 + 0.5 * 0.9 * DT - 0.1 * slope)


def test_proportional_alone_leaves_an_offset_and_the_integral_removes_it() -> None:
    assert fly(Pid(Gains(p=4.0)), 10.0, push=-0.5)[-1] == pytest.approx((4.0 - 0.5) / 5.0, abs=1e-3)
    assert fly(Pid(Gains(p=4.0, i=3.0)), 20.0, push=-0.5)[-1] == pytest.approx(1.0, abs=1e-3)


def test_a_set_point_step_causes_no_derivative_kick() -> None:
    pid = Pid(Gains(p=1.0, d=5.0))
    pid.step(0.0, 0.0, DT)
    assert pid.step(1.0, 0.0, DT) == pytest.approx(1.0)


def test_derivative_is_filtered() -> None:
    pid = Pid(Gains(p=0.0, d=1.0, derivative_filter_s=0.1))
    pid.step(0.0, 0.0, DT)
    first = pid.step(0.0, 0.02, DT)  # a slope of 1 begins
    assert first == pytest.approx(-(1 - math.exp(-DT / 0.1)))
    for k in range(2, 100):
        last = pid.step(0.0, 0.02 * k, DT)
    assert last == pytest.approx(-1.0, abs=1e-6)


def test_back_calculation_keeps_the_overshoot_small() -> None:
    """Compared with the same loop and an external limit that is unknown to it."""
    gains = Gains(p=2.0, i=4.0)
    wound = Pid(gains)
    y = top = 0.0
    for k in range(1500):
        y += (max(-0.7, min(0.7, wound.step(1.0 if k < 500 else 0.3, y, DT))) - y) * DT / 0.3
        top = max(top, y if k > 800 else 0.0)
    limited = Pid(gains, low=-0.7, high=0.7)
    z = highest = 0.0
    for k in range(1500):
        z += (limited.step(1.0 if k < 500 else 0.3, z, DT) - z) * DT / 0.3
        highest = max(highest, z if k > 800 else 0.0)
    assert top > 0.65, "the other loop's integral kept growing"
    assert highest < 0.31


def test_a_limit_outside_is_reported() -> None:
    pid = Pid(Gains(p=1.0, i=1.0))
    for _ in range(1000):
        pid.step(1.0, 0.0, DT)
        pid.applied(0.2)
    assert pid.integral == pytest.approx(0.2 - 1.0 + 1.0 * DT / (1 - math.exp(-DT)), abs=0.05)
    assert abs(pid.integral) < 1.0


def test_without_p_the_integral_follows_the_limit_at_once() -> None:
    pid = Pid(Gains(p=0.0, i=1.0), low=-0.5, high=0.5)
    for _ in range(100):
        pid.step(10.0, 0.0, DT)
    assert pid.integral == pytest.approx(0.5)


def test_new_gains_cause_no_jump_with_an_integral() -> None:
    pid = Pid(Gains(p=1.0, i=0.5, d=0.2))
    y = 0.0
    for _ in range(100):
        before = pid.step(1.0, y, DT)
        y += (before - y) * DT / 0.3
    pid.gains = Gains(p=3.0, i=0.2, d=0.0, derivative_filter_s=0.2)
    after = pid.step(1.0, y, DT)
    assert after == pytest.approx(before, abs=0.02)
    assert pid.gains.p == 3.0
    pid.gains = Gains(p=1.0)
    assert pid.integral == 0.0


def test_taking_over_causes_no_jump() -> None:
    pid = Pid(Gains(p=2.0, i=1.0))
    pid.reset(0.7, set_point=1.0, measured=0.4)
    assert pid.step(1.0, 0.4, DT) == pytest.approx(0.7, abs=0.02)


def test_rate_limit() -> None:
    pid = Pid(Gains(p=10.0), rate=2.0)
    pid.reset(0.0)
    assert [pid.step(1.0, 0.0, 0.1) for _ in range(3)] == pytest.approx([0.2, 0.4, 0.6])
    assert pid.step(1.0, 0.0, 0.0) == pytest.approx(0.6), "in no time nothing changes"


def test_angles_take_the_shorter_way() -> None:
    pid = Pid(Gains(p=1.0, d=0.1, derivative_filter_s=0.0), angle=True)
    assert pid.step(3.1, -3.1, DT) == pytest.approx(6.2 - 2 * math.pi)
    slope = (3.13 - (-3.1 + 2 * math.pi)) / DT
    assert pid.step(3.1, 3.13, DT) == pytest.approx(3.1 - 3.13 - 0.1 * slope)


@given(
    st.lists(st.tuples(st.floats(-100, 100), st.floats(-100, 100), st.floats(0, 1)), min_size=1, max_size=30),
    st.floats(0, 10),
    st.floats(0, 10),
    st.floats(0, 1),
)
@example([(0.0, 0.0, 0.0), (0.0, -1.0, 1.0), (0.0, 0.0, 0.05174634432178894), (-6.0, 0.0, 1.0)], 0.0, 3.0, 1.0)
def test_output_stays_within_its_limits(
    samples: list[tuple[float, float, float]], p: float, i: float, d: float
) -> None:
    pid = Pid(Gains(p=p, i=i, d=d), low=-2.0, high=3.0, rate=5.0)
    last = None
    for goal, measured, dt in samples:
        u = pid.step(goal, measured, dt)
        assert -2.0 <= u <= 3.0
        if last is not None:
            assert abs(u - last) <= 5.0 * dt + 1e-9
        last = u


@pytest.mark.parametrize("wrong", [{"p": -1.0}, {"i": math.nan}, {"d": math.inf}, {"tracking_s": -0.1}])
def test_invalid_gains(wrong: dict[str, float]) -> None:
    with pytest.raises(UsageError, match=next(iter(wrong))):
        Gains(**wrong)


def test_invalid_limits() -> None:
    with pytest.raises(UsageError, match="below high"):
        Pid(Gains(), low=1.0, high=1.0)
    with pytest.raises(UsageError, match="rate"):
        Pid(Gains(), rate=0.0)


@pytest.mark.parametrize("wrong", [math.nan, math.inf])
def test_a_nan_measurement_leaves_the_loop_unchanged(wrong: float) -> None:
    pid, other = (Pid(Gains(p=1.0, i=0.5, d=0.1), low=-1.0, high=1.0) for _ in range(2))
    before = [loop.step(0.0, 0.1, 0.02) for loop in (pid, other)]
    assert pid.step(0.0, wrong, 0.02) == before[0]
    assert [pid.step(0.0, m, 0.02) for m in (0.1, -0.1)] == [other.step(0.0, m, 0.02) for m in (0.1, -0.1)]
