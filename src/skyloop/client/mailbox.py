"""Where samples wait for a consumer: a mailbox in which the newest win, and a notifier that wakes the consumer."""

from __future__ import annotations

import contextlib
import threading
import time
from _thread import LockType, allocate_lock
from collections import deque
from collections.abc import Callable
from typing import Generic, Protocol, TypeVar

T = TypeVar("T")


class Notifier:
    """Wakes all threads that wait for a condition. Notifying costs one test when nobody waits.

    Every waiting thread brings its own lock and checks its condition once more after adding it, so that no notification
    is missed and the notifying thread, which receives for everybody, never acquires a lock.
    """

    __slots__ = ("_waiting",)

    def __init__(self) -> None:
        self._waiting: list[LockType] = []

    def notify(self) -> None:
        """Wake every thread that waits now."""
        waiting = self._waiting
        while waiting:
            try:
                lock = waiting.pop()
            except IndexError:  # another thread notified at the same time
                return
            lock.release()

    def wait_for(self, ready: Callable[[], bool], timeout_s: float | None = None) -> bool:
        """Wait until ``ready()`` is true.

        Args:
            ready: Checked on this thread, at first and after each notification.
            timeout_s: How long to wait [s]; None: for ever.

        Returns:
            Whether it became true in time.
        """
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
            with contextlib.suppress(ValueError):  # the notifying thread has removed it
                self._waiting.remove(lock)


T_contra = TypeVar("T_contra", contravariant=True)


class Holder(Protocol[T_contra]):
    """Whatever samples can be put into: a mailbox, or several that are emptied together."""

    def put(self, item: T_contra, /) -> None:
        """Add the newest item and wake the consumer."""

    @property
    def dropped(self) -> int:
        """Items that newer ones pushed out before they were taken."""


class Mailbox(Generic[T]):
    """Keeps the newest ``depth`` items that its consumer has not taken yet, and counts those that it had to drop.

    Any number of threads put, one takes.
    """

    __slots__ = ("_items", "_lock", "_offered", "closed", "delivered", "depth", "notifier")

    def __init__(self, depth: int = 1, notifier: Notifier | None = None) -> None:
        """Make an empty mailbox.

        Args:
            depth: How many items are kept.
            notifier: Notified with each item; one that is shared lets a thread wait for several mailboxes. None: an own
                one.
        """
        self.depth = depth
        self.notifier = notifier or Notifier()
        self.closed = False
        self.delivered = 0  #: how many were taken
        self._offered = 0
        self._items: deque[T] = deque(maxlen=depth)
        self._lock = threading.Lock()

    @property
    def dropped(self) -> int:
        """Items that newer ones pushed out before they were taken."""
        with self._lock:
            return self._offered - self.delivered - len(self._items)

    @property
    def waiting(self) -> bool:
        """Whether there is an item to take."""
        return bool(self._items)

    def put(self, item: T) -> None:
        """Add the newest item and wake the consumer."""
        with self._lock:
            self._offered += 1
            self._items.append(item)
        self.notifier.notify()

    def take(self) -> T | None:
        """Take the oldest of the items kept; None if there is none. Does not wait."""
        with self._lock:
            if not self._items:
                return None
            self.delivered += 1
            return self._items.popleft()

    def peek(self) -> T | None:
        """Return what :meth:`take` would, without taking it."""
        with self._lock:
            return self._items[0] if self._items else None

    def wait(self, timeout_s: float | None = None) -> T | None:
        """Take an item like :meth:`take`, but wait for one.

        Args:
            timeout_s: How long to wait [s]; None: for ever.

        Returns:
            The item; None if none came in time or the mailbox was closed.
        """
        self.notifier.wait_for(lambda: bool(self._items) or self.closed, timeout_s)
        return None if self.closed else self.take()

    def close(self) -> None:
        """Discard what is kept, and wake the consumer, which gets None from now on."""
        self.closed = True
        with self._lock:
            self._offered -= len(self._items)  # discarded items count neither as delivered nor as dropped
            self._items.clear()
        self.notifier.notify()
