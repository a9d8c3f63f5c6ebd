from __future__ import annotations

import itertools
import math
import threading
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.clock import ManualClock
from skyloop.errors import UsageError
from skyloop.sim import STEP_S, Pacer
from skyloop.sim.host import Report, SimHost
from skyloop.sim.options import MOST_LAG_S, SLOW_AGAIN_NS, SLOW_NS, SimOptions, SlownessWatch
from skyloop.sim.reports import Occurrence


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


def test_a_long_pause_is_skipped_and_counted() -> None:
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


def test_the_catch_up_can_be_limited() -> None:
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


def test_simulation_times_map_to_the_clock() -> None:
    clock = ManualClock()
    pacer = Pacer(Counter(), speed=2.0, clock=clock)
    assert pacer.clock_ns(1.0) == clock.now_ns + 500_000_000


@pytest.mark.parametrize("speed", [0.0, -1.0, math.nan, math.inf])
def test_an_invalid_speed_is_refused(speed: float) -> None:
    with pytest.raises(UsageError, match="speed"):
        Pacer(Counter(), speed=speed)


def test_a_slow_simulation_is_reported_periodically() -> None:
    watch, lost_s = SlownessWatch(0), 0.0
    said = []
    for n in range(1, 40):
        now_ns = n * SLOW_NS
        lost_s += 0.0 if n < 3 else 0.1 if n < 5 else 1.0  # of 5 s each
        share = watch.update(lost_s, now_ns)
        assert watch.update(lost_s + 1.0, now_ns + 1) is None, "only over some time"
        if share is not None:
            assert share == pytest.approx(0.8)
            said.append(now_ns)
    assert said[0] == 5 * SLOW_NS, "a small lag is not reported"
    assert [b - a for a, b in itertools.pairwise(said)] == [SLOW_AGAIN_NS] * 2


def test_one_thread_at_a_time_steps_a_world_after_a_restart() -> None:
    """The ending thread was once still in a step when the next one began."""

    class Observer:
        def __init__(self) -> None:
            self.reports = threading.Event()
            self.failures: list[Exception] = []

        def report(self, report: Report) -> None:
            self.reports.set()

        def happened(self, occurrence: Occurrence) -> None: ...

        def wanted_fps(self, camera: str) -> float:
            return 0.0

        def failed(self, error: Exception) -> None:
            self.failures.append(error)

    host = SimHost(SimOptions(world="empty", cameras=()))
    inside, most = [0], [0]
    step, entered, go_on = host.simulation.step, threading.Event(), threading.Event()

    def slow(steps: int) -> None:
        inside[0] += 1
        most[0] = max(most[0], inside[0])
        entered.set()
        go_on.wait(20.0)
        step(steps)
        inside[0] -= 1

    host.simulation.step = slow  # type: ignore[method-assign, assignment]
    first, second = Observer(), Observer()
    host.attach(0, first, None, [])  # type: ignore[arg-type]
    assert entered.wait(20.0)
    leaving = threading.Thread(target=host.detach, args=(0, first))
    leaving.start()
    while host.observers:
        time.sleep(0.001)
    host.attach(0, second, None, [])  # type: ignore[arg-type]
    assert not second.reports.wait(0.1), "the first one is still in its step"
    go_on.set()
    leaving.join(20.0)
    assert second.reports.wait(20.0)
    host.detach(0, second)
    assert most == [1]
    assert first.failures == second.failures == []
