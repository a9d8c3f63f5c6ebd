"""Transfer bytes in order over connections that never block: TCP and serial ports."""

from __future__ import annotations

import os
import re
import socket
import struct
import sys
import threading
import time
from abc import ABC, abstractmethod
from contextlib import suppress
from enum import IntEnum
from pathlib import Path
from typing import Any, Final

from skyloop.clock import Clock, monotonic_ns, nanoseconds
from skyloop.errors import MissingExtraError
from skyloop.platform import socket_pair, wait_readable

CONNECT_S: Final = 1.0  #: time limit for establishing a TCP connection
STUCK_NS: Final = nanoseconds(0.5)  #: time after which a connection with a full buffer is considered dead
_READ_BYTES: Final = 65_536  # maximum number of bytes per read
_BITS_PER_BYTE: Final = 10  # bits sent per byte on a serial line, including start and stop bits
_DRAIN_S: Final = 0.1  # time limit for closing one connection before opening the next
END_S: Final = 0.5  #: time limit for the last close; TCP resends a lost packet after 0.2 s
_UNACKNOWLEDGED_MS: Final = 2500  # time without acknowledgement after which TCP drops the connection
_WINDOWS_BUFFER: Final = 4096  # size of output buffers [bytes]: Windows does not count the unsent bytes of TCP
_SO_NWRITE: Final = 0x1024  # bytes in a socket's output buffer (macOS' sys/socket.h, where TIOCOUTQ is for terminals)
_LOOK_S: Final = 0.1  # how often the threads of a port of Windows check whether it is to be closed
_AT_ONCE: Final = 256  # maximum number of bytes that such a thread writes at once
_OVERDUE_NS: Final = nanoseconds(0.1)  # a line counts as stalled if bytes are unsent this long after they were due
_TCP_OVERDUE_NS: Final = nanoseconds(0.3)  # TCP may acknowledge 0.2 s late, and by then has resent lost packets
#: Size of the longest frame in MAVLink and MSP [bytes]. The parser of a flight controller consumes as many bytes as a
#: frame announces without looking for another frame in them. A frame that may be incomplete is therefore padded before
#: a stop is sent.
_LONGEST: Final = 280


class Rank(IntEnum):
    """Priority of a packet. STOP is always sent immediately, the last rank only when the line is idle."""

    STOP = 0  #: emergency stops, which empty the output buffer of a serial port
    COMMAND = 1  #: modes and arming: rare and small packets that are never held back
    SETPOINT = 2
    QUERY = 3  #: requests, parameters
    POSE = 4  #: external poses: frequent and large packets


#: Maximum backlog of the line at which a packet of each rank is still sent [ns].
_PATIENCE_NS: Final = {Rank.SETPOINT: nanoseconds(0.1), Rank.QUERY: nanoseconds(0.06), Rank.POSE: nanoseconds(0.02)}


class LinePace:
    """Estimates the backlog of a line; packets can then be held back rather than arrive late. Pure.

    Args:
        bytes_per_s: Speed of the line; None if the line never limits the rate.
        overdue_ns: How late written bytes may be before the line counts as stalled.
    """

    def __init__(self, bytes_per_s: float | None, overdue_ns: int = _OVERDUE_NS) -> None:
        self._overdue_ns = overdue_ns
        self._ns_per_byte = 0.0 if bytes_per_s is None else 1e9 / bytes_per_s
        self._free_ns = 0  # time at which all bytes written so far will have been sent
        self._written = 0  # number of bytes written so far
        self._mark = 0  # how many of these bytes should have been sent by _due_ns
        self._due_ns: int | None = None  # when those bytes should have been sent; None if there are none

    def admits(self, rank: Rank, now_ns: int) -> bool:
        """Return whether a packet may be sent now; if not, it would wait behind others and arrive late."""
        return rank <= Rank.COMMAND or self._free_ns - now_ns <= _PATIENCE_NS[rank]

    def stalled(self, now_ns: int) -> bool:
        """Return whether the line is stuck, judged by the number of bytes left in the output buffer."""
        return self._due_ns is not None and now_ns > self._due_ns

    def on_waiting(self, size: int, now_ns: int) -> None:
        """Update the estimate with the number of written bytes that are still in the output buffer."""
        if not size:
            self._due_ns = None
        elif self._due_ns is None or self._written - size >= self._mark:
            self._mark, self._due_ns = self._written, self._free_ns + self._overdue_ns
        self._free_ns = max(self._free_ns, now_ns + round(size * self._ns_per_byte))

    def on_written(self, size: int, now_ns: int) -> None:
        """Update the estimate with the number of bytes just written."""
        self._free_ns = max(self._free_ns, now_ns) + round(size * self._ns_per_byte)
        self._written += size


