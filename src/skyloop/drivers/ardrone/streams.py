"""The drone's video port: the two ways in which frames come. Sockets, and nothing of pictures."""

from __future__ import annotations

import socket
from typing import Final

from skyloop.clock import Clock, nanoseconds
from skyloop.drivers.ardrone.assembly import PaveAssembly
from skyloop.drivers.backlog import Coded
from skyloop.drivers.live_video import Stream
from skyloop.wire.ardrone.uvlc import is_intra

CONNECT_S: Final = 1.0
POLL_S: Final = 0.1
SILENT_S: Final = 3.0  #: without a whole frame for so long, a connection is given up
KEEP_ALIVE_S: Final = 0.5
WAKE: Final = b"\x01\x00\x00\x00"  #: to an AR.Drone 1: any small datagram starts the video and keeps it up
_CHUNK: Final = 1 << 16


class PaveStream:
    """An AR.Drone 2: PaVE over TCP. Raises OSError if the drone can't be reached."""

    def __init__(self, host: str, port: int, connection: int, clock: Clock) -> None:
        self._clock = clock
        self._assembly = PaveAssembly(connection)
        self._heard_ns = clock()
        self._socket = socket.create_connection((host, port), CONNECT_S)
        self._socket.settimeout(POLL_S)

    @property
    def broken(self) -> int:
        return self._assembly.broken

    @property
    def lost_bytes(self) -> int:
        return self._assembly.lost_bytes

    def read(self) -> list[Coded]:
        try:
            data = self._socket.recv(_CHUNK)
        except TimeoutError:
            frames = []
        else:
            if not data:
                self._assembly.end()
                raise ConnectionError("the drone ended the stream")
            frames = self._assembly.feed(data, self._clock())
        self._heard_ns = self._clock() if frames else self._heard_ns
        _give_up_if_silent(self._clock() - self._heard_ns)
        return frames

    def close(self) -> None:
        self._socket.close()


class DatagramStream:
    """An AR.Drone 1: a picture a datagram over UDP, while somebody keeps asking for them."""

    def __init__(self, host: str, port: int, connection: int, clock: Clock) -> None:
        self.broken = 0
        self.lost_bytes = 0
        self._connection = connection
        self._clock = clock
        self._heard_ns = clock()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.settimeout(POLL_S)
            self._socket.connect((host, port))  # what others send is not taken then
            self._socket.send(WAKE)
        except OSError:
            self._socket.close()
            raise
        self._woken_ns = self._heard_ns

    def read(self) -> list[Coded]:
        """The drone gives no stamp: a picture counts as taken when it came."""
        try:
            data = self._socket.recv(_CHUNK)
        except TimeoutError:
            data = b""
        now_ns = self._clock()
        if now_ns - self._woken_ns > nanoseconds(KEEP_ALIVE_S):
            self._woken_ns = now_ns
            self._socket.send(WAKE)
        if data:
            self._heard_ns = now_ns
            return [Coded(data, is_intra(data), now_ns, now_ns, self._connection)]
        _give_up_if_silent(now_ns - self._heard_ns)
        return []

    def close(self) -> None:
        self._socket.close()


def open_stream(version: int, host: str, port: int, connection: int, clock: Clock) -> Stream:
    """Raises OSError if the drone can't be reached; an AR.Drone 1's absence shows only when reading."""
    return (PaveStream if version == 2 else DatagramStream)(host, port, connection, clock)


def _give_up_if_silent(silent_ns: int) -> None:
    if silent_ns > nanoseconds(SILENT_S):
        raise TimeoutError(f"no frame came for {SILENT_S:g} s")
