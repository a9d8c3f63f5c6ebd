"""Addresses of vehicles: ``scheme://place?option=value``. Pure."""

from __future__ import annotations

import ipaddress
import math
import re
from dataclasses import dataclass, field
from urllib.parse import parse_qsl, unquote

from skyloop.errors import UsageError

_HOST = re.compile(r"[A-Za-z0-9]([A-Za-z0-9.-]{0,252}[A-Za-z0-9])?\Z")
_SCHEME = re.compile(r"[a-z][a-z0-9+.-]*\Z")


@dataclass(frozen=True, slots=True)
class VehicleUri:
    """A parsed vehicle address.

    Args:
        scheme: The driver's name.
        place: What stands between ``://`` and ``?``, percent-decoded: a host, a path, or nothing.
        options: Names and values as they were given, percent-decoded.
        text: The address as it was given; empty for one that was made in code.
    """

    scheme: str
    place: str = ""
    options: dict[str, str] = field(default_factory=dict)
    text: str = ""

    def __str__(self) -> str:
        return self.text or f"{self.scheme}://{self.place}"

    def number(self, option: str, default: float, *, minimum: float = -math.inf, maximum: float = math.inf) -> float:
        """Return an option as a finite number within a range.

        Args:
            option: Its name.
            default: Returned if the option is not given; not checked against the range.
            minimum: Smallest allowed value.
            maximum: Largest allowed value.

        Raises:
            UsageError: It is not a finite number within the range.
        """
        given = self.options.get(option)
        if given is None:
            return default
        try:
            value = float(given)
        except ValueError:
            value = math.nan
        if not (math.isfinite(value) and minimum <= value <= maximum):
            raise UsageError(
                f"{self}: option {option} is {given!r} and must be a number from {minimum:g} to {maximum:g}"
            )
        return value

    def whole(self, option: str, default: int, *, minimum: int = 0, maximum: int = 2**31 - 1) -> int:
        """Return an option as a whole number within a range.

        Args:
            option: Its name.
            default: Returned if the option is not given.
            minimum: Smallest allowed value.
            maximum: Largest allowed value.

        Raises:
            UsageError: It is not a whole number within the range.
        """
        value = self.number(option, default, minimum=minimum, maximum=maximum)
        if value != int(value):
            raise UsageError(f"{self}: option {option} is {value:g} and must be a whole number")
        return int(value)

    def flag(self, option: str, default: bool = False) -> bool:
        """Return an option as a bool: ``1``, ``true``, ``yes`` or nothing after the name; ``0``, ``false``, ``no``.

        Args:
            option: Its name.
            default: Returned if the option is not given.

        Raises:
            UsageError: It is another word.
        """
        given = self.options.get(option)
        if given is None:
            return default
        meanings = {"1": True, "true": True, "yes": True, "": True, "0": False, "false": False, "no": False}
        if given.lower() not in meanings:
            raise UsageError(f"{self}: option {option} is {given!r} and must be true or false")
        return meanings[given.lower()]


def host_and_port(text: str) -> tuple[str, int] | None:
    """Return a host and its port; None for anything else.

    Args:
        text: Such as ``192.168.1.1:14550``, ``drone.local:14550``, ``[::]:14550`` or ``[fe80::1%eth0]:14550``: an
            address of IPv6 stands in brackets, which are not part of the host.
    """
    host, _, port = text.rpartition(":")
    if not port.isdecimal() or not 1 <= int(port) <= 65_535:
        return None
    if _HOST.match(host):
        return host, int(port)
    try:
        known = ipaddress.IPv6Address(host[1:-1]) if host.startswith("[") and host.endswith("]") else None
    except ValueError:
        return None
    return None if known is None else (host[1:-1], int(port))


def parse_uri(text: str) -> VehicleUri:
    """Parse a vehicle's address.

    Args:
        text: Such as ``ardrone://192.168.1.1?camera=front``. Place and options may be percent-encoded.

    Raises:
        UsageError: It has no scheme with ``://``, or gives an option twice.
    """
    scheme, separator, rest = text.partition("://")
    if not separator or not _SCHEME.match(scheme):
        raise UsageError(f"{text!r} is not a vehicle's address: it looks like sim:// or ardrone://192.168.1.1")
    place, _, query = rest.partition("?")
    pairs = parse_qsl(query, keep_blank_values=True)
    options = dict(pairs)
    if len(options) != len(pairs):
        raise UsageError(f"{text!r} gives an option twice")
    return VehicleUri(scheme, unquote(place), options, text)
