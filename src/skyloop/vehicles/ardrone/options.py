"""Options in an ``ardrone://`` address, listed in ``docs/ardrone.md``. Pure."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final, TypeVar

from skyloop.address import is_host
from skyloop.drivers.base import reject_unknown_options
from skyloop.drivers.live_camera import INTRINSICS_OPTIONS, check_intrinsics
from skyloop.drivers.uri import VehicleUri
from skyloop.errors import UnknownNameError, UsageError
from skyloop.vehicles.ardrone.telemetry import OPTION_TAGS
from skyloop.vehicles.ardrone.wire import at, configuration, navdata
from skyloop.vehicles.ardrone.wire.navdata import Ports

MAX_RATE_HZ: Final = 200.0  #: rate of full navdata
_Meaning = TypeVar("_Meaning")
_VERSIONS: Final = {"auto": None, "1": 1, "2": 2}
_MODES: Final = {"demo": False, "full": True}
KNOWN: Final = {
    *("version", "navdata", "navdata_options", "rate", "video", "ids"),
    *("navdata_port", "video_port", "at_port", "control_port"),
    *INTRINSICS_OPTIONS,
}


@dataclass(frozen=True, slots=True)
class ArdroneOptions:
    """The contents of a parsed ``ardrone://`` address."""

    host: str
    ports: Ports = navdata.STANDARD
    version: int | None = None  #: the drone's version; None to read it from the configuration
    full: bool = False  #: whether to request navdata at 200 Hz with all options instead of the demo mode
    navdata_options: int | None = None  #: one bit per tag; None to leave the drone's configuration as it is
    rate_hz: float = 50.0  #: maximum rate of feedback with full navdata; demo mode has 15 Hz
    video: bool = True
    ids: bool = True  #: whether to use our own settings on an AR.Drone 2 (multi-configuration)


def options_of(uri: VehicleUri) -> ArdroneOptions:
    """Parse an address."""
    reject_unknown_options(uri, KNOWN)
    if not uri.place:
        raise UsageError(f"{uri} names no host; it should look like ardrone://192.168.1.1")
    if not is_host(uri.place):
        hint = "; ports are given as options, such as ?at_port=5556" if ":" in uri.place else ""
        raise UsageError(f"{uri}: {uri.place!r} is not the name or IPv4 address of a host{hint}")
    check_intrinsics(uri)
    return ArdroneOptions(
        host=uri.place,
        ports=Ports(
            navdata=_port(uri, "navdata_port", navdata.PORT),
            video=_port(uri, "video_port", navdata.VIDEO),
            at=_port(uri, "at_port", at.PORT),
            control=_port(uri, "control_port", configuration.PORT),
        ),
        version=_one_of(uri, "version", "auto", _VERSIONS),
        full=_one_of(uri, "navdata", "demo", _MODES),
        navdata_options=_mask(uri),
        rate_hz=uri.number("rate", 50.0, minimum=1.0, maximum=MAX_RATE_HZ),
        video=uri.flag("video", default=True),
        ids=uri.flag("ids", default=True),
    )


def _port(uri: VehicleUri, name: str, usual: int) -> int:
    return uri.whole(name, usual, minimum=1, maximum=65535)


def _one_of(uri: VehicleUri, name: str, usual: str, meanings: dict[str, _Meaning]) -> _Meaning:
    given = uri.options.get(name, usual)
    if given not in meanings:
        raise UnknownNameError(f"{name} of ardrone://", given, meanings)
    return meanings[given]


def _mask(uri: VehicleUri) -> int | None:
    """Return the value of ``navdata_options``, which is given as option names or a number with one bit per tag.

    The demo option is always included.
    """
    given = uri.options.get("navdata_options")
    if given is None:
        return None
    if re.fullmatch(r"0x[0-9a-fA-F]{1,8}|[0-9]{1,10}", given):
        mask = int(given, 0) if given.startswith("0x") else int(given)
        if mask >= 1 << 32:
            raise UsageError(f"{uri}: navdata_options is {given} and must fit in 32 bits")
        return mask | 1
    mask = 1
    for name in filter(None, given.split(",")):
        if name not in OPTION_TAGS:
            raise UnknownNameError("option of navdata", name, OPTION_TAGS)
        mask |= 1 << OPTION_TAGS[name]
    return mask
