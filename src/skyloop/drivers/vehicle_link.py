"""The thread that serves a vehicle's session: it waits for sockets, is woken by others, and outlives its own errors."""

from __future__ import annotations

import selectors
import socket
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Final, Generic, TypeVar

from skyloop.clock import Clock, monotonic_ns, seconds
from skyloop.drivers.base import Sink
from skyloop.drivers.vehicle_session import Telling, VehicleSession
from skyloop.messages import AnyAction, EventKind, Severity

PAUSE_S: Final = 0.03  #: after an error

S = TypeVar("S", bound=VehicleSession)


class VehicleLink(ABC, Generic[S]):
    """Serves a session from :meth:`start` to :meth:`stop`. ``deliver`` gets its tellings, on the link's thread.

    All decisions are the session's, made with ``lock`` held; what it tells is delivered with the lock free. A kind of
    vehicle keeps its sockets in ``_selector``.
    """

    def __init__(
        self,
        name: str,
        session: S,
        deliver: Callable[[list[Telling]], None],
        clock: Clock = monotonic_ns,
        *,
        close_s: float = 2.0,
    ) -> None:
        self.session = session
        self.lock = threading.Lock()
        self._deliver = deliver
        self._clock = clock
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

    def stop(self) -> None:
        """End, and give everything back. Who waits for an answer gets none."""
        self._stopping.set()
        self._wake()
        if self._thread is not threading.current_thread():
            self._thread.join(self._close_s)
        with self.lock:
            self.session.close()

    # For a kind's methods that the proxy's threads call ----------------------------------------------------------

    def _decided(self, decide: Callable[[int], AnyAction]) -> AnyAction:
        """What is really applied, decided now, and said at once if the session's pace lets it."""
        with self.lock:
            now_ns = self._clock()
            applied = decide(now_ns)
            due_ns = self.session.due_ns
            if due_ns <= now_ns:
                self._say(now_ns)
        if now_ns < due_ns:
            self._wake()
        return applied

    def _answer(
        self, ask: Callable[[Callable[[str | None], None]], None], within_s: float, otherwise: str | None
    ) -> str | None:
        """Have something asked with the lock held, and wait for what the function that it is given gets."""
        done = threading.Event()
        answers: list[str | None] = []

        def end(answer: str | None) -> None:
            answers.append(answer)
            done.set()

        with self.lock:
            ask(end)
        self._wake()
        done.wait(within_s)
        return answers[0] if answers else otherwise

    # On the link's thread ----------------------------------------------------------------------------------------

    @abstractmethod
    def _renew(self) -> None:
        """Make sockets, or make them anew, where it is time to. With the lock free."""

    @abstractmethod
    def _receive(self, ready: object, /) -> None:
        """Read what came at this socket. With the lock free."""

    @abstractmethod
    def _say(self, now_ns: int) -> None:
        """Send what is due. With the lock held, on any thread."""

    def _look(self, now_ns: int) -> None:
        """Do what goes by other paces than the session's. With the lock held."""

    @abstractmethod
    def _release(self) -> None:
        """Close what the link opened."""

    def _step(self) -> None:
        with self.lock:
            wait_ns = self.session.due_ns - self._clock()
        ready = self._selector.select(max(0.0, seconds(wait_ns)))
        self._renew()
        for key, _ in ready:
            if key.fileobj is self._awake:
                self._slept()
            else:
                self._receive(key.fileobj)
        with self.lock:
            now_ns = self._clock()
            if now_ns >= self.session.due_ns:
                self._say(now_ns)
            self._look(now_ns)
            tellings = self.session.tellings()
        if not self._stopping.is_set():
            self._deliver(tellings)

    def _run(self) -> None:
        try:
            while not self._stopping.is_set():
                try:
                    self._step()
                except Exception as error:  # noqa: BLE001  whatever happens, the vehicle must be told what to do
                    self._deliver([partial(_tell_failure, error)])
                    self._stopping.wait(PAUSE_S)
        finally:
            self._release()
            self._selector.close()
            self._awake.close()
            self._waker.close()

    def _wake(self) -> None:
        """Have the thread look at once. From any thread."""
        with suppress(OSError):  # it is awake, or it ended
            self._waker.send(b"\0")

    def _slept(self) -> None:
        """It was woken: nothing of that is left."""
        with suppress(OSError):
            while self._awake.recv(4096):
                pass


def _tell_failure(error: Exception, sink: Sink) -> None:
    sink.event(EventKind.DRIVER_ERROR, f"the link to the vehicle failed: {error!r}", Severity.ERROR, where="link")
