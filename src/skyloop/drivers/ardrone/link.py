"""The sockets of one drone and the thread that serves them: navdata, AT at their pace, the control port."""

from __future__ import annotations

import selectors
import socket
from collections.abc import Callable
from functools import partial
from typing import Final

from skyloop.clock import Clock, monotonic_ns, nanoseconds
from skyloop.drivers.ardrone.configuration import Exchange, Read, Write
from skyloop.drivers.ardrone.dump_client import DumpClient
from skyloop.drivers.ardrone.sender import Message
from skyloop.drivers.ardrone.session import REPEATS, START_NAVDATA, Session
from skyloop.drivers.vehicle_link import VehicleLink
from skyloop.drivers.vehicle_session import Telling
from skyloop.messages import AnyAction

MAX_DATAGRAM: Final = 65_536
BURST: Final = 32  #: datagrams that are read before AT commands get their turn
WRITE_S: Final = 0.9  #: a key is written, acknowledged and read back within this, or it failed
RENEW_NS: Final = nanoseconds(2.0)  #: pace of new sockets while nothing is heard: this host's address may have changed


class Link(VehicleLink[Session]):
    """As :class:`VehicleLink`."""

    def __init__(self, session: Session, deliver: Callable[[list[Telling]], None], clock: Clock = monotonic_ns) -> None:
        super().__init__("skyloop-ardrone", session, deliver, clock)
        self._navdata: socket.socket | None = None
        self._at: socket.socket | None = None
        self._renewed_ns = -RENEW_NS
        self._dump = DumpClient(session.options.ports.control, self._selector)

    # From the proxy's threads ----------------------------------------------------------------------------------

    def command(self, action: AnyAction) -> AnyAction:
        """Decide, and say it at once unless the last datagram was just sent."""
        return self._decided(partial(self.session.command, action))

    def say(self, message: Message, times: int = REPEATS) -> None:
        """A command without acknowledgement, at this many ticks."""
        with self.lock:
            self.session.say(message, times)

    def write(self, key: str, text: str) -> str | None:
        """Write a key and read it back. Returns why that failed, or None. Takes up to 0.9 s."""

        def ask(end: Callable[[str | None], None]) -> None:
            deadline_ns = self._clock() + nanoseconds(WRITE_S)
            self.session.submit(Exchange(iter((Write(key, text), Read())), deadline_ns, end))

        return self._answer(ask, WRITE_S + 0.1, "the driver did not get to it")

    # On the link's thread --------------------------------------------------------------------------------------

    def _release(self) -> None:
        with self.lock:
            self._close_sockets()
        self._dump.close()

    def _receive(self, ready: object) -> None:
        navdata, at = self._navdata, self._at
        if navdata is not None and ready is navdata:
            self._receive_navdata(navdata)
        elif at is not None and ready is at:
            self._drain(at)
        else:
            with self.lock:
                self._dump.serve(self.session.configurator)
                self.session.due_ns = 0  # to go on at once

    def _look(self, now_ns: int) -> None:
        if self._navdata is not None and self.session.wants_start(now_ns):
            self._send(self._navdata, START_NAVDATA)
        self._dump.follow(self.session.configurator, now_ns)

    def _receive_navdata(self, navdata: socket.socket) -> None:
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

    def _renew(self) -> None:
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
