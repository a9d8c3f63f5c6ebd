"""How much may be on the way to one end. Pure."""

from __future__ import annotations

from collections import deque
from typing import Final

DEPTH: Final = 256  #: packets that were sent to an end and not yet taken there, before further ones are refused
MAX_BYTES: Final = 1 << 20  #: the same in bytes
RECENT_PACKETS: Final = 64  #: of an end, among which one that comes a second time is known
ACKNOWLEDGE_AFTER: Final = DEPTH // 8  #: packets taken before that is told


class Window:
    """The packets on the way to one end, numbered from 1. Not locked."""

    def __init__(self) -> None:
        self._sizes: deque[int] = deque()  # of those on the way, oldest first
        self._bytes = 0
        self._next = 1

    def send(self, size: int) -> int:
        """Number of the next packet, now on the way; 0 if there is no room for it."""
        if len(self._sizes) >= DEPTH or (self._sizes and self._bytes + size > MAX_BYTES):
            return 0
        self._sizes.append(size)
        self._bytes += size
        self._next += 1
        return self._next - 1

    def taken(self, number: int) -> None:
        """The packets up to this number have arrived and were taken; a number that was never sent says nothing."""
        if number >= self._next:
            return
        while self._sizes and self._next - len(self._sizes) <= number:
            self._bytes -= self._sizes.popleft()


class Taker:
    """The other end's side: says when to tell what was taken."""

    def __init__(self) -> None:
        self._told = 0
        self._bytes = 0

    def took(self, number: int, size: int) -> bool:
        """A packet was taken; returns whether to tell it now."""
        self._bytes += size
        if number - self._told < ACKNOWLEDGE_AFTER and self._bytes < MAX_BYTES // 8:
            return False
        self._told = number
        self._bytes = 0
        return True


class Recent:
    """The packets that came last. Where there is a direct way and one through a router, each comes twice."""

    def __init__(self, depth: int = RECENT_PACKETS) -> None:
        self._packets: deque[tuple[int, bytes]] = deque(maxlen=depth)

    def is_new(self, number: int, packet: bytes) -> bool:
        """Whether this one was not among them; from now on it is."""
        if (number, packet) in self._packets:
            return False
        self._packets.append((number, packet))
        return True
