"""Distributions of delays, and what a process takes."""

from __future__ import annotations

import os
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.measuring.machine import cpu_time_s
from benchmarks.measuring.statistics import summarize
from skyloop.bench import spread


def test_a_summary_by_hand() -> None:
    found = summarize([100_000, 200_000, 300_000, 400_000, 1_500_000], sent=7, period_s=0.03125)
    assert (found.samples, found.lost, found.period_ms) == (5, 2, 31.25)
    assert (found.minimum_us, found.median_us, found.maximum_us) == (100.0, 300.0, 1500.0)
    assert found.mean_us == pytest.approx(500.0)
    assert found.mean_of_period == pytest.approx(0.016)
    assert found.under_1_percent == pytest.approx(3 / 5)  # below 312.5 µs: 100, 200 and 300 are
    assert found.p99_us == pytest.approx(1456.0)


@given(st.lists(st.integers(0, 10**10), min_size=1, max_size=200), st.integers(0, 50))
def test_a_summary_is_in_order(delays_ns: list[int], lost: int) -> None:
    found = summarize(delays_ns, sent=len(delays_ns) + lost, period_s=0.0667)
    figures = [found.minimum_us, found.median_us, found.p99_us, found.p999_us, found.maximum_us]
    assert all(later >= earlier * (1 - 1e-9) for earlier, later in pairwise(figures))
    assert found.minimum_us * (1 - 1e-9) <= found.mean_us <= found.maximum_us * (1 + 1e-9)
    assert (found.samples, found.lost) == (len(delays_ns), lost)
    assert 0.0 <= found.under_1_percent <= 1.0
    assert spread(delays_ns).median_us == pytest.approx(found.median_us)


def test_a_channel_without_samples_is_no_figure() -> None:
    with pytest.raises(ValueError, match="not one sample"):
        spread([])
    with pytest.raises(ValueError, match="not one sample"):
        summarize([], sent=3, period_s=1.0)


def test_processor_time_of_a_process() -> None:
    assert cpu_time_s(os.getpid()) > 0.0
    assert cpu_time_s(2**22 + 1) == 0.0  # more than a process can have as its number
