"""The sockets of one drone and the thread that serves them: commands at their pace, answers, state.

All decisions are the session's, made under one lock; what it tells is delivered by this thread with the lock free.
"""

from __future__ import annotations

import selectors
import socket
import threading
from collections.abc import Callable
from functools import partial
from typing import Final

from skyloop.clock import Clock, monotonic_ns, nanoseconds, seconds
from skyloop.drivers.link_thread import LinkThread, tell_failure
from skyloop.drivers.tello.session import Session, Telling
from skyloop.drivers.tello.sockets import MAX_DATAGRAM, address_of, at, towards
from skyloop.messages import AnyAction

BURST: Final = 32  #: datagrams that are read before commands get their turn
ASK_S: Final = 0.95  #: a command is answered within this, or it failed
RENEW_NS: Final = nanoseconds(2.0)  #: pace of new sockets while nothing is heard: this host's address may have changed
_CLOSE_S: Final = 2.0


class Link(LinkThread):
    """Serves a session from :meth:`start` to :meth:`stop`. ``deliver`` gets its tellings, on the link's thread."""

    def __init__(self, session: Session, deliver: Callable[[list[Telling]], None], clock: Clock = monotonic_ns) -> None:
        super().__init__("skyloop-tello", close_s=_CLOSE_S)
        self.session = session
        self.addresses: tuple[str, str] | None = None  #: the drone's, and this host's towards it
        self._deliver = deliver
        self._clock = clock
        self._commands: socket.socket | None = None
        self._states: socket.socket | None = None
        self._renewed_ns = -RENEW_NS

    def stop(self) -> None:
        """End, and give everything back. Questions that wait are answered by nothing."""
        self.join()
        with self.lock:
            self.session.close()

    # From the proxy's threads ----------------------------------------------------------------------------------

    def command(self, action: AnyAction) -> AnyAction:
        """Decide, and say it at once unless the last ``rc`` was just sent."""
        with self.lock:
            now_ns = self._clock()
            applied = self.session.command(action, now_ns)
            due_ns = self.session.due_ns
            if due_ns <= now_ns:
                self._say(now_ns)
        if now_ns < due_ns:
            self.wake()
        return applied

    def ask(self, text: str) -> str | None:
        """Say a command and wait for its answer; None if none came. Takes up to 0.95 s."""
        done = threading.Event()
        replies: list[str | None] = []

        def end(reply: str | None) -> None:
            replies.append(reply)
            done.set()

        with self.lock:
            self.session.ask(text, end)
        self.wake()
        done.wait(ASK_S)
        return replies[0] if replies else None

    # On the link's thread --------------------------------------------------------------------------------------

    def _fail(self, error: Exception) -> None:
        self._deliver([partial(tell_failure, error)])

    def _release(self) -> None:
        with self.lock:
            self._close_sockets()

    def _step(self) -> None:
        now_ns = self._clock()
        with self.lock:
            wait_ns = self.session.due_ns - now_ns
        ready = self._selector.select(max(0.0, seconds(wait_ns)))
        self._renew_sockets()
        for key, _ in ready:
            if key.fileobj is self._awake:
                self._slept()
            elif key.fileobj is self._commands:
                self._receive(self._commands, self.session.reply_heard)
            elif key.fileobj is self._states:
                self._receive(self._states, self.session.state_heard)
        with self.lock:
            now_ns = self._clock()
            if now_ns >= self.session.due_ns:
                self._say(now_ns)
            tellings = self.session.tellings()
        if not self._stopping.is_set():
            self._deliver(tellings)

    def _receive(self, port: socket.socket, heard: Callable[[bytes, int], None]) -> None:
        for _ in range(BURST):
            try:
                datagram, sender = port.recvfrom(MAX_DATAGRAM)
            except BlockingIOError:
                return
            except OSError as error:
                with self.lock:
                    self.session.unreachable(error.strerror or str(error))
                return
            if self.addresses is not None and sender[0] == self.addresses[0]:
                with self.lock:
                    heard(datagram, self._clock())

    def _say(self, now_ns: int) -> None:
        for datagram in self.session.tick(now_ns):
            if self._commands is None:
                return
            try:
                self._commands.send(datagram)
            except BlockingIOError:
                pass  # lost, like any datagram may be
            except OSError as error:
                self.session.unreachable(error.strerror or str(error))

    # Sockets ---------------------------------------------------------------------------------------------------

    def _renew_sockets(self) -> None:
        """Make them, and make them anew now and then while the drone is not heard."""
        now_ns = self._clock()
        with self.lock:
            if self.session.is_heard or now_ns - self._renewed_ns < RENEW_NS:
                return
            self._renewed_ns = now_ns
            self._close_sockets()
            try:
                self._open_sockets()
            except OSError as error:
                self._close_sockets()
                self.session.unreachable(error.strerror or str(error))

    def _open_sockets(self) -> None:
        options = self.session.options
        address = address_of(options)
        self._commands = towards(options, address)
        self._selector.register(self._commands, selectors.EVENT_READ)
        local = str(self._commands.getsockname()[0])
        self._states = at(options, local, options.state_port)
        self._selector.register(self._states, selectors.EVENT_READ)
        self.addresses = address, local

    def _close_sockets(self) -> None:
        for port in (self._commands, self._states):
            if port is not None:
                self._selector.unregister(port)
                port.close()
        self._commands = self._states = None
