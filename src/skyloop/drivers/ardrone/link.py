"""The sockets of one drone and the thread that serves them: navdata, AT at their pace, the control port.

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
from skyloop.drivers.ardrone.configuration import Exchange, Read, Write
from skyloop.drivers.ardrone.dump_client import DumpClient
from skyloop.drivers.ardrone.sender import Message
from skyloop.drivers.ardrone.session import REPEATS, START_NAVDATA, Session, Telling
from skyloop.drivers.link_thread import LinkThread, tell_failure
from skyloop.messages import AnyAction

MAX_DATAGRAM: Final = 65_536
BURST: Final = 32  #: datagrams that are read before AT commands get their turn
WRITE_S: Final = 0.9  #: a key is written, acknowledged and read back within this, or it failed
RENEW_NS: Final = nanoseconds(2.0)  #: pace of new sockets while nothing is heard: this host's address may have changed
_CLOSE_S: Final = 2.0


class Link(LinkThread):
    """Serves a session from :meth:`start` to :meth:`stop`. ``deliver`` gets its tellings, on the link's thread."""

    def __init__(self, session: Session, deliver: Callable[[list[Telling]], None], clock: Clock = monotonic_ns) -> None:
        super().__init__("skyloop-ardrone", close_s=_CLOSE_S)
        self.session = session
        self._deliver = deliver
        self._clock = clock
        self._navdata: socket.socket | None = None
        self._at: socket.socket | None = None
        self._renewed_ns = -RENEW_NS
        self._dump = DumpClient(session.options.ports.control, self._selector)

    def stop(self) -> None:
        """End, and give everything back. Exchanges that go on fail."""
        self.join()
        with self.lock:
            self.session.close()

    # From the proxy's threads ----------------------------------------------------------------------------------

    def command(self, action: AnyAction) -> AnyAction:
        """Decide, and say it at once unless the last datagram was just sent."""
        with self.lock:
            now_ns = self._clock()
            applied = self.session.command(action, now_ns)
            due_ns = self.session.due_ns
            if due_ns <= now_ns:
                self._say(now_ns)
        if now_ns < due_ns:
            self.wake()
        return applied

    def say(self, message: Message, times: int = REPEATS) -> None:
        """A command without acknowledgement, at this many ticks."""
        with self.lock:
            self.session.say(message, times)

    def write(self, key: str, text: str) -> str | None:
        """Write a key and read it back. Returns why that failed, or None. Takes up to 0.9 s."""
        done = threading.Event()
        failures: list[str | None] = []

        def end(failure: str | None) -> None:
            failures.append(failure)
            done.set()

        with self.lock:
            deadline_ns = self._clock() + nanoseconds(WRITE_S)
            self.session.submit(Exchange(iter((Write(key, text), Read())), deadline_ns, end))
        self.wake()
        if not done.wait(WRITE_S + 0.1):
            return "the driver did not get to it"
        return failures[0]

    # On the link's thread --------------------------------------------------------------------------------------

    def _fail(self, error: Exception) -> None:
        self._deliver([partial(tell_failure, error)])

    def _release(self) -> None:
        with self.lock:
            self._close_sockets()
        self._dump.close()

    def _step(self) -> None:
        now_ns = self._clock()
        with self.lock:
            wait_ns = self.session.due_ns - now_ns
        ready = self._selector.select(max(0.0, seconds(wait_ns)))
        self._renew_sockets()
        for key, _ in ready:
            if key.fileobj is self._awake:
                self._slept()
            elif key.fileobj is self._navdata:
                self._receive(self._navdata)
            elif key.fileobj is self._at:
                self._drain(self._at)
            else:
                with self.lock:
                    self._dump.serve(self.session.configurator)
                    self.session.due_ns = 0  # to go on at once
        with self.lock:
            now_ns = self._clock()
            if now_ns >= self.session.due_ns:
                self._say(now_ns)
            if self._navdata is not None and self.session.wants_start(now_ns):
                self._send(self._navdata, START_NAVDATA)
            self._dump.follow(self.session.configurator, now_ns)
            tellings = self.session.tellings()
        if not self._stopping.is_set():
            self._deliver(tellings)

    def _receive(self, navdata: socket.socket) -> None:
        for _ in range(BURST):
            try:
                datagram = navdata.recv(MAX_DATAGRAM)
            except BlockingIOError:
                return
            except OSError as error:
                with self.lock:
                    self.session.unreachable(error.strerror or str(error))
                return
            with self.lock:
                self.session.heard(datagram, self._clock())

    def _drain(self, connection: socket.socket) -> None:
        """Nothing is expected here but errors that the host sent back, which the navdata's socket gets as well."""
        try:
            while connection.recv(MAX_DATAGRAM):
                pass
        except OSError:
            pass

    def _say(self, now_ns: int) -> None:
        datagram = self.session.tick(now_ns)
        if datagram and self._at is not None:
            self._send(self._at, datagram)

    def _send(self, connection: socket.socket, datagram: bytes) -> None:
        try:
            connection.send(datagram)
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
        options = self.session.options
        try:
            address = str(socket.getaddrinfo(options.host, None, socket.AF_INET, socket.SOCK_DGRAM)[0][4][0])
            navdata = self._connected(address, options.ports.navdata)
            at = self._connected(address, options.ports.at)
        except OSError as error:
            with self.lock:
                self.session.unreachable(error.strerror or str(error))
            return
        with self.lock:
            self._close_sockets()
            self._navdata, self._at, self._dump.address = navdata, at, address
        self._selector.register(navdata, selectors.EVENT_READ)
        self._selector.register(at, selectors.EVENT_READ)

    @staticmethod
    def _connected(address: str, port: int) -> socket.socket:
        connection = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            connection.setblocking(False)
            connection.connect((address, port))
        except OSError:
            connection.close()
            raise
        return connection

    def _close_sockets(self) -> None:
        for connection in (self._navdata, self._at):
            if connection is not None:
                self._selector.unregister(connection)
                connection.close()
        self._navdata = self._at = None