_NOT_READ: Final = "the vehicle no longer reads what we send"


class ByteStream(ABC):
    """An open connection. Not thread-safe.

    ``dropped`` counts packets that were not sent because the line had a backlog, was stalled, or had no room. Drivers
    repeat each of these packets or send a newer packet instead. Buffers at the far end, and buffers of pseudo-terminals
    (which the system reports as empty), can't be seen here. Sessions therefore send no set-points while they receive
    nothing.
    """

    def __init__(self, pace: LinePace, clock: Clock) -> None:
        self.dropped = 0
        self.drain_s = _DRAIN_S  #: how long :meth:`close` waits for the bytes already written to be sent
        self._pace = pace
        self._clock = clock
        self._stuck_ns = STUCK_NS
        self._full_ns: int | None = None  # when the buffer became full or the line stalled
        self._whole = _LONGEST  # number of bytes written since a frame may have been cut off
        self._rest = b""  # end of a partly written frame, altered to make the receiver discard the frame
        self._cleared = False  # a full buffer was emptied for a stop, and is not known to be read again yet
        self._after_stop = 1 << 62  # bytes written since a stop; if no more than this are waiting, the stop was sent

    @abstractmethod
    def fileno(self) -> int:
        """Return the descriptor."""

    @abstractmethod
    def read(self) -> bytes:
        """Return the bytes received so far, possibly none. Raises ``OSError`` if the connection has ended."""

    def write(self, data: bytes, rank: Rank = Rank.SETPOINT) -> None:
        """Send a packet, or drop it if there is no room or the line has a backlog. Never waits.

        Raises ``OSError`` if sending fails, or if no complete packet could be sent for 0.5 s (TCP: 2.5 s).
        """
        now_ns, waiting, stop = self._clock(), self._waiting(), rank is Rank.STOP
        self._pace.on_waiting(waiting, now_ns)
        if stop and _LONGEST < waiting <= self._after_stop:  # with fewer bytes waiting, padding takes just as long
            self._discard()
        stalled = self._cleared or self._pace.stalled(now_ns)
        sent, whole = 0, False
        if not stalled or rank <= Rank.COMMAND:
            if not self._pace.admits(rank, now_ns):
                self.dropped += 1
                return
            packet = self._rest + (self._filled(data) if stop else data)
            sent = self._attempt(packet)
            if stop and sent < len(packet) and self._discard():
                packet = self._filled(data)
                sent = self._attempt(packet)
                self._cleared = stalled = not self._waiting()
            whole = sent == len(packet)
            self._rest = self._rest_of(packet, sent)
        if sent:
            self._pace.on_written(sent, now_ns)
            self._whole += sent
            self._after_stop = 0 if stop and whole else self._after_stop + sent
        self.dropped += not whole
        self._check_room(now_ns, room=whole and not stalled)

    def _rest_of(self, packet: bytes, sent: int) -> bytes:
        """Return the bytes to write before the next packet: the end of a frame that was only partly sent.

        That frame is outdated. Its last byte, part of a checksum, is inverted to make the receiver discard the frame.
        Without the end, the receiver would mistake the next packet for the missing part. (A vehicle that ignores
        signatures still executes a signed frame if only the signature was cut off.)
        """
        if sent <= len(self._rest):
            return self._rest[sent:]
        return packet[sent:-1] + bytes([packet[-1] ^ 0xFF]) if sent < len(packet) else b""

    def _filled(self, data: bytes) -> bytes:
        return bytes(max(0, _LONGEST - self._whole)) + data

    def _attempt(self, packet: bytes) -> int:
        try:
            return self._write(packet)
        except BlockingIOError:
            return 0

    def _check_room(self, now_ns: int, *, room: bool) -> None:
        if room:
            self._full_ns = None
        elif self._full_ns is None:
            self._full_ns = now_ns
        elif now_ns - self._full_ns >= self._stuck_ns:
            raise ConnectionError(_NOT_READ)

    def _waiting(self) -> int:
        """Return the number of bytes in the output buffer; 0 if unavailable."""
        return 0

    def _discard(self) -> bool:
        """Empty the output buffer, which may cut off a frame; return whether this appears to have worked."""
        return False

    def _drain(self) -> bool:
        """Wait briefly until written bytes have been sent; return whether they have."""
        until_s = time.monotonic() + self.drain_s
        # On a stuck line, only a stop is worth waiting for: it may have been sent after the buffer was emptied for it.
        patient = self._full_ns is None or self._cleared or self._waiting() > self._after_stop
        while patient and (self._waiting() or self._cleared) and time.monotonic() < until_s:
            time.sleep(0.005)
        return patient and not (self._waiting() or self._cleared)

    @abstractmethod
    def _write(self, data: bytes) -> int:
        """Write as many bytes as fit and return their number; raise BlockingIOError if there is no room."""

    @abstractmethod
    def close(self) -> None:
        """Close the connection."""


