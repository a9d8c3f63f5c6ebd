"""The proxy's clock as seen from here. Pure."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Final

#: How fast two clocks may run apart: quartz is good to 50 ppm, and time services correct its rate by as much again.
MAX_DRIFT: Final = 200e-6


@dataclass(frozen=True, slots=True)
class Offset:
    """The proxy's clock less ours, and how wrong that may be, both in ns."""

    ns: int = 0
    uncertainty_ns: int = 0


@dataclass(frozen=True, slots=True)
class _Trip:
    sent_ns: int  # on our clock; since then the offset has moved by the drift at most
    low_ns: int
    high_ns: int


class OffsetEstimator:
    """Estimates the offset between two monotonic clocks from round trips.

    The answer was written between sending and receiving, which bounds the offset whatever the two ways took (Cristian,
    "Probabilistic clock synchronization", 1989). The bounds of a trip grow apart with time by what the clocks may
    drift, and the truth lies within the bounds of all trips (Marzullo and Owicki, "Maintaining the time in a
    distributed system", 1983).
    """

    def __init__(self, depth: int = 16, max_drift: float = MAX_DRIFT) -> None:
        self._trips: deque[_Trip] = deque(maxlen=depth)
        self._max_drift = max_drift

    def __len__(self) -> int:
        return len(self._trips)

    def add(self, sent_ns: int, theirs_ns: int, received_ns: int) -> Offset:
        """A round trip: sent and received on our clock, answered at ``theirs_ns`` on the other."""
        received_ns = max(sent_ns, received_ns)
        self._trips.append(_Trip(sent_ns, theirs_ns - received_ns - 1, theirs_ns - sent_ns + 1))
        return self.at(received_ns)

    def at(self, now_ns: int) -> Offset:
        """The estimate at a time on our clock."""
        if not self._trips:
            return Offset()
        low_ns, high_ns = self._bounds(self._trips[-1], now_ns)
        for trip in reversed(self._trips):
            low, high = self._bounds(trip, now_ns)
            if max(low, low_ns) > min(high, high_ns):
                break  # a clock was set, or drifts faster than any should: what is older counts no longer
            low_ns, high_ns = max(low, low_ns), min(high, high_ns)
        return Offset((low_ns + high_ns) // 2, (high_ns - low_ns + 1) // 2)

    def _bounds(self, trip: _Trip, now_ns: int) -> tuple[int, int]:
        drift_ns = round(max(0, now_ns - trip.sent_ns) * self._max_drift)
        return trip.low_ns - drift_ns, trip.high_ns + drift_ns
