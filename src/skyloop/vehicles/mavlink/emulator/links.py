"""The emulated autopilot's settings and links (UDP to one peer, a TCP server for one client) and their messages."""

from __future__ import annotations

import socket
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Final, Protocol

from skyloop.clock import monotonic_ns, nanoseconds
from skyloop.errors import UsageError
from skyloop.faults import Faults
from skyloop.sim.options import SimOptions
from skyloop.vehicles.emulation.emulator import Address, ByteServer, DatagramPort, Loop
from skyloop.vehicles.mavlink.wire.codec import MavlinkCodec, Message

REPORTS_HZ: Final = 125.0  #: rate at which a real-time world reports
APART: Final = 10  #: difference between the port numbers of two drones


class Kind(StrEnum):
    """Kinds of emulated autopilot."""

    ARDUCOPTER = "arducopter"
    PX4 = "px4"


@dataclass(frozen=True, slots=True)
class Ports:
    """The ports of one emulated autopilot."""

    udp: int  #: the autopilot's own UDP port, which sends to ``remote`` until a message arrives
    remote: int  #: UDP port of the other end
    tcp: int | None = None  #: port of the TCP server for one client; None if there is no server

    @classmethod
    def standard(cls, kind: Kind, drone: int = 0) -> Ports:
        """Return the ports that the autopilots' own simulations use."""
        if kind is Kind.PX4:
            return cls(udp=14580 + drone, remote=14540 + drone)
        return cls(udp=5763 + APART * drone, remote=14550 + APART * drone, tcp=5760 + APART * drone)

    @classmethod
    def counted(cls, kind: Kind, base: int | None, drone: int) -> Ports:
        """Return ports numbered from a base, which increases by 10 per drone: UDP port, remote UDP port, TCP port.

        The base is None for the standard ports, 0 for any free ports. Raises :class:`UsageError` for ports above 65535.
        """
        if base is None:
            return cls.standard(kind, drone)
        if base == 0:
            return cls.free(kind)
        first = base + APART * drone
        if not 0 < first <= 65533:
            raise UsageError(f"--port-base {base}: drone {drone} would need port {first + 2}; the last is 65535")
        return cls(first, first + 1, first + 2 if kind is Kind.ARDUCOPTER else None)

    @classmethod
    def free(cls, kind: Kind) -> Ports:
        """Return ports that are currently free."""
        return cls.several(kind, 0, 1)[0]

    @classmethod
    def several(cls, kind: Kind, base: int | None, drones: int) -> list[Ports]:
        """Return distinct ports for several drones; see :meth:`counted`."""
        if base != 0:
            return [cls.counted(kind, base, drone) for drone in range(drones)]
        with ExitStack() as held:  # keep all of them open: the system soon reuses a closed port
            return [cls._held(kind, held) for _ in range(drones)]

    @classmethod
    def _held(cls, kind: Kind, held: ExitStack) -> Ports:
        udp, remote = (_free(held, socket.SOCK_DGRAM) for _ in range(2))
        return cls(udp, remote, _free(held, socket.SOCK_STREAM) if kind is Kind.ARDUCOPTER else None)


def _free(held: ExitStack, kind: socket.SocketKind) -> int:
    made = held.enter_context(socket.socket(socket.AF_INET, kind))
    made.bind(("127.0.0.1", 0))
    return int(made.getsockname()[1])


def with_multirotors(options: SimOptions | None = None, *, rate_hz: float = REPORTS_HZ) -> SimOptions:
    """Return the options for a world of emulated autopilots, which has no cameras.

    ``rate_hz`` is the rate at which an autopilot runs, by default the highest possible. A lower rate makes a fleet
    cheaper but also limits the rate of every message.
    """
    return replace(options or SimOptions(), rate_hz=rate_hz, cameras=())


