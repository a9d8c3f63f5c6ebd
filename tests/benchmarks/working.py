"""Work for the processes of the tests."""

from __future__ import annotations

from benchmarks.measuring.statistics import Summary
from benchmarks.measuring.workers import Pipe


def fails(pipe: Pipe) -> None:
    raise RuntimeError("on purpose")


def is_silent(pipe: Pipe) -> None:
    pipe.recv()


def echo(pipe: Pipe, what: int | str) -> None:
    pipe.send(what)
    pipe.recv()


def plausible(summary: Summary, sent: int) -> None:
    assert 0.3 * sent <= summary.samples <= sent  # a crowded machine leaves some out
    assert summary.samples + summary.lost == sent
    assert 0 < summary.minimum_us <= summary.median_us <= summary.p99_us <= summary.p999_us <= summary.maximum_us < 1e6
