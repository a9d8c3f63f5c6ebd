"""How samples wait at a consumer's door: a bell to wake whoever waits, and a short buffer in which the newest win."""

from __future__ import annotations

import contextlib
import threading
import time
from _thread import LockType, allocate_lock
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

T = TypeVar("T")


class Bell:
    """Wakes all threads that wait for something to become true. Ringing costs one test when nobody waits.

    Every waiter brings its own lock and looks once more after it hung it up, so that no ring is missed and the
    ringing thread, which receives for everybody, never takes a lock itself.
    """

    __slots__ = ("_waiting",)

    def __init__(self) -> None:
        self._waiting: list[LockType] = []

    def ring(self) -> None:
        """Wake everybody who waits now."""
        waiting = self._waiting
        while waiting:
            try:
                lock = waiting.pop()
            except IndexError:  # two rang at once, the other was faster
                return
            lock.release()

    def wait_for(self, ready: Callable[[], bool], timeout_s: float | None = None) -> bool:
        """Wait until ``ready()`` is true, looked at after each ring; False if it is not within the time."""
        if ready():
            return True
        deadline = None if timeout_s is None else time.monotonic() + timeout_s
        while True:
            left = -1.0 if deadline is None else min(deadline - time.monotonic(), threading.TIMEOUT_MAX)
            if deadline is not None and left <= 0.0:
                return ready()
            self._sleep(ready, left)
            if ready():
                return True

    def _sleep(self, ready: Callable[[], bool], timeout_s: float) -> None:
        lock = allocate_lock()
        lock.acquire()
        self._waiting.append(lock)
        try:
            if not ready():
                lock.acquire(True, timeout_s)
        finally:
            with contextlib.suppress(ValueError):  # it was rung: whoever rang took it off
                self._waiting.remove(lock)


class Buffer(Generic[T]):
    """Keeps the newest ``depth`` items that its consumer has not taken yet, and counts those that it had to drop.

    Any number of threads put, one takes. ``bell`` may be shared, to wait for several buffers at once.
    """

    __slots__ = ("_items", "_lock", "_offered", "bell", "closed", "delivered", "depth")

    def __init__(self, depth: int = 1, bell: Bell | None = None) -> None:
        self.depth = depth
        self.bell = bell or Bell()
        self.closed = False
        self.delivered = 0  #: how many were taken
        self._offered = 0
        self._items: deque[T] = deque(maxlen=depth)
        self._lock = threading.Lock()

    @property
    def dropped(self) -> int:
        """How many newer ones pushed out before they were taken."""
        with self._lock:
            return self._offered - self.delivered - len(self._items)

    @property
    def waiting(self) -> bool:
        """Whether there is an item to take."""
        return bool(self._items)

    def put(self, item: T) -> None:
        """Offer the newest item; wakes the consumer."""
        with self._lock:
            self._offered += 1
            self._items.append(item)
        self.bell.ring()

    def take(self) -> T | None:
        """The oldest of those kept, or None. Does not wait."""
        with self._lock:
            if not self._items:
                return None
            self.delivered += 1
            return self._items.popleft()

    def peek(self) -> T | None:
        """What :meth:`take` would give, left where it is."""
        with self._lock:
            return self._items[0] if self._items else None

    def wait(self, timeout_s: float | None = None) -> T | None:
        """Like :meth:`take`, but waits; None if nothing came in time or the buffer was closed."""
        self.bell.wait_for(lambda: bool(self._items) or self.closed, timeout_s)
        return None if self.closed else self.take()

    def close(self) -> None:
        """Let nobody wait here any more."""
        self.closed = True
        with self._lock:
            self._offered -= len(self._items)  # what nobody will take was neither delivered nor dropped
            self._items.clear()
        self.bell.ring()
