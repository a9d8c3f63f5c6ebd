"""Reads the drone's configuration from its control port (TCP), without ever blocking."""

from __future__ import annotations

import errno
import os
import selectors
import socket
from typing import Final

from skyloop.clock import nanoseconds
from skyloop.drivers.ardrone.configuration import Configurator

RETRY_NS: Final = nanoseconds(0.25)
_CHUNK: Final = 1 << 16


class DumpClient:
    """Connects when the configurator wants a dump, feeds it, and lets go when it has it."""

    def __init__(self, port: int, selector: selectors.BaseSelector) -> None:
        self.address = ""  #: of the drone, once it is known
        self._port = port
        self._selector = selector
        self._number = 0
        self._connection: socket.socket | None = None
        self._connected = False
        self._tried_ns = -RETRY_NS

    def follow(self, configurator: Configurator, now_ns: int) -> None:
        """Connect or let go, as the configurator wants. To be called at every step."""
        if configurator.wants_dump != self._number:
            self.close()
            self._number, self._tried_ns = configurator.wants_dump, -RETRY_NS
        if self._number and self._connection is None and now_ns - self._tried_ns >= RETRY_NS:
            self._tried_ns = now_ns
            self._connect(configurator)

    def serve(self, configurator: Configurator) -> None:
        """The connection is ready: it is made, failed, or has data."""
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
        """Let go."""
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
        except OSError as error:  # no address to speak of
            connection.close()
            configurator.dump_failed(self._told(error.strerror or str(error)))
            return
        self._connection = connection
        self._selector.register(connection, selectors.EVENT_READ | selectors.EVENT_WRITE)
        if code not in (0, errno.EINPROGRESS):
            self._fail(configurator, os.strerror(code))

    def _finish_connecting(self, connection: socket.socket, configurator: Configurator) -> None:
        code = connection.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        if code:
            self._fail(configurator, os.strerror(code))
            return
        self._connected = True
        self._selector.modify(connection, selectors.EVENT_READ)
        configurator.dump_opened()

    def _fail(self, configurator: Configurator, reason: str) -> None:
        self.close()
        configurator.dump_failed(self._told(reason))

    def _told(self, reason: str) -> str:
        return f"TCP port {self._port}: {reason}"
