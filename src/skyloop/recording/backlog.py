"""A bounded backlog of samples waiting to be written; when it is full, frames are dropped first, then feedback."""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Final

from skyloop.recording.options import MB

RESERVE: Final = 64 * MB  #: additional bytes, reserved for samples that must not be dropped


class Rank(IntEnum):
    """The order in which samples are dropped, highest rank first."""

    KEPT = 0  #: commands, events, parameters, logs: dropped only if the reserve is also full
    STATE = 1  #: feedback, annotations, results
    FRAME = 2


@dataclass(frozen=True, slots=True)
class Item:
    """A sample to write: an object of a type from :mod:`skyloop.messages` or from the layout, or an encoded frame."""

    drone: int  #: the drone's index in the recording
    channel: str  #: the channel's name in the drop counts: ``feedback``, ``video.front`` …
    rank: Rank
    received_ns: int  #: time of reception, on this process's monotonic clock
    sample: Any
    size: int  #: approximate size [bytes]


#: Counts by drone and channel.
Counts = Counter[tuple[int, str]]


class Backlog:
    """A bounded first-in, first-out queue with any number of producers and one consumer."""

    def __init__(self, limit: int, reserve: int = RESERVE) -> None:
        """Limit frames and feedback to ``limit`` bytes; all other samples may use ``reserve`` more bytes."""
        self.dropped: Counts = Counter()  #: counts of dropped items
        self._limit = limit
        self._ceiling = limit + reserve
        self._lock = threading.Lock()
        self._queues: tuple[deque[tuple[int, Item]], ...] = (deque(), deque(), deque())
        self._number = 0
        self._size = 0

    @property
    def size(self) -> int:
        """Bytes waiting to be written."""
        return self._size

    def put(self, item: Item) -> None:
        """Append an item; if the backlog is full, drop and count the oldest item of the highest rank."""
        with self._lock:
            self._number += 1
            self._queues[item.rank].append((self._number, item))
            self._size += item.size
            if self._size > self._limit:
                self._make_room()

    def put_back(self, items: Iterable[Item]) -> None:
        """Put the most recently taken items, which could not be written, back at the front in their original order."""
        with self._lock:
            first = self._first()
            for number, item in enumerate(reversed(list(items)), 1):
                self._queues[item.rank].appendleft((first - number, item))
                self._size += item.size
            self._make_room()

    def take(self, size: int) -> list[Item]:
        """Remove and return the oldest items, in order of arrival, up to ``size`` bytes in total. Does not block."""
        taken: list[Item] = []
        with self._lock:
            while size > 0:
                filled = [queue for queue in self._queues if queue]
                if not filled:
                    break
                _, item = min(filled, key=lambda queue: queue[0][0]).popleft()
                taken.append(item)
                size -= item.size
                self._size -= item.size
        return taken

    def count(self, item: Item) -> None:
        """Count an item that was dropped elsewhere."""
        with self._lock:
            self.dropped[item.drone, item.channel] += 1

    def _first(self) -> int:
        return min((queue[0][0] for queue in self._queues if queue), default=self._number + 1)

    def _make_room(self) -> None:
        kept, state, frames = self._queues
        for queue, limit in ((frames, self._limit), (state, self._limit), (kept, self._ceiling)):
            while self._size > limit and queue:
                _, item = queue.popleft()  # drop the oldest item, so that the remaining ones have no gaps
                self._size -= item.size
                self.dropped[item.drone, item.channel] += 1
