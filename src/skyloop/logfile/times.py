"""When a recorded sample was known to the proxy, on the proxy's own clock: the time along which flights are looked at.

Those times stand in the samples themselves. The times of the file are the recorder's, and those of one that wrote down
a replay in step with its application say nothing about the flight.
"""

from __future__ import annotations

from typing import Any, Final

from skyloop.clock import NS_PER_S
from skyloop.messages import Annotation, Applied, Event, Feedback, LogEntry

_BACK_NS: Final = 10 * NS_PER_S  #: a sample's time is not believed if it lies farther before the newest one than this
_AHEAD_NS: Final = 3600 * NS_PER_S  #: or farther ahead of it


def told_ns(value: Any) -> int | None:
    """When the proxy knew of a sample, told, or published it; None for one that does not say."""
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
    """The time along a recording, sample by sample: never backwards, and not led astray by a single wrong time."""

    def __init__(self) -> None:
        self.first_ns: int | None = None
        self.newest_ns = 0
        self._doubted_ns: int | None = None  # far ahead: believed if the next such one agrees, as after a long pause

    def follow(self, value: Any) -> int:
        """The time of the next sample, in the order of the file."""
        own_ns = told_ns(value)
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
