"""The shared part of all vehicles' sessions: late packets are distinguished from a restarted vehicle."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.drivers.vehicle_session import RESTART_RUN, Arrival, RestartWatch

STEP_NS = 20_000_000


def judged(watch: RestartWatch, numbers: list[int]) -> list[Arrival]:
    """Return the verdicts on consecutive packets."""
    return [watch.update(number, place * STEP_NS) for place, number in enumerate(numbers)]


def test_a_new_count_needs_a_run_of_packets() -> None:
    watch = RestartWatch(tolerance=100)
    assert judged(watch, [5000, 5020, 4950, 3000, 5040]) == [*([Arrival.NEW] * 3), Arrival.LATE, Arrival.NEW]
    assert judged(watch, [20, 40, 60, 80, 100, 120]) == [
        *([Arrival.LATE] * (RESTART_RUN - 1)),
        Arrival.RESTARTED,
        Arrival.NEW,
    ]


def test_a_burst_of_late_packets_does_not_start_a_new_count() -> None:
    """However many: they arrive together, and the next one continues the old count."""
    watch = RestartWatch()
    assert watch.update(5000, 0) is Arrival.NEW
    assert {watch.update(number, STEP_NS) for number in range(1000, 1020)} == {Arrival.LATE}
    assert watch.update(5001, 2 * STEP_NS) is Arrival.NEW


@pytest.mark.parametrize("tolerance", [0, 1000])
def test_a_count_may_restart_where_it_wraps(tolerance: int) -> None:
    watch = RestartWatch(tolerance, 1 << 32)
    numbers = [(1 << 32) - 30, (1 << 32) - 10, 10, (1 << 32) - 5000, 30]
    assert judged(watch, numbers) == [Arrival.NEW, Arrival.NEW, Arrival.NEW, Arrival.LATE, Arrival.NEW]


@given(st.lists(st.integers(1, 400), min_size=1, max_size=40), st.integers(1, 5000))
def test_single_late_packets_never_start_a_new_count(steps: list[int], behind: int) -> None:
    watch, number = RestartWatch(), 10_000
    for place, step in enumerate(steps):
        number += step
        assert watch.update(number, 2 * place * STEP_NS) is Arrival.NEW
        assert watch.update(number - behind, (2 * place + 1) * STEP_NS) is Arrival.LATE
