"""A directory of sockets for each test that starts processes, and results that were made up."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from benchmarks.measuring.delays import Cell, Delays, Series
from benchmarks.measuring.schedule import CHANNELS, PACKET_PERIOD_S
from benchmarks.measuring.statistics import Summary, summarize
from skyloop.bench import Machine

SIZES = ["320×240", "1920×1080"]
#: Median delays of the made-up results [µs], times 10 with the large frames.
MEDIANS = {"floor": 50, "skyloop": 60, "ros2": 600}


@pytest.fixture(scope="package", autouse=True)
def sockets() -> Iterator[None]:
    with tempfile.TemporaryDirectory(prefix="skyloop-") as folder, pytest.MonkeyPatch.context() as patch:
        patch.setenv("SKYLOOP_RUNTIME_DIR", str(Path(folder) / "run"))
        yield


def summary_of(median_us: float, *, sent: int = 102) -> Summary:
    """101 samples around a median, the longest of them twice as long."""
    delays = [median_us * 1e3 * (0.5 + index / 100) for index in range(100)] + [median_us * 2e3]
    return summarize(delays, sent=sent, period_s=PACKET_PERIOD_S)


@pytest.fixture
def made_up() -> Delays:
    series = [
        Series(channel, [0.03125 * n for n in range(200)], [50.0 + n for n in range(200)]) for channel in CHANNELS
    ]
    return Delays(
        machine=Machine("A processor", 2, "An OS x86_64", "Linux 6.1", "3.11.7", {"numpy": "2.0"}),
        seconds=5.0,
        sizes=SIZES,
        contenders={"floor": "bare hand-over", "skyloop": "Skyloop", "ros2": "ROS 2 (rclpy)"},
        versions={"ros2": "9.1"},
        skipped={"zenoh": "not installed"},
        cells=[
            Cell(name, size, channel, summary_of(median * (10 if size == SIZES[1] else 1)))
            for name, median in MEDIANS.items()
            for size in SIZES
            for channel in CHANNELS
        ],
        series=series,
    )
