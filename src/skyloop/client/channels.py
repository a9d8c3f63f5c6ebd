"""Pass samples from the receiving thread to consumers: channels, callbacks and newest-wins mailboxes."""

from __future__ import annotations

import logging
import math
import re
import threading
import time
from _thread import LockType, allocate_lock
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any, Final, Generic, Protocol, Self, TypeVar

from skyloop.errors import ClosedError, SkyloopError, UsageError
from skyloop.messages import EventKind, Severity
from skyloop.messages.relayed import PROCESSOR_NAME

T = TypeVar("T")
C = TypeVar("C", bound="Channel[Any]")
T_contra = TypeVar("T_contra", contravariant=True)

#: Called with a listener's name and the exception that its function raised.
Report = Callable[[str, Exception | SystemExit], None]


class Emit(Protocol):
    """Emits one of the client's own events; ``data`` are its details."""

    def __call__(self, kind: EventKind, text: str, severity: Severity = Severity.WARNING, **data: str) -> None: ...


JOIN_S: Final = 2.0  #: how long cancelling waits for a call in progress [s]
_REPORT_EVERY_S: Final = 1.0  #: minimum interval between reports of one listener's errors
_log = logging.getLogger("skyloop")


class Channel(Generic[T]):
    """Delivers one kind of sample to every consumer, on the thread on which it arrives."""

    def __init__(self, subscribe: Callable[[bool], None] | None = None) -> None:
        """Create a channel without consumers.

        ``subscribe`` is called under the lock: with True when samples are needed, with False when they no longer are.
        """
        self.subscribed = False  #: whether samples are needed: there is a consumer or the channel is kept
        self.kept = False  #: subscribed permanently, by :meth:`keep`
        self._consumers: tuple[Callable[[T], None], ...] = ()
        self._drops: dict[Callable[[T], None], Callable[[], int]] = {}
        self._dropped_before = 0  # samples missed by consumers that have been removed
        self._lock = threading.Lock()
        self._subscribe = subscribe

    def add(self, consumer: Callable[[T], None], dropped: Callable[[], int]) -> None:
        """Add a consumer, called on the publishing thread; ``dropped`` returns how many samples it has missed."""
        with self._lock:
            self._drops[consumer] = dropped
            self._consumers = (*self._consumers, consumer)
            self._update()

    def remove(self, consumer: Callable[[T], None]) -> None:
        """Remove a consumer. An unknown consumer is ignored."""
        with self._lock:
            if consumer not in self._drops:
                return
            self._dropped_before += self._drops.pop(consumer)()
            self._consumers = tuple(known for known in self._consumers if known != consumer)
            self._update()

    @contextmanager
    def into(self, mailbox: Holder[T]) -> Iterator[None]:
        """Deliver samples into ``mailbox`` during the block."""
        put = mailbox.put
        self.add(put, lambda: mailbox.dropped)
        try:
            yield
        finally:
            self.remove(put)

    def keep(self) -> None:
        """Stay subscribed even without consumers."""
        if not self.kept:
            with self._lock:
                self.kept = True
                self._update()

    @property
    def consumed(self) -> bool:
        return bool(self._consumers)

    @property
    def dropped(self) -> int:
        """Number of samples that consumers have missed, including consumers that were removed."""
        with self._lock:
            return self._dropped_before + sum(dropped() for dropped in self._drops.values())

    def publish(self, sample: T) -> None:
        """Deliver ``sample`` to every consumer on the calling thread. No lock is held during the calls."""
        for consumer in self._consumers:
            consumer(sample)

    def _update(self) -> None:
        """Subscribe or unsubscribe if samples are newly needed or no longer needed. The caller must hold the lock."""
        wanted = self.kept or bool(self._consumers)
        if wanted is not self.subscribed:
            self.subscribed = wanted
            if self._subscribe is not None:
                self._subscribe(wanted)


