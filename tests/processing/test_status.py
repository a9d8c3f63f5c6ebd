"""Workers' statistics, in figures and words."""

from __future__ import annotations

import pytest

from skyloop.clock import ManualClock
from skyloop.messages import ProcessorShare
from skyloop.processing.worker import Status, Tally, together

SHARE = ProcessorShare("detector", "front", 1, 3, 4)


def test_the_last_second_counts() -> None:
    clock = ManualClock()
    tally = Tally(clock)
    for age_s in (0.9, 0.05, 0.04, 0.07):
        tally.came()
        tally.made(age_s, age_s / 2)
        clock.advance(0.5 if age_s == 0.9 else 0.2)
    tally.stale, tally.errors = 2, 3
    status = tally.status("detector", "front", SHARE, 5)
    assert (status.frames, status.results, status.dropped, status.stale, status.errors) == (4, 4, 5, 2, 3)
    assert (status.frames_hz, status.results_hz) == (3.0, 3.0)
    assert (status.age_s, status.age_max_s, status.took_s) == (0.05, 0.07, 0.025)
    assert str(status).split("  ") == [
        "detector front",
        "part 2 of 3",
        "3.0 frames/s",
        "3.0 results/s",
        "age 50 ms (max 70 ms)",
        "dropped 5",
        "too old 2",
        "errors 3",
    ]


def test_before_anything_happened() -> None:
    status = Tally(ManualClock()).status("detector", "front", None, 0)
    assert "no part now  0.0 frames/s  0.0 results/s  age –" in str(status)


def test_several_together() -> None:
    one = Status(processor="d", camera="front", parts=2, workers=2, results=3, results_hz=1.0, age_s=0.1, age_max_s=0.2)
    two = Status(
        processor="d", camera="front", part=1, parts=2, workers=2, results=4, results_hz=2.0, refused=1, unsent=2
    )
    both = together([one, two])
    assert both is not None
    assert (both.processes, both.parts, both.results, both.results_hz, both.age_s) == (2, 2, 7, 3.0, 0.1)
    assert "2 of 2 processes working" in str(both)
    assert str(both).endswith("errors 0  unsendable 1  unsent 2")
    assert together([one]) is one
    assert together([]) is None


@pytest.mark.parametrize("parts", [0, 2])
def test_a_worker_without_a_part_is_not_working(parts: int) -> None:
    one = Status(processor="d", camera="front", parts=parts, workers=2)
    both = together([one, Status(processor="d", camera="front", parts=2, workers=2)])
    assert both is not None
    assert both.parts == (2 if parts else 1)
