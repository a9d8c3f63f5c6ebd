"""Estimate of the proxy's clock from this process. Pure: the time is an argument."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Final

#: Largest relative drift: quartz is accurate to 50 ppm, and time services correct its rate by as much again; both
#: clocks may do so in opposite directions.
MAX_DRIFT: Final = 200e-6


@dataclass(frozen=True, slots=True)
class Offset:
    """The proxy's clock minus this process's clock, and the largest error of that, both in ns."""

    ns: int = 0
    uncertainty_ns: int = 0


@dataclass(frozen=True, slots=True)
class _Trip:
    sent_ns: int  # on our clock; since then the offset has changed by the drift at most
    low_ns: int
    high_ns: int


class OffsetEstimator:
    """Estimates the offset between two monotonic clocks from round trips.

    The answer was written between sending and receiving, which bounds the offset whatever each direction took
    (Cristian, "Probabilistic clock synchronization", 1989). The bounds of a round trip grow apart with time by what the
    clocks may drift, and the truth lies within the bounds of all round trips (Marzullo and Owicki, "Maintaining the
    time in a distributed system", 1983).
    """

    def __init__(self, depth: int = 16, max_drift: float = MAX_DRIFT) -> None:
        """Start without round trips, with an offset of 0.

        Args:
            depth: How many round trips are kept.
            max_drift: Largest relative difference in rate between the two clocks.
        """
        self._trips: deque[_Trip] = deque(maxlen=depth)
        self._max_drift = max_drift

    def __len__(self) -> int:
        return len(self._trips)

    def add(self, sent_ns: int, theirs_ns: int, received_ns: int) -> Offset:
        """Add a round trip, and return the estimate at its end.

        Args:
            sent_ns: When the request was sent, on this process's clock.
            theirs_ns: When it was answered, on the proxy's clock.
            received_ns: When the answer came, on this process's clock.
        """
        received_ns = max(sent_ns, received_ns)
        self._trips.append(_Trip(sent_ns, theirs_ns - received_ns - 1, theirs_ns - sent_ns + 1))
        return self.at(received_ns)

    def at(self, now_ns: int) -> Offset:
        """Return the estimate at a time on this process's clock."""
        if not self._trips:
            return Offset()
        low_ns, high_ns = self._bounds(self._trips[-1], now_ns)
        for trip in reversed(self._trips):
            low, high = self._bounds(trip, now_ns)
            if max(low, low_ns) > min(high, high_ns):
                break  # a clock was set, or drifts too fast: ignore older round trips
            low_ns, high_ns = max(low, low_ns), min(high, high_ns)
        return Offset((low_ns + high_ns) // 2, (high_ns - low_ns + 1) // 2)

    def _bounds(self, trip: _Trip, now_ns: int) -> tuple[int, int]:
        drift_ns = round(max(0, now_ns - trip.sent_ns) * self._max_drift)
        return trip.low_ns - drift_ns, trip.high_ns + drift_ns
