"""One thread for many vehicles' links, because with a thread for each, most time would go to switching threads.

Commands bypass this thread: they are sent on the thread that receives them.
"""

from __future__ import annotations

import selectors
import socket
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from heapq import heapify, heappop, heappush
from itertools import count
from typing import Any, Final

from skyloop.clock import nanoseconds, seconds
from skyloop.drivers.base import ServedLink
from skyloop.drivers.vehicle_link import PAUSE_S

_LONGEST_WAIT_NS: Final = 1_000_000_000  #: maximum time to wait in the selector
_MOST_STALE: Final = 4  #: number of queue entries per link at which stale ones are removed


class LinkThread:
    """Serves links on one thread when they are readable or due, from construction to :meth:`close`.

    Like a :class:`skyloop.transport.local.reactor.Reactor`, it shows whose code is running and can be split. ``links``:
    the initial ones, each with the vehicle it belongs to.
    """

    def __init__(self, links: Mapping[ServedLink, Any] | None = None) -> None:
        self.inside: Any = None  #: the vehicle whose link is currently being served
        self.entries = 0  #: number of times :attr:`inside` was set
        self._selector = selectors.DefaultSelector()
        self._waker, self._awake = socket.socketpair()
        self._waker.setblocking(False)
        self._awake.setblocking(False)
        self._lock = threading.Lock()  # guards the knowledge of whose code is running
        self._members: dict[ServedLink, Any] = {}
        self._due_ns: dict[ServedLink, int] = {}
        self._queue: list[tuple[int, int, ServedLink]] = []  # a heap by due time; entries with other times are stale
        self._order = count()  # breaks ties between due times
        self._paused: set[ServedLink] = set()  # links that are not polled because of an error
        self._closing = False
        self._selector.register(self._awake, selectors.EVENT_READ)
        for link, vehicle in (links or {}).items():
            self.add(link, vehicle)
        self._thread = threading.Thread(target=self._run, name="skyloop-links", daemon=True)
        self._thread.start()

    def add(self, link: ServedLink, vehicle: Any) -> None:
        """Serve a link from now on until it ends. Any thread."""
        with self._lock:
            self._members[link] = vehicle
            self._plan(link, 0)
            self._selector.register(link, selectors.EVENT_READ, link)
        self._wake()

    @property
    def empty(self) -> bool:
        """Whether there is no link to serve."""
        return not self._members

    def split(self, stuck: Any) -> LinkThread:
        """Leave this thread to one vehicle's links; return a new one for all other links. Any thread."""
        with self._lock:
            others = {link: vehicle for link, vehicle in self._members.items() if vehicle is not stuck}
            for link in others:
                self._forget(link)
        return LinkThread(others)

    def close(self) -> None:
        """End the thread, unless it is stuck, and any links that remain. Idempotent."""
        self._closing = True
        self._wake()
        if threading.current_thread() is not self._thread and self.inside is None:
            self._thread.join()

    def _forget(self, link: ServedLink) -> None:
        del self._members[link]
        self._due_ns.pop(link, None)
        self._paused.discard(link)
        self._unwatch(link)

    def _unwatch(self, link: ServedLink) -> None:
        with suppress(KeyError, ValueError, OSError):
            self._selector.unregister(link)

    def _plan(self, link: ServedLink, due_ns: int) -> None:
        """Schedule a link to be served by the given time. The lock must be held."""
        if self._due_ns.get(link) == due_ns:
            return
        self._due_ns[link] = due_ns
        heappush(self._queue, (due_ns, next(self._order), link))
        if len(self._queue) > _MOST_STALE * len(self._due_ns):
            self._queue = [entry for entry in self._queue if self._due_ns.get(entry[2]) == entry[0]]
            heapify(self._queue)

    def _next_ns(self) -> int | None:
        """Return when the next link is due, or None if there is none. The lock must be held."""
        queue = self._queue
        while queue and self._due_ns.get(queue[0][2]) != queue[0][0]:
            heappop(queue)
        return queue[0][0] if queue else None

    def _due(self, now_ns: int) -> set[ServedLink]:
        """Return the links that are due. The lock must be held."""
        due: set[ServedLink] = set()
        while (next_ns := self._next_ns()) is not None and next_ns <= now_ns:
            link = heappop(self._queue)[2]
            del self._due_ns[link]  # until it has been served
            due.add(link)
        return due

    def _run(self) -> None:
        while not self._closing:
            with self._lock:
                next_ns = self._next_ns()
            if next_ns is None:
                next_ns = time.monotonic_ns() + _LONGEST_WAIT_NS
            wait_s = seconds(max(0, min(next_ns - time.monotonic_ns(), _LONGEST_WAIT_NS)))
            ready = {key.data for key, _ in self._selector.select(wait_s)}
            if None in ready:
                ready.remove(None)
                with suppress(OSError):
                    self._awake.recv(4096)
            now_ns = time.monotonic_ns()
            with self._lock:
                turns = ready | self._due(now_ns)
            for link in turns:
                self._serve(link, readable=link in ready)
            self.inside = None
        with self._lock:
            left = list(self._members)
        for link in left:  # links of a vehicle that was dropped
            link.end()
        self._selector.close()
        self._awake.close()
        self._waker.close()

    def _serve(self, link: ServedLink, *, readable: bool) -> None:
        with self._lock:
            vehicle = self._members.get(link)
            if vehicle is None:
                return  # another thread has taken it over in the meantime
            if link in self._paused:
                self._paused.remove(link)
                readable = True  # it may be readable: it was not polled
                self._selector.register(link, selectors.EVENT_READ, link)
        self.inside = vehicle
        self.entries += 1
        failed = False
        due_ns: int | None
        try:
            due_ns = link.serve(readable=readable)
        except Exception:  # noqa: BLE001  the link has reported it; all others continue
            failed, due_ns = True, time.monotonic_ns() + nanoseconds(PAUSE_S)
        with self._lock:
            if due_ns is not None:
                if link in self._members:
                    self._plan(link, due_ns)
                    if failed:
                        self._unwatch(link)
                        self._paused.add(link)
                return
            if link in self._members:
                self._forget(link)
        link.end()

    def _wake(self) -> None:
        with suppress(OSError):  # the thread is awake, or has ended
            self._waker.send(b"\0")
