"""When a recorded picture is due. Pure."""

from __future__ import annotations

from typing import Final

from skyloop.clock import nanoseconds

LATE_NS: Final = 250_000_000  #: further behind than this, the schedule starts anew instead of rushing to catch up
GAP_S: Final = 2.0  #: a longer step between two stamps, or one backwards, is a cut in the recording


class FilePacer:
    """Maps a recording's own time stamps to the times at which its pictures are shown.

    Times never go backwards. A stamp that jumps (a cut, a clock that was set) counts as one usual period.
    """

    def __init__(self, speed: float, period_s: float) -> None:
        self._speed = speed
        self._period_s = period_s
        self._stamp_s: float | None = None
        self._due_ns = 0

    def due_ns(self, stamp_s: float, now_ns: int) -> int:
        """When to show the picture of this stamp; ``now_ns`` is the time at which it was ready."""
        if self._stamp_s is None:
            self._due_ns = now_ns
        else:
            step_s = stamp_s - self._stamp_s
            if not 0.0 <= step_s <= GAP_S:
                step_s = self._period_s
            self._due_ns += nanoseconds(step_s / self._speed)
            if now_ns - self._due_ns > LATE_NS:
                self._due_ns = now_ns
        self._stamp_s = stamp_s
        return self._due_ns


class LiveClock:
    """Maps a live stream's stamps to this host's clock: the smallest delay seen lately is taken for no delay.

    A stream whose clock runs a little slower is followed through two windows of ``window_s``, one of which is always
    complete. Times run neither backwards nor ahead.
    """

    def __init__(self, window_s: float = 5.0) -> None:
        self._window_ns = nanoseconds(window_s)
        self._stamp_ns = 0
        self._before_ns: int | None = None  # smallest offset of the window before
        self._smallest_ns: int | None = None  # and of this one
        self._begun_ns = 0

    def captured_ns(self, stamp_s: float, arrived_ns: int) -> int:
        """When the picture of this stamp, which came at ``arrived_ns``, was taken; never later than that."""
        stamp_ns = nanoseconds(stamp_s)
        if stamp_ns < self._stamp_ns:  # the stream's clock was set back: what was learned is void
            self._before_ns = self._smallest_ns = None
        self._stamp_ns = stamp_ns
        offset_ns = arrived_ns - stamp_ns
        if self._smallest_ns is None:
            self._smallest_ns, self._begun_ns = offset_ns, arrived_ns
        elif arrived_ns - self._begun_ns > self._window_ns:
            self._before_ns, self._smallest_ns, self._begun_ns = self._smallest_ns, offset_ns, arrived_ns
        self._smallest_ns = min(self._smallest_ns, offset_ns)
        return stamp_ns + min(self._smallest_ns, self._before_ns if self._before_ns is not None else offset_ns)
