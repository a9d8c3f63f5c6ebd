"""How much of an encoded stream a path carries: judged by what a subscriber acknowledges, the time passed as argument.

Delay comes first. Each acknowledgement gives a round trip, and how much was delivered meanwhile (as in Cardwell et al.,
"BBR: Congestion-Based Congestion Control", ACM Queue 14(5), 2016). What the round trip takes above the shortest of
late is taken for waiting in the path: while that is long the rate falls below what was delivered, and otherwise it
grows. No picture is begun while more is under way than the path delivers in :data:`MOST_WAIT_S`, so that a path that
stalls holds a few pictures and not seconds of them, and nothing has to be thrown away after it was encoded.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Final

from skyloop.clock import nanoseconds, seconds

LEAST_KBIT_S: Final = 60
START_KBIT_S: Final = 300
GOOD_WAIT_S: Final = 0.03  #: waiting in the path below which the rate grows …
LONG_WAIT_S: Final = 0.06  #: … and above which it falls
MOST_WAIT_S: Final = 0.08  #: as much is under way, beside what the shortest round trip holds
GROWTH_1_S: Final = 0.5  #: of the rate, each second …
SEARCH_1_S: Final = 2.0  #: … and from the start, or an outage, up to the first long wait
STANDING_S: Final = 0.1  #: the shortest wait within so long is judged: only a queue that stays is ours
LOST_S: Final = 1.0  #: what is not acknowledged for so long is taken for lost
SHORTEST_S: Final = 10.0  #: how long a shortest round trip counts
_MEAN_S: Final = 0.5  # time over which the delivery is averaged


@dataclass(slots=True)
class _Sent:
    seq: int
    size: int
    sent_ns: int
    delivered: int  # bytes that were delivered when it was sent …
    delivered_ns: int  # … and when the last of them was


class StreamRate:
    """The rate of one stream to one subscriber. Not thread-safe.

    Args:
        most_kbit_s: The highest rate [kbit/s].
        now_ns: The present time.
    """

    def __init__(self, most_kbit_s: int, now_ns: int) -> None:
        self.kbit_s = float(min(START_KBIT_S, most_kbit_s))  #: the present rate
        self.wait_s = 0.0  #: how long the newest acknowledged picture waited in the path [s]
        self.lost = 0  #: pictures that were never acknowledged
        self._most_kbit_s = most_kbit_s
        self._growth_1_s = SEARCH_1_S
        self._under_way: deque[_Sent] = deque()
        self._bytes = 0  # of these
        self._delivered = 0
        self._delivered_ns = now_ns
        self._capacity_kbit_s = self.kbit_s  # as delivered, averaged
        self._shortest: deque[tuple[int, int]] = deque()  # round trips [ns] and when, each longer than those before it
        self._changed_ns = now_ns
        self._waits: deque[tuple[float, int]] = deque()  # [s], and when

    def may_send(self, now_ns: int) -> bool:
        """Return whether another picture may be begun now."""
        while self._under_way and now_ns - self._under_way[0].sent_ns > nanoseconds(LOST_S):
            self._bytes -= self._under_way.popleft().size
            self.lost += 1
            self.kbit_s = max(LEAST_KBIT_S, self.kbit_s / 2)
            self._growth_1_s = SEARCH_1_S
            self._capacity_kbit_s = min(self._capacity_kbit_s, self.kbit_s)
        if not self._under_way:
            return True
        least_ns = self._least_ns()
        if now_ns - self._under_way[0].sent_ns >= least_ns + nanoseconds(MOST_WAIT_S):
            return False
        most_kbit = min(self.kbit_s, self._capacity_kbit_s) * (seconds(least_ns) + MOST_WAIT_S)
        return len(self._under_way) < 2 or self._bytes * 8e-3 <= most_kbit

    def sent(self, seq: int, size: int, now_ns: int) -> None:
        """Note a picture.

        Args:
            seq: Its number, higher than those before.
            size: Its bytes.
            now_ns: When it was handed to the transport.
        """
        if not self._under_way:
            self._delivered_ns = now_ns  # the path had nothing to do until now
        self._under_way.append(_Sent(seq, size, now_ns, self._delivered, self._delivered_ns))
        self._bytes += size

    def acknowledged(self, seq: int, now_ns: int) -> None:
        """Note that the subscriber has a picture.

        Args:
            seq: Its number.
            now_ns: When its acknowledgement came.
        """
        newest = None
        while self._under_way and self._under_way[0].seq <= seq:
            newest = self._under_way.popleft()
            self._bytes -= newest.size
            self._delivered += newest.size
            if newest.seq < seq:
                self.lost += 1
        if newest is None or newest.seq != seq:
            return
        self._delivered_ns = now_ns
        trip_ns = now_ns - newest.sent_ns
        self._add_trip(trip_ns, now_ns)
        waits = self._waits
        waits.append((seconds(trip_ns - self._least_ns()), now_ns))
        while now_ns - waits[0][1] > nanoseconds(STANDING_S):
            waits.popleft()
        self.wait_s = min(wait_s for wait_s, _ in waits)
        passed_s = max(seconds(now_ns - newest.delivered_ns), 0.001)
        delivered_kbit_s = (self._delivered - newest.delivered) * 8e-3 / passed_s
        step_s = min(seconds(now_ns - self._changed_ns), 0.2)
        self._changed_ns = now_ns
        share = min(1.0, step_s / _MEAN_S)
        if self.wait_s > GOOD_WAIT_S:  # the path was busy all the time: what came is what it carries
            self._capacity_kbit_s += (delivered_kbit_s - self._capacity_kbit_s) * max(share, 0.25)
        else:
            self._capacity_kbit_s = max(self._capacity_kbit_s, delivered_kbit_s, self.kbit_s)
        if self.wait_s > LONG_WAIT_S:
            self.kbit_s = min(self.kbit_s, 0.85 * self._capacity_kbit_s)
            waits.clear()  # and look again
            self._growth_1_s = GROWTH_1_S
        elif self.wait_s < GOOD_WAIT_S:
            self.kbit_s *= 1.0 + self._growth_1_s * step_s
        self.kbit_s = min(max(self.kbit_s, LEAST_KBIT_S), self._most_kbit_s)

    def _add_trip(self, trip_ns: int, now_ns: int) -> None:
        while self._shortest and self._shortest[-1][0] >= trip_ns:
            self._shortest.pop()
        self._shortest.append((trip_ns, now_ns))
        while now_ns - self._shortest[0][1] > nanoseconds(SHORTEST_S):
            self._shortest.popleft()

    def _least_ns(self) -> int:
        return self._shortest[0][0] if self._shortest else nanoseconds(0.1)


#: What a picture is made smaller by, and the share of the pictures that is sent, from the best on: below the rate at
#: which these make good pictures, the next are taken.
_LADDER: Final = ((1.0, 1.0), (0.75, 1.0), (0.5, 1.0), (0.5, 0.5), (0.25, 0.5))
ENOUGH_BITS: Final = 0.05  #: of the rate, for a pixel that is sent: with less, blocks show


def picture_form(kbit_s: float, pixels_1_s: float) -> tuple[float, float]:
    """Choose the size of the pictures and how many are sent, for a rate.

    Args:
        kbit_s: The rate [kbit/s].
        pixels_1_s: Pixels that the camera gives in a second.

    Returns:
        The factor for width and height, and the share of the pictures.
    """
    for scale, share in _LADDER:
        if kbit_s * 1000.0 >= ENOUGH_BITS * pixels_1_s * scale**2 * share:
            return scale, share
    return _LADDER[-1]
