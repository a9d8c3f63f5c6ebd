"""The autopilot's parameters as ours: its own names under ``mavlink.``, and the names that all drivers share. Pure."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from skyloop.drivers.mavlink.metadata import COMMON, MEANINGS, Common, Meaning
from skyloop.drivers.mavlink.parameter_exchange import Held
from skyloop.errors import ParameterError, UnknownNameError
from skyloop.messages import Parameter, ParameterType, Refusal, Value
from skyloop.wire.mavlink.parameter_values import bounds, is_integer

PREFIX: Final = "mavlink."
TAKEOFF_ALTITUDE: Final = "limits.takeoff_altitude"
TAKEOFF_RANGE_M: Final = (0.5, 50.0)
_NAME: Final = re.compile(r"[A-Za-z0-9_]{1,16}\Z")


@dataclass(frozen=True, slots=True)
class Entry:
    """A parameter, and the autopilot's name and factor behind it."""

    parameter: Parameter
    native: str
    factor: float = 1.0  #: the autopilot's number times this is the parameter's

    def to_native(self, value: Value) -> float:
        """As the autopilot takes it. Raises :class:`ParameterError` for what is no finite number, or no whole one."""
        name, whole = self.parameter.name, self.parameter.type is ParameterType.INT
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise ParameterError(f"{name} takes a finite number, not {value!r:.60}", code=Refusal.WRONG_TYPE)
        if whole and value != int(value):
            raise ParameterError(f"{name} takes a whole number, not {value!r}", code=Refusal.WRONG_TYPE)
        low, high = self.parameter.minimum, self.parameter.maximum
        if (low is not None and value < low) or (high is not None and value > high):
            raise ParameterError(f"{name} is from {low} to {high}, not {value!r}", code=Refusal.OUT_OF_RANGE)
        return value / self.factor

    def from_native(self, number: float) -> Value:
        return int(number) if self.parameter.type is ParameterType.INT else short(number * self.factor)


def entries_of(held: Mapping[str, Held]) -> dict[str, Entry]:
    """All parameters that the vehicle told, by our names."""
    found: dict[str, Entry] = {}
    for name, each in held.items():
        entry = _own(each) if _NAME.match(name) else None
        if entry is not None:
            found[entry.parameter.name] = entry
    for common in COMMON:
        enabled = not common.needs or (common.needs in held and held[common.needs].value != 0)
        if common.native in held and common.name not in found and enabled and held[common.native].value > 0:
            entry = _shared(common, held[common.native])
            found[common.name] = entry
    return found


def takeoff_altitude(height_m: float) -> Parameter:
    """The driver's own."""
    low, high = TAKEOFF_RANGE_M
    text = "where a take-off ends, above the place of the start"
    return Parameter(TAKEOFF_ALTITUDE, ParameterType.FLOAT, height_m, "m", low, high, description=text)


def entry_of(entries: Mapping[str, Entry], name: str) -> Entry:
    """Raises :class:`UnknownNameError`, and :class:`ParameterError` for one that can only be read."""
    entry = entries.get(name)
    if entry is None:
        raise UnknownNameError("parameter of the vehicle", name, entries)
    if entry.parameter.read_only:
        raise ParameterError(f"{name} can only be read", code=Refusal.READ_ONLY)
    return entry


def short(number: float) -> float:
    """A number in single precision without the digits that it does not have."""
    return float(f"{number:.7g}")


def _own(held: Held) -> Entry | None:
    meaning = MEANINGS.get(held.name, Meaning())
    name = PREFIX + held.name.lower()
    if not math.isfinite(held.value):
        parameter = Parameter(name, ParameterType.TEXT, str(held.value), read_only=True, description="no number")
        return Entry(parameter, held.name)
    if is_integer(held.kind):
        least, most = map(float, bounds(held.kind))
        value: float = int(held.value)
        kind = ParameterType.INT
    else:
        least, most = -math.inf, math.inf
        value, kind = short(held.value), ParameterType.FLOAT
    low = meaning.low if meaning.low is not None else least
    high = meaning.high if meaning.high is not None else most
    return Entry(
        Parameter(
            name,
            kind,
            value,
            meaning.unit,
            _bound(min(low, value)),  # a vehicle that has a value beyond shows that its own range is wider
            _bound(max(high, value)),
            description=meaning.text or f"{held.name} of the autopilot",
        ),
        held.name,
    )


def _bound(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _shared(common: Common, held: Held) -> Entry:
    meaning, value = MEANINGS.get(held.name, Meaning()), short(held.value * common.factor)
    low = meaning.low * common.factor if meaning.low is not None else None
    high = meaning.high * common.factor if meaning.high is not None else None
    parameter = Parameter(
        common.name,
        ParameterType.FLOAT,
        value,
        common.unit,
        low if low is None else min(low, value),
        high if high is None else max(high, value),
        description=f"{common.text} ({held.name})",
    )
    return Entry(parameter, held.name, common.factor)
