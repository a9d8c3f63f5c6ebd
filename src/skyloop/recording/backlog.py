"""What was received and is not written yet: bounded, and when it is full, frames go first, then feedback."""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Final

from skyloop.recording.options import MB

RESERVE: Final = 64 * MB  #: bytes, beyond the limit, for what must not be dropped


class Rank(IntEnum):
    """What is dropped first has the highest."""

    KEPT = 0  #: commands, events, parameters, logs: dropped only when the reserve is full as well
    STATE = 1  #: feedback, annotations
    FRAME = 2


@dataclass(frozen=True, slots=True)
class Item:
    """Something to write: a sample of :mod:`skyloop.messages` or of the layout, or an encoded picture."""

    drone: int  #: which one of the recording's
    channel: str  #: as the counts name it: ``feedback``, ``video.front`` …
    rank: Rank
    received_ns: int  #: on this process's monotonic clock
    sample: Any
    size: int  #: bytes, roughly


#: Counts by drone and channel.
Counts = Counter[tuple[int, str]]


class Backlog:
    """Keeps the order of arrival. Any number of threads put, one takes."""

    def __init__(self, limit: int, reserve: int = RESERVE) -> None:
        self.dropped: Counts = Counter()
        self._limit = limit
        self._ceiling = limit + reserve
        self._lock = threading.Lock()
        self._queues: tuple[deque[tuple[int, Item]], ...] = (deque(), deque(), deque())
        self._number = 0
        self._size = 0

    @property
    def size(self) -> int:
        """Bytes that wait."""
        return self._size

    def put(self, item: Item) -> None:
        """Take it, or drop others or this one, and count that."""
        with self._lock:
            self._number += 1
            self._queues[item.rank].append((self._number, item))
            self._size += item.size
            if self._size > self._limit:
                self._make_room()

    def put_back(self, items: Iterable[Item]) -> None:
        """What was taken last and could not be written, in its order; it comes first again."""
        with self._lock:
            first = self._first()
            for number, item in enumerate(reversed(list(items)), 1):
                self._queues[item.rank].appendleft((first - number, item))
                self._size += item.size
            self._make_room()

    def take(self, size: int) -> list[Item]:
        """The oldest, until they make up this size, in the order of their arrival. Does not wait."""
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
        """Count one that was dropped elsewhere."""
        with self._lock:
            self.dropped[item.drone, item.channel] += 1

    def _first(self) -> int:
        return min((queue[0][0] for queue in self._queues if queue), default=self._number + 1)

    def _make_room(self) -> None:
        kept, state, frames = self._queues
        for queue, limit in ((frames, self._limit), (state, self._limit), (kept, self._ceiling)):
            while self._size > limit and queue:
                _, item = queue.popleft()  # the oldest: what comes after it belongs together
                self._size -= item.size
                self.dropped[item.drone, item.channel] += 1
