"""Offset of clocks, history of feedback, statistics."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.client.frame import FeedbackHistory, interpolate
from skyloop.client.monitoring import DEPTH, MAX_DRIFT, ChannelCounter, OffsetEstimator, distribution
from skyloop.messages import Feedback, FlightState

angles = st.floats(-math.pi, math.pi)


@given(
    st.integers(-(10**15), 10**15),
    st.lists(st.tuples(st.integers(0, 10**8), st.integers(0, 10**8)), min_size=1, max_size=40),
)
def test_the_offset_is_within_its_uncertainty(offset_ns: int, trips: list[tuple[int, int]]) -> None:
    estimator = OffsetEstimator()
    now_ns = 10**12
    for there_ns, back_ns in trips:
        best = estimator.add(now_ns, now_ns + there_ns + offset_ns, now_ns + there_ns + back_ns)
        assert abs(best.ns - offset_ns) <= best.uncertainty_ns
        now_ns += 10**9
    newest_there, newest_back = trips[-1]
    assert best.uncertainty_ns <= (newest_there + newest_back) * (0.5 + MAX_DRIFT) + 3


@given(
    st.integers(-(10**15), 10**15),
    st.floats(-MAX_DRIFT, MAX_DRIFT),
    st.lists(st.tuples(st.integers(0, 10**8), st.integers(0, 10**8), st.integers(0, 10**10)), min_size=1, max_size=60),
)
def test_the_offset_follows_a_drifting_clock(offset_ns: int, drift: float, trips: list[tuple[int, int, int]]) -> None:
    def true_ns(at_ns: int) -> int:
        return offset_ns + round(drift * (at_ns - 10**12))

    estimator = OffsetEstimator()
    now_ns = 10**12
    for there_ns, back_ns, pause_ns in trips:
        answered_ns = now_ns + there_ns
        best = estimator.add(now_ns, answered_ns + true_ns(answered_ns), answered_ns + back_ns)
        now_ns = answered_ns + back_ns
        assert abs(best.ns - true_ns(now_ns)) <= best.uncertainty_ns
        now_ns += pause_ns
        later = estimator.at(now_ns)
        assert abs(later.ns - true_ns(now_ns)) <= later.uncertainty_ns
        assert later.uncertainty_ns >= best.uncertainty_ns


def test_the_best_answer_serves_until_drift_may_have_made_it_worse() -> None:
    estimator = OffsetEstimator()
    estimator.add(0, 500_000, 1_000_000)  # known to 0.5 ms
    for second in range(1, 4):
        slow = estimator.add(second * 10**9, second * 10**9 + 500_000, second * 10**9 + 20_000_000)
        assert slow.uncertainty_ns < 1_500_000
    assert estimator.at(60 * 10**9).uncertainty_ns > 10_000_000


def test_a_clock_that_was_set_is_followed_at_once() -> None:
    estimator = OffsetEstimator()
    for second in range(5):
        estimator.add(second * 10**9, second * 10**9, second * 10**9 + 1000)
    jumped = estimator.add(5 * 10**9, 65 * 10**9, 5 * 10**9 + 1000)
    assert abs(jumped.ns - 60 * 10**9) <= jumped.uncertainty_ns < 2000


def test_the_state_between_two_samples() -> None:
    a = Feedback(
        captured_ns=0,
        yaw_rad=3.0,
        altitude_m=1.0,
        velocity_m_s=(0.0, 2.0, 0.0),
        state=FlightState.HOVERING,
        battery=0.5,
    )
    b = Feedback(captured_ns=100, yaw_rad=-3.0, altitude_m=2.0, velocity_m_s=(1.0, 0.0, 0.0), state=FlightState.FLYING)
    middle = interpolate(a, b, 25)
    assert middle.captured_ns == 25
    assert middle.yaw_rad == pytest.approx(3.0 + 0.25 * (math.tau - 6.0))
    assert middle.altitude_m == pytest.approx(1.25)
    assert middle.velocity_m_s == pytest.approx((0.25, 1.5, 0.0))
    assert (middle.state, middle.battery, middle.roll_rad) == (FlightState.HOVERING, 0.5, None)
    assert interpolate(a, b, 75).state is FlightState.FLYING
    assert interpolate(a, b, 75).battery is None


@given(angles, angles, st.floats(0.0, 1.0))
def test_angles_take_the_shorter_way(a: float, b: float, share: float) -> None:
    at = round(share * 10**6)
    got = interpolate(Feedback(captured_ns=0, yaw_rad=a), Feedback(captured_ns=10**6, yaw_rad=b), at).yaw_rad
    assert got is not None
    assert -math.pi <= got <= math.pi
    whole = abs(math.remainder(b - a, math.tau))
    part = abs(math.remainder(got - a, math.tau))
    assert part == pytest.approx(whole * at / 10**6, abs=1e-9)


def test_history_looks_on_both_sides() -> None:
    history = FeedbackHistory(depth=4)
    assert history.at(5) == (None, None, False)
    for at in (0, 10**9, 2 * 10**9):
        history.add(Feedback(captured_ns=at, altitude_m=at / 1e9))
    state, reach_s, final = history.at(1_250_000_000)
    assert state is not None
    assert state.altitude_m == pytest.approx(1.25)
    assert (reach_s, final) == (0.75, True)
    state, reach_s, final = history.at(10**9)
    assert state is not None
    assert (state.captured_ns, reach_s, final) == (10**9, 0.0, True)
    state, reach_s, final = history.at(2_500_000_000)
    assert state is not None
    assert (state.captured_ns, reach_s, final) == (2 * 10**9, 0.5, False), "not beyond the known samples"
    state, reach_s, final = history.at(-(10**9))
    assert state is not None
    assert (state.captured_ns, reach_s, final) == (0, 1.0, False)


def test_the_history_of_a_restarted_proxy_is_separate() -> None:
    history = FeedbackHistory()
    history.add(Feedback(captured_ns=100))
    history.add(Feedback(captured_ns=50))
    state, _, _ = history.at(100)
    assert state is not None
    assert state.captured_ns == 50


def test_distribution() -> None:
    assert distribution(np.array([], np.int64)) is None
    figures = distribution(np.arange(1, 101, dtype=np.int64) * 1_000_000)
    assert figures is not None
    assert figures.median == pytest.approx(0.0505)
    assert figures.p99 == pytest.approx(0.099)
    assert figures.maximum == pytest.approx(0.1)
    assert figures.count == 100
    assert figures.mean == pytest.approx(0.0505)


def test_counter() -> None:
    counter = ChannelCounter()
    assert counter.stats(0).rate_hz == 0.0
    assert counter.stats(0).delay_s is None
    for number in range(3 * DEPTH):
        now_ns = 10**9 + number * 10**7
        counter.follow(number * 2)
        counter.add(1000 + number, now_ns - 5000, now_ns)
    stats = counter.stats(now_ns + 10**6, dropped=3, malformed=2)
    assert (stats.count, stats.lost, stats.dropped, stats.malformed) == (3 * DEPTH, 3 * DEPTH - 1, 3, 2)
    assert stats.rate_hz == pytest.approx(100.0)
    assert stats.age_s == pytest.approx((10**6 + 5000) / 1e9)
    assert stats.delay_s is not None
    assert stats.delay_s.count == DEPTH
    assert stats.delay_s.maximum == pytest.approx((1000 + 3 * DEPTH - 1) / 1e9)
    assert counter.stats(now_ns + 3 * 10**9).rate_hz == 0.0, "it has stopped"
