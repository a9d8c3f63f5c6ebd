"""The driver's limits and the vehicle's own parameters, and how to write them.

The vehicle's names are in camel case; ours are in lower case behind ``crazyflie.``. A written value is lost when the
vehicle is switched off, unless ``crazyflie.store`` keeps it in its memory.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import partial
from typing import Final

import msgspec

from skyloop.drivers.base import checked_value
from skyloop.errors import ParameterError, UnknownNameError
from skyloop.messages import Parameter, ParameterType, Refusal, Value
from skyloop.vehicles.crazyflie.link import CrazyflieLink
from skyloop.vehicles.crazyflie.options import OWN_LIMITS
from skyloop.vehicles.crazyflie.wire.contents import Entry, MiscMessage

PREFIX: Final = "crazyflie."
STORE: Final = "crazyflie.store"
FORGET: Final = "crazyflie.forget"
NONE: Final = "none"
#: Groups whose parameters turn motors without a flight: they can be read only.
MOTOR_GROUPS: Final = frozenset({"motorpowerset", "health", "motortest", "powerdist", "system"})
_REPORTED: Final = (
    ("firmware", "the firmware's version"),
    ("device", "the kind of vehicle"),
    ("protocol", "version of the protocol"),
)


def own_name(entry: Entry) -> str:
    """Return our name for a parameter of the vehicle."""
    return PREFIX + re.sub(r"[^a-z0-9_.]", "_", entry.full_name.lower())


def vehicle_parameter(entry: Entry, value: float) -> Parameter:
    """Return a parameter with its current value."""
    low, high = entry.type.limits
    locked = entry.read_only or entry.group.lower() in MOTOR_GROUPS
    text = f"the firmware's {entry.full_name}" + ("; it can be stored" if entry.extended else "")
    if entry.type.is_float:
        return Parameter(own_name(entry), ParameterType.FLOAT, value, read_only=locked, description=text)
    return Parameter(
        own_name(entry), ParameterType.INT, int(value), minimum=low, maximum=high, read_only=locked, description=text
    )


def keeping_parameters(names: Iterable[str]) -> list[Parameter]:
    """Return the parameters that keep others' values in the vehicle's memory, or make it forget them."""
    choices: tuple[Value, ...] = (NONE, *names)
    rows = ((STORE, "keeps the current value of this parameter"), (FORGET, "forgets the kept value of this parameter"))
    return [
        Parameter(name, ParameterType.TEXT, NONE, default=NONE, choices=choices, description=text, momentary=True)
        for name, text in rows
    ]


class CrazyflieParameters:
    """All parameters of one open driver."""

    def __init__(self, link: CrazyflieLink) -> None:
        self._link = link
        self._kept = {STORE: NONE, FORGET: NONE}  # the last one stored, and forgotten

    def parameters(self) -> list[Parameter]:
        """Return the parameters whose values are known, with these values."""
        with self._link.lock:
            session = self._link.session
            limits = dict(session.setpoints.limits)
            entries = self._entries()
            found = {name: vehicle_parameter(entry, session.values[entry.number]) for name, entry in entries.items()}
            reported = {"firmware": session.firmware, "device": session.device, "protocol": session.protocol_text}
        own = [limit.parameter(limits[limit.name]) for limit in OWN_LIMITS]
        texts = [
            Parameter(PREFIX + name, ParameterType.TEXT, reported[name], read_only=True, description=text)
            for name, text in _REPORTED
            if reported[name]
        ]
        stored = [name for name, entry in entries.items() if entry.extended and not found[name].read_only]
        keeping = [self._momentary(one) for one in keeping_parameters(stored)] if stored else []
        return [*own, *found.values(), *keeping, *texts]

    def _momentary(self, parameter: Parameter) -> Parameter:
        return msgspec.structs.replace(parameter, value=self._kept[parameter.name])

    def _entries(self) -> dict[str, Entry]:
        """Return the vehicle's parameters whose values are known. The caller holds the lock."""
        session = self._link.session
        entries: dict[str, Entry] = {}
        for number, entry in session.parameters.entries.items():
            if number in session.values:
                entries.setdefault(own_name(entry), entry)
        return entries

    def write(self, name: str, value: Value) -> Value:
        """Write a parameter, and return the value in force afterwards. Takes up to 0.95 s.

        Raises an error for a wrong name or value, or if the vehicle refuses or does not answer.
        """
        known = {parameter.name: parameter for parameter in self.parameters()}
        if name not in known:
            raise UnknownNameError("parameter of the Crazyflie", name, known)
        parameter = known[name]
        if parameter.read_only:
            why = ": it turns motors" if name.split(".")[1] in MOTOR_GROUPS else ""
            raise ParameterError(f"{name} can only be read{why}", code=Refusal.READ_ONLY)
        value = checked_value(parameter, value)
        with self._link.lock:
            session = self._link.session
            if name in session.setpoints.limits:
                assert isinstance(value, float)
                session.setpoints.limits[name] = value
                return value
            entries = self._entries()
        if name in self._kept:
            return self._keep(name, str(value), entries)
        assert isinstance(value, int | float)
        return self._write(name, entries[name], value)

    def _write(self, name: str, entry: Entry, value: float) -> Value:
        try:
            entry.type.encode(value)
        except ValueError as error:
            raise ParameterError(f"{name}: {error}", code=Refusal.OUT_OF_RANGE) from None
        answer = self._link.ask(partial(self._link.session.write, entry.number, value))
        if answer is None:
            raise ParameterError(f"{name}: the vehicle did not answer", code=Refusal.DRIVER_FAILED)
        with self._link.lock:
            in_force = self._link.session.values[entry.number]
        return in_force if entry.type.is_float else int(in_force)

    def _keep(self, name: str, which: str, entries: dict[str, Entry]) -> Value:
        if which != NONE:
            answer = self._link.ask(partial(self._link.session.store, entries[which].number, clear=name == FORGET))
            if answer is None:
                raise ParameterError(f"{name}: the vehicle did not answer", code=Refusal.DRIVER_FAILED)
            error = MiscMessage.decode(answer).data[:1]
            if error != b"\0":
                raise ParameterError(f"{name}: the vehicle refuses {which} (error {error.hex() or 'unknown'})")
        self._kept[name] = which
        return which
