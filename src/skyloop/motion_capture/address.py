"""Addresses of motion capture systems: which system, on which host, in which axes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final
from urllib.parse import SplitResult, parse_qsl, urlsplit

from skyloop.errors import UnknownNameError, UsageError

#: By scheme of the address: the system's name in the ``motioncapture`` package, and its default axis that points up.
#: VRPN has a client of its own here.
SYSTEMS: Final = {
    "vicon": ("vicon", "z"),
    "optitrack": ("optitrack", "y"),  # Motive streams with y up by default
    "qualisys": ("qualisys", "z"),
    "vrpn": ("vrpn", "z"),
}
VRPN: Final = "vrpn"
SIM: Final = "sim"
OPTIONS: Final = {
    "up": "the axis that points up in what the system sends: y or z",
    "latency": "how old a pose is when it arrives [s], from exposure to here",
    "interface": "address of the network interface that the system is on (OptiTrack)",
    "port": "of the system's command channel (OptiTrack; default 1510)",
    "sensor": "of trackers whose name in bodies has none (VRPN): a number from 0",
}


@dataclass(frozen=True, slots=True)
class System:
    """A parsed address of a motion capture system."""

    address: str
    kind: str  #: as the ``motioncapture`` package names it, or ``sim``
    host: str
    up: str = "z"
    latency_s: float = 0.0
    settings: tuple[tuple[str, str], ...] = ()  #: further settings for the package
    port: int | None = None  #: after the host in the address
    sensor: int | None = None  #: of VRPN's trackers where the body's name has none

    @property
    def configuration(self) -> dict[str, str]:
        """The settings with which the ``motioncapture`` package connects."""
        host = self.host if self.port is None else f"{self.host}:{self.port}"
        return {"hostname": host, **dict(self.settings)}


def parse_system(address: str) -> System:
    """Parse the address of a motion capture system.

    Args:
        address: ``vicon://HOST``, ``optitrack://HOST?up=z``, ``qualisys://HOST``, ``vrpn://HOST?sensor=2`` or
            ``sim://``.

    Raises:
        UsageError: The address is malformed, or an option has a wrong value.
        UnknownNameError: There is no such system or option.
    """
    parts = urlsplit(address) if isinstance(address, str) else urlsplit("")
    if not parts.scheme or "://" not in address:
        raise UsageError(f"{address!r} is no motion capture system: give one such as vicon://192.168.0.10 or sim://")
    options = dict(parse_qsl(parts.query, keep_blank_values=True))
    for name in options:
        if name not in OPTIONS:
            raise UnknownNameError(f"option of {parts.scheme}://", name, OPTIONS)
    if parts.scheme == SIM:
        if options or parts.netloc:
            raise UsageError(f"{address!r}: sim:// takes no host and no options; the bodies name the drones")
        return System(address, SIM, "")
    if parts.scheme not in SYSTEMS:
        raise UnknownNameError("motion capture system", parts.scheme, [*SYSTEMS, SIM])
    if not parts.hostname:
        raise UsageError(f"{address!r} names no host: {parts.scheme}://192.168.0.10")
    kind, up = SYSTEMS[parts.scheme]
    up = options.get("up", up)
    if up not in ("y", "z"):
        raise UsageError(f"{address!r}: up is {up!r} and must be y or z")
    settings = [("interface_ip", options["interface"])] if "interface" in options else []
    if command := _port(address, options):
        settings.append(("port_command", command))
    if settings and kind != "optitrack":
        raise UsageError(f"{address!r}: interface and port are for optitrack:// only")
    sensor = options.get("sensor")
    if sensor is not None and kind != VRPN:
        raise UsageError(f"{address!r}: sensor is for vrpn:// only")
    if sensor is not None and not (sensor.isascii() and sensor.isdigit() and len(sensor) <= 9):
        raise UsageError(f"{address!r}: sensor is {sensor!r} and must be a whole number from 0")
    if kind == VRPN and parts.path.strip("/"):
        raise UsageError(f"{address!r}: the tracker is named in bodies, as {{'alpha': {parts.path.strip('/')!r}}}")
    port = _port_of_host(address, parts)
    if port is not None and kind == "optitrack":
        raise UsageError(f"{address!r}: the port of OptiTrack's command channel is an option, ?port={port}")
    if port is not None and kind == "qualisys":  # which takes its base port by itself
        settings.append(("port", str(port)))
        port = None
    latency_s = _latency(address, options)
    number = None if sensor is None else int(sensor)
    return System(address, kind, parts.hostname, up, latency_s, tuple(settings), port, number)


def _latency(address: str, options: dict[str, str]) -> float:
    text = options.get("latency", "0")
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not 0.0 <= value <= 1.0:
        raise UsageError(f"{address!r}: latency is {text!r} and must be from 0 to 1 second")
    return value


def _port_of_host(address: str, parts: SplitResult) -> int | None:
    """Return the port after the host; None if there is none."""
    try:
        return parts.port
    except ValueError:
        raise UsageError(f"{address!r}: the port must be a whole number from 1 to 65535") from None


def _port(address: str, options: dict[str, str]) -> str | None:
    text = options.get("port")
    if text is not None and not (text.isascii() and text.isdigit() and 1 <= int(text) <= 65535):
        raise UsageError(f"{address!r}: port is {text!r} and must be a whole number from 1 to 65535")
    return text
