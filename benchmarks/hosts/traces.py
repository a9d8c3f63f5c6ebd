"""The capacity of a mobile network over time: recorded, or synthesised from a seed."""

from __future__ import annotations

import math
import os
import random
from bisect import bisect_left, bisect_right
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from skyloop.errors import FileFormatError, UsageError

OPPORTUNITY: Final = 1500  #: bytes that may leave at each time of a trace
QUEUE: Final = 300_000  #: bytes queued in a modem before it drops more
SYNTHETIC: Final = "synthetic"
RECORDED: Final = ("ATT-LTE-driving-2016", "TMobile-LTE-short", "Verizon-LTE-short")
_MS: Final = 1_000_000
_FIXTURES: Final = Path(os.environ.get("SKYLOOP_FIXTURES") or Path(__file__).parents[3] / "shared" / "fixtures")
_MAX_LINES: Final = 2_000_000


@dataclass(frozen=True, slots=True)
class Trace:
    """When packets can leave. It is repeated after its end.

    Raises:
        UsageError: There are no times, or they are not in rising order.
    """

    name: str
    at_ms: tuple[int, ...]  #: at each, :data:`OPPORTUNITY` bytes may leave; unused ones are lost
    queue: int = QUEUE  #: size of the queue [bytes]
    begin_ns: int = 0  #: when the trace begins, on the monotonic clock

    def __post_init__(self) -> None:
        if not self.at_ms or self.at_ms[0] < 0 or self.at_ms[-1] <= 0:
            raise UsageError(f"the trace {self.name} has {len(self.at_ms)} times and needs one after its begin")
        if any(later < earlier for earlier, later in zip(self.at_ms, self.at_ms[1:], strict=False)):
            raise UsageError(f"the times of the trace {self.name} must not fall")

    @property
    def length_ms(self) -> int:
        """The time until it repeats."""
        return self.at_ms[-1]

    def due_ns(self, index: int) -> int:
        """Return the time of an opportunity; indices continue after the end."""
        turn, index = divmod(index, len(self.at_ms))
        return self.begin_ns + (turn * self.length_ms + self.at_ms[index]) * _MS

    def first_after(self, now_ns: int) -> int:
        """Return the index of the first opportunity at or after a time."""
        turn, ms = divmod(-(-(now_ns - self.begin_ns) // _MS), self.length_ms)
        if turn < 0:
            return 0
        return turn * len(self.at_ms) + bisect_left(self.at_ms, ms)

    def kbit(self, from_ms: float, to_ms: float) -> float:
        """Return the capacity in a part of the trace, excluding the end [kbit]."""
        return (bisect_left(self.at_ms, to_ms) - bisect_left(self.at_ms, from_ms)) * OPPORTUNITY * 8e-3

    def waits_ms(self, ms: float) -> float:
        """Return how long nothing has been able to leave, at a moment within the trace."""
        index = bisect_right(self.at_ms, ms)
        return ms - (self.at_ms[index - 1] if index else 0)


class Modem:
    """The queue before a path with a varying capacity: first in, first out, bounded.

    Args:
        trace: The capacity.
    """

    def __init__(self, trace: Trace) -> None:
        self.trace = trace
        self._next = 0  # the next opportunity …
        self._room = OPPORTUNITY  # … and its remaining bytes
        self._waiting: deque[tuple[int, int]] = deque()  # departure times and bytes
        self._bytes = 0

    def leaves_ns(self, size: int, now_ns: int) -> int | None:
        """Return when a packet that arrives now leaves; None if the queue is full and drops it."""
        while self._waiting and self._waiting[0][0] <= now_ns:
            self._bytes -= self._waiting.popleft()[1]
        if self._bytes + size > self.trace.queue:
            return None
        first = self.trace.first_after(now_ns)
        if first > self._next:
            self._next, self._room = first, OPPORTUNITY
        left = size
        while left > self._room:
            left -= self._room
            self._next, self._room = self._next + 1, OPPORTUNITY
        self._room -= left
        at_ns = max(self.trace.due_ns(self._next), now_ns)
        self._waiting.append((at_ns, size))
        self._bytes += size
        return at_ns


def recorded(name: str) -> Trace | None:
    """Return a recorded uplink; None if missing: beside the checkout or in ``SKYLOOP_FIXTURES``.

    Raises:
        FileFormatError: The file is not a trace.
    """
    file = _FIXTURES / "mobile-network" / f"{name}.up.120s"
    if not file.is_file():
        return None
    try:
        times = tuple(int(line) for line in file.read_text().split()[:_MAX_LINES])
        return Trace(name, times)
    except (ValueError, UsageError) as error:
        raise FileFormatError(f"{file} is not a trace with a time in ms on each line: {error}") from None


def synthetic(seed: int = 1, length_s: int = 120, kbit_s: float = 2200.0) -> Trace:
    """Synthesise a trace like that of a phone in a car: its rate wanders, and sometimes nothing passes.

    The logarithm of the rate follows an autoregressive process of one second (with a standard deviation of 0.7), and
    once in 12 s on average, nothing passes for 0.6 to 4 s, usually for a short time. This resembles the poorest of the
    three recorded traces, AT&T's: 1900 kbit/s on average, a tenth of the seconds below 300 kbit/s, and in two minutes
    eleven gaps of more than 250 ms.

    Args:
        seed: Determines everything.
        length_s: Length of the trace [s].
        kbit_s: Approximate average while something passes.
    """
    rng = random.Random(seed)
    level, budget, silent_ms, times = 0.0, 0.0, 0, []
    for ms in range(length_s * 1000):
        if ms % 100 == 0:
            level = level * math.exp(-0.1) + rng.gauss(0.0, 0.7 * math.sqrt(1 - math.exp(-0.2)))
            if silent_ms <= 0 and rng.random() < 0.1 / 12.0:
                silent_ms = min(4000, round(600 * rng.paretovariate(1.2)))
        if silent_ms > 0:
            silent_ms -= 1
            continue
        budget += kbit_s * math.exp(level - 0.25) * rng.expovariate(1.0) / (8 * OPPORTUNITY)
        while budget >= 1.0:
            budget -= 1.0
            times.append(ms)
    return Trace(SYNTHETIC, tuple(times))


def find(names: tuple[str, ...] = ()) -> list[Trace]:
    """Return the traces with these names or, without names, all recorded traces, or else the synthetic one.

    Raises:
        UsageError: No trace has this name.
    """
    found = []
    for name in names or RECORDED:
        trace = synthetic() if name == SYNTHETIC else recorded(name)
        if trace is not None:
            found.append(trace)
        elif names:
            raise UsageError(
                f"there is no trace {name!r}: known are {', '.join(RECORDED)} (in {_FIXTURES}) and {SYNTHETIC}"
            )
    return found or [synthetic()]
