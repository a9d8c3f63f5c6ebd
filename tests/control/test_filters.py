"""Filters and limits against their closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from skyloop.control.filters import Complementary, LowPass, Median
from skyloop.control.limiting import SetpointLimiter, SetpointLimits, clamped, shortened, within
from skyloop.errors import UsageError
from skyloop.messages import Velocity


@given(st.lists(st.floats(0.001, 0.3), min_size=1, max_size=50), st.floats(0.01, 2.0))
def test_low_pass_of_a_step_does_not_depend_on_the_sampling(steps: list[float], time_constant_s: float) -> None:
    low: LowPass[float] = LowPass(time_constant_s, 0.0)
    for dt in steps:
        value = low.step(1.0, dt)
    assert value == pytest.approx(1.0 - math.exp(-sum(steps) / time_constant_s), abs=1e-9)


def test_low_pass_of_arrays_starts_with_the_first() -> None:
    low: LowPass[NDArray[np.float64]] = LowPass(0.5)
    assert low.step(np.array([1.0, 2.0]), 0.1) == pytest.approx([1.0, 2.0])
    assert low.step(np.array([1.0, 4.0]), 0.0) == pytest.approx([1.0, 2.0])
    low.reset()
    assert low.step(np.array([3.0, 4.0]), 0.1) == pytest.approx([3.0, 4.0])
    passing: LowPass[float] = LowPass(0.0, 5.0)
    assert passing.step(1.0, 0.1) == 1.0


def test_the_cutoff_loses_three_decibels() -> None:
    low: LowPass[float] = LowPass.from_cutoff(2.0)
    seen = [low.step(math.sin(2 * math.pi * 2.0 * k * 1e-3), 1e-3) for k in range(4000)]
    assert max(seen[2000:]) == pytest.approx(1 / math.sqrt(2), abs=0.01)


def test_complementary_removes_the_drift_and_stays_fast() -> None:
    both = Complementary(1.0)
    assert both.step(1.0, None, 0.1) is None
    rng = np.random.default_rng(1)
    errors = []
    true = 3.0
    for _ in range(3000):
        true += 0.8 * 0.01
        angle = both.step(0.8 + 0.1, true + rng.normal(0, 0.1), 0.01)  # the rate is off by 0.1 rad/s
        assert angle is not None
        assert -math.pi <= angle < math.pi
        errors.append(math.remainder(angle - true, 2 * math.pi))
    assert np.mean(errors[1000:]) == pytest.approx(0.1, abs=0.02), "bias times time constant stays"
    assert np.std(errors[1000:]) < 0.02, "a fifth of the measurement's noise"
    held = Complementary(1.0, 3.0)
    for _ in range(10):
        held.step(0.5, None, 0.1)  # no measurement: the rate alone
    assert held.angle == pytest.approx(3.5 - 2 * math.pi)


def test_median_drops_outliers() -> None:
    median = Median(3)
    assert [median.step(x) for x in (1.0, 99.0, 2.0, 3.0, -50.0, 4.0)] == [1.0, 1.0, 2.0, 3.0, 2.0, 3.0]


@pytest.mark.parametrize(
    "make",
    [
        lambda: LowPass(-1.0),
        lambda: LowPass.from_cutoff(0.0),
        lambda: Complementary(math.nan),
        lambda: Median(0),
        lambda: Median(True),
        lambda: SetpointLimits(speed_m_s=0.0),
    ],
)
def test_invalid_arguments(make: object) -> None:
    with pytest.raises(UsageError, match="must be"):
        make()  # type: ignore[operator]


def test_vectors() -> None:
    assert shortened(np.array([3.0, 4.0]), 1.0) == pytest.approx([0.6, 0.8])
    assert shortened(np.array([0.3, 0.4]), 1.0) == pytest.approx([0.3, 0.4])
    assert (clamped(3.0, 1.0), clamped(-3.0, 1.0), clamped(0.5, 1.0)) == (1.0, -1.0, 0.5)


@given(st.one_of(st.floats(-1e6, 1e6), st.sampled_from([math.nan, math.inf, -math.inf])), st.floats(0.0, 100.0))
def test_nan_never_passes_a_clamp(value: float, longest: float) -> None:
    assert abs(clamped(value, longest)) <= longest
    assert clamped(math.nan, longest) == 0.0
    assert within(math.nan, 2.0, 3.0) == 2.0
    assert np.linalg.norm(shortened(np.array([value, 1.0]), longest)) <= longest + 1e-9
    assert np.isfinite(shortened(np.array([value, 1.0]), math.inf)).all()


LIMITS = SetpointLimits(1.0, 0.5, 0.8, acceleration_m_s2=2.0, climb_acceleration_m_s2=1.0, turn_acceleration_rad_s2=4.0)


@given(
    st.lists(
        st.tuples(st.lists(st.floats(-50, 50), min_size=4, max_size=4), st.floats(0.0, 0.2)), min_size=1, max_size=20
    )
)
def test_set_points_stay_within_their_limits(wanted: list[tuple[list[float], float]]) -> None:
    limiter, last = SetpointLimiter(LIMITS), None
    for values, dt in wanted:
        new = limiter.step(np.array(values), dt)
        assert math.hypot(new.forward, new.left) <= 1.0 + 1e-9
        assert abs(new.up) <= 0.5 + 1e-9
        assert abs(new.yaw_rate) <= 0.8 + 1e-9
        if last is not None:
            assert math.hypot(new.forward - last.forward, new.left - last.left) <= 2.0 * dt + 1e-9
            assert abs(new.up - last.up) <= 1.0 * dt + 1e-9
            assert abs(new.yaw_rate - last.yaw_rate) <= 4.0 * dt + 1e-9
        last = new


def test_one_nan_neither_passes_the_limiter_nor_stays_in_it() -> None:
    limiter = SetpointLimiter(LIMITS)
    assert limiter.step(np.array([math.nan, math.inf, math.nan, -math.inf]), 0.1) == Velocity()
    assert limiter.step(np.zeros(4), math.nan) == Velocity()
    assert limiter.step(np.array([0.1, 0.0, 0.0, 0.0]), 0.1) == Velocity(forward=0.1)


def test_limiter_starts_from_a_given_set_point() -> None:
    limiter = SetpointLimiter(LIMITS)
    limiter.reset(Velocity(forward=0.5))
    assert limiter.step(np.zeros(4), 0.1).forward == pytest.approx(0.3)
    limiter.reset()
    assert limiter.step(np.zeros(4), 0.1) == Velocity()
    assert SetpointLimiter(SetpointLimits()).step(np.full(4, 9.0), 0.0).forward == 9.0
