"""The proxy's counters, by dotted name."""

from __future__ import annotations

from collections import defaultdict, deque
from typing import Final

from skyloop.clock import NS_PER_S

#: Command delays that the distribution is taken over: about a minute of one pilot at 32 Hz.
WINDOW: Final = 2000


class Counters:
    """Counts and the recent command delays. Each name is counted under one lock only, or by one thread."""

    def __init__(self) -> None:
        self.counts: defaultdict[str, int] = defaultdict(int)
        self.delays_ns: deque[int] = deque(maxlen=WINDOW)  #: sent to applied, of accepted commands

    def snapshot(self, **now: float) -> dict[str, float]:
        """All counters, the distribution of the command delay [s], and what the caller adds."""
        values: dict[str, float] = {name: float(count) for name, count in self.counts.copy().items()}
        values.update(now)
        delays = sorted(self.delays_ns.copy())
        if delays:
            values["commands.delay.median_s"] = delays[len(delays) // 2] / NS_PER_S
            values["commands.delay.p99_s"] = delays[int(0.99 * (len(delays) - 1))] / NS_PER_S
            values["commands.delay.max_s"] = delays[-1] / NS_PER_S
            values["commands.delay.mean_s"] = sum(delays) / len(delays) / NS_PER_S
            values["commands.delay.count"] = float(len(delays))
        return dict(sorted(values.items()))
