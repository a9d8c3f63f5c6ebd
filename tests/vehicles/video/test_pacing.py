"""Due times of recorded images, and capture times of live ones."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from skyloop.clock import NS_PER_S, LiveClock
from skyloop.vehicles.video.player import FilePacer

MS = 1_000_000


def test_stamps_are_kept_however_long_decoding_takes() -> None:
    pacer = FilePacer(speed=1.0, period_s=0.04)
    due = [pacer.due_ns(0.04 * n, 100 * MS + n * 40 * MS + (n % 3) * 10 * MS) for n in range(10)]
    assert due == [100 * MS + n * 40 * MS for n in range(10)]


def test_twice_the_speed_takes_half_the_time() -> None:
    pacer = FilePacer(speed=2.0, period_s=0.04)
    assert [pacer.due_ns(stamp, 0) for stamp in (5.0, 5.04, 5.1)] == [0, 20 * MS, 50 * MS]


def test_a_jump_of_the_stamps_counts_as_one_period() -> None:
    pacer = FilePacer(speed=1.0, period_s=0.04)
    assert [pacer.due_ns(stamp, 0) for stamp in (5.0, 900.0, 900.04, 3.0)] == [0, 40 * MS, 80 * MS, 120 * MS]


def test_after_a_pause_it_does_not_rush() -> None:
    pacer = FilePacer(speed=1.0, period_s=0.04)
    pacer.due_ns(0.0, 0)
    assert pacer.due_ns(0.04, 5 * NS_PER_S) == 5 * NS_PER_S
    assert pacer.due_ns(0.08, 5 * NS_PER_S) == 5 * NS_PER_S + 40 * MS


def test_live_the_smallest_delay_counts_as_none() -> None:
    clock = LiveClock()
    delays_ms = [80, 20, 35, 22, 60]
    taken = [clock.captured_ns(n * 0.1, n * 100 * MS + delay * MS) for n, delay in enumerate(delays_ms)]
    assert taken == [80 * MS, 120 * MS, 220 * MS, 320 * MS, 420 * MS]


def test_live_a_slower_clock_is_followed() -> None:
    clock = LiveClock(window_s=1.0)
    for n in range(600):
        arrived = n * 33 * MS
        stamp_s = arrived * (1 - 1e-3) / NS_PER_S  # the camera's clock loses 1 ms a second
        age = arrived - clock.captured_ns(stamp_s, arrived)
    assert age <= 4 * MS  # would be 20 ms by now


def test_live_a_clock_that_is_set_back_is_learned_again() -> None:
    clock = LiveClock()
    assert clock.captured_ns(1000.0, 50 * MS) == 50 * MS
    assert clock.captured_ns(0.0, 90 * MS) == 90 * MS
    assert clock.captured_ns(0.04, 150 * MS) == 130 * MS


@given(st.lists(st.tuples(st.floats(0.001, 1.0), st.integers(0, 300)), min_size=1, max_size=80))
def test_live_times_never_run_backwards_or_ahead(steps: list[tuple[float, int]]) -> None:
    clock, stamp_s, arrived, before = LiveClock(window_s=2.0), 0.0, 0, -(10**18)
    for step_s, delay_ms in steps:
        stamp_s += step_s
        arrived = max(arrived + 1, round(stamp_s * NS_PER_S) + delay_ms * MS)
        captured = clock.captured_ns(stamp_s, arrived)
        assert before <= captured <= arrived
        before = captured
