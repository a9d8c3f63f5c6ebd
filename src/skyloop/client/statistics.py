"""Statistics of the channels, cheap to gather: rings of the newest delays, evaluated when somebody looks."""

from __future__ import annotations

from array import array
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

DEPTH = 1024  #: samples kept of each channel, a power of two


@dataclass(frozen=True, slots=True)
class Distribution:
    """Of delays, in seconds."""

    median: float
    p99: float
    maximum: float
    mean: float
    count: int


@dataclass(frozen=True, slots=True)
class ChannelStats:
    """One channel since the drone was connected.

    ``count``: samples received (sent, for commands); ``rate_hz``: over the last two seconds; ``lost``: missing by the
    gaps in their numbers (for video this includes what the proxy left out); ``dropped``: pushed out by newer ones
    before their consumer took them (commands: could not be handed to the link); ``malformed``: not to be understood.
    ``delay_s``: from publishing (sending, for commands) to receiving, of the last 1024; ``age_s``: from the newest
    sample's capture until now. None where nothing is known. ``uncertainty_s``: how wrong both may be because two
    computers' clocks had to be compared; 0 on one host.
    """

    count: int = 0
    rate_hz: float = 0.0
    lost: int = 0
    dropped: int = 0
    malformed: int = 0
    delay_s: Distribution | None = None
    age_s: float | None = None
    uncertainty_s: float = 0.0


def distribution(delays_ns: NDArray[np.int64]) -> Distribution | None:
    """Of delays in ns; None for none."""
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
    """Counts one channel. One thread adds; any thread may look."""

    __slots__ = ("_arrivals", "_delays", "captured_ns", "count", "dropped", "last_seq", "lost", "malformed")

    def __init__(self) -> None:
        self._arrivals = array("q", bytes(8 * DEPTH))
        self._delays = array("q", bytes(8 * DEPTH))
        self.count = 0
        self.lost = 0
        self.dropped = 0
        self.malformed = 0
        self.captured_ns: int | None = None  #: of the newest, on our clock
        self.last_seq: int | None = None

    def add(self, delay_ns: int, captured_ns: int, now_ns: int) -> None:
        """A sample arrived now that was captured at ``captured_ns`` on our clock."""
        place = self.count & (DEPTH - 1)
        self._arrivals[place] = now_ns
        self._delays[place] = delay_ns
        self.captured_ns = captured_ns
        self.count += 1

    def follow(self, seq: int) -> None:
        """Count what is missing between the sample before and this one."""
        last = self.last_seq
        if last is not None and seq > last + 1:
            self.lost += seq - last - 1
        self.last_seq = seq

    def stats(self, now_ns: int, *, dropped: int = 0, malformed: int = 0, ages: bool = True) -> ChannelStats:
        """The figures now. ``dropped`` and ``malformed`` are added to what was counted here."""
        filled = min(self.count, DEPTH)
        arrivals = np.frombuffer(bytes(self._arrivals), np.int64)[:filled]
        delays = np.frombuffer(bytes(self._delays), np.int64)[:filled]
        return ChannelStats(
            count=self.count,
            rate_hz=_rate(arrivals, now_ns),
            lost=self.lost,
            dropped=self.dropped + dropped,
            malformed=self.malformed + malformed,
            delay_s=distribution(delays),
            age_s=(now_ns - self.captured_ns) / 1e9 if ages and self.captured_ns is not None else None,
        )


def _rate(arrivals_ns: NDArray[np.int64], now_ns: int) -> float:
    """Samples per second over the last two seconds, or over the time since the first if that is shorter."""
    recent = arrivals_ns[arrivals_ns > now_ns - 2_000_000_000]
    if recent.size < 2:
        return 0.0
    return float((recent.size - 1) / max(1e-9, (recent.max() - recent.min()) / 1e9))
