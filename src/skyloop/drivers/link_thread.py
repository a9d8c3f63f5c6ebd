"""The thread that serves a vehicle's link: it waits for sockets, is woken by others, and outlives its own errors."""

from __future__ import annotations

import selectors
import socket
import threading
from abc import ABC, abstractmethod
from contextlib import suppress
from typing import Final

from skyloop.drivers.base import Sink
from skyloop.messages import EventKind, Severity

PAUSE_S: Final = 0.03  #: after an error


class LinkThread(ABC):
    """A driver's link writes ``_step``, which waits by ``_selector``, ``_fail`` and ``_release``.

    ``lock`` is to be held by whoever touches what the link decides by.
    """

    def __init__(self, name: str, *, close_s: float) -> None:
        self.lock = threading.Lock()
        self._stopping = threading.Event()
        self._selector = selectors.DefaultSelector()
        self._awake, self._waker = socket.socketpair()
        self._close_s = close_s
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def start(self) -> None:
        """Begin."""
        self._awake.setblocking(False)
        self._waker.setblocking(False)
        self._selector.register(self._awake, selectors.EVENT_READ)
        self._thread.start()

    def join(self) -> None:
        """End, and give everything back."""
        self._stopping.set()
        self.wake()
        if self._thread is not threading.current_thread():
            self._thread.join(self._close_s)

    def wake(self) -> None:
        """Have the thread look at once. From any thread."""
        with suppress(OSError):  # it is awake, or it ended
            self._waker.send(b"\0")

    def _slept(self) -> None:
        """It was woken: nothing of that is left."""
        with suppress(OSError):
            while self._awake.recv(4096):
                pass

    def _run(self) -> None:
        try:
            while not self._stopping.is_set():
                try:
                    self._step()
                except Exception as error:  # noqa: BLE001  whatever happens, the vehicle must be told what to do
                    self._fail(error)
                    self._stopping.wait(PAUSE_S)
        finally:
            self._release()
            self._selector.close()
            self._awake.close()
            self._waker.close()

    @abstractmethod
    def _step(self) -> None:
        """Wait until something is to be done, and do it."""

    @abstractmethod
    def _fail(self, error: Exception) -> None:
        """A step raised; it is to be told."""

    @abstractmethod
    def _release(self) -> None:
        """Close what the link opened."""


def tell_failure(error: Exception, sink: Sink) -> None:
    """What a link tells of an error of its own."""
    sink.event(EventKind.DRIVER_ERROR, f"the link to the vehicle failed: {error!r}", Severity.ERROR, where="link")
