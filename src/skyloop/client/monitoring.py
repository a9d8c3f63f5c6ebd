"""Evaluate a connection from the arrival times of packets: its link, its clock offset and its statistics. Pure."""

from __future__ import annotations

from array import array
from collections import deque
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import nanoseconds
from skyloop.messages import LinkState

#: Maximum relative drift between two clocks. Quartz is accurate to 50 ppm, time services correct its rate by up to the
#: same amount, and the two clocks may deviate in opposite directions.
MAX_DRIFT: Final = 200e-6
DEPTH: Final = 1024  #: number of samples stored per channel, a power of two


@dataclass(frozen=True, slots=True)
class Thresholds:
    """Thresholds at which a link counts as degraded or lost."""

    late_s: float = 0.3  #: time without feedback after which the link counts as degraded
    silent_s: float = 1.0  #: time without any packet after which the link is reconnected
    missing_share: float = 0.1  #: fraction of missing or malformed samples in a window that degrades the link
    window_s: float = 1.0
    malformed: int = 5  #: number of malformed packets in a window after which the link is reconnected


@dataclass(frozen=True, slots=True)
class Verdict:
    """The monitor's assessment of the packets received so far."""

    state: LinkState
    reason: str
    restart: bool = False  #: whether to close the connection and establish a new one


_Counts = tuple[int, int, int]  #: at_ns, received, missing: a time, and the totals at that time

#: Maximum gap tolerated because of a low feedback rate [s]; at lower rates, pings check the link.
MAX_PATIENCE_S: Final = 2.0
WINDOW_PERIODS: Final = 10.0  #: minimum window for the missing fraction [feedback periods]


