"""A connection to one vehicle over UDP, TCP or a serial port, and the thread that serves and reopens it."""

from __future__ import annotations

import socket
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Final

from skyloop.clock import Clock, monotonic_ns, nanoseconds
from skyloop.drivers.base import ServedLink
from skyloop.drivers.byte_stream import END_S, ByteStream, SerialStream, TcpStream
from skyloop.drivers.vehicle_link import ConnectionLink
from skyloop.drivers.vehicle_session import SinkCallback
from skyloop.messages import AnyAction
from skyloop.vehicles.mavlink.options import Address, ConnectionKind, Peer
from skyloop.vehicles.mavlink.protocol import MavlinkSession, Packet
from skyloop.vehicles.mavlink.wire.codec import Message

MAX_DATAGRAM: Final = 65_536  #: bytes
BURST: Final = 64  #: maximum number of datagrams per read, so that other links of the thread get their turn


class UdpListener:
    """A UDP port that replies to the sender of the newest datagram."""

    whole = True  #: whether each received piece is a whole datagram

    def __init__(self, address: Address) -> None:
        self.dropped = 0
        self._six = ":" in address.place
        self._socket = socket.socket(socket.AF_INET6 if self._six else socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setblocking(False)
            if self._six:
                self._socket.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)  # accept IPv4 vehicles, too
            self._socket.bind(self._to_socket((address.place, address.number)))
        except OSError:
            self._socket.close()
            raise

    def fileno(self) -> int:
        return self._socket.fileno()

    def receive(self) -> list[tuple[bytes, Peer]]:
        """Return up to :data:`BURST` received datagrams, each with its sender."""
        received: list[tuple[bytes, Peer]] = []
        for _ in range(BURST):
            try:
                data, source = self._socket.recvfrom(MAX_DATAGRAM)
                received.append((data, _peer_of(source)))
            except BlockingIOError:
                break
            except ConnectionError:  # ICMP port unreachable, but the peer may come back
                continue
        return received

    def send(self, packet: Packet) -> None:
        """Send a datagram; drop it if there is no peer yet or the buffer is full."""
        if packet.peer is None:
            self.dropped += 1  # no vehicle has been found yet
            return
        try:
            self._socket.sendto(packet.data, self._to_socket(packet.peer))
        except BlockingIOError:
            self.dropped += 1

    def close(self) -> None:
        self._socket.close()

    def _to_socket(self, peer: tuple[str, int]) -> tuple[str, int] | tuple[str, int, int, int]:
        host, port = peer
        if not self._six:
            return peer
        host, _, scope = host.partition("%")
        number = int(scope) if scope.isdecimal() else socket.if_nametoindex(scope) if scope else 0
        return (host if ":" in host or not host else f"{_OF_IPV4}{host}"), port, 0, number


_OF_IPV4: Final = "::ffff:"  #: prefix of IPv4 addresses on an IPv6 socket (RFC 4291, section 2.5.5.2)


def _peer_of(source: tuple[str, int] | tuple[str, int, int, int]) -> tuple[str, int]:
    """Return a datagram's sender as an address: IPv4 without the prefix, link-local with the interface."""
    host, port = source[:2]
    if len(source) == 4 and source[3] and "%" not in host:
        host = f"{host}%{source[3]}"
    return host.removeprefix(_OF_IPV4), port


class UdpSender(UdpListener):
    """A UDP socket that sends first, from an ephemeral port."""

    def __init__(self, address: Address) -> None:
        family, *_, found = socket.getaddrinfo(address.place, address.number, 0, socket.SOCK_DGRAM)[0]
        self._to = _peer_of((str(found[0]), *found[1:]))
        super().__init__(Address(ConnectionKind.UDP_IN, "::" if family == socket.AF_INET6 else "", 0))

    def send(self, packet: Packet) -> None:
        """Send a datagram to the packet's peer or, before one is known, to the configured address."""
        super().send(packet._replace(peer=packet.peer or self._to))


class _Stream(ByteStream):
    """An ordered byte stream to one vehicle."""

    whole = False

    def receive(self) -> list[tuple[bytes, Peer]]:
        """Return the received bytes; raise OSError once the stream has ended."""
        data = self.read()
        return [(data, None)] if data else []

    def send(self, packet: Packet) -> None:
        """Send a packet, or drop it; see :meth:`ByteStream.write`."""
        self.write(packet.data, packet.rank)


