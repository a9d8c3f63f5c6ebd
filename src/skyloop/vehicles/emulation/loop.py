"""One thread that waits for sockets, for times and for work that other threads hand it."""

from __future__ import annotations

import heapq
import itertools
import logging
import selectors
import socket
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Final

from skyloop.clock import monotonic_ns, seconds

_LONGEST_WAIT_S: Final = 1.0
_log = logging.getLogger(__name__)


class Loop:
    """Calls back on one thread.

    Everything but :meth:`post`, :meth:`start` and :meth:`stop` belongs to that thread, or to before its start. What a
    callback raises is logged, and the loop goes on.

    Args:
        name: Of the thread.
    """

    def __init__(self, name: str) -> None:
        self._selector = selectors.DefaultSelector()
        self._waker, self._wakened = socket.socketpair()
        self._waker.setblocking(False)
        self._wakened.setblocking(False)
        self._posted: deque[Callable[[], None]] = deque()
        self._timers: list[tuple[int, int, Callable[[], None]]] = []
        self._order = itertools.count()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self.watch(self._wakened, self._empty)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Stop the thread. When this returns no callback runs any more. Must not be called by one."""
        self._stopping = True
        self._wake()
        if self._thread.is_alive():
            self._thread.join()
        self._selector.close()
        self._waker.close()
        self._wakened.close()

    def post(self, call: Callable[[], None]) -> None:
        """Have a function called on the loop's thread. From any thread."""
        self._posted.append(call)
        self._wake()

    def at(self, due_ns: int, call: Callable[[], None]) -> None:
        """Have a function called at a time of the monotonic clock [ns]."""
        heapq.heappush(self._timers, (due_ns, next(self._order), call))

    def watch(
        self, sock: socket.socket, readable: Callable[[], None], writable: Callable[[], None] | None = None
    ) -> None:
        """Have a function called when a socket has something to read.

        Args:
            sock: Replaces an earlier watch of the same socket.
            readable: Called when there is something to read.
            writable: Called when there is room to write; None: never.
        """
        events = selectors.EVENT_READ | (selectors.EVENT_WRITE if writable else 0)
        try:
            self._selector.modify(sock, events, (readable, writable))
        except KeyError:
            self._selector.register(sock, events, (readable, writable))

    def forget(self, sock: socket.socket) -> None:
        """Stop watching a socket."""
        with suppress(KeyError, ValueError):
            self._selector.unregister(sock)

    def _run(self) -> None:
        while not self._stopping:
            wait_s = _LONGEST_WAIT_S
            if self._timers:
                wait_s = min(wait_s, max(0.0, seconds(self._timers[0][0] - monotonic_ns())))
            for key, events in self._selector.select(wait_s):
                readable, writable = key.data
                if events & selectors.EVENT_READ:
                    self._call(readable)
                if events & selectors.EVENT_WRITE and writable is not None:
                    self._call(writable)
            for _ in range(len(self._posted)):
                self._call(self._posted.popleft())
            while self._timers and self._timers[0][0] <= monotonic_ns():
                self._call(heapq.heappop(self._timers)[2])

    def _call(self, call: Callable[[], None]) -> None:
        try:
            call()
        except Exception:  # noqa: BLE001  a drone that dies of one datagram helps nobody
            _log.exception("the emulated firmware met an error and continues")

    def _wake(self) -> None:
        with suppress(OSError):  # full: it is awake already
            self._waker.send(b"\0")

    def _empty(self) -> None:
        with suppress(BlockingIOError):
            self._wakened.recv(4096)
