"""Maps the stamps of a live stream's own clock to this host's clock. Pure."""

from __future__ import annotations

from skyloop.clock import nanoseconds


class LiveClock:
    """Maps a live stream's stamps to this host's clock, taking the smallest delay seen lately for no delay.

    A stream whose clock runs a little slower is followed through two windows, one of which is always complete. Times
    run neither backwards nor ahead.

    Args:
        window_s: Length of a window [s].
    """

    def __init__(self, window_s: float = 5.0) -> None:
        self._window_ns = nanoseconds(window_s)
        self._stamp_ns = 0
        self._before_ns: int | None = None  # smallest offset of the window before
        self._smallest_ns: int | None = None  # and of this one
        self._begun_ns = 0

    def captured_ns(self, stamp_s: float, arrived_ns: int) -> int:
        """Return when a picture was captured, never later than it arrived.

        Args:
            stamp_s: On the stream's clock [s]. A step back voids what was learned.
            arrived_ns: On this host's monotonic clock.
        """
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
