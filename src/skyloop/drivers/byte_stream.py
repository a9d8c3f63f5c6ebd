"""Connections that carry bytes in order, without waiting: TCP and serial ports."""

from __future__ import annotations

import select
import socket
from typing import Final, Protocol

from skyloop.errors import MissingExtraError

CONNECT_S: Final = 1.0
_MOST: Final = 65_536  # bytes read at once


class ByteStream(Protocol):
    """An open connection."""

    def fileno(self) -> int: ...

    def read(self) -> bytes:
        """Return what came, possibly nothing.

        Raises:
            OSError: Nothing more will come.
        """

    def write(self, data: bytes) -> None:
        """Send, or drop it where there is no room.

        Raises:
            OSError: It can't be sent, or only in part: what follows would be noise.
        """

    def close(self) -> None: ...


class TcpStream:
    """A client of a TCP server. Connected is not yet served.

    Args:
        host: Numeric.
        port: TCP.

    Raises:
        OSError: It can't be reached within :data:`CONNECT_S`.
    """

    def __init__(self, host: str, port: int) -> None:
        self._socket = socket.create_connection((host, port), CONNECT_S)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setblocking(False)

    def fileno(self) -> int:
        """Return the descriptor."""
        return self._socket.fileno()

    def read(self) -> bytes:
        """Return what came, possibly nothing.

        Raises:
            OSError: The connection ended.
        """
        try:
            data = self._socket.recv(_MOST)
        except BlockingIOError:
            return b""
        if not data:
            raise ConnectionError("the vehicle ended the connection")
        return data

    def write(self, data: bytes) -> None:
        """Send, or drop it where there is no room.

        Raises:
            OSError: It was sent in part: what follows half a frame would be noise.
        """
        try:
            sent = self._socket.send(data)
        except BlockingIOError:
            return
        if sent < len(data):
            raise ConnectionError("the vehicle no longer reads what is sent")

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()


class SerialStream:
    """A serial port, through pyserial, opened for this process alone.

    Args:
        path: Of the device.
        baud: Bits a second.
        what: That needs it, for the error.
        extra: That installs pyserial, for the error.

    Raises:
        OSError: It can't be opened.
        MissingExtraError: pyserial is not installed.
    """

    def __init__(self, path: str, baud: int, what: str, extra: str) -> None:
        try:
            import serial
        except ImportError as error:
            raise MissingExtraError(what, extra, cause=str(error)) from error
        self._port = serial.Serial(path, baud, timeout=0, write_timeout=0, exclusive=True)

    def fileno(self) -> int:
        """Return the descriptor."""
        number: int = self._port.fileno()
        return number

    def read(self) -> bytes:
        """Return what came, possibly nothing.

        Raises:
            OSError: It was unplugged.
        """
        if not select.select([self], [], [], 0)[0]:
            return b""
        data: bytes = self._port.read(_MOST)  # raises SerialException, an OSError, once it is unplugged
        return data

    def write(self, data: bytes) -> None:
        """Send."""
        self._port.write(data)

    def close(self) -> None:
        """Close the port."""
        self._port.close()
