"""When a recorded sample was known to the proxy, on the proxy's own clock: the time axis of a flight.

Those times are in the samples themselves. The times of the file are the recorder's, and those of a file that recorded a
replay in step with its application are unrelated to the flight.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Final

import msgspec

from skyloop.clock import NS_PER_S
from skyloop.messages import Annotation, Applied, Event, Feedback, LogEntry

_BACK_NS: Final = 10 * NS_PER_S  #: a sample's time is ignored if it is farther before the newest one than this,
_AHEAD_NS: Final = 3600 * NS_PER_S  #: or farther ahead of it


_TIMES: Final = ("captured_ns", "published_ns", "applied_ns", "sent_ns", "at_ns", "made_ns")


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


def shifted(value: Any, shift_ns: int) -> Any:
    """Return a sample with its times on a clock that is ahead of its own by ``shift_ns``."""
    names = [name for name in _TIMES if getattr(value, name, 0)]
    if names:
        return msgspec.structs.replace(value, **{name: getattr(value, name) + shift_ns for name in names})
    if (header := getattr(value, "header", None)) is not None:  # a frame's record
        return msgspec.structs.replace(value, header=shifted(header, shift_ns))
    record = getattr(value, "record", None)
    return value if record is None else replace(value, record=shifted(record, shift_ns))


class Course:
    """The time along a recording, sample by sample: it never runs backwards, and ignores a single wrong time.

    Where the clock of the proxy begins anew, because its computer has started again, time goes on from where it was, by
    as much as the recorder's clock does.

    Attributes:
        first_ns: Time of the first sample that has one.
        newest_ns: Time of the newest sample.
        shift_ns: What is added to the samples' own times now, since the proxy's clock began anew.
    """

    def __init__(self, shift_ns: int = 0) -> None:
        """Start before the first sample, or with the shift that is in force there."""
        self.first_ns: int | None = None
        self.newest_ns = 0
        self.shift_ns = shift_ns
        self._doubted_ns: int | None = None  # far off: accepted if the next such one agrees
        self._log_ns = 0  # of the newest sample

    def follow(self, value: Any, log_ns: int = 0) -> int:
        """Return the time of the next sample, in the order of the file.

        Args:
            value: The sample.
            log_ns: When it was recorded, on the recorder's clock; 0: not known.
        """
        own_ns = reported_ns(value)
        if own_ns is None:
            return self.newest_ns
        own_ns += self.shift_ns
        if self.first_ns is None:
            self.first_ns = self.newest_ns = own_ns
        elif -_BACK_NS < own_ns - self.newest_ns < _AHEAD_NS:
            self.newest_ns = max(self.newest_ns, own_ns)
            self._doubted_ns = None if isinstance(value, Feedback) else self._doubted_ns
        elif own_ns > self.newest_ns or isinstance(value, Feedback):  # others' times may be those of applications
            agree = self._doubted_ns is not None and abs(own_ns - self._doubted_ns) < _BACK_NS
            self._doubted_ns = own_ns
            if agree and own_ns < self.newest_ns:
                passed_ns = min(max(0, log_ns - self._log_ns), _AHEAD_NS) if log_ns and self._log_ns else 0
                self.newest_ns += passed_ns
                self.shift_ns += self.newest_ns - own_ns
                self._doubted_ns = None
            elif agree:
                self.newest_ns = own_ns
            else:
                return self.newest_ns
        else:
            return self.newest_ns
        self._log_ns = log_ns
        return self.newest_ns
