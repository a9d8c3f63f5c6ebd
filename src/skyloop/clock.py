"""Time. All times in Skyloop are integer nanoseconds on a monotonic clock; decisions take the time as an argument.

``time.monotonic_ns`` is ``CLOCK_MONOTONIC``: one clock for all processes of a host, so that ages across processes
of one host need no estimation. Wall-clock time is never used for ages.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

#: A source of the time: returns integer nanoseconds that never go backwards.
Clock = Callable[[], int]

NS_PER_S: Final = 1_000_000_000

monotonic_ns: Clock = time.monotonic_ns


def seconds(ns: int) -> float:
    """Nanoseconds to seconds."""
    return ns / NS_PER_S


def nanoseconds(s: float) -> int:
    """Seconds to whole nanoseconds."""
    return round(s * NS_PER_S)


class ManualClock:
    """A clock that stands still until it is told to move: for tests and for simulation faster than real time."""

    def __init__(self, start_ns: int = NS_PER_S) -> None:
        self.now_ns = start_ns

    def __call__(self) -> int:
        return self.now_ns

    def advance(self, seconds_: float) -> int:
        """Move forward by ``seconds_`` and return the new time."""
        if seconds_ < 0:
            raise ValueError(f"a monotonic clock cannot go back by {-seconds_} s")
        self.now_ns += nanoseconds(seconds_)
        return self.now_ns