@dataclass(frozen=True, slots=True)
class MavlinkSettings:
    """The arguments passed to :class:`skyloop.vehicles.mavlink.emulator.MavlinkFirmware`."""

    kind: Kind
    bind: str
    ports: Ports
    system: int
    faults: Faults
    delay_s: float
    boot_s: float
    gps: bool
    version: int
    key: bytes | None
    video: tuple[str, int] | None

    def carries(self, message: Message) -> bool:
        """Return whether this protocol version has the message: MAVLink 1 has no message numbers above 255."""
        return self.version == 2 or message.id < 256


MAX_INTERVAL_US: Final = 2**31 - 1  #: maximum value of the interval field in ``MESSAGE_INTERVAL``


class LinkIntervals:
    """The message intervals on one link. Times are on the autopilot's clock [s]."""

    def __init__(self, rates: Mapping[int, float]) -> None:
        self._usual = dict(rates)
        self._periods = {number: 1.0 / rate for number, rate in rates.items()}
        self._due = dict.fromkeys(self._periods, 0.0)

    def reset(self) -> None:
        """Reset everything, because the autopilot and its clock were restarted."""
        self._periods = {number: 1.0 / rate for number, rate in self._usual.items()}
        self._due = dict.fromkeys(self._periods, 0.0)

    def set_interval(self, number: int, interval_us: float) -> None:
        """Set a message's interval as in ``SET_MESSAGE_INTERVAL``: -1 stops it, 0 restores the default."""
        if interval_us < 0:
            self._periods.pop(number, None)
        elif interval_us == 0:
            if number in self._usual:
                self._periods[number] = 1.0 / self._usual[number]
            else:
                self._periods.pop(number, None)
        else:
            self._periods[number] = interval_us / 1e6
        self._due[number] = 0.0

    def interval_us(self, number: int) -> int:
        """Return a message's interval; -1 if the message is not sent."""
        period_s = self._periods.get(number)
        return -1 if period_s is None else round(period_s * 1e6)

    def due(self, time_s: float) -> list[int]:
        """Return the messages to send now: each is returned only once, however late the call is."""
        found = []
        for number, period_s in self._periods.items():
            due_s = self._due[number]
            if time_s >= due_s:
                found.append(number)
                following_s = due_s + period_s
                self._due[number] = following_s if following_s > time_s else time_s + period_s
        return found


OnMessage = Callable[["Port", Message], None]

AUTOPILOT_COMPONENT: Final = 1  #: MAV_COMP_ID_AUTOPILOT1
PEER_NS: Final = nanoseconds(3.0)  #: time without data after which a peer may be replaced by another


class Port(Protocol):
    """A link of the autopilot, with the message rates requested on it."""

    streams: LinkIntervals

    def send(self, message: Message) -> None: ...

    def close(self) -> None: ...


def _codec(settings: MavlinkSettings) -> MavlinkCodec:
    return MavlinkCodec(settings.system, AUTOPILOT_COMPONENT, key=settings.key)


class UdpPort:
    """A UDP port that sends to the remote port until a message arrives, then to that message's sender."""

    def __init__(self, loop: Loop, settings: MavlinkSettings, streams: LinkIntervals, on_message: OnMessage) -> None:
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
        return self._port.port

    def send(self, message: Message) -> None:
        if self._settings.carries(message):
            self._port.send(self._codec.encode(message, version=self._settings.version), self._peer)

    def close(self) -> None:
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
    """A TCP server for one client at a time. The next client waits in the kernel's backlog, receiving nothing."""

    def __init__(self, loop: Loop, settings: MavlinkSettings, streams: LinkIntervals, on_message: OnMessage) -> None:
        self.streams = streams
        self._settings = settings
        self._on_message = on_message
        self._codec = _codec(settings)
        self._server = ByteServer(
            loop, (settings.bind, settings.ports.tcp or 0), self._receive, self._begin, name="MAVLink"
        )

    @property
    def port(self) -> int:
        return self._server.port

    def send(self, message: Message) -> None:
        if self._settings.carries(message):
            self._server.send(self._codec.encode(message, version=self._settings.version))

    def close(self) -> None:
        self._server.close()

    def _begin(self) -> None:
        self._codec = _codec(self._settings)

    def _receive(self, data: bytes) -> None:
        for message in self._codec.decode(data):
            self._on_message(self, message)
