"""Times and clocks. All times are integer nanoseconds on a monotonic clock, and decisions take the time as an argument.

``time.monotonic_ns`` is ``CLOCK_MONOTONIC``. All processes of a host share it, and ages across processes need no
estimate. Time namespaces, as in containers, are an exception: :func:`clock_identity` distinguishes them. Ages never
depend on wall-clock time.
"""

from __future__ import annotations

import functools
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

#: A time source; returns integer nanoseconds that never decrease.
Clock = Callable[[], int]

NS_PER_S: Final = 1_000_000_000
#: Time after which a thread releases the interpreter lock, in a process that serves vehicles. With Python's default of
#: 5 ms, each packet in a flood could delay a command by 5 ms.
SWITCH_INTERVAL_S: Final = 0.001

#: The clock of drivers and applications too (docs/drivers.md). On Windows, it has steps of 15.6 ms before Python 3.13.
monotonic_ns: Clock = time.monotonic_ns


def seconds(ns: int) -> float:
    """Convert nanoseconds to seconds."""
    return ns / NS_PER_S


def nanoseconds(s: float) -> int:
    """Convert seconds to whole nanoseconds, rounded to the nearest."""
    return round(s * NS_PER_S)


def slept_ns() -> int:
    """Return how long this computer has slept since it was started [ns]; 0 if unknown.

    The monotonic clock stops during sleep, except on Windows: anything received earlier is older than its timestamp
    suggests. The result may be out of date for a moment, but is never too large.
    """
    if sys.platform == "linux":
        return time.clock_gettime_ns(time.CLOCK_BOOTTIME) - time.monotonic_ns()
    if sys.platform == "darwin":  # clock_gettime(3) there: the second one is the clock of time.monotonic_ns
        return time.clock_gettime_ns(time.CLOCK_MONOTONIC_RAW) - time.clock_gettime_ns(time.CLOCK_UPTIME_RAW)
    return 0


def beats(period_s: float, ended: threading.Event) -> Iterator[None]:
    """Yield once per period, with absolute deadlines, until ``ended`` is set; skip missed periods."""
    due_s = time.monotonic()
    while True:
        due_s = max(due_s + period_s, time.monotonic())
        if ended.wait(max(0.0, due_s - time.monotonic())):
            return
        yield


@functools.cache
def boot_id() -> str:
    """Return an identifier of the kernel's current boot; empty if unknown, as on systems other than Linux."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        return ""


@functools.cache
def clock_identity() -> str:
    """Return an identifier of this process's monotonic clock; processes with equal identifiers read the same clock.

    It combines the kernel's boot ID and the time namespace. It is empty if the boot ID is unknown.
    """
    if not (boot := boot_id()):
        return ""
    try:
        namespace = Path("/proc/self/ns/time").stat().st_ino
    except OSError:  # the kernel has no time namespaces
        namespace = 0
    return f"{boot}/{namespace}"


class ManualClock:
    """A clock that moves only when advanced, for tests and faster-than-real-time simulation."""

    def __init__(self, start_ns: int = NS_PER_S) -> None:
        self.now_ns = start_ns

    def __call__(self) -> int:
        """Return the current time [ns]."""
        return self.now_ns

    def advance(self, seconds_: float) -> int:
        """Advance by ``seconds_`` (``ValueError`` if negative) and return the new time [ns]."""
        if seconds_ < 0:
            raise ValueError(f"a monotonic clock cannot go back by {-seconds_} s")
        self.now_ns += nanoseconds(seconds_)
        return self.now_ns


class LiveClock:
    """Maps the timestamps of a live stream to this host's clock, taking the smallest recent delay as zero.

    It uses two time windows, one of which is always complete, to allow for a stream whose clock runs slightly slower.
    The resulting times never decrease and are never in the future.
    """

    def __init__(self, window_s: float = 5.0) -> None:
        self._window_ns = nanoseconds(window_s)
        self._stamp_ns = 0
        self._before_ns: int | None = None  # smallest offset of the previous window
        self._smallest_ns: int | None = None  # smallest offset of this window
        self._begun_ns = 0

    def captured_ns(self, stamp_s: float, arrived_ns: int) -> int:
        """Return the time at which a frame was captured, which is never later than its arrival.

        ``stamp_s`` is the frame's timestamp on the stream's clock [s]; if that clock jumps back, the estimate restarts.
        ``arrived_ns`` is the arrival time on this host's monotonic clock.
        """
        stamp_ns = nanoseconds(stamp_s)
        if stamp_ns < self._stamp_ns:  # the stream's clock jumped back: reset the estimate
            self._before_ns = self._smallest_ns = None
        self._stamp_ns = stamp_ns
        offset_ns = arrived_ns - stamp_ns
        if self._smallest_ns is None:
            self._smallest_ns, self._begun_ns = offset_ns, arrived_ns
        elif arrived_ns - self._begun_ns > self._window_ns:
            self._before_ns, self._smallest_ns, self._begun_ns = self._smallest_ns, offset_ns, arrived_ns
        self._smallest_ns = min(self._smallest_ns, offset_ns)
        return stamp_ns + min(self._smallest_ns, self._before_ns if self._before_ns is not None else offset_ns)
