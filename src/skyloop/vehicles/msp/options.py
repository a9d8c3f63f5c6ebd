"""Options of an ``msp://`` address. Pure. ``docs/msp.md`` has them as a table."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from skyloop.drivers.base import reject_unknown_options
from skyloop.drivers.uri import VehicleUri, host_and_port
from skyloop.errors import UsageError

DEFAULT_BAUD: Final = 115_200
DEFAULT_RATE_HZ: Final = 50.0
KNOWN: Final = {"baud", "rate", "override"}
_EXAMPLES: Final = "it looks like msp:///dev/ttyACM0?baud=115200 or msp://tcp:127.0.0.1:5761"


@dataclass(frozen=True, slots=True)
class MspOptions:
    """A parsed address. Either ``port`` is a TCP port of the host ``place``, or ``place`` is a serial port's path."""

    place: str
    port: int | None = None
    baud: int = DEFAULT_BAUD
    rate_hz: float = DEFAULT_RATE_HZ  #: of the sticks
    override: bool = False  #: a pilot keeps a real receiver, and lets the sticks be overridden by a switch

    @property
    def serial(self) -> bool:
        """Whether it is a serial port."""
        return self.port is None

    def __str__(self) -> str:
        return f"{self.place} at {self.baud} baud" if self.port is None else f"{self.place}, TCP port {self.port}"


def options_of(uri: VehicleUri) -> MspOptions:
    """Parse an address.

    Raises:
        UnknownNameError: It has an unknown option.
        UsageError: It names no place, or an option's value makes no sense.
    """
    reject_unknown_options(uri, KNOWN)
    rate = uri.number("rate", DEFAULT_RATE_HZ, minimum=20.0, maximum=250.0)
    override = uri.flag("override", default=False)
    if uri.place.startswith("/"):
        baud = uri.whole("baud", DEFAULT_BAUD, minimum=9600, maximum=10_000_000)
        return MspOptions(uri.place, None, baud, rate, override)
    if "baud" in uri.options:
        raise UsageError(f"{uri}: baud is for a serial port, such as msp:///dev/ttyACM0?baud=115200")
    word, _, rest = uri.place.partition(":")
    found = host_and_port(rest)
    if word != "tcp" or found is None:
        raise UsageError(f"{uri} names no place: {_EXAMPLES}")
    return MspOptions(*found, rate_hz=rate, override=override)
