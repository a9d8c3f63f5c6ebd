"""Inject faults into transports; the same seed gives the same faults. Pure: the sender handles delays."""

from __future__ import annotations

import random
from dataclasses import dataclass
from typing import TypeVar

from skyloop.errors import UsageError

_Item = TypeVar("_Item")


@dataclass(frozen=True, slots=True)
class Faults:
    """Faults to inject, as probabilities from 0 to 1 for each packet or frame in each direction.

    ``corrupt`` flips one random bit, only in packets. ``reorder`` delays an item until after the next item. Each
    direction of each connection has its own ``random.Random``, which is seeded from ``seed``.
    """

    seed: int = 0
    drop: float = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0
    corrupt: float = 0.0

    def __post_init__(self) -> None:
        for name in ("drop", "duplicate", "reorder", "corrupt"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise UsageError(f"{name} is {getattr(self, name)!r} and must be a probability between 0 and 1")


class FaultInjector:
    """Injects the faults into one direction of one connection. Not thread-safe."""

    def __init__(self, faults: Faults, key: str) -> None:
        self._faults = faults
        self._random = random.Random(f"{faults.seed}/{key}")
        self._held: list[object] = []

    def packets(self, packet: bytes) -> list[bytes]:
        """Return what arrives when this packet is sent: any number of packets, in order of arrival."""
        if packet and self._random.random() < self._faults.corrupt:
            damaged = bytearray(packet)
            damaged[self._random.randrange(len(damaged))] ^= 1 << self._random.randrange(8)
            packet = bytes(damaged)
        return self.items(packet)

    def items(self, item: _Item) -> list[_Item]:
        """Do the same as :meth:`packets` for items of any type, but without corruption."""
        held: list[_Item] = self._held  # type: ignore[assignment]
        chance = self._random.random
        if chance() < self._faults.drop:
            return []
        if not held and chance() < self._faults.reorder:
            held.append(item)
            return []
        copies = [item, item] if chance() < self._faults.duplicate else [item]
        arriving = copies + held
        held.clear()
        return arriving
