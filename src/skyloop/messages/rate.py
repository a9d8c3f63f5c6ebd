"""At most so many samples a second, by the times that they bear. Pure."""

from __future__ import annotations

import math
from typing import Final

from skyloop.clock import NS_PER_S

TOLERANCE: Final = 0.1  #: of a period: a sample that comes so much too early is in time


class RateLimiter:
    """Selects samples of one series so that on average no more than so many a second are left.

    It keeps state, so each series and each consumer needs its own.
    """

    def __init__(self, max_hz: float | None) -> None:
        """Start with the first sample in time.

        Args:
            max_hz: Most samples a second, above 0; None: all.
        """
        self.max_hz = math.inf if max_hz is None else max_hz
        self._due_ns: int | None = None

    @property
    def max_hz(self) -> float:
        """Most samples a second that are in time; infinity: all."""
        return NS_PER_S / self._period_ns if self._period_ns else math.inf

    @max_hz.setter
    def max_hz(self, max_hz: float) -> None:
        self._period_ns = round(NS_PER_S / max_hz)  # 0: every sample is in time

    def in_time(self, at_ns: int) -> bool:
        """Return whether a sample is to be kept. Call it once for each sample, in order.

        Args:
            at_ns: Its time, on any one clock.
        """
        period_ns, due_ns = self._period_ns, self._due_ns
        if not period_ns:
            return True
        # A time long before the last one is of another run of the source, and restarts the count.
        if due_ns is None or at_ns < due_ns - 2 * period_ns or at_ns >= due_ns + period_ns:
            self._due_ns = at_ns + period_ns
            return True
        if at_ns < due_ns - TOLERANCE * period_ns:
            return False
        self._due_ns = due_ns + period_ns
        return True
