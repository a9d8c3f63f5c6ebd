"""UDP sockets of this host towards one Tello."""

from __future__ import annotations

import errno
import socket
from typing import Final

from skyloop.drivers.tello.options import TelloOptions

MAX_DATAGRAM: Final = 65_536
_BUFFER: Final = 1 << 20  # half a second of video


def address_of(options: TelloOptions) -> str:
    """The drone's. Raises OSError for a name that nobody knows."""
    return str(socket.getaddrinfo(options.host, None, socket.AF_INET, socket.SOCK_DGRAM)[0][4][0])


def towards(options: TelloOptions, address: str) -> socket.socket:
    """Sends commands and hears their answers; takes datagrams of the drone's port alone. Raises OSError."""
    made = _through(options)
    try:
        made.bind((options.local or "", 0))
        made.connect((address, options.port))
    except OSError:
        made.close()
        raise
    return made


def at(options: TelloOptions, local: str, port: int) -> socket.socket:
    """Hears what comes to this port of this host, from whomever: look at the sender. Raises OSError."""
    made = _through(options)
    try:
        made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
        made.bind((local, port))
    except OSError as error:
        made.close()
        if error.errno == errno.EADDRINUSE:
            raise OSError(
                error.errno,
                f"UDP port {port} of {local} is in use: end the other program, or see how docs/tello.md flies several",
            ) from error
        raise
    return made


def _through(options: TelloOptions) -> socket.socket:
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    made.setblocking(False)
    if options.interface is not None:
        try:
            made.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, options.interface.encode() + b"\0")
        except OSError as error:
            made.close()
            raise OSError(error.errno, f"interface {options.interface}: {error.strerror}") from error
    return made
