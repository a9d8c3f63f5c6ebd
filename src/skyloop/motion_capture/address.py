"""Addresses of motion capture systems: which system, where, and in which axes it counts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final
from urllib.parse import SplitResult, parse_qsl, urlsplit

from skyloop.errors import UnknownNameError, UsageError

#: Scheme of an address: the name of the system in the ``motioncapture`` package, and which axis it has up by default.
SYSTEMS: Final = {
    "vicon": ("vicon", "z"),
    "optitrack": ("optitrack", "y"),  # Motive streams with y up unless told otherwise
    "qualisys": ("qualisys", "z"),
    "vrpn": ("vrpn", "z"),
}
SIM: Final = "sim"
OPTIONS: Final = {
    "up": "the axis that points up in what the system sends: y or z",
    "latency": "how old a pose is when it arrives [s], from exposure to here",
    "interface": "address of the network interface that the system is on (OptiTrack)",
    "port": "of the system's command channel (OptiTrack; default 1510)",
}


@dataclass(frozen=True, slots=True)
class System:
    """A motion capture system."""

    address: str
    kind: str  #: as the ``motioncapture`` package names it, or ``sim``
    host: str
    up: str = "z"
    latency_s: float = 0.0
    settings: tuple[tuple[str, str], ...] = ()  #: further ones, as the package takes them

    @property
    def configuration(self) -> dict[str, str]:
        """What the ``motioncapture`` package connects by."""
        return {"hostname": self.host, **dict(self.settings)}


def parse_system(address: str) -> System:
    """Read ``vicon://HOST``, ``optitrack://HOST?up=z``, ``qualisys://HOST``, ``vrpn://HOST``, ``sim://``.

    Raises :class:`UsageError` and :class:`UnknownNameError` naming what would be right.
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
    if port := _port(address, options):
        settings.append(("port_command", port))
    if settings and kind != "optitrack":
        raise UsageError(f"{address!r}: interface and port are for optitrack:// only")
    host, place = parts.hostname, _place(address, parts)
    if place is not None and kind == "optitrack":
        raise UsageError(f"{address!r}: the port of OptiTrack's command channel is an option, ?port={place}")
    if place is not None and kind == "qualisys":  # which takes its base port by itself
        settings.append(("port", str(place)))
    elif place is not None:
        host = f"{host}:{place}"
    return System(address, kind, host, up, _latency(address, options), tuple(settings))


def _latency(address: str, options: dict[str, str]) -> float:
    text = options.get("latency", "0")
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not 0.0 <= value <= 1.0:
        raise UsageError(f"{address!r}: latency is {text!r} and must be from 0 to 1 second")
    return value


def _place(address: str, parts: SplitResult) -> int | None:
    """The port that stands after the host."""
    try:
        return parts.port
    except ValueError:
        raise UsageError(f"{address!r}: the port must be a whole number from 1 to 65535") from None


def _port(address: str, options: dict[str, str]) -> str | None:
    text = options.get("port")
    if text is not None and not (text.isascii() and text.isdigit() and 1 <= int(text) <= 65535):
        raise UsageError(f"{address!r}: port is {text!r} and must be a whole number from 1 to 65535")
    return text
