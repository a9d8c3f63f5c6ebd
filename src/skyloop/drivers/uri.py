"""Parse the addresses of vehicles: ``scheme://place?option=value``. Pure."""

from __future__ import annotations

import ipaddress
import math
import re
from collections.abc import Mapping
from typing import Final
from urllib.parse import parse_qsl, unquote

from skyloop.address import HIDDEN, is_broken, is_host, shown_address, shown_name, without_secrets
from skyloop.errors import UsageError

_SHORT_SECRET: Final = 4  # number of characters below which a secret also occurs within ordinary words
_SCHEME = re.compile(r"[a-z][a-z0-9+.-]*\Z")


class VehicleUri:
    """A parsed vehicle address that doesn't reveal its secrets.

    ``str()``, ``repr()``, :attr:`place`, :attr:`options` and pickles contain no users, passwords or keys (see
    ``skyloop.address``). Only code that opens the vehicle reads these, with :meth:`reveal_place` and :meth:`reveal`.
    """

    __slots__ = ("_given", "_secrets", "options", "place", "scheme")

    def __init__(self, scheme: str, place: str = "", options: Mapping[str, str] | None = None, text: str = "") -> None:
        """Store an address: the driver's name; a host, a path or nothing; and options by name.

        ``text`` is the original address; empty if code builds the address.
        """
        given = dict(options or {})
        broken = is_broken(given)
        self.scheme: Final = scheme  #: name of the driver
        #: The part between ``://`` and ``?``, percent-decoded: a host, a path, or empty.
        self.place: Final = without_secrets(place, broken=broken, place_of=scheme)
        #: Option names and values as given, percent-decoded.
        self.options: Final[Mapping[str, str]] = {
            shown_name(name): without_secrets(value, name, broken=broken) if value else value
            for name, value in given.items()
        }
        self._given: Final = (place, given, text)
        pairs = {text: shown_address(text), place: self.place}
        pairs |= {value: without_secrets(value, name, broken=broken) for name, value in given.items() if value}
        for value in (place, *given.values()):
            user, at, _ = value.partition("://")[2].rpartition("@")
            password = user.partition(":")[2] or user
            if at and password:
                pairs[password] = HIDDEN
        self._secrets: Final = sorted(
            ((one, shown) for one, shown in pairs.items() if one != shown), key=lambda pair: -len(pair[0])
        )

    def __str__(self) -> str:
        return shown_address(self._given[2]) or f"{self.scheme}://{self.place}"

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self)!r})"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, VehicleUri) and (self.scheme, self._given) == (other.scheme, other._given)

    __hash__ = None  # type: ignore[assignment]

    def __copy__(self) -> VehicleUri:
        return self

    def __deepcopy__(self, _: object) -> VehicleUri:
        return self

    def __reduce__(self) -> tuple[object, ...]:
        return VehicleUri, (self.scheme, self.place, self.options, str(self))

    def reveal_place(self) -> str:
        """Return the place with its secrets. Use the result only to open the place; never show or store it."""
        return self._given[0]

    def reveal(self, option: str) -> str | None:
        """Return an option with its secrets; None if it was not given. See :meth:`reveal_place` for its use."""
        return self._given[1].get(option)

    def reveal_text(self) -> str:
        """Return the whole address with its secrets, for use only by the process that serves it."""
        return self._given[2] or f"{self.scheme}://{self._given[0]}"

    def scrub(self, text: str) -> str:
        """Hide the secrets of this address in other text, such as a library's error message."""
        for given, shown in self._secrets:
            if len(given) < _SHORT_SECRET:  # hiding it within words would hide too much, and thereby reveal it
                text = re.sub(rf"(?<![A-Za-z0-9]){re.escape(given)}(?![A-Za-z0-9])", HIDDEN, text)
            else:
                text = text.replace(given, shown)
        return text

    def number(self, option: str, default: float, *, minimum: float = -math.inf, maximum: float = math.inf) -> float:
        """Return an option as a finite number from ``minimum`` to ``maximum``; ``default`` if it is not given.

        Raises :class:`UsageError` for any other value. The default is not checked.
        """
        given = self.reveal(option)
        if given is None:
            return default
        try:
            value = float(given)
        except ValueError:
            value = math.nan
        if not (math.isfinite(value) and minimum <= value <= maximum):
            shown = self.options[option]
            raise UsageError(
                f"{self}: option {option} is {shown!r} and must be a number from {minimum:g} to {maximum:g}"
            )
        return value

    def whole(self, option: str, default: int, *, minimum: int = 0, maximum: int = 2**31 - 1) -> int:
        """Return an option as a whole number within a range; arguments and errors are those of :meth:`number`."""
        value = self.number(option, default, minimum=minimum, maximum=maximum)
        if value != int(value):
            raise UsageError(f"{self}: option {option} is {value:g} and must be a whole number")
        return int(value)

    def flag(self, option: str, default: bool = False) -> bool:
        """Return an option as a bool: ``1``, ``true``, ``yes`` or only the name, or ``0``, ``false`` or ``no``.

        Returns ``default`` if it is not given. Raises :class:`UsageError` for any other value.
        """
        given = self.options.get(option)
        if given is None:
            return default
        meanings = {"1": True, "true": True, "yes": True, "": True, "0": False, "false": False, "no": False}
        if given.lower() not in meanings:
            raise UsageError(f"{self}: option {option} is {given!r} and must be true or false")
        return meanings[given.lower()]


def host_and_port(text: str) -> tuple[str, int] | None:
    """Split an address into a host and a port; return None if it is anything else.

    Examples are ``192.168.1.1:14550``, ``drone.local:14550``, ``[::]:14550`` and ``[fe80::1%eth0]:14550``; the brackets
    around an IPv6 address are not part of the host.
    """
    host, _, port = text.rpartition(":")
    if not port.isdecimal() or not 1 <= int(port) <= 65_535:
        return None
    if is_host(host):
        return host, int(port)
    try:
        known = ipaddress.IPv6Address(host[1:-1]) if host.startswith("[") and host.endswith("]") else None
    except ValueError:
        return None
    return None if known is None else (host[1:-1], int(port))


def parse_uri(text: str) -> VehicleUri:
    """Parse a vehicle's address, such as ``ardrone://192.168.1.1?camera=front``; it may be percent-encoded.

    Raises :class:`UsageError` if the text has no scheme followed by ``://``, or gives an option twice.
    """
    scheme, separator, rest = text.partition("://")
    if not separator or not _SCHEME.match(scheme):
        shown = shown_address(text)
        raise UsageError(f"{shown!r} is not a vehicle's address, such as sim:// or ardrone://192.168.1.1")
    place, _, query = rest.partition("?")
    pairs = parse_qsl(query, keep_blank_values=True)
    options = dict(pairs)
    if len(options) != len(pairs):
        raise UsageError(f"{shown_address(text)!r} gives an option twice")
    return VehicleUri(scheme, unquote(place), options, text)
