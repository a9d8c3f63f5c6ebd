"""``python -m benchmarks.ros``: what it makes of a run's times. The run itself needs rclpy."""

from __future__ import annotations

import pytest

from benchmarks.ros import _judged, measure, table
from skyloop.bench import Machine
from skyloop.errors import UnsupportedError
from skyloop.messages import Applied, Velocity


def test_delays_are_counted_from_the_publisher_and_from_the_bridge() -> None:
    published_ns = [0, 1_000_000, 2_000_000, 3_000_000]
    echoes = {
        number: Applied(number, 1, 1, at + 400_000, at + 700_000, Velocity(), Velocity())
        for number, at in enumerate(published_ns)
        if number != 2  # lost on its way
    }
    results = _judged(Machine.here(), 0.1, published_ns, [5_000_000] * 3, echoes, [4_000_000] * 3)
    assert (results.command.median_us, results.command_own.median_us) == (700.0, 300.0)
    assert (results.image.median_us, results.image_own.median_us) == (5000.0, 4000.0)
    assert results.command.samples == 2
    assert [row[-1] for row in table(results).rows] == ["400", "1000"]


def test_without_rclpy_it_says_what_is_missing() -> None:
    with pytest.raises(UnsupportedError, match="skyloop install ros"):
        measure(1.0, "/bin/false")
