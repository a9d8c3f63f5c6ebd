"""Connections that carry bytes in order, without waiting: TCP and serial ports."""

from __future__ import annotations

import os
import re
import socket
import time
from abc import ABC, abstractmethod
from contextlib import suppress
from enum import IntEnum
from pathlib import Path
from typing import Final

from skyloop.clock import Clock, monotonic_ns, nanoseconds
from skyloop.errors import MissingExtraError
from skyloop.files import wait_readable

CONNECT_S: Final = 1.0
STUCK_NS: Final = nanoseconds(0.5)  #: a connection that has no room for so long is no longer read
_MOST: Final = 65_536  # bytes read at once
_BITS: Final = 10  # that a serial line takes for a byte
_DRAIN_S: Final = 0.1  # that closing a serial port may take


class Rank(IntEnum):
    """How important a packet is: the first is sent whatever is under way, the last only on a line that is free."""

    COMMAND = 0  #: emergency stops, modes, arming: rare, small, never held back
    SETPOINT = 1
    QUERY = 2  #: requests, parameters
    POSE = 3  #: poses from outside, which come often and are large


#: How far the line may be behind for a packet to be sent [ns].
_PATIENCE_NS: Final = {
    Rank.SETPOINT: nanoseconds(0.1),
    Rank.QUERY: nanoseconds(0.06),
    Rank.POSE: nanoseconds(0.02),
}


class LinePace:
    """Tells how far a slow line is behind, so that what is sent is new when it arrives. Pure.

    Args:
        bytes_per_s: Of the line; None: it is as fast as needed.
    """

    def __init__(self, bytes_per_s: float | None) -> None:
        self._ns_per_byte = 0.0 if bytes_per_s is None else 1e9 / bytes_per_s
        self._free_ns = 0  # when all that was written has been carried

    def admits(self, rank: Rank, now_ns: int) -> bool:
        """Return whether a packet may be sent now; if not, it would wait behind others and arrive late."""
        return rank is Rank.COMMAND or self._free_ns - now_ns <= _PATIENCE_NS[rank]

    def on_written(self, size: int, now_ns: int) -> None:
        """Note that so many bytes were written."""
        self._free_ns = max(self._free_ns, now_ns) + round(size * self._ns_per_byte)


class ByteStream(ABC):
    """An open connection. Not thread-safe.

    ``dropped`` counts the packets that were not sent, because the line was behind or had no room.

    Args:
        pace: Of the line.
        clock: Monotonic, ns.
    """

    def __init__(self, pace: LinePace, clock: Clock) -> None:
        self.dropped = 0
        self._pace = pace
        self._clock = clock
        self._full_ns: int | None = None  # since when there is no room

    @abstractmethod
    def fileno(self) -> int:
        """Return the descriptor."""

    @abstractmethod
    def read(self) -> bytes:
        """Return what came, possibly nothing.

        Raises:
            OSError: Nothing more will come.
        """

    def write(self, data: bytes, rank: Rank = Rank.SETPOINT) -> None:
        """Send a packet, or drop it where there is no room or the line is behind. Never waits.

        Args:
            data: The packet.
            rank: Its importance.

        Raises:
            OSError: It can't be sent, or only in part so that what follows would be noise, or nothing could be sent for
                :data:`STUCK_NS`.
        """
        now_ns = self._clock()
        if not self._pace.admits(rank, now_ns):
            self.dropped += 1
            return
        try:
            sent = self._write(data)
        except BlockingIOError:
            self.dropped += 1
            if self._full_ns is None:
                self._full_ns = now_ns
            if now_ns - self._full_ns < STUCK_NS:
                return
            sent = 0
        if sent < len(data):
            self._full_ns = now_ns if self._full_ns is None else self._full_ns
            raise ConnectionError("the vehicle no longer reads what is sent")
        self._full_ns = None
        self._pace.on_written(sent, now_ns)

    @abstractmethod
    def _write(self, data: bytes) -> int:
        """Write what there is room for and return how many bytes that were; raise BlockingIOError for none."""

    @abstractmethod
    def close(self) -> None:
        """Close the connection."""


class TcpStream(ByteStream):
    """A client of a TCP server. Connected is not yet served.

    Args:
        host: Numeric.
        port: TCP.
        clock: Monotonic, ns.

    Raises:
        OSError: It can't be reached within :data:`CONNECT_S`.
    """

    def __init__(self, host: str, port: int, clock: Clock = monotonic_ns) -> None:
        super().__init__(LinePace(None), clock)
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

    def _write(self, data: bytes) -> int:
        return self._socket.send(data)

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()


class SerialStream(ByteStream):
    """A serial port, through pyserial, opened for this process alone.

    Args:
        path: Of the device.
        baud: Bits a second.
        what: That needs it, for the error.
        extra: That installs pyserial, for the error.
        clock: Monotonic, ns.

    Raises:
        OSError: It can't be opened.
        MissingExtraError: pyserial is not installed.
    """

    def __init__(self, path: str, baud: int, what: str, extra: str, clock: Clock = monotonic_ns) -> None:
        try:
            import serial
        except ImportError as error:
            raise MissingExtraError(what, extra, cause=str(error)) from error
        super().__init__(LinePace(line_speed(path, baud)), clock)
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
        if not wait_readable(self, 0.0):
            return b""
        data = os.read(self.fileno(), _MOST)  # pyserial's own waits by select.select, which knows low numbers only
        if not data:
            raise ConnectionError("the port was unplugged, or another program reads it")
        return data

    def _write(self, data: bytes) -> int:
        return os.write(self.fileno(), data)  # pyserial's own tries again and again while there is no room

    def close(self) -> None:
        """Close the port. What nobody reads is thrown away: the system would wait for it, with some ports for 30 s."""
        with suppress(Exception):  # it may be unplugged, and the error of a terminal is no OSError
            until_s = time.monotonic() + (_DRAIN_S if self._full_ns is None else 0.0)
            while self._port.out_waiting and time.monotonic() < until_s:
                time.sleep(0.005)
            if self._full_ns is not None or self._port.out_waiting:
                self._port.reset_output_buffer()
        self._port.close()


def line_speed(path: str, baud: int) -> float | None:
    """Return how many bytes a second a serial port carries; None for one over USB, whose bit rate means nothing.

    Args:
        path: Of the device; links are followed.
        baud: Bits a second.
    """
    device = Path(path).resolve().name
    return None if re.match(r"ttyACM|(cu|tty)\.usbmodem", device) else baud / _BITS