class TcpStream(ByteStream):
    """A TCP connection to a numeric address (a name look-up would block). The server need not be running yet.

    Raises ``OSError`` if the connection is not established within :data:`CONNECT_S`.
    """

    def __init__(self, host: str, port: int, clock: Clock = monotonic_ns) -> None:
        super().__init__(LinePace(None, _TCP_OVERDUE_NS), clock)
        self._stuck_ns = nanoseconds(_UNACKNOWLEDGED_MS / 1000)  # TCP needs 0.6 s for a packet lost twice
        self._socket = socket.create_connection((host, port), CONNECT_S)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if hasattr(socket, "TCP_USER_TIMEOUT"):  # not available on macOS
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _UNACKNOWLEDGED_MS)
        self._socket.setblocking(False)
        if sys.platform == "win32":
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _WINDOWS_BUFFER)

    def fileno(self) -> int:
        return self._socket.fileno()

    def read(self) -> bytes:
        try:
            data = self._socket.recv(_READ_BYTES)
        except BlockingIOError:
            return b""
        if not data:
            raise ConnectionError("the vehicle closed the connection")
        return data

    def _write(self, data: bytes) -> int:
        return self._socket.send(data)

    def close(self) -> None:
        """Close the connection and discard unacknowledged data, which the system would otherwise resend for minutes."""
        drained = self._drain()
        with suppress(OSError):
            if sys.platform == "win32":
                # Closing a blocking socket waits for up to this second, and then resets the connection.
                # learn.microsoft.com/windows/win32/api/winsock/nf-winsock-closesocket
                self._socket.setblocking(True)
                self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("HH", 1, 1))
            elif not drained:
                self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self._socket.close()

    def _waiting(self) -> int:
        if sys.platform == "win32":
            return 0  # no such count
        import fcntl
        import termios

        with suppress(Exception):  # the count is unavailable, or the connection has ended
            self._socket.getpeername()  # raises if the connection has ended: lost bytes would still be counted
            if sys.platform == "darwin":
                return self._socket.getsockopt(socket.SOL_SOCKET, _SO_NWRITE)
            count: int = struct.unpack("i", fcntl.ioctl(self._socket, termios.TIOCOUTQ, bytes(4)))[0]
            return count
        return 0


