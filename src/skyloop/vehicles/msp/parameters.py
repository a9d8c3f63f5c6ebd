"""Options in an ``msp://`` address, and the driver's parameters (limits, scales, gains, AUX). Pure.

``docs/msp.md`` lists both.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

from skyloop.drivers.base import checked_value, reject_unknown_options
from skyloop.drivers.byte_stream import serial_port
from skyloop.drivers.uri import VehicleUri, host_and_port
from skyloop.errors import UnknownNameError, UsageError
from skyloop.messages import Parameter, ParameterType, Value
from skyloop.vehicles.msp.firmware import MOST_AUX
from skyloop.vehicles.msp.setpoints import Gains, Limits, MspSetpoints

DEFAULT_BAUD: Final = 115_200  #: the firmwares' own default for MSP
DEFAULT_RATE_HZ: Final = 50.0  #: default rate of stick frames
KNOWN: Final = {"baud", "rate", "override"}
_EXAMPLES: Final = "it looks like msp:///dev/ttyACM0?baud=115200, msp://COM3 or msp://tcp:127.0.0.1:5761"


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
        return self.port is None

    def __str__(self) -> str:
        return f"{self.place} at {self.baud} baud" if self.port is None else f"{self.place}, TCP port {self.port}"


def options_of(uri: VehicleUri) -> MspOptions:
    reject_unknown_options(uri, KNOWN)
    rate = uri.number("rate", DEFAULT_RATE_HZ, minimum=20.0, maximum=250.0)
    override = uri.flag("override", default=False)
    if (port := serial_port(uri.place)) is not None:
        baud = uri.whole("baud", DEFAULT_BAUD, minimum=9600, maximum=10_000_000)
        return MspOptions(port, None, baud, rate, override)
    if "baud" in uri.options:
        raise UsageError(f"{uri}: baud is for a serial port, such as msp:///dev/ttyACM0?baud=115200")
    word, _, rest = uri.place.partition(":")
    found = host_and_port(rest)
    if word != "tcp" or found is None:
        raise UsageError(f"{uri} names no host or device: {_EXAMPLES}")
    return MspOptions(*found, rate_hz=rate, override=override)


AUTOMATIC: Final = 0  #: AUX channel value meaning that the driver sets it to suit the modes
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
#: Each parameter, the controller's field (None for 0), the maximum, unit and description.
_LEARNT: Final = (
    (TILT, "full_tilt_rad", 1.5, "rad", "lean of a full stick in ANGLE mode; 0: the flight controller's angle_limit"),
    (HOVER, "hover", 0.9, "", "hover throttle as a share of full throttle, learnt in flight; 0: unknown"),
)


_Entry = tuple[Parameter, Callable[[float], None]]  # a parameter with its current value, and what writes it


class DriverParameters:
    """The driver's own parameters. The caller must hold the lock of the controller that uses them."""

    def __init__(self, setpoints: MspSetpoints) -> None:
        self._setpoints = setpoints

    def parameters(self) -> list[Parameter]:
        """Return all parameters with their current values."""
        return [parameter for parameter, _ in self._entries().values()]

    def write(self, name: str, value: Value) -> Value:
        """Write a parameter and return the value in force; raise an error for an unknown name or an invalid value."""
        entries = self._entries()
        if name not in entries:
            raise UnknownNameError("parameter of msp://", name, entries)
        parameter, write = entries[name]
        value = checked_value(parameter, value)
        assert isinstance(value, int | float)
        write(value)
        return value

    def _entries(self) -> dict[str, _Entry]:
        setpoints = self._setpoints
        made = [
            *(self._setting("limits", f"limits.{row[0]}", Limits(), *row) for row in _LIMITS),
            *(self._setting("gains", f"msp.{row[0]}", Gains(), *row) for row in _GAINS),
        ]
        for name, field, high, unit, text in _LEARNT:
            parameter = _number(name, getattr(setpoints, field) or 0.0, 0.0, high, unit, text, 0.0)
            made.append((parameter, partial(self._write_learnt, field)))
        for channel in range(MOST_AUX):
            name, value = f"{AUX}{channel + 1}", setpoints.given_aux.get(channel, AUTOMATIC)
            text = "pulse width sent on this AUX channel; 0: as arming and ANGLE mode need it; not for the arm switch"
            parameter = Parameter(name, ParameterType.INT, value, "µs", 0, 2100, default=AUTOMATIC, description=text)
            made.append((parameter, partial(self._write_aux, channel)))
        return {entry[0].name: entry for entry in made}

    def _setting(
        self, group: str, name: str, usual: Limits | Gains, field: str, low: float, high: float, unit: str, text: str
    ) -> _Entry:
        """Return the entry for a field of the controller's limits or gains."""

        def write(value: float) -> None:
            setattr(self._setpoints, group, replace(getattr(self._setpoints, group), **{field: value}))

        now = getattr(getattr(self._setpoints, group), field)
        return _number(name, now, low, high, unit, text, getattr(usual, field)), write

    def _write_learnt(self, field: str, value: float) -> None:
        setattr(self._setpoints, field, value or None)

    def _write_aux(self, channel: int, value: float) -> None:
        if value == AUTOMATIC:
            self._setpoints.given_aux.pop(channel, None)
        else:
            self._setpoints.given_aux[channel] = int(value)


def _number(name: str, value: float, low: float, high: float, unit: str, text: str, default: float) -> Parameter:
    return Parameter(name, ParameterType.FLOAT, value, unit, low, high, default=default, description=text)
