"""A TCP port of the drone that sends to its clients and discards the data that they send."""

from __future__ import annotations

import socket
from collections import deque
from collections.abc import Callable
from typing import Final

from skyloop.vehicles.ardrone.wire.navdata import FIRST_SEQUENCE
from skyloop.vehicles.emulation.datagrams import Address, Loop, bound

MOST: Final = 8  #: maximum number of recipients of datagrams


class Listeners:
    """Recipients' addresses, each with its own sequence.

    There are at most :data:`MOST`; one more replaces the one whose last request is the oldest. As with the real drone,
    requests need not be repeated.
    """

    def __init__(self) -> None:
        self._sequences: dict[Address, int] = {}  # ordered by the time of the last request

    def refresh(self, address: Address) -> bool:
        """Record a request from an address; return whether the address is new."""
        sequence = self._sequences.pop(address, None)
        self._sequences[address] = FIRST_SEQUENCE if sequence is None else sequence
        if len(self._sequences) > MOST:
            del self._sequences[next(iter(self._sequences))]
        return sequence is None

    def next_sequences(self) -> list[tuple[Address, int]]:
        """Return each address with its next sequence number."""
        now = list(self._sequences.items())
        for address, sequence in now:
            self._sequences[address] = (sequence + 1) & 0xFFFFFFFF
        return now

    def __len__(self) -> int:
        return len(self._sequences)


MOST_CLIENTS: Final = 8  #: maximum number of clients of a TCP port
MOST_BACKLOG: Final = 256 * 1024  #: bytes queued for one client in addition to the system's buffer
_SYSTEM_BUFFER: Final = 64 * 1024
_READ: Final = 4096


class Outlet:
    """The connection to one client.

    A client that reads too slowly loses whole pieces of the stream, from the first one that does not fit until the next
    one that can be decoded without its predecessors.
    """

    def __init__(self, loop: Loop, connection: socket.socket, gone: Callable[[Outlet], None]) -> None:
        self._loop = loop
        self._socket = connection
        self._gone = gone
        self._waiting: deque[memoryview] = deque()
        self._backlog = 0
        self._writing = False
        self._skipping = False
        self.dropped = 0  #: number of pieces dropped
        connection.setblocking(False)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SYSTEM_BUFFER)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        loop.watch(connection, self._read)

    def offer(self, piece: bytes, *, starts: bool) -> None:
        """Send a piece unless the client is too slow; ``starts`` says whether a stream can begin with it."""
        if starts:
            self._skipping = False
        if self._skipping or self._backlog > MOST_BACKLOG:
            self._skipping = True
            self.dropped += 1
            return
        self._waiting.append(memoryview(piece))
        self._backlog += len(piece)
        if not self._writing:
            self._write()

    def skip_to_start(self) -> None:
        """Drop pieces until the next one with which a stream can begin."""
        self._skipping = True

    def close(self) -> None:
        """Close the connection."""
        self._loop.forget(self._socket)
        self._socket.close()

    def _write(self) -> None:
        try:
            while self._waiting:
                piece = self._waiting[0]
                sent = self._socket.send(piece)
                self._backlog -= sent
                if sent == len(piece):
                    self._waiting.popleft()
                else:
                    self._waiting[0] = piece[sent:]
        except BlockingIOError:
            pass
        except OSError:
            self._gone(self)
            return
        if self._writing != bool(self._waiting):
            self._writing = bool(self._waiting)
            self._loop.watch(self._socket, self._read, self._write if self._writing else None)

    def _read(self) -> None:
        try:
            data = self._socket.recv(_READ)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._gone(self)


class StreamPort:
    """A listening port and its clients. Used on the loop's thread."""

    def __init__(self, loop: Loop, bind: Address, *, name: str, joined: Callable[[Outlet], None] | None = None) -> None:
        self._loop = loop
        self._joined = joined
        self._socket = bound(socket.SOCK_STREAM, bind, name)
        self._socket.listen(MOST_CLIENTS)
        self.outlets: list[Outlet] = []  #: replaced as a whole, because other threads may read it
        loop.watch(self._socket, self.accept)

    @property
    def port(self) -> int:
        """The actual port, which was chosen if 0 was given."""
        return int(self._socket.getsockname()[1])

    def accept(self) -> None:
        """Accept all pending connections."""
        while True:
            try:
                connection, _ = self._socket.accept()
            except OSError:  # none pending, or already closed
                return
            if len(self.outlets) >= MOST_CLIENTS:
                connection.close()
                continue
            outlet = Outlet(self._loop, connection, self._drop)
            self.outlets = [*self.outlets, outlet]
            if self._joined is not None:
                self._joined(outlet)

    def broadcast(self, piece: bytes, *, starts: bool = True) -> None:
        """Send a piece to all clients."""
        for outlet in self.outlets:
            outlet.offer(piece, starts=starts)

    def close(self) -> None:
        """Close the port and all connections."""
        self._loop.forget(self._socket)
        self._socket.close()
        for outlet in self.outlets:
            outlet.close()
        self.outlets = []

    def _drop(self, outlet: Outlet) -> None:
        outlet.close()
        self.outlets = [other for other in self.outlets if other is not outlet]