class TcpClient(_Stream, TcpStream):
    """A client of the autopilot's TCP server, which serves one client at a time: even an open connection may wait."""

    def __init__(self, address: Address) -> None:
        super().__init__(address.place, address.number)


class SerialPort(_Stream, SerialStream):
    """A serial port opened exclusively through pyserial."""

    def __init__(self, address: Address) -> None:
        super().__init__(address.place, address.number, "mavlink://serial:", "mavlink")


MavlinkConnection = UdpListener | TcpClient | SerialPort
_KINDS: Final[dict[ConnectionKind, type[MavlinkConnection]]] = {
    ConnectionKind.UDP_IN: UdpListener,
    ConnectionKind.UDP_OUT: UdpSender,
    ConnectionKind.TCP: TcpClient,
    ConnectionKind.SERIAL: SerialPort,
}


def open_connection(address: Address) -> MavlinkConnection:
    """Open a connection to a host given by its numeric address. Takes up to a second."""
    return _KINDS[address.kind](address)


WRITE_S: Final = 0.9  #: time after which an unconfirmed write fails
_CLOSE_S: Final = 3.0  #: time allowed for the thread to end


class MavlinkLink(ConnectionLink[MavlinkSession, MavlinkConnection]):
    """The link to one vehicle: its thread keeps the connection open and serves the session."""

    RETRY_NS = nanoseconds(1.0)

    def __init__(
        self,
        session: MavlinkSession,
        deliver: Callable[[list[SinkCallback]], None],
        clock: Clock = monotonic_ns,
        *,
        serve: Callable[[ServedLink], None] | None = None,
    ) -> None:
        udp = session.options.address.kind in (ConnectionKind.UDP_IN, ConnectionKind.UDP_OUT)
        super().__init__(
            "skyloop-mavlink",
            session,
            deliver,
            clock,
            family=socket.AF_UNSPEC,
            close_s=_CLOSE_S,
            serve=serve if udp else None,
        )
        self._silent_ns = None if udp else nanoseconds(8.0)  # a stream may stay open although its vehicle is gone

    # From the proxy's threads ------------------------------------------------------------------------------------

    def command(self, action: AnyAction, *, alone: bool = False, new: bool = True) -> AnyAction:
        """Pass an action to :meth:`MavlinkSession.command` and send it at once. May be called from any thread."""
        return self._decide(partial(self.session.command, action, alone=alone, new=new))

    def send(self, message: Message) -> None:
        """Send a message to the vehicle now. May be called from any thread."""
        with self.lock:
            self.session.send(message)
            self._send_due(self._clock())

    def write(self, name: str, value: float) -> str | None:
        """Write a parameter within 0.9 s; return the failure or None. Never call it on the link's thread."""

        def ask(end: Callable[[str | None], None]) -> None:
            now_ns = self._clock()
            self.session.parameters.write(name, value, now_ns + nanoseconds(WRITE_S), end)
            self._send_due(now_ns)

        return self._wait_for_answer(ask, WRITE_S + 0.2, "the driver did not get to it")

    # On the link's thread ----------------------------------------------------------------------------------------

    def _read(self, connection: MavlinkConnection) -> None:
        received = connection.receive()
        now_ns = self._clock()
        with self.lock:
            for data, peer in received:
                self.session.receive(data, peer, now_ns, whole=connection.whole)

    def _send_due(self, now_ns: int) -> None:
        """Send the packets that are due. May be called from any thread, with the lock held."""
        packets = self.session.poll(now_ns)
        connection = self._connection
        if connection is None or self._broken:
            return
        try:
            for packet in sorted(packets, key=lambda each: each.rank):
                connection.send(packet)
        except OSError as error:
            if connection.whole:
                self.session.failed(error)
            else:
                self._on_broken(error, now_ns)
        self.session.dropped = connection.dropped

    def _on_end(self, connection: MavlinkConnection) -> None:
        if isinstance(connection, ByteStream):
            connection.drain_s = END_S

    # The connection ----------------------------------------------------------------------------------------------

    def _connect(self) -> MavlinkConnection:
        return open_connection(self._address())

    def _address(self) -> Address:
        """Return the address with its host resolved to a number; raise OSError if it can't be resolved."""
        address = self.session.options.address
        if address.kind not in (ConnectionKind.TCP, ConnectionKind.UDP_OUT):
            return address
        return replace(address, place=self._lookup.address(address.place))
