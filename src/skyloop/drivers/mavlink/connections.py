"""The ways to a vehicle: UDP, TCP and a serial port. Nothing blocks; what goes wrong is an OSError that says it."""

from __future__ import annotations

import select
import socket
from contextlib import suppress
from typing import Final, Protocol

from skyloop.drivers.mavlink.options import Address, Way
from skyloop.errors import MissingExtraError

Peer = tuple[str, int] | None  #: of UDP; a stream has no other

MAX_DATAGRAM: Final = 65_536
BURST: Final = 64  #: datagrams that are read before others have their turn
CONNECT_S: Final = 1.0


class Connection(Protocol):
    """An open way."""

    whole: bool  #: each piece is a datagram

    def fileno(self) -> int: ...

    def receive(self) -> list[tuple[bytes, Peer]]:
        """What came. Raises OSError when nothing more will."""

    def send(self, data: bytes, peer: Peer) -> None:
        """Lost without a word where there is no room. Raises OSError."""

    def close(self) -> None: ...


class UdpIn:
    """Listens, and answers."""

    whole = True

    def __init__(self, address: Address) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setblocking(False)
            self._socket.bind((address.place, address.number))
        except OSError:
            self._socket.close()
            raise

    def fileno(self) -> int:
        return self._socket.fileno()

    def receive(self) -> list[tuple[bytes, Peer]]:
        came: list[tuple[bytes, Peer]] = []
        for _ in range(BURST):
            try:
                came.append(self._socket.recvfrom(MAX_DATAGRAM))
            except BlockingIOError:
                break
            except ConnectionError:  # nobody listens where we sent to: it may come back
                continue
        return came

    def send(self, data: bytes, peer: Peer) -> None:
        if peer is None:
            return  # nobody was heard yet
        with suppress(BlockingIOError):
            self._socket.sendto(data, peer)

    def close(self) -> None:
        self._socket.close()


class UdpOut(UdpIn):
    """Speaks first, from a port of its own."""

    def __init__(self, address: Address) -> None:
        found = socket.getaddrinfo(address.place, address.number, socket.AF_INET, socket.SOCK_DGRAM)
        self._to: tuple[str, int] = str(found[0][4][0]), address.number
        super().__init__(Address(Way.UDP_IN, "", 0))

    def send(self, data: bytes, peer: Peer) -> None:
        super().send(data, peer or self._to)


class Tcp:
    """A client of the autopilot's server. Connected is not yet served: it takes one client at a time."""

    whole = False

    def __init__(self, address: Address) -> None:
        self._socket = socket.create_connection((address.place, address.number), CONNECT_S)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setblocking(False)

    def fileno(self) -> int:
        return self._socket.fileno()

    def receive(self) -> list[tuple[bytes, Peer]]:
        try:
            data = self._socket.recv(MAX_DATAGRAM)
        except BlockingIOError:
            return []
        if not data:
            raise ConnectionError("the vehicle ended the connection")
        return [(data, None)]

    def send(self, data: bytes, peer: Peer) -> None:  # noqa: ARG002
        """A frame that does not fit whole ends the connection: what follows half a frame would be noise."""
        try:
            sent = self._socket.send(data)
        except BlockingIOError:
            return
        if sent < len(data):
            raise ConnectionError("the vehicle takes nothing any more")

    def close(self) -> None:
        self._socket.close()


class Serial:
    """A serial port, through pyserial."""

    whole = False

    def __init__(self, address: Address) -> None:
        try:
            import serial
        except ImportError as error:
            raise MissingExtraError("mavlink://serial:", "mavlink", cause=str(error)) from error
        self._port = serial.Serial(address.place, address.number, timeout=0, write_timeout=0, exclusive=True)

    def fileno(self) -> int:
        number: int = self._port.fileno()
        return number

    def receive(self) -> list[tuple[bytes, Peer]]:
        if not select.select([self], [], [], 0)[0]:
            return []
        data: bytes = self._port.read(MAX_DATAGRAM)  # raises SerialException, an OSError, once it is unplugged
        return [(data, None)] if data else []

    def send(self, data: bytes, peer: Peer) -> None:  # noqa: ARG002
        self._port.write(data)

    def close(self) -> None:
        self._port.close()


_KINDS: Final[dict[Way, type[UdpIn] | type[Tcp] | type[Serial]]] = {
    Way.UDP_IN: UdpIn,
    Way.UDP_OUT: UdpOut,
    Way.TCP: Tcp,
    Way.SERIAL: Serial,
}


def connect(address: Address) -> Connection:
    """Open the way. Takes up to :data:`CONNECT_S`. Raises OSError, and :class:`MissingExtraError` without pyserial."""
    return _KINDS[address.way](address)
