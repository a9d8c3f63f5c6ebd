"""The emulated autopilot's ports: UDP to one peer, and a TCP server for one client."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, Protocol

from skyloop.clock import monotonic_ns, nanoseconds
from skyloop.vehicles.emulation.byte_server import ByteServer
from skyloop.vehicles.emulation.datagrams import Address, DatagramPort
from skyloop.vehicles.emulation.loop import Loop
from skyloop.vehicles.mavlink.emulator.settings import Settings
from skyloop.vehicles.mavlink.emulator.streams import Streams
from skyloop.vehicles.mavlink.wire.codec import Codec, Message

OnMessage = Callable[["Port", Message], None]

AUTOPILOT_COMPONENT: Final = 1
PEER_NS: Final = nanoseconds(3.0)  #: a peer that is silent for so long may be replaced by another


class Port(Protocol):
    """One link of the autopilot, with the rates that were asked for on it."""

    streams: Streams

    def send(self, message: Message) -> None: ...

    def close(self) -> None: ...


def _codec(settings: Settings) -> Codec:
    return Codec(settings.system, AUTOPILOT_COMPONENT, key=settings.key)


class UdpPort:
    """A UDP port: sends to the remote port until a message comes, then to its sender.

    Args:
        loop: Calls back when something comes.
        settings: Of the firmware.
        streams: Rates of the messages.
        on_message: Called with each message.

    Raises:
        LinkError: The port is taken.
    """

    def __init__(self, loop: Loop, settings: Settings, streams: Streams, on_message: OnMessage) -> None:
        self.streams = streams
        self._settings = settings
        self._on_message = on_message
        self._codec = _codec(settings)
        self._peer: Address = (settings.bind if settings.bind != "0.0.0.0" else "127.0.0.1", settings.ports.remote)
        self._peer_ns = -PEER_NS
        self._port = DatagramPort(
            loop,
            (settings.bind, settings.ports.udp),
            self._receive,
            name="MAVLink",
            faults=settings.faults,
            delay_s=settings.delay_s,
        )

    @property
    def port(self) -> int:
        """The real port, where 0 was asked for."""
        return self._port.port

    def send(self, message: Message) -> None:
        """Send a message to the peer."""
        self._port.send(self._codec.encode(message, version=self._settings.version), self._peer)

    def close(self) -> None:
        """Close the port."""
        self._port.close()

    def _receive(self, datagram: bytes, sender: Address) -> None:
        messages = self._codec.decode(datagram, whole=True)
        if not messages:
            return
        now_ns = monotonic_ns()
        if sender == self._peer or now_ns - self._peer_ns >= PEER_NS:
            self._peer, self._peer_ns = sender, now_ns
        for message in messages:
            self._on_message(self, message)


class TcpPort:
    """A TCP server for one client at a time: the next one waits in the kernel, connected and without a byte.

    Args:
        loop: Calls back when something comes.
        settings: Of the firmware.
        streams: Rates of the messages.
        on_message: Called with each message.

    Raises:
        LinkError: The port is taken.
    """

    def __init__(self, loop: Loop, settings: Settings, streams: Streams, on_message: OnMessage) -> None:
        self.streams = streams
        self._settings = settings
        self._on_message = on_message
        self._codec = _codec(settings)
        self._server = ByteServer(
            loop, (settings.bind, settings.ports.tcp or 0), self._receive, self._begin, name="MAVLink"
        )

    @property
    def port(self) -> int:
        """The real port, where 0 was asked for."""
        return self._server.port

    def send(self, message: Message) -> None:
        """Send a message to the client, if there is one.

        Raises:
            OSError: The client is gone.
        """
        self._server.send(self._codec.encode(message, version=self._settings.version))

    def close(self) -> None:
        """Close the server and the connection."""
        self._server.close()

    def _begin(self) -> None:
        self._codec = _codec(self._settings)

    def _receive(self, data: bytes) -> None:
        for message in self._codec.decode(data):
            self._on_message(self, message)
