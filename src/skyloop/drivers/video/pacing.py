"""When a recorded picture is due. Pure."""

from __future__ import annotations

from typing import Final

from skyloop.clock import nanoseconds
from skyloop.drivers.live_clock import LiveClock

__all__ = ["FilePacer", "LiveClock"]

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
