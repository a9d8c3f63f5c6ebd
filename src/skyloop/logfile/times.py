"""When a recorded sample was known to the proxy, on the proxy's own clock: the time axis of a flight.

Those times are in the samples themselves. The times of the file are the recorder's, and those of a file that recorded a
replay in step with its application are unrelated to the flight.
"""

from __future__ import annotations

from typing import Any, Final

from skyloop.clock import NS_PER_S
from skyloop.messages import Annotation, Applied, Event, Feedback, LogEntry

_BACK_NS: Final = 10 * NS_PER_S  #: a sample's time is ignored if it is farther before the newest one than this,
_AHEAD_NS: Final = 3600 * NS_PER_S  #: or farther ahead of it


def reported_ns(value: Any) -> int | None:
    """Return when the proxy received or published a sample; None for one without a time."""
    if isinstance(value, Feedback):
        return value.published_ns or value.captured_ns
    if isinstance(value, Applied):
        return value.applied_ns
    if isinstance(value, Event | LogEntry):
        return value.at_ns
    if isinstance(value, Annotation):
        return value.captured_ns
    made_ns = getattr(value, "made_ns", None)  # of a result's record
    if made_ns is not None:
        return int(made_ns)
    header = getattr(value, "header", None)  # of a frame's record or picture
    return None if header is None else int(header.published_ns)


class Course:
    """The time along a recording, sample by sample: it never runs backwards, and ignores a single wrong time.

    Attributes:
        first_ns: Time of the first sample that has one.
        newest_ns: Time of the newest sample.
    """

    def __init__(self) -> None:
        """Start before the first sample."""
        self.first_ns: int | None = None
        self.newest_ns = 0
        self._doubted_ns: int | None = None  # far ahead: accepted if the next such one agrees, as after a long pause

    def follow(self, value: Any) -> int:
        """Return the time of the next sample, in the order of the file."""
        own_ns = reported_ns(value)
        if own_ns is None:
            return self.newest_ns
        if self.first_ns is None:
            self.first_ns = self.newest_ns = own_ns
        elif -_BACK_NS < own_ns - self.newest_ns < _AHEAD_NS:
            self.newest_ns = max(self.newest_ns, own_ns)
        elif own_ns > self.newest_ns:
            agree = self._doubted_ns is not None and abs(own_ns - self._doubted_ns) < _BACK_NS
            self.newest_ns = own_ns if agree else self.newest_ns
            self._doubted_ns = own_ns
        return self.newest_ns