class FollowingChannel(Channel[T], Generic[T, C]):
    """A channel that switches to another camera's channel if the proxy restarts with different cameras.

    Callers that don't name a camera use it to get the vehicle's first. New consumers are added to the current channel.
    """

    def __init__(self, find: Callable[[], C], changes: Channel[Any]) -> None:
        """Start with the result of ``find``, called again after each sample of ``changes``; ignore its later errors."""
        super().__init__()
        self.current = find()
        self._find = find
        self._changes = changes

    def add(self, consumer: Callable[[T], None], dropped: Callable[[], int]) -> None:
        with self._lock:
            if not self._drops:
                self._changes.add(self._find_again, lambda: 0)
            self._drops[consumer] = dropped
            self.current.add(consumer, dropped)

    def remove(self, consumer: Callable[[T], None]) -> None:
        with self._lock:
            if self._drops.pop(consumer, None) is not None:
                self.current.remove(consumer)
                if not self._drops:
                    self._changes.remove(self._find_again)

    def _find_again(self, _: object) -> None:
        with self._lock, suppress(SkyloopError):  # the vehicle has no camera, or the drone was closed
            before, self.current = self.current, self._find()
            for consumer, dropped in self._drops.items() if self.current is not before else ():
                before.remove(consumer)
                self.current.add(consumer, partial(_since, dropped, dropped()))


def _since(dropped: Callable[[], int], before: int) -> int:
    return dropped() - before


class Listener(Generic[T]):
    """An application's callback, called with samples until :meth:`cancel` or the end of its ``with`` block.

    The function has its own thread and a mailbox of the newest ``depth`` samples. However slow it is, it receives new
    samples and delays no other consumer. With ``inline=True``, the function is called on the receiving thread before
    the next sample is received. This is fastest, but the function must be quick and must not wait. Its exceptions are
    counted, and at most one per second is logged and emitted as an event. The next sample is delivered as usual.
    """

    def __init__(
        self,
        function: Callable[[T], object],
        channel: Channel[T],
        report: Report,
        *,
        name: str,
        depth: int = 1,
        inline: bool = False,
        on_cancel: Callable[[Listener[T]], None] | None = None,
    ) -> None:
        """Start calling ``function`` with each sample of ``channel``; up to ``depth`` samples may wait.

        ``report`` is called with the listener's ``name`` and each exception of ``function``; the listener's thread has
        the same name. ``on_cancel`` is called with the listener. ``inline``: whether to call the function on the
        publishing thread instead of on its own thread.
        """
        self.name = name
        self.errors = 0  #: number of calls that raised
        self._function = function
        self._channel = channel
        self._report = report
        self._on_cancel = on_cancel
        self._calls = 0
        self._next_report_s = 0.0
        self._mailbox: Mailbox[T] = Mailbox(depth)
        self._consumer = self._call if inline else self._mailbox.put
        self._thread = None if inline else threading.Thread(target=self._run, name=f"skyloop-{name}", daemon=True)
        if self._thread is not None:
            self._thread.start()
        channel.add(self._consumer, lambda: self.dropped)

    @property
    def delivered(self) -> int:
        """Number of times the function has been called."""
        return self._calls

    @property
    def dropped(self) -> int:
        """Number of samples replaced by newer ones before the function was ready for them."""
        return self._mailbox.dropped

    def cancel(self, *, wait: bool = True) -> None:
        """Stop calling the function. Idempotent.

        Args:
            wait: Whether to wait up to 2 s for a call in progress; ignored if called from the function itself.
        """
        self._channel.remove(self._consumer)
        self._mailbox.close()
        if self._on_cancel is not None:
            self._on_cancel(self)
        if wait:
            self.join(JOIN_S)

    def join(self, within_s: float) -> None:
        """Wait for a call in progress; return at once if called from the function itself."""
        thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            thread.join(within_s)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.cancel()

    def _run(self) -> None:
        mailbox = self._mailbox
        while not mailbox.closed:
            sample = mailbox.wait()
            if sample is not None:
                self._call(sample)

    def _call(self, sample: T) -> None:
        self._calls += 1
        try:
            self._function(sample)
        except ClosedError:  # the drone was closed or its flight ended: count the error, but don't report it
            self.errors += 1
        except SystemExit as error:  # without this, it would only end this thread, and nobody would notice
            self._report(self.name, error)
        except Exception as error:  # noqa: BLE001  (an application's function may raise anything)
            self.errors += 1
            self._failed(error)

    def _failed(self, error: Exception) -> None:
        now_s = time.monotonic()
        if now_s < self._next_report_s:
            return  # report at most once a second; ``errors`` counts every one
        self._next_report_s = now_s + _REPORT_EVERY_S
        _log.error("%s raised %r (%d times so far)", self.name, error, self.errors, exc_info=error)
        self._report(self.name, error)


