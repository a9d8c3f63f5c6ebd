"""Options in ``crazyflie://`` addresses, listed in ``docs/crazyflie.md``. Pure."""

from __future__ import annotations

import re
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from skyloop.drivers.base import reject_unknown_options
from skyloop.drivers.uri import VehicleUri, host_and_port
from skyloop.drivers.vehicle_session import OwnLimit
from skyloop.errors import UnknownNameError, UsageError
from skyloop.vehicles.crazyflie.wire.crtp import ESP_PORT, UDP_PORT

CPX_PORT: Final = 5000
CRAZYFLIE, ESP = "crazyflie", "esp"  #: dialects over UDP
_EXAMPLES: Final = (
    "it should look like crazyflie://radio:0/80/2M/E7E7E7E7E7, crazyflie://udp:127.0.0.1:19850, "
    "or crazyflie://esp:192.168.43.42"
)
_RADIO: Final = re.compile(r"(\d{1,2})(?:/(\d{1,3})(?:/(250K|1M|2M)(?:/([0-9A-Fa-f]{10}))?)?)?\Z")


class LinkKind(StrEnum):
    """Ways to a vehicle."""

    RADIO = "radio"  #: a Crazyradio
    UDP = "udp"
    ESP = "esp"  #: ESP-Drone and LiteWing: UDP with a checksum
    TCP = "tcp"  #: CPX, through the AI-deck's Wi-Fi


_PORTS: Final = {LinkKind.UDP: UDP_PORT, LinkKind.ESP: ESP_PORT, LinkKind.TCP: CPX_PORT}


class VelocityMode(StrEnum):
    """How velocity set-points are flown."""

    HIGH_LEVEL = "high_level"  #: as short flights of the high-level commander; without the next one it hovers
    SETPOINT = "setpoint"  #: as low-level set-points; without the next one it falls after 2 s


@dataclass(frozen=True, slots=True)
class RadioAddress:
    """Where a vehicle listens, and which Crazyradio sends."""

    dongle: int = 0
    channel: int = 80  #: 0 to 125, at 2400 MHz + channel
    rate: str = "2M"
    address: bytes = b"\xe7" * 5


TAKEOFF_ALTITUDE: Final = "limits.takeoff_altitude"
OWN_LIMITS: Final = (
    OwnLimit(TAKEOFF_ALTITUDE, 1.0, 0.2, 10.0, "m", "Height of a take-off above its start"),
    OwnLimit("limits.speed", 1.0, 0.05, 5.0, "m/s", "Maximum horizontal speed"),
    OwnLimit("limits.climb", 0.5, 0.05, 2.0, "m/s", "Maximum vertical speed"),
    OwnLimit("limits.yaw_rate", 1.5, 0.1, 6.0, "rad/s", "Maximum yaw rate"),
    OwnLimit("limits.tilt", 0.35, 0.02, 0.6, "rad", "Maximum roll and pitch of an attitude set-point"),
)
KNOWN: Final = {"velocity", "rate", "dialect", *(limit.option for limit in OWN_LIMITS)}


@dataclass(frozen=True, slots=True)
class CrazyflieOptions:
    """The contents of a parsed ``crazyflie://`` address."""

    kind: LinkKind
    host: str = ""
    port: int = 0
    radio: RadioAddress = RadioAddress()
    velocity: VelocityMode = VelocityMode.HIGH_LEVEL
    rate_hz: float = 50.0  #: rate of the state estimate
    limits: tuple[tuple[str, float], ...] = tuple((limit.name, limit.usual) for limit in OWN_LIMITS)

    @property
    def checksum(self) -> bool:
        """Whether each packet ends with a checksum."""
        return self.kind is LinkKind.ESP

    def __str__(self) -> str:
        if self.kind is LinkKind.RADIO:
            radio = self.radio
            return f"Crazyradio {radio.dongle}, channel {radio.channel}, {radio.rate}, {radio.address.hex().upper()}"
        return f"{self.host}, {'TCP' if self.kind is LinkKind.TCP else 'UDP'} port {self.port}"


def options_of(uri: VehicleUri, further: frozenset[str] = frozenset()) -> CrazyflieOptions:
    """Parse an address; ``further`` are options that others check. Raises :class:`UsageError`."""
    reject_unknown_options(uri, KNOWN | further)
    kind, _, rest = uri.place.partition(":")
    rest = rest.removeprefix("//")
    dialect = uri.options.get("dialect", CRAZYFLIE)
    if dialect not in (CRAZYFLIE, ESP):
        raise UnknownNameError("dialect of crazyflie://", dialect, [CRAZYFLIE, ESP])
    if kind == LinkKind.UDP and dialect == ESP:
        kind = LinkKind.ESP
    if kind not in list(LinkKind):
        raise UsageError(f"{uri} does not say how to reach the vehicle; {_EXAMPLES}")
    host, port, radio = "", 0, RadioAddress()
    if kind == LinkKind.RADIO:
        radio = _radio(uri, rest)
    else:
        found = host_and_port(rest) or host_and_port(f"{rest}:{_PORTS[LinkKind(kind)]}")
        if found is None:
            raise UsageError(f"{uri}: {rest!r} is not a host, or a host and a port; {_EXAMPLES}")
        host, port = found
    mode = uri.options.get("velocity", VelocityMode.HIGH_LEVEL)
    if mode not in list(VelocityMode):
        raise UnknownNameError("velocity of crazyflie://", mode, [known.value for known in VelocityMode])
    limits = tuple((limit.name, limit.given(uri)) for limit in OWN_LIMITS)
    rate_hz = uri.number("rate", 50.0, minimum=5.0, maximum=100.0)
    return CrazyflieOptions(LinkKind(kind), host, port, radio, VelocityMode(mode), rate_hz, limits)


def _radio(uri: VehicleUri, text: str) -> RadioAddress:
    found = _RADIO.match(text)
    if found is None or int(found[2] or 0) > 125:
        raise UsageError(f"{uri}: {text!r} is not DONGLE/CHANNEL/RATE/ADDRESS; {_EXAMPLES}")
    usual = RadioAddress()
    return RadioAddress(
        dongle=int(found[1]),
        channel=int(found[2] or usual.channel),
        rate=found[3] or usual.rate,
        address=bytes.fromhex(found[4]) if found[4] else usual.address,
    )
