"""The drone's own clock, as navdata and the headers of its video have it. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

_NS_PER_US: Final = 1000
_NS_PER_MS: Final = 1_000_000
_US_PER_S: Final = 1_000_000
_SECOND_BITS: Final = 11
_MICROSECOND_BITS: Final = 21


@dataclass(frozen=True, slots=True)
class DroneClock:
    """Counts from when the drone was switched on. Arguments are times of this host's monotonic clock [ns]."""

    booted_ns: int

    def navdata_time(self, at_ns: int) -> int:
        """Return seconds in the upper 11 bits and microseconds in the lower 21: wraps after 2048 s."""
        s, us = divmod((at_ns - self.booted_ns) // _NS_PER_US, _US_PER_S)
        return s % (1 << _SECOND_BITS) << _MICROSECOND_BITS | us

    def milliseconds(self, at_ns: int) -> int:
        """Return milliseconds, as the video's headers have them."""
        return (at_ns - self.booted_ns) // _NS_PER_MS