class SerialStream(ByteStream):
    """A serial port, opened for exclusive use with pyserial; its output buffer is emptied first.

    Raises ``OSError`` if the port can't be opened, and :class:`MissingExtraError` if pyserial is not installed.
    """

    def __init__(self, path: str, baud: int, what: str, extra: str, clock: Clock = monotonic_ns) -> None:
        try:
            import serial
        except ImportError as error:
            raise MissingExtraError(what, extra, cause=str(error)) from error
        super().__init__(LinePace(line_speed(path, baud)), clock)
        self._threads: _PortThreads | None = None
        if sys.platform == "win32":
            self._port = serial.Serial(path, baud, timeout=_LOOK_S, exclusive=True)
            self._threads = _PortThreads(self._port)
        else:
            self._port = serial.Serial(path, baud, timeout=0, write_timeout=0, exclusive=True)
        self._discard()
        self._whole = 0  # the previous connection may have left an incomplete frame

    def fileno(self) -> int:
        number: int = self._port.fileno() if self._threads is None else self._threads.near.fileno()
        return number

    def read(self) -> bytes:
        if not wait_readable(self, 0.0):
            return b""
        if self._threads is not None:
            data = self._threads.near.recv(_READ_BYTES)
        else:
            data = os.read(self.fileno(), _READ_BYTES)  # pyserial's uses select.select: only descriptors below 1024
        if not data:
            raise ConnectionError("the port was unplugged, or another program reads it")
        return data

    def _write(self, data: bytes) -> int:
        if self._threads is not None:
            return self._threads.write(data)
        return os.write(self.fileno(), data)  # pyserial's write() retries while there is no room

    def _waiting(self) -> int:
        if self._threads is not None:
            return self._threads.waiting
        with suppress(Exception):  # unavailable, or the port has disappeared, which write() reports
            waiting: int = self._port.out_waiting
            return waiting
        return 0

    def _discard(self) -> bool:
        before = self._waiting()
        with suppress(Exception):  # termios.error is not an OSError
            if self._threads is not None:
                self._threads.clear()
            self._port.reset_output_buffer()
            if not before or self._waiting() < before:  # some port drivers can't empty the buffer
                self._whole, self._rest = 0, b""
                return True
        return False

    def close(self) -> None:
        """Close the port and discard unsent data, which the system would otherwise wait to send, sometimes for 30 s."""
        if not self._drain():
            self._discard()
        if self._threads is not None:
            self._threads.close()
        self._port.close()


class _PortThreads:
    """Reads and writes a serial port on two threads, where a link can't wait for the port itself, as on Windows.

    The port's timeout for reading is :data:`_LOOK_S`. Its calls for writing wait, but emptying its output buffer ends
    them (learn.microsoft.com/windows/win32/api/winbase/nf-winbase-purgecomm).
    """

    def __init__(self, port: Any) -> None:
        self._port = port
        self.near, self._far = socket_pair()  #: receives what the port does
        self.near.setblocking(False)
        self._unsent = bytearray()
        self._writing = 0  # number of bytes that are being written
        self._closing = False
        self._ended = False  # whether nothing more can be written
        self._changed = threading.Condition()
        self._threads = [
            threading.Thread(target=work, name="skyloop-serial", daemon=True) for work in (self._read, self._send)
        ]
        for thread in self._threads:
            thread.start()

    @property
    def waiting(self) -> int:
        with self._changed:
            return len(self._unsent) + self._writing

    def write(self, data: bytes) -> int:
        with self._changed:
            if self._ended:
                raise ConnectionError("the port was unplugged")
            room = max(0, _WINDOWS_BUFFER - len(self._unsent) - self._writing)
            self._unsent += data[:room]
            self._changed.notify_all()
            return min(room, len(data))

    def clear(self) -> None:
        with self._changed:
            self._unsent.clear()

    def close(self) -> None:
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self.near.close()
        for thread in self._threads:
            thread.join(END_S)

    def _read(self) -> None:
        with self._far, suppress(Exception):  # the port was unplugged or closed: the link reads the end
            while not self._closing:
                if data := self._port.read(max(1, self._port.in_waiting)):
                    self._far.sendall(data)

    def _send(self) -> None:
        from serial import SerialTimeoutException

        try:
            while True:
                with self._changed:
                    self._writing = 0
                    self._changed.wait_for(lambda: self._unsent or self._closing)
                    if self._closing:
                        return
                    data = bytes(self._unsent[:_AT_ONCE])
                    self._writing = len(data)
                    del self._unsent[:_AT_ONCE]
                with suppress(SerialTimeoutException):  # without a time limit: emptying the buffer cut this write off
                    self._port.write(data)
        except Exception:  # noqa: BLE001  the port was unplugged
            with self._changed:
                self._ended = True


def serial_port(place: str) -> str | None:
    """Return the name of a serial port in an address, a path or Windows' ``COM3``; None if the text is neither."""
    if found := re.fullmatch(r"(?:/|[/\\]{2}\.[/\\])?(com\d{1,3})", place, re.IGNORECASE):
        return found[1].upper()
    return place if place.startswith("/") else None


def line_speed(path: str, baud: int) -> float | None:
    """Return a serial port's speed in bytes per second; None for USB ports, whose bit rate is meaningless."""
    device = Path(path).resolve().name
    return None if re.match(r"ttyACM|(cu|tty)\.usbmodem", device) else baud / _BITS_PER_BYTE
