"""The impairments of a path, determined by a seed; time is an argument."""

from __future__ import annotations

import heapq
import random
from dataclasses import dataclass

from benchmarks.hosts.traces import Modem, Trace
from skyloop.clock import nanoseconds
from skyloop.errors import UsageError


@dataclass(frozen=True, slots=True)
class Impairments:
    """The effects of a path on packets, each way. ``loss`` and ``reorder`` are probabilities for each packet.

    Raises:
        UsageError: A value is out of range: probabilities 0 to 1, times 0 to 60 s.
    """

    loss: float = 0.0
    delay_s: float = 0.0
    jitter_s: float = 0.0  #: maximum of a uniform addition to the delay, which keeps the order
    reorder: float = 0.0  #: fraction of packets held back …
    reorder_s: float = 0.01  #: … for this much longer, so that later packets overtake them
    trace: Trace | None = None  #: capacity of the path: packets first wait for that, then for all of the above

    def __post_init__(self) -> None:
        for name in ("loss", "reorder"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise UsageError(f"{name} is {getattr(self, name)!r} and must be a probability between 0 and 1")
        for name in ("delay_s", "jitter_s", "reorder_s"):
            if not 0.0 <= getattr(self, name) <= 60.0:
                raise UsageError(f"{name} is {getattr(self, name)!r} and must be between 0 and 60 s")

    @property
    def longest_s(self) -> float:
        """The longest transit time of a packet that arrives [s], without a trace."""
        return self.delay_s + self.jitter_s + (self.reorder_s if self.reorder else 0.0)


class Way:
    """One direction of a path: packets enter, and leave when their time has come.

    Args:
        seed: Determines the fate of each packet.
        impairments: The effects on packets.
    """

    def __init__(self, seed: object, impairments: Impairments) -> None:
        self.impairments = impairments  #: may change at any time; applies to later packets
        self.lost = 0
        self._modem: Modem | None = None
        self._random = random.Random(str(seed))
        self._waiting: list[tuple[int, int, bytes]] = []
        self._number = 0
        self._last_ns = 0

    def put(self, packet: bytes, now_ns: int) -> None:
        """Add a packet."""
        wrong, chance = self.impairments, self._random.random
        # Always draw three numbers, so that a packet's fate depends on its number, not on earlier rates.
        lost, held, jitter = chance() < wrong.loss, chance() < wrong.reorder, chance() * wrong.jitter_s
        if lost:
            self.lost += 1
            return
        if wrong.trace is not None:
            if self._modem is None or self._modem.trace is not wrong.trace:
                self._modem = Modem(wrong.trace)
            leaves_ns = self._modem.leaves_ns(len(packet), now_ns)
            if leaves_ns is None:
                self.lost += 1
                return
            now_ns = leaves_ns
        due_ns = max(now_ns + nanoseconds(wrong.delay_s + jitter), self._last_ns)
        self._last_ns = due_ns
        if held:
            due_ns += nanoseconds(wrong.reorder_s)
        self._number += 1
        heapq.heappush(self._waiting, (due_ns, self._number, packet))

    def get(self, now_ns: int) -> tuple[int, bytes] | None:
        """Return the next packet that is due, and when it was due [ns]; None if there is none."""
        if self._waiting and self._waiting[0][0] <= now_ns:
            due_ns, _, packet = heapq.heappop(self._waiting)
            return due_ns, packet
        return None

    @property
    def next_ns(self) -> int | None:
        """When the next packet is due [ns]; None if none is waiting."""
        return self._waiting[0][0] if self._waiting else None
