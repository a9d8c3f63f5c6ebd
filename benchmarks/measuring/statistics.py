"""Distributions of delays."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np

SMALL_SHARE = 0.01  #: fraction of the period; the paper counts the delays below it


class Summary(msgspec.Struct, frozen=True):
    """A distribution of delays of samples sent periodically."""

    samples: int
    lost: int  #: sent but never received
    period_ms: float
    mean_us: float
    minimum_us: float
    maximum_us: float
    median_us: float
    p99_us: float
    p999_us: float
    under_1_percent: float  #: fraction of the samples that took less than 1 % of the period, 0 to 1

    @property
    def mean_of_period(self) -> float:
        """The mean as a fraction of the period."""
        return self.mean_us / 1e3 / self.period_ms


def summarize(delays_ns: Sequence[float], *, sent: int, period_s: float) -> Summary:
    """Return all figures of the delays of one channel.

    Args:
        delays_ns: The delays of the samples that arrived [ns].
        sent: Number of samples sent.
        period_s: The channel's period [s].

    Raises:
        ValueError: No sample arrived.
    """
    values = _microseconds(delays_ns)
    median, p99, p999 = (float(value) for value in np.percentile(values, [50.0, 99.0, 99.9]))
    return Summary(
        samples=len(delays_ns),
        lost=max(0, sent - len(delays_ns)),
        period_ms=period_s * 1e3,
        mean_us=float(values.mean()),
        minimum_us=float(values.min()),
        maximum_us=float(values.max()),
        median_us=median,
        p99_us=p99,
        p999_us=p999,
        under_1_percent=float((values < SMALL_SHARE * period_s * 1e6).mean()),
    )


def _microseconds(delays_ns: Sequence[float]) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    if not delays_ns:
        raise ValueError("not one sample arrived")
    values: np.ndarray[tuple[int], np.dtype[np.float64]] = np.asarray(delays_ns, np.float64) / 1e3
    return values