class Holder(Protocol[T_contra]):
    """A destination for samples: one mailbox, or several that a consumer empties together."""

    def put(self, item: T_contra, /) -> None:
        """Add the newest item and wake the consumer."""

    @property
    def dropped(self) -> int:
        """Number of items replaced by newer ones before a consumer took them."""


class Mailbox(Generic[T]):
    """Keeps the newest ``depth`` items until its consumer takes them, and counts the items it dropped.

    Any number of threads may put items, but only one may take them.
    """

    __slots__ = ("_items", "_lock", "_offered", "closed", "delivered", "depth", "notifier")

    def __init__(self, depth: int = 1, notifier: Notifier | None = None) -> None:
        """Create an empty mailbox; mailboxes that share a ``notifier`` let one thread wait for all of them."""
        self.depth = depth
        self.notifier = notifier or Notifier()
        self.closed = False
        self.delivered = 0  #: number of items taken
        self._offered = 0
        self._items: deque[T] = deque(maxlen=depth)
        self._lock = threading.Lock()

    @property
    def dropped(self) -> int:
        """Items replaced by newer ones before they were taken."""
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
        """Remove and return the oldest item; None if there is none. Does not wait."""
        with self._lock:
            if not self._items:
                return None
            self.delivered += 1
            return self._items.popleft()

    def peek(self) -> T | None:
        """Return the oldest item without removing it."""
        with self._lock:
            return self._items[0] if self._items else None

    def wait(self, timeout_s: float | None = None) -> T | None:
        """Wait for an item and take it; return None after the time-out or once the mailbox is closed."""
        self.notifier.wait_for(lambda: bool(self._items) or self.closed, timeout_s)
        return None if self.closed else self.take()

    def close(self) -> None:
        """Discard all items and wake the consumer, which receives None."""
        self.closed = True
        with self._lock:
            self._offered -= len(self._items)  # discarded items are counted neither as delivered nor as dropped
            self._items.clear()
        self.notifier.notify()


class Notifier:
    """Wakes all threads that wait for a condition. Notifying is a single check when no thread waits.

    Each waiting thread adds its own lock and then checks its condition once more. This way no notification is missed,
    and the notifying thread, which receives for all consumers, never acquires a lock.
    """

    __slots__ = ("_waiting",)

    def __init__(self) -> None:
        self._waiting: list[LockType] = []

    def notify(self) -> None:
        """Wake every waiting thread."""
        waiting = self._waiting
        while waiting:
            try:
                lock = waiting.pop()
            except IndexError:  # another thread is notifying at the same time
                return
            lock.release()

    def wait_for(self, ready: Callable[[], bool], timeout_s: float | None = None) -> bool:
        """Wait until ``ready()`` is true; return whether it became true in time. None waits without limit.

        ``ready`` is called on the waiting thread, once immediately and then after each notification.
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
            with suppress(ValueError):  # the notifying thread has removed it
                self._waiting.remove(lock)


def checked_name(processor: str) -> str:
    """Return ``processor`` if it is a valid name of a processor; raise :class:`UsageError` otherwise."""
    if not isinstance(processor, str) or not re.fullmatch(PROCESSOR_NAME, processor):
        raise UsageError(f"the name of a processor must have 1 to 64 letters, digits or _ . -, not {processor!r:.80}")
    return processor


def checked_age(max_age_s: float | None) -> float | None:
    """Return ``max_age_s`` if it is a valid age limit [s] or None; raise :class:`UsageError` otherwise."""
    if max_age_s is not None and (not isinstance(max_age_s, int | float) or math.isnan(max_age_s) or max_age_s < 0):
        raise UsageError(f"max_age_s is {max_age_s!r} and must be a number of seconds")
    return max_age_s
