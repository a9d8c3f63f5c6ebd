"""Decide which parts of an address may be shown (never users, passwords or keys), and whether it is local. Pure.

People also write passwords without quoting them, including characters that separate the parts of an address. If it is
unclear where a password ends, everything after it is hidden, too.
"""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterable
from typing import Final
from urllib.parse import quote, unquote, unquote_plus

HIDDEN: Final = "***"
_SECRET: Final = "password|passwd|passphrase|pass|pwd|pw|token|secret|key|apikey|auth|credential|credentials"
_SECRET_NAME: Final = re.compile(rf"(?i)(?:.*[_.-])?(?:{_SECRET})\Z")
_HOST_NAME: Final = re.compile(r"[A-Za-z0-9]([A-Za-z0-9.-]{0,252}[A-Za-z0-9])?\Z")
_NAME: Final = re.compile(r"[A-Za-z0-9_.-]*\Z")
#: A secret within a path, as in ``rtsp://192.168.1.10/user=admin_password=abc_channel=1.sdp``; its end is ambiguous.
_IN_PATH: Final = re.compile(rf"(?i)(?<![a-z])((?:{_SECRET})=)[^/?#]*")
_HOST: Final = re.compile(r"(?:\[[^\]]*\]|[^:\[\]]*)(?::\d*)?\Z")
#: Prefixes of places that are devices. They never contain a user name, even if their path contains an ``@``.
_DEVICES: Final = {"mavlink": ("serial:/", "serial:~")}
_KEEP: Final = "/:@*,;=()[]~!$'+"  # punctuation that is common in addresses


def is_host(text: str) -> bool:
    """Return whether a text is the name or IPv4 address of a host."""
    return _HOST_NAME.match(text) is not None


def is_loopback(host: str) -> bool:
    """Return whether an address can be reached only from this machine."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def without_secrets(text: str, option: str = "", *, broken: bool = False, place_of: str = "") -> str:
    """Return a part of an address without anything that might be secret: user, password, query and keys.

    ``text`` (percent-decoded) is either the address of a stream, the value of ``option``, or the place in a vehicle's
    address with the scheme ``place_of``. ``broken``: whether the address may have been split in the middle of a
    password.
    """
    if _SECRET_NAME.match(option):
        return HIDDEN
    scheme, separator, rest = text.partition("://")
    if not separator:
        is_path = text.startswith(("/", "~", *_DEVICES.get(place_of, ())))
        user, at, host = text.rpartition("@")
        return _hide(host if at and ":" in user and not is_path else text)
    place = re.split(r"[?#]", rest.rpartition("@")[2], maxsplit=1)[0]
    if broken or not _HOST.match(place.partition("/")[0]):
        place = HIDDEN
    return f"{scheme}://{_hide(place)}"


def _hide(path: str) -> str:
    return _IN_PATH.sub(rf"\1{HIDDEN}", path)


def shown_name(option: str) -> str:
    """Return an option's name if it can be shown; hide an invalid name, which may be the end of a password."""
    return option if _NAME.match(option) else HIDDEN


def is_broken(options: Iterable[str]) -> bool:
    """Return whether the names of the options indicate that an address was split within its password."""
    return any("@" in option for option in options)


def shown_address(text: str) -> str:
    """Return what the user entered, ``scheme://place?option=value`` or any other text, without possible secrets."""
    scheme, separator, rest = text.partition("://")
    place, mark, query = rest.partition("?")
    if not separator:
        return without_secrets(text)
    pairs = [pair.partition("=") for pair in query.split("&")] if mark else []
    broken = is_broken(unquote_plus(name) for name, _, _ in pairs)
    options = []
    for name, equals, value in pairs:
        decoded = unquote_plus(name)
        given = unquote_plus(value)
        shown = without_secrets(given, decoded, broken=broken) if given else given
        kept = name if shown_name(decoded) == decoded else HIDDEN
        options.append(f"{kept}{equals}{value if shown == given else quote(shown, safe=_KEEP)}")
    decoded = unquote(place)
    shown = without_secrets(decoded, broken=broken, place_of=scheme)
    kept = place if shown == decoded else quote(shown, safe=f"{_KEEP}&")
    return f"{scheme}://{kept}{mark}{'&'.join(options)}"
