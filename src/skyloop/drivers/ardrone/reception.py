"""Navdata as they come: damage, order, gaps and time. Pure."""

from __future__ import annotations

from collections import Counter
from typing import Final

from skyloop.clock import nanoseconds
from skyloop.drivers.live_clock import LiveClock
from skyloop.errors import DecodeError
from skyloop.messages import Value
from skyloop.wire.ardrone.navdata import Navdata, decode
from skyloop.wire.ardrone.options import Time

RESTART_SILENCE_NS: Final = nanoseconds(0.2)  #: after it a lower sequence is a new count, and not a late datagram
RESTART_RUN: Final = 5  #: so many in a row, in order among themselves, are one as well
_MICROSECOND_BITS: Final = 21
_TIME_WRAP_S: Final = 1 << 11


class Reception:
    """Decodes navdata and keeps those that are whole and newer than the last.

    ``counts`` has ``received``, ``damaged`` (no navdata, or a wrong checksum), ``late`` (repeated or out of order),
    ``missed`` (gaps in the sequence), ``restarts`` of the sequence and ``unknown`` options.
    """

    def __init__(self) -> None:
        self.counts = Counter(dict.fromkeys(("received", "damaged", "late", "missed", "restarts", "unknown"), 0))
        self._sequence = 0
        self._accepted_ns = 0
        self._late_sequence = 0
        self._late_run = 0

    def receive(self, datagram: bytes, now_ns: int) -> Navdata | None:
        """The content of a datagram, or None if it is damaged or late. Never raises."""
        try:
            navdata = decode(datagram)
        except DecodeError:
            self.counts["damaged"] += 1
            return None
        if not self._is_new(navdata.sequence, now_ns):
            self.counts["late"] += 1
            return None
        self.counts["received"] += 1
        self.counts["unknown"] += len(navdata.unknown)
        return navdata

    def expect_restart(self) -> None:
        """The drone was silent or lost us: whatever comes next is the first."""
        self._accepted_ns = 0

    def telemetry(self) -> dict[str, Value]:
        """The counts under the names that feedback's native telemetry gives them."""
        return {f"navdata.{name}": count for name, count in self.counts.items()}

    def _is_new(self, sequence: int, now_ns: int) -> bool:
        if sequence > self._sequence:
            if self._sequence:
                self.counts["missed"] += sequence - self._sequence - 1
        elif self._begins_anew(sequence, now_ns):
            self.counts["restarts"] += 1
        else:
            return False
        self._sequence, self._accepted_ns, self._late_run = sequence, now_ns, 0
        return True

    def _begins_anew(self, sequence: int, now_ns: int) -> bool:
        if now_ns - self._accepted_ns >= RESTART_SILENCE_NS and sequence != self._sequence:
            return True
        self._late_run = self._late_run + 1 if sequence > self._late_sequence else 1
        self._late_sequence = sequence
        return self._late_run >= RESTART_RUN


class DroneClock:
    """When the drone was in the state that a datagram tells, on this host's clock.

    Without the option of its time that is when the datagram came; with it, its stamps are mapped by the smallest
    delay seen lately. Times never run backwards.
    """

    def __init__(self) -> None:
        self._live = LiveClock()
        self._stamp_s: float | None = None
        self._turns = 0
        self._captured_ns = 0

    def captured_ns(self, navdata: Navdata, arrived_ns: int) -> int:
        """Of a datagram that came at ``arrived_ns``."""
        time = navdata.get(Time)
        captured_ns = arrived_ns if time is None else self._live.captured_ns(self._unwrapped(time.time), arrived_ns)
        self._captured_ns = max(self._captured_ns, captured_ns)
        return self._captured_ns

    def _unwrapped(self, time: int) -> float:
        stamp_s = (time >> _MICROSECOND_BITS) + (time & ((1 << _MICROSECOND_BITS) - 1)) / 1e6
        before_s = self._stamp_s
        self._stamp_s = stamp_s
        if before_s is not None and stamp_s < before_s - _TIME_WRAP_S / 2:
            self._turns += 1
        return self._turns * _TIME_WRAP_S + stamp_s
