"""The queue for the thread that calls a handler: commands come first, and connections take turns.

Two hundred requests from one connection therefore delay the others no more than one request would.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Hashable
from typing import Final, Generic, TypeVar

Item = TypeVar("Item")
#: After this number of consecutive commands, handle one other packet, so that endless commands can't stop others from
#: requesting authority.
IN_A_ROW: Final = 16


class _TurnQueue(Generic[Item]):
    """One queue per connection; the connections take turns."""

    def __init__(self) -> None:
        self._order: deque[Hashable] = deque()
        self._waiting: dict[Hashable, deque[Item]] = {}

    def __bool__(self) -> bool:
        return bool(self._order)

    def count(self, of: Hashable) -> int:
        return len(self._waiting.get(of, ()))

    def put(self, of: Hashable, item: Item) -> None:
        waiting = self._waiting.get(of)
        if waiting is None:
            self._waiting[of] = deque((item,))
            self._order.append(of)
        else:
            waiting.append(item)

    def get(self) -> Item:
        of = self._order.popleft()
        waiting = self._waiting[of]
        item = waiting.popleft()
        if waiting:
            self._order.append(of)
        else:
            del self._waiting[of]
        return item


class HandlerQueue(Generic[Item]):
    """A queue with many producers and one consumer. Items of equal urgency from one connection stay in order."""

    def __init__(self) -> None:
        self._changed = threading.Condition(threading.Lock())
        self._urgent: _TurnQueue[Item] = _TurnQueue()
        self._others: _TurnQueue[Item] = _TurnQueue()
        self._in_a_row = 0
        self._closed = False

    def put(self, of: Hashable, item: Item, *, urgent: bool = False, at_most: int | None = None) -> bool:
        """Queue a connection's item, urgent ones first; refuse it if ``at_most`` are waiting. Any thread."""
        with self._changed:
            queue = self._urgent if urgent else self._others
            if at_most is not None and queue.count(of) >= at_most:
                return False
            queue.put(of, item)
            self._changed.notify()
            return True

    def waiting(self, of: Hashable) -> int:
        """Return how many of a connection's non-urgent items are queued."""
        with self._changed:
            return self._others.count(of)

    def close(self) -> None:
        """Stop :meth:`get` from waiting; it still returns items already queued."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def get(self, timeout_s: float) -> Item | None:
        """Return the next item, or None after the time-out or if the queue is closed and empty."""
        with self._changed:
            self._changed.wait_for(lambda: self._urgent or self._others or self._closed, timeout_s)
            if self._urgent and not (self._others and self._in_a_row >= IN_A_ROW):
                self._in_a_row += 1
                return self._urgent.get()
            self._in_a_row = 0
            return self._others.get() if self._others else None

    @property
    def over(self) -> bool:
        """Whether the queue is closed and empty."""
        with self._changed:
            return self._closed and not self._urgent and not self._others