class LinkMonitor:
    """Monitors one connection. :meth:`verdict` does the work; the other methods only set a few attributes.

    Samples are numbered consecutively. A gap counts as lost samples, minus those the proxy skipped to lower the rate.
    """

    def __init__(self, thresholds: Thresholds, now_ns: int) -> None:
        self._limits = thresholds
        self.late_ns = self._feedback_late_ns = nanoseconds(thresholds.late_s)  #: time without data before a ping
        self._silent_ns = nanoseconds(thresholds.silent_s)
        self._window_ns = self._malformed_window_ns = nanoseconds(thresholds.window_s)
        self._no_gaps_ns = 0  # gaps before this time may be due to a changed request
        self.received_ns = now_ns  #: when the last valid packet arrived
        self.feedback_ns = 0  #: when feedback last arrived; 0 if never
        self.received = 0  #: number of feedback samples received
        self.missing = 0  #: number of samples missing, inferred from gaps in their sequence numbers
        self.malformed_count = 0
        self._last_seq: int | None = None
        self._past: deque[_Counts] = deque([(now_ns, 0, 0)])
        self._past_malformed: deque[tuple[int, int]] = deque([(now_ns, 0)])

    def excuse(self, silence_s: float) -> None:
        """Increase the time without data before the link counts as lost [s], for networks that pause."""
        self._limits = replace(self._limits, silent_s=self._limits.silent_s + silence_s)
        self._silent_ns += nanoseconds(silence_s)

    def expect(self, period_s: float, now_ns: int) -> None:
        """Set the expected time between two feedback samples [s]; 0 if the proxy sends all samples."""
        limits, patience_s = self._limits, min(period_s, MAX_PATIENCE_S)
        # A change of rate loses no samples, but it leaves a gap in the numbers, and the first new sample takes a while.
        self._no_gaps_ns = now_ns + nanoseconds(limits.window_s)
        self.received_ns = max(self.received_ns, now_ns)
        if self.feedback_ns:
            self.feedback_ns = max(self.feedback_ns, now_ns)
        self._feedback_late_ns = nanoseconds(limits.late_s + period_s)
        self.late_ns = nanoseconds(limits.late_s + patience_s)
        self._silent_ns = nanoseconds(limits.silent_s + patience_s)
        self._window_ns = nanoseconds(max(limits.window_s, WINDOW_PERIODS * patience_s))

    def feedback(self, seq: int, now_ns: int, skipped: int = 0) -> bool:
        """Record a feedback sample; ``skipped`` is the number of samples that the proxy skipped before it.

        Returns False if the sample is a duplicate or arrived after a newer one.
        """
        self.received_ns = now_ns
        last = self._last_seq
        if last is not None:
            if seq <= last:
                return False
            gap = seq - last - 1
            if gap > skipped and now_ns >= self._no_gaps_ns:  # the proxy also skipped samples before each lost one
                self.missing += -((skipped - gap) // (skipped + 1))
        self._last_seq = seq
        self.feedback_ns = now_ns
        self.received += 1
        return True

    def malformed(self) -> None:
        """Record a packet that could not be decoded."""
        self.malformed_count += 1

    def verdict(self, now_ns: int) -> Verdict:
        """Return the current state and its reason. Call this about twenty times a second."""
        received, missing, malformed = self._window(now_ns)
        silent_ns = now_ns - self.received_ns
        if silent_ns > self._silent_ns:
            return Verdict(LinkState.LOST, f"no data for {silent_ns / 1e9:.1f} s", restart=True)
        if malformed >= self._limits.malformed:
            return Verdict(LinkState.LOST, f"{malformed} malformed packets within a second", restart=True)
        if not self.feedback_ns:
            return Verdict(LinkState.CONNECTING, "no feedback yet")
        late_ns = now_ns - self.feedback_ns
        if late_ns > self._feedback_late_ns:
            return Verdict(LinkState.DEGRADED, f"no feedback for {late_ns / 1e9:.1f} s")
        bad = missing + malformed
        if bad > self._limits.missing_share * (received + bad):
            return Verdict(LinkState.DEGRADED, f"{bad} of {received + bad} samples missing or malformed")
        return Verdict(LinkState.UP, "")

    def _window(self, now_ns: int) -> tuple[int, int, int]:
        """Return how many samples were received, missing and malformed within the window."""
        past, past_malformed = self._past, self._past_malformed
        past.append((now_ns, self.received, self.missing))
        while len(past) > 2 and past[1][0] <= now_ns - self._window_ns:
            past.popleft()
        past_malformed.append((now_ns, self.malformed_count))
        while len(past_malformed) > 2 and past_malformed[1][0] <= now_ns - self._malformed_window_ns:
            past_malformed.popleft()
        _, received, missing = past[0]
        return self.received - received, self.missing - missing, self.malformed_count - past_malformed[0][1]


class StallWatch:
    """Detects that one channel has stalled while others still deliver, and should be resubscribed.

    If all channels paused, the measurement starts again, because this channel may be the last to resume.
    """

    def __init__(self, patience_s: float, now_ns: int) -> None:
        """Start watching a channel, which counts as stalled after a silence of ``patience_s``."""
        self._patience_ns = nanoseconds(patience_s)
        self.received_ns = now_ns  #: time at which this channel last delivered
        self._asked_ns = now_ns
        self._flow_ns = now_ns  # time at which the others last resumed delivering

    def stalled(self, others_flow: bool, now_ns: int) -> bool:
        """Return whether to resubscribe now; returns True at most once every ``patience_s``."""
        if not others_flow:
            self._flow_ns = now_ns
        if now_ns - max(self.received_ns, self._asked_ns, self._flow_ns) <= self._patience_ns:
            return False
        self._asked_ns = now_ns
        return True


@dataclass(frozen=True, slots=True)
class Offset:
    """The proxy's clock minus this process's clock, and the maximum error of this difference [ns]."""

    ns: int = 0
    uncertainty_ns: int = 0


_Trip = tuple[int, int, int]  #: sent_ns, low_ns, high_ns: a time on our clock, and the bounds at that time


class OffsetEstimator:
    """Estimates the offset between two monotonic clocks from round trips.

    The proxy answered between the times of sending and receiving, which bounds the offset regardless of the delay in
    each direction (Cristian, "Probabilistic clock synchronization", 1989). The bounds from a round trip widen over time
    by the possible drift of the clocks, and the true offset lies within the bounds of all round trips (Marzullo and
    Owicki, "Maintaining the time in a distributed system", 1983).
    """

    def __init__(self, depth: int = 16, max_drift: float = MAX_DRIFT) -> None:
        """Start with an offset of 0; ``max_drift`` is the maximum relative difference between the clocks' rates."""
        self._trips: deque[_Trip] = deque(maxlen=depth)
        self._max_drift = max_drift

    def __len__(self) -> int:
        return len(self._trips)

    def add(self, sent_ns: int, theirs_ns: int, received_ns: int) -> Offset:
        """Add a round trip that was answered at ``theirs_ns`` on the proxy's clock; return the estimate at its end."""
        received_ns = max(sent_ns, received_ns)
        # Both clocks are read in whole nanoseconds, so each bound may be off by 1.
        self._trips.append((sent_ns, theirs_ns - received_ns - 1, theirs_ns - sent_ns + 1))
        return self.at(received_ns)

    def at(self, now_ns: int) -> Offset:
        """Return the estimate at a time on this process's clock."""
        if not self._trips:
            return Offset()
        low_ns, high_ns = self._bounds(self._trips[-1], now_ns)
        for trip in reversed(self._trips):
            low, high = self._bounds(trip, now_ns)
            if max(low, low_ns) > min(high, high_ns):
                break  # a clock was set or drifts too fast: ignore older round trips
            low_ns, high_ns = max(low, low_ns), min(high, high_ns)
        return Offset((low_ns + high_ns) // 2, (high_ns - low_ns + 1) // 2)

    def _bounds(self, trip: _Trip, now_ns: int) -> tuple[int, int]:
        sent_ns, low_ns, high_ns = trip
        drift_ns = round(max(0, now_ns - sent_ns) * self._max_drift)
        return low_ns - drift_ns, high_ns + drift_ns


@dataclass(frozen=True, slots=True)
class Distribution:
    """Distribution of delays [s]."""

    median: float
    p99: float
    maximum: float
    mean: float
    count: int


@dataclass(frozen=True, slots=True)
class ChannelStats:
    """Statistics of one channel since the drone was connected. Unknown values are None."""

    count: int = 0  #: samples received; for commands, commands sent
    rate_hz: float = 0.0  #: samples per second, over the last two seconds
    lost: int = 0  #: missing samples, inferred from gaps in their numbers; for video, including those the proxy skipped
    #: Samples replaced by newer ones before a consumer took them; for commands, those that the transport rejected.
    dropped: int = 0
    malformed: int = 0  #: undecodable samples
    #: Time from publishing to receiving, over the last 1024 samples; for commands, the time from sending to applying.
    delay_s: Distribution | None = None
    age_s: float | None = None  #: time since the newest sample's capture
    uncertainty_s: float = 0.0  #: maximum error of both, due to comparing two hosts' clocks; 0 on one host


def distribution(delays_ns: NDArray[np.int64]) -> Distribution | None:
    """Return the distribution of delays [ns]; None if there are none."""
    if not delays_ns.size:
        return None
    seconds = np.sort(delays_ns) / 1e9
    last = seconds.size - 1
    return Distribution(
        median=float(np.median(seconds)),
        p99=float(seconds[round(0.99 * last)]),
        maximum=float(seconds[last]),
        mean=float(seconds.mean()),
        count=seconds.size,
    )


class ChannelCounter:
    """Counts the samples of one channel. One thread adds samples; any thread may read."""

    __slots__ = ("_arrivals", "_delays", "captured_ns", "count", "dropped", "last_seq", "lost", "malformed")

    def __init__(self) -> None:
        self._arrivals = array("q", bytes(8 * DEPTH))
        self._delays = array("q", bytes(8 * DEPTH))
        self.count = 0
        self.lost = 0
        self.dropped = 0
        self.malformed = 0
        self.captured_ns: int | None = None  #: capture time of the newest sample, on this process's clock
        self.last_seq: int | None = None

    def add(self, delay_ns: int, captured_ns: int, now_ns: int) -> None:
        """Count a sample, its delay, and its times of capture and reception on this process's clock."""
        place = self.count & (DEPTH - 1)
        self._arrivals[place] = now_ns
        self._delays[place] = delay_ns
        self.captured_ns = captured_ns
        self.count += 1

    def follow(self, seq: int) -> None:
        """Count the samples missing between the previous number and ``seq``."""
        last = self.last_seq
        if last is not None and seq > last + 1:
            self.lost += seq - last - 1
        self.last_seq = seq

    def stats(
        self, now_ns: int, *, lost: int = 0, dropped: int = 0, malformed: int = 0, ages: bool = True
    ) -> ChannelStats:
        """Return the statistics at ``now_ns``, adding the arguments to the numbers counted here.

        ``ages``: whether ``age_s`` is meaningful for this channel.
        """
        filled = min(self.count, DEPTH)
        arrivals = np.frombuffer(bytes(self._arrivals), np.int64)[:filled]
        delays = np.frombuffer(bytes(self._delays), np.int64)[:filled]
        return ChannelStats(
            count=self.count,
            rate_hz=_rate(arrivals, now_ns),
            lost=self.lost + lost,
            dropped=self.dropped + dropped,
            malformed=self.malformed + malformed,
            delay_s=distribution(delays),
            age_s=(now_ns - self.captured_ns) / 1e9 if ages and self.captured_ns is not None else None,
        )


def _rate(arrivals_ns: NDArray[np.int64], now_ns: int) -> float:
    """Return the samples per second between the first and the last sample of the last two seconds."""
    recent = arrivals_ns[arrivals_ns > now_ns - 2_000_000_000]
    if recent.size < 2:
        return 0.0
    return float((recent.size - 1) / max(1e-9, (recent.max() - recent.min()) / 1e9))
