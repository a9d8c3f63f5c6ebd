"""Options in an ``msp://`` address, and the driver's parameters (limits, scales, gains, AUX). Pure.

``docs/msp.md`` lists both.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

from skyloop.drivers.base import checked_value, reject_unknown_options
from skyloop.drivers.uri import VehicleUri, host_and_port
from skyloop.errors import UnknownNameError, UsageError
from skyloop.messages import Parameter, ParameterType, Value
from skyloop.vehicles.msp.firmware import MOST_AUX
from skyloop.vehicles.msp.setpoints import Gains, Limits, SetpointController

DEFAULT_BAUD: Final = 115_200
DEFAULT_RATE_HZ: Final = 50.0
KNOWN: Final = {"baud", "rate", "override"}
_EXAMPLES: Final = "it looks like msp:///dev/ttyACM0?baud=115200 or msp://tcp:127.0.0.1:5761"


@dataclass(frozen=True, slots=True)
class MspOptions:
    """A parsed address. Either ``port`` is a TCP port on the host ``place``, or ``place`` is a serial port's path."""

    place: str
    port: int | None = None
    baud: int = DEFAULT_BAUD
    rate_hz: float = DEFAULT_RATE_HZ  #: rate at which sticks are sent
    override: bool = False  #: whether a pilot keeps a real receiver, with a switch that hands over the sticks

    @property
    def serial(self) -> bool:
        """Whether the address is a serial port."""
        return self.port is None

    def __str__(self) -> str:
        return f"{self.place} at {self.baud} baud" if self.port is None else f"{self.place}, TCP port {self.port}"


def options_of(uri: VehicleUri) -> MspOptions:
    """Parse an address."""
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
        raise UsageError(f"{uri} names no host or device: {_EXAMPLES}")
    return MspOptions(*found, rate_hz=rate, override=override)


AUTOMATIC: Final = 0  #: value of an AUX channel that is to be set as the modes require
_LIMITS: Final = (
    ("tilt", 0.02, 1.0, "rad", "maximum roll and pitch together, up to a full stick"),
    ("climb", 0.05, 10.0, "m/s", "maximum climb and descent"),
    ("yaw_rate", 0.05, 10.0, "rad/s", "maximum yaw rate, up to a full stick"),
    ("throttle", 0.1, 1.0, "", "maximum throttle, as a share of full throttle"),
)
_GAINS: Final = (
    ("climb_p", 0.0, 10.0, "1/s", "acceleration per climb error"),
    ("climb_i", 0.0, 10.0, "1/s²", "learning rate of the hover throttle"),
)
TILT: Final = "msp.full_stick.tilt"
HOVER: Final = "msp.hover_throttle"
AUX: Final = "msp.aux"


@dataclass(frozen=True, slots=True)
class _Entry:
    parameter: Parameter
    write: Callable[[float], None]


class DriverParameters:
    """The driver's own parameters. The caller must hold the lock that protects the controller that uses them."""

    def __init__(self, setpoints: SetpointController) -> None:
        self._setpoints = setpoints

    def parameters(self) -> list[Parameter]:
        """Return all parameters with their current values."""
        return [entry.parameter for entry in self._entries().values()]

    def write(self, name: str, value: Value) -> Value:
        """Write a parameter and return the value in force; raise an error for an unknown name or an invalid value."""
        entries = self._entries()
        if name not in entries:
            raise UnknownNameError("parameter of msp://", name, entries)
        value = checked_value(entries[name].parameter, value)
        assert isinstance(value, int | float)
        entries[name].write(value)
        return value

    def _entries(self) -> dict[str, _Entry]:
        made = [*self._limits(), *self._gains(), self._tilt(), self._hover(), *self._aux()]
        return {entry.parameter.name: entry for entry in made}

    def _limits(self) -> list[_Entry]:
        def writing(field: str) -> Callable[[float], None]:
            def write(value: float) -> None:
                self._setpoints.limits = replace(self._setpoints.limits, **{field: value})

            return write

        now, usual = self._setpoints.limits, Limits()
        return [
            _Entry(
                _number(f"limits.{field}", getattr(now, field), low, high, unit, text, getattr(usual, field)),
                writing(field),
            )
            for field, low, high, unit, text in _LIMITS
        ]

    def _gains(self) -> list[_Entry]:
        def writing(field: str) -> Callable[[float], None]:
            def write(value: float) -> None:
                self._setpoints.gains = replace(self._setpoints.gains, **{field: value})

            return write

        now, usual = self._setpoints.gains, Gains()
        return [
            _Entry(
                _number(f"msp.{field}", getattr(now, field), low, high, unit, text, getattr(usual, field)),
                writing(field),
            )
            for field, low, high, unit, text in _GAINS
        ]

    def _tilt(self) -> _Entry:
        def write(value: float) -> None:
            self._setpoints.full_tilt_rad = value or None

        text = "lean of a full stick in ANGLE mode; 0: the flight controller's angle_limit"
        return _Entry(_number(TILT, self._setpoints.full_tilt_rad or 0.0, 0.0, 1.5, "rad", text, 0.0), write)

    def _hover(self) -> _Entry:
        def write(value: float) -> None:
            self._setpoints.hover = value or None

        text = "hover throttle as a share of full throttle, learnt in flight; 0: unknown"
        return _Entry(_number(HOVER, self._setpoints.hover or 0.0, 0.0, 0.9, "", text, 0.0), write)

    def _aux(self) -> list[_Entry]:
        def writing(channel: int) -> Callable[[float], None]:
            def write(value: float) -> None:
                if value == AUTOMATIC:
                    self._setpoints.given_aux.pop(channel, None)
                else:
                    self._setpoints.given_aux[channel] = int(value)

            return write

        text = "pulse width sent on this AUX channel; 0: as arming and ANGLE mode need it; not for the arm switch"
        made = []
        for channel in range(MOST_AUX):
            value = self._setpoints.given_aux.get(channel, AUTOMATIC)
            name = f"{AUX}{channel + 1}"
            parameter = Parameter(name, ParameterType.INT, value, "µs", 0, 2100, default=AUTOMATIC, description=text)
            made.append(_Entry(parameter, writing(channel)))
        return made


def _number(name: str, value: float, low: float, high: float, unit: str, text: str, default: float) -> Parameter:
    return Parameter(name, ParameterType.FLOAT, value, unit, low, high, default=default, description=text)
