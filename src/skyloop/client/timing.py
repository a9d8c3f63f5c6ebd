"""The proxy's clock as seen from here. Pure."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Offset:
    """The proxy's clock less ours, and how wrong that may be, both in ns."""

    ns: int = 0
    uncertainty_ns: int = 0


class OffsetEstimator:
    """Estimates the offset between two monotonic clocks from round trips.

    The answer was written between sending and receiving, so half a round trip bounds the error whatever the two
    ways took (Cristian, "Probabilistic clock synchronization", 1989); the shortest trip of the last ``depth`` counts.
    """

    def __init__(self, depth: int = 16) -> None:
        self._trips: deque[Offset] = deque(maxlen=depth)
        self.best = Offset()

    def add(self, sent_ns: int, theirs_ns: int, received_ns: int) -> Offset:
        """A round trip: sent and received on our clock, answered at ``theirs_ns`` on the other."""
        half_ns = max(0, received_ns - sent_ns) // 2
        self._trips.append(Offset(theirs_ns - sent_ns - half_ns, half_ns + 1))
        self.best = min(self._trips, key=lambda trip: trip.uncertainty_ns)
        return self.best
