"""Estimate the stream rate that a path can carry, based on a subscriber's acknowledgements. Pure: time is an argument.

Low delay has priority. The part of a frame's round trip that exceeds the shortest recent round trip counts as waiting
in the path. If there is a standing queue, the rate falls below the delivery rate (as in Cardwell et al., "BBR:
Congestion-Based Congestion Control", ACM Queue 14(5), 2016). A mobile network may carry ten times as much in one tenth
of a second as in the next. When the rate is close to the network's average, frames are therefore often late. Each late
frame also reduces the rate, which then grows so slowly that few are late. No frame is started while more is in flight
than the path delivers in :data:`MOST_WAIT_S`. A stalled path therefore holds a few frames rather than seconds of them,
and no encoded frame has to be dropped. While the path is stalled, single frames are sent at increasing intervals,
because anything queued delays the first fresh frame, which is sent as soon as an acknowledgement arrives.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Final

from skyloop.clock import nanoseconds, seconds

LEAST_KBIT_S: Final = 60  #: the minimum rate
#: The initial rate. Isolated late frames do not reduce the rate below it: the path is idle for most of the wait, so a
#: lower rate would hardly help.
START_KBIT_S: Final = 300
STANDING_S: Final = 0.25  #: the shortest wait within this time is the wait in the standing queue
LONG_WAIT_S: Final = 0.06  #: the rate falls if the wait in the standing queue is longer than this
FALL: Final = 0.85  #: fraction of the delivery rate to which the rate then falls
GOOD_WAIT_S: Final = 0.03  #: the rate grows if the wait in the standing queue is shorter than this
LATE_S: Final = 0.1  #: a single frame that has waited this long is late
LATE_FALL: Final = 0.7  #: factor for the rate after a late frame
LATE_EVERY_S: Final = 0.15  #: all late frames within this time reduce the rate only once
GROWTH_1_S: Final = 0.1  #: growth of the rate per second
SEARCH_1_S: Final = 2.0  #: growth per second below the initial rate, or while no frame has been late
MOST_WAIT_S: Final = 0.08  #: maximum delivery time of the frames in flight, beyond the shortest round trip
SILENT_S: Final = 0.3  #: a path that carries nothing for this long has stalled (the rate is not the cause)
SILENT_FALL: Final = 0.5  #: factor for the rate after a stall, because the path's rate is then uncertain
PROBE_S: Final = 0.15  #: interval between frames while frames wait in the path
PROBES_S: Final = 0.1  #: no frame is sent if more is in flight than the rate delivers in this time
SELDOM: Final = 1 / 3  #: during silence, the interval is this fraction of the silence so far
SELDOM_S: Final = 0.5  #: maximum interval between frames during silence
LOST_S: Final = 1.0  #: frames without an acknowledgement after this time count as lost
SHORTEST_S: Final = 10.0  #: maximum age of a shortest round trip
_FEWEST: Final = 3  # number of frames needed to judge a queue


@dataclass(slots=True)
class _Sent:
    seq: int
    size: int
    sent_ns: int


class StreamRate:
    """The rate of one stream to one subscriber, limited to ``most_kbit_s``. Not thread-safe."""

    def __init__(self, most_kbit_s: int, now_ns: int) -> None:
        self.kbit_s = float(min(START_KBIT_S, most_kbit_s))  #: the current rate
        self.wait_s = 0.0  #: minimum time that frames currently wait in the path [s]
        self.lost = 0  #: number of frames that were never acknowledged
        self._most_kbit_s = most_kbit_s
        self._searches = True  # whether no frame has been late yet
        self._silent = False  # whether the path has stalled
        self._quiet_ns = 0  # start of the period without an acknowledgement for frames in flight; 0: none are in flight
        self._returned_ns = now_ns - nanoseconds(SHORTEST_S)  # time at which the path resumed after a stall
        self._owed = False  # whether a frame must be sent immediately
        self._under_way: deque[_Sent] = deque()
        self._bytes = 0  # number of bytes in flight
        self._sent_ns = now_ns - nanoseconds(LOST_S)  # time at which the newest frame was sent
        self._delivered = 0
        self._shortest: deque[tuple[int, int]] = deque()  # round trips [ns] with their times, each longer than the last
        self._waits: deque[tuple[float, int, int]] = deque()  # waits [s], their times, and the amount delivered by then
        self._changed_ns = now_ns
        self._late_ns = now_ns - nanoseconds(LATE_EVERY_S)

    def may_send(self, now_ns: int) -> bool:
        """Return whether another frame may be started now."""
        under_way = self._under_way
        while under_way and now_ns - under_way[0].sent_ns > nanoseconds(LOST_S):
            self._bytes -= under_way.popleft().size
            self.lost += 1
            self._stands_still()
        if self._owed:
            return True
        passed_s, quiet_s = seconds(now_ns - self._sent_ns), seconds(now_ns - (self._quiet_ns or now_ns))
        seldom = passed_s >= min(max(PROBE_S, SELDOM * quiet_s), SELDOM_S)
        if not under_way:
            return seldom or not self._silent
        least_ns = self._least_ns()
        waits_s = seconds(now_ns - max(under_way[0].sent_ns, self._returned_ns) - least_ns)
        if waits_s >= MOST_WAIT_S:
            if waits_s >= SILENT_S:
                self._stands_still()
            return seldom and (quiet_s >= SILENT_S or self._holds(PROBES_S))
        return len(under_way) < 2 or self._holds(seconds(least_ns) + MOST_WAIT_S)

    def _holds(self, time_s: float) -> bool:
        """Return whether the rate delivers everything that is in flight within this time [s]."""
        return self._bytes * 8e-3 <= self.kbit_s * time_s  # 8e-3: from bytes to kbit

    def sent(self, seq: int, size: int, now_ns: int) -> None:
        """Record that a frame was handed to the transport. ``seq`` is higher than for all earlier frames."""
        self._under_way.append(_Sent(seq, size, now_ns))
        self._bytes += size
        self._quiet_ns = self._quiet_ns or now_ns
        self._sent_ns = now_ns
        self._owed = False

    def acknowledged(self, seq: int, now_ns: int) -> None:
        """Record that the subscriber has received a frame."""
        if self._quiet_ns and now_ns - self._quiet_ns >= nanoseconds(SILENT_S):  # more acknowledgements will follow
            self._returned_ns, self._owed = now_ns, True
        newest = None
        while self._under_way and self._under_way[0].seq <= seq:
            newest = self._under_way.popleft()
            self._bytes -= newest.size
            self._delivered += newest.size
            if newest.seq < seq:
                self.lost += 1
        self._quiet_ns = now_ns if self._under_way else 0
        if newest is None or newest.seq != seq:
            return
        trip_ns = now_ns - newest.sent_ns
        self._add_trip(trip_ns, now_ns)
        wait_s = seconds(trip_ns - self._least_ns())
        step_s = min(seconds(now_ns - self._changed_ns), 0.2)  # after a pause, the rate must not jump
        self._changed_ns = now_ns
        waits = self._waits
        if wait_s > SILENT_S:
            self._stands_still()
            waits.clear()
            self.wait_s = wait_s
            return
        self._silent = False
        waits.append((wait_s, now_ns, self._delivered))
        while len(waits) > _FEWEST and now_ns - waits[0][1] > nanoseconds(STANDING_S):
            waits.popleft()
        self.wait_s = min(wait for wait, _, _ in waits)
        if self.wait_s > LONG_WAIT_S and len(waits) >= _FEWEST:
            _, since_ns, before = waits[0]
            delivered_kbit_s = (self._delivered - before) * 8e-3 / max(seconds(now_ns - since_ns), 0.001)
            self._fall(FALL * delivered_kbit_s)
            waits.clear()  # start measuring again from here
        elif wait_s > LATE_S:
            if now_ns - self._late_ns >= nanoseconds(LATE_EVERY_S):
                self._late_ns = now_ns
                self._fall(max(LATE_FALL * self.kbit_s, START_KBIT_S))
        elif self.wait_s < GOOD_WAIT_S:
            growth_1_s = SEARCH_1_S if self._searches or self.kbit_s < START_KBIT_S else GROWTH_1_S
            self.kbit_s = min(self.kbit_s * (1.0 + growth_1_s * step_s), self._most_kbit_s)

    def forget(self) -> None:
        """Forget the frames in flight, because they will not be acknowledged."""
        self._under_way.clear()
        self._waits.clear()
        self._bytes = self._quiet_ns = 0
        self._silent = self._owed = False

    def _stands_still(self) -> None:
        if not self._silent:
            self._silent = True
            self._fall(SILENT_FALL * self.kbit_s)

    def _fall(self, kbit_s: float) -> None:
        """Reduce the rate, but not below the minimum."""
        self._searches = False
        self.kbit_s = min(self.kbit_s, max(kbit_s, LEAST_KBIT_S))

    def _add_trip(self, trip_ns: int, now_ns: int) -> None:
        while self._shortest and self._shortest[-1][0] >= trip_ns:
            self._shortest.pop()
        self._shortest.append((trip_ns, now_ns))
        while now_ns - self._shortest[0][1] > nanoseconds(SHORTEST_S):
            self._shortest.popleft()

    def _least_ns(self) -> int:
        return self._shortest[0][0] if self._shortest else nanoseconds(0.1)  # assumed until one is measured


#: Factors for the frame's size, and fractions of the frames to send, best first. If the rate is too low for good frames
#: with one entry, the next entry is used.
_LADDER: Final = ((1.0, 1.0), (0.75, 1.0), (0.5, 1.0), (0.5, 0.5), (0.25, 0.5))
ENOUGH_BITS: Final = 0.05  #: bits per sent pixel below which compression blocks become visible


def picture_form(kbit_s: float, pixels_1_s: float) -> tuple[float, float]:
    """Return the factor for width and height and the fraction of frames to send, for a given rate."""
    for scale, share in _LADDER:
        if kbit_s * 1000.0 >= ENOUGH_BITS * pixels_1_s * scale**2 * share:
            return scale, share
    return _LADDER[-1]
