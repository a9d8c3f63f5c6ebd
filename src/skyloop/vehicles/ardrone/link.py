"""One drone's sockets: navdata, AT commands and the control port."""

from __future__ import annotations

import errno
import os
import selectors
import socket
from collections.abc import Callable
from contextlib import suppress
from typing import Final

from skyloop.clock import Clock, monotonic_ns, nanoseconds
from skyloop.drivers.vehicle_link import MAX_DATAGRAM, VehicleLink
from skyloop.drivers.vehicle_session import SinkCallback
from skyloop.vehicles.ardrone.configuration import Configurator, Exchange, Read, Write
from skyloop.vehicles.ardrone.protocol import REPEATS, START_NAVDATA, ArdroneSession
from skyloop.vehicles.ardrone.wire.at import AtMessage

WRITE_S: Final = 0.9  #: time allowed for writing a key, including the acknowledgement and reading it back


class ArdroneLink(VehicleLink[ArdroneSession]):
    """The link to one drone: navdata, AT commands and the control port."""

    def __init__(
        self, session: ArdroneSession, deliver: Callable[[list[SinkCallback]], None], clock: Clock = monotonic_ns
    ) -> None:
        super().__init__("skyloop-ardrone", session, deliver, clock)
        self._navdata: socket.socket | None = None
        self._at: socket.socket | None = None
        self._dump = DumpClient(session.options.ports.control, self._selector, self._serve_dump)

    # From the proxy's threads ----------------------------------------------------------------------------------

    def send(self, message: AtMessage, times: int = REPEATS) -> None:
        """Send an unacknowledged command in each of the next ``times`` ticks. May be called from any thread."""
        with self.lock:
            self.session.send(message, times)

    def write(self, key: str, text: str) -> str | None:
        """Write a key and read it back within 0.9 s; return the failure or None. Never call it on the link's thread."""

        def ask(end: Callable[[str | None], None]) -> None:
            deadline_ns = self._clock() + nanoseconds(WRITE_S)
            self.session.submit(Exchange(iter((Write(key, text), Read())), deadline_ns, end))

        return self._wait_for_answer(ask, WRITE_S + 0.1, "the driver did not get to it")

    # On the link's thread --------------------------------------------------------------------------------------

    def _open_sockets(self) -> None:
        options = self.session.options
        address = self._lookup.address(options.host)
        navdata = _connected(address, options.ports.navdata)
        try:
            at = _connected(address, options.ports.at)
        except OSError:
            navdata.close()
            raise
        with self.lock:
            self._close_ports()
            self._navdata, self._at, self._dump.address = navdata, at, address
        self._watch(navdata, lambda: self._read_datagrams(navdata, self.session.on_navdata))
        self._watch(at, lambda: _discard(at))

    def _close_sockets(self) -> None:
        self._close_ports()
        self._dump.close()

    def _close_ports(self) -> None:
        for port in (self._navdata, self._at):
            if port is not None:
                self._forget(port)
        self._navdata = self._at = None

    def _send_due(self, now_ns: int) -> None:
        datagram = self.session.poll(now_ns)
        if datagram and self._at is not None:
            self._send_datagram(self._at, datagram)

    def _poll(self, now_ns: int) -> None:
        if self._navdata is not None and self.session.wants_start(now_ns):
            self._send_datagram(self._navdata, START_NAVDATA)
        self._dump.follow(self.session.configurator, now_ns)

    def _serve_dump(self) -> None:
        with self.lock:
            self._dump.serve(self.session.configurator)
            self.session.due_ns = 0  # so that the session continues at once


def _connected(address: str, port: int) -> socket.socket:
    connection = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        connection.setblocking(False)
        connection.connect((address, port))
    except OSError:
        connection.close()
        raise
    return connection


def _discard(port: socket.socket) -> None:
    """Discard data received on the AT port: only errors from the host, which the navdata socket also reports."""
    with suppress(OSError):
        while port.recv(MAX_DATAGRAM):
            pass


# The control port ----------------------------------------------------------------------------------------------------

RETRY_NS: Final = nanoseconds(0.25)  #: time between attempts to connect to the control port
_CHUNK: Final = 1 << 16  #: maximum number of bytes per read


class DumpClient:
    """Fetches the dump that the configurator requests, over a separate connection to the control port."""

    def __init__(self, port: int, selector: selectors.BaseSelector, ready: Callable[[], None]) -> None:
        self.address = ""  #: the drone's address; empty until known
        self._port = port
        self._selector = selector
        self._ready = ready
        self._number = 0
        self._connection: socket.socket | None = None
        self._connected = False
        self._tried_ns = -RETRY_NS

    def follow(self, configurator: Configurator, now_ns: int) -> None:
        """Open or close the connection as the configurator requires. Called in every step of the link."""
        if configurator.wants_dump != self._number:
            self.close()
            self._number, self._tried_ns = configurator.wants_dump, -RETRY_NS
        if self._number and self._connection is None and now_ns - self._tried_ns >= RETRY_NS:
            self._tried_ns = now_ns
            self._connect(configurator)

    def serve(self, configurator: Configurator) -> None:
        """Handle a socket event: the connection was established or failed, or data can be read."""
        connection = self._connection
        if connection is None:
            return
        try:
            if not self._connected:
                self._finish_connecting(connection, configurator)
                return
            data = connection.recv(_CHUNK)
        except BlockingIOError:
            return
        except OSError as error:
            self._fail(configurator, error.strerror or str(error))
            return
        if not data:
            self._fail(configurator, "the connection ended early")
        elif configurator.dump_received(data):
            self.close()

    def close(self) -> None:
        """Close the connection if it is open."""
        if self._connection is not None:
            self._selector.unregister(self._connection)
            self._connection.close()
            self._connection = None

    def _connect(self, configurator: Configurator) -> None:
        self._connected = False
        connection = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        connection.setblocking(False)
        try:
            code = connection.connect_ex((self.address, self._port))
        except OSError as error:  # there is no usable address
            connection.close()
            configurator.dump_failed(self._with_port(error.strerror or str(error)))
            return
        self._connection = connection
        self._selector.register(connection, selectors.EVENT_READ | selectors.EVENT_WRITE, self._ready)
        if code not in (0, errno.EINPROGRESS):
            self._fail(configurator, os.strerror(code))

    def _finish_connecting(self, connection: socket.socket, configurator: Configurator) -> None:
        code = connection.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        if code:
            self._fail(configurator, os.strerror(code))
            return
        self._connected = True
        self._selector.modify(connection, selectors.EVENT_READ, self._ready)
        configurator.dump_opened()

    def _fail(self, configurator: Configurator, reason: str) -> None:
        self.close()
        configurator.dump_failed(self._with_port(reason))

    def _with_port(self, reason: str) -> str:
        return f"TCP port {self._port}: {reason}"
