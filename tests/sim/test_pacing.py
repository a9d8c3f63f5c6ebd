from __future__ import annotations

import itertools
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.clock import ManualClock
from skyloop.errors import UsageError
from skyloop.sim import STEP_S, Pacer
from skyloop.sim.pacing import MOST_LAG_S, SLOW_AGAIN_NS, SLOW_NS, SlownessWatch


class Counter:
    def __init__(self) -> None:
        self.steps = 0

    def __call__(self, n: int) -> None:
        self.steps += n


def test_steps_are_done_when_they_are_due() -> None:
    clock, counter = ManualClock(), Counter()
    pacer = Pacer(counter, clock=clock)
    assert pacer.run_due() == pytest.approx(STEP_S)
    clock.advance(STEP_S)
    assert pacer.run_due() == pytest.approx(STEP_S)
    assert counter.steps == 1
    clock.advance(0.0101)
    pacer.run_due()
    assert counter.steps == 3


@given(st.lists(st.floats(0.0, 0.09), min_size=1, max_size=60), st.sampled_from([0.5, 1.0, 4.0]))
def test_late_calls_are_caught_up_without_drift(waits: list[float], speed: float) -> None:
    clock, counter = ManualClock(), Counter()
    start = clock.now_ns
    pacer = Pacer(counter, speed=speed, clock=clock)
    for wait in waits:
        clock.advance(wait)
        while pacer.run_due() == 0:
            pass
    wanted = (clock.now_ns - start) / 1e9 * speed / STEP_S
    assert counter.steps == pytest.approx(wanted, abs=1.001)
    assert pacer.lost_s == 0


def test_a_long_pause_is_given_up_and_counted() -> None:
    clock, counter = ManualClock(), Counter()
    pacer = Pacer(counter, clock=clock)
    clock.advance(10.0)
    while pacer.run_due() == 0:
        pass
    assert counter.steps * STEP_S == pytest.approx(MOST_LAG_S, abs=2 * STEP_S)
    assert pacer.lost_s == pytest.approx(10.0 - MOST_LAG_S, abs=2 * STEP_S)
    done = counter.steps
    clock.advance(0.1)
    while pacer.run_due() == 0:
        pass
    assert counter.steps - done == pytest.approx(0.1 / STEP_S, abs=1)


def test_how_much_is_caught_up_can_be_less() -> None:
    clock, counter = ManualClock(), Counter()
    pacer = Pacer(counter, most_lag_s=0.02, clock=clock)
    clock.advance(1.0)
    while pacer.run_due() == 0:
        pass
    assert counter.steps * STEP_S == pytest.approx(0.02, abs=2 * STEP_S)


def test_one_call_does_not_run_for_long() -> None:
    clock, counter = ManualClock(), Counter()
    pacer = Pacer(counter, clock=clock)
    clock.advance(0.2)
    assert pacer.run_due() == 0
    assert counter.steps == 25


def test_times_of_the_simulation_map_to_the_clock() -> None:
    clock = ManualClock()
    pacer = Pacer(Counter(), speed=2.0, clock=clock)
    assert pacer.clock_ns(1.0) == clock.now_ns + 500_000_000


@pytest.mark.parametrize("speed", [0.0, -1.0, math.nan, math.inf])
def test_a_speed_that_is_none_is_refused(speed: float) -> None:
    with pytest.raises(UsageError, match="speed"):
        Pacer(Counter(), speed=speed)


def test_a_simulation_that_stays_behind_is_said_now_and_then() -> None:
    watch, lost_s = SlownessWatch(0), 0.0
    said = []
    for n in range(1, 40):
        now_ns = n * SLOW_NS
        lost_s += 0.0 if n < 3 else 0.1 if n < 5 else 1.0  # of 5 s each
        share = watch.update(lost_s, now_ns)
        assert watch.update(lost_s + 1.0, now_ns + 1) is None, "over a while only"
        if share is not None:
            assert share == pytest.approx(0.8)
            said.append(now_ns)
    assert said[0] == 5 * SLOW_NS, "a little is no matter"
    assert [b - a for a, b in itertools.pairwise(said)] == [SLOW_AGAIN_NS] * 2
