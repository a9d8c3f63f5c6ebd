"""Statistics of channels: the newest delays in rings, evaluated when they are read."""

from __future__ import annotations

from array import array
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

DEPTH = 1024  #: samples kept of each channel, a power of two


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
    """Statistics of one channel since the drone was connected. None where nothing is known.

    Attributes:
        count: Samples received; for commands, sent.
        rate_hz: Samples a second, over the last two seconds.
        lost: Samples missing by the gaps in their numbers; for video including those that the proxy left out.
        dropped: Samples that newer ones pushed out before their consumer took them; for commands, those that could not
            be handed to the transport.
        malformed: Samples that could not be decoded.
        delay_s: From publishing to receiving, of the last 1024 samples; for commands, from sending to applying.
        age_s: From the newest sample's capture until now.
        uncertainty_s: Largest error of ``delay_s`` and ``age_s`` from comparing two hosts' clocks; 0 on one host.
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
    """Return the distribution of delays; None for none.

    Args:
        delays_ns: In ns, any length.
    """
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
    """Counts the samples of one channel. One thread adds; any thread may read."""

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
        """Count a sample.

        Args:
            delay_ns: Its delay.
            captured_ns: When it was captured, on this process's clock.
            now_ns: When it arrived.
        """
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
        """Return the statistics at ``now_ns``.

        Args:
            now_ns: On this process's clock.
            lost: Added to what was counted here.
            dropped: Added to what was counted here.
            malformed: Added to what was counted here.
            ages: Whether ``age_s`` is meaningful for this channel.
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
    """Samples per second over the last two seconds, or over the time since the first if that is shorter."""
    recent = arrivals_ns[arrivals_ns > now_ns - 2_000_000_000]
    if recent.size < 2:
        return 0.0
    return float((recent.size - 1) / max(1e-9, (recent.max() - recent.min()) / 1e9))
