"""The drone's keys and commands as parameters, with their own names and the SI names that all drivers share. Pure."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Final

import msgspec

from skyloop.drivers.base import checked_value
from skyloop.errors import DecodeError, ParameterError, UnknownNameError
from skyloop.messages import Parameter, ParameterType, Refusal, Value
from skyloop.vehicles.ardrone.setpoints import ArdroneSetpoints, Condition
from skyloop.vehicles.ardrone.wire.at import AtMessage
from skyloop.vehicles.ardrone.wire.configuration import (
    FIRST_FLIP,
    FLIGHT_ANIMATIONS,
    KEYS,
    LED_ANIMATIONS,
    NO_ANIMATION,
    VideoChannel,
    VideoCodec,
    format_value,
    parse_value,
)

# Keys of the configuration -------------------------------------------------------------------------------------------

PREFIX: Final = "ardrone."
_NAME: Final = re.compile(r"[a-z0-9_]+(\.[a-z0-9_]+)*\Z")
_TYPES: Final[dict[type, ParameterType]] = {
    bool: ParameterType.BOOL,
    int: ParameterType.INT,
    float: ParameterType.FLOAT,
    tuple: ParameterType.VECTOR,
    str: ParameterType.TEXT,
}
#: Keys that the driver writes itself or that are written by a parameter which checks the drone's state first.
_OURS: Final = {
    "general:navdata_demo": "set by the option navdata in the address",
    "general:navdata_options": "set by the option navdata_options in the address",
    "custom:session_id": "set by the driver",
    "custom:profile_id": "set by the driver",
    "custom:application_id": "set by the driver",
    "control:flight_anim": "write ardrone.flight_animation instead",
    "leds:leds_anim": "write leds.animation instead",
}


@dataclass(frozen=True, slots=True)
class _Common:
    """A name shared by all drivers, and the key it maps to. The key's number divided by ``divisor`` is in SI units."""

    name: str
    key: str
    unit: str = ""
    divisor: float = 1.0
    text: str = ""


_MILLI: Final = 1000.0  #: divisor for the drone's mm and mm/s
_COMMON: Final = (
    _Common("limits.tilt", "control:euler_angle_max", "rad", 1.0, "maximum roll and pitch, currently in force"),
    _Common("limits.climb", "control:control_vz_max", "m/s", _MILLI, "maximum climb and descent, currently in force"),
    _Common("limits.yaw_rate", "control:control_yaw", "rad/s", 1.0, "maximum yaw rate, currently in force"),
    _Common("limits.altitude", "control:altitude_max", "m", _MILLI, "ceiling; 100 means none"),
    *(
        common
        for where in ("indoor", "outdoor")
        for common in (
            _Common(f"limits.{where}.tilt", f"control:{where}_euler_angle_max", "rad", 1.0, f"for {where} flight"),
            _Common(f"limits.{where}.climb", f"control:{where}_control_vz_max", "m/s", _MILLI, f"for {where} flight"),
            _Common(f"limits.{where}.yaw_rate", f"control:{where}_control_yaw", "rad/s", 1.0, f"for {where} flight"),
        )
    ),
    _Common("camera.fps", "video:codec_fps", "1/s", 1, "frame rate of the video"),
)
CHANNEL_KEY: Final = "video:video_channel"
_CHANNELS: Final = {1: ("front", "bottom", "front_with_bottom", "bottom_with_front"), 2: ("front", "bottom")}


@dataclass(frozen=True, slots=True)
class Entry:
    """A parameter and the key it maps to."""

    parameter: Parameter
    key: str
    like: bool | int | float | str | tuple[float, ...]  #: any value of the key's type
    divisor: float = 1.0
    names: tuple[str, ...] = ()  #: names for the key's values 0, 1, 2 and so on; empty if the values have no names

    def to_text(self, value: Value) -> str:
        """Convert a value to the drone's notation; raise :class:`ParameterError` if its type or name does not fit."""
        if self.names:
            if value not in self.names:
                raise _wrong(self.parameter, f"is one of {', '.join(self.names)}")
            return str(self.names.index(str(value)))
        if isinstance(self.like, float | int) and not isinstance(self.like, bool):
            if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
                raise _wrong(self.parameter, f"takes a finite number, not {value!r}")
            number = value * self.divisor
            return format_value(round(number) if isinstance(self.like, int) else float(number))
        if type(value) is not type(self.like):
            raise _wrong(self.parameter, f"takes a {self.parameter.type.value}, not {value!r:.60}")
        return format_value(value)

    def from_text(self, text: str) -> Value:
        """Convert the drone's text to a value; raise :class:`DecodeError` if the text does not fit the key's type."""
        value = parse_value(text, self.like)
        if self.names:
            number = int(str(value))
            if not 0 <= number < len(self.names):
                raise DecodeError(f"{text!r} is not the index of one of {', '.join(self.names)}")
            return self.names[number]
        if self.divisor != 1.0 and isinstance(value, int | float):
            return value / self.divisor
        return value


def _wrong(parameter: Parameter, what: str) -> ParameterError:
    return ParameterError(f"{parameter.name} {what}", code=Refusal.WRONG_TYPE)


def entries_of(values: Mapping[str, str], version: int | None) -> dict[str, Entry]:
    """Return all parameters in a configuration by name. Unknown keys become read-only texts."""
    found: dict[str, Entry] = {}
    for name, text in values.items():
        entry = _own_entry(name, text, version)
        if entry is not None:
            found[entry.parameter.name] = entry
    for common in _COMMON:
        if common.key in values and (entry := _common_entry(common, values[common.key])) is not None:
            found[common.name] = entry
    if CHANNEL_KEY in values and (entry := _channel_entry(values[CHANNEL_KEY], version)) is not None:
        found[entry.parameter.name] = entry
    return found


def prepare_write(entries: Mapping[str, Entry], name: str, value: Value) -> tuple[Entry, str]:
    """Return the entry and the text to write for a new value; raise an error if the name or value is invalid."""
    entry = entries.get(name)
    if entry is None:
        raise UnknownNameError("parameter of the AR.Drone", name, entries)
    if entry.parameter.read_only:
        raise ParameterError(f"{name} can only be read: {entry.parameter.description}", code=Refusal.READ_ONLY)
    return entry, entry.to_text(value)


def is_confirmed(entry: Entry, wanted: str, reported: str) -> bool:
    """Return whether the drone reports the written value, regardless of its number format."""
    try:
        one, other = parse_value(wanted, entry.like), parse_value(reported, entry.like)
    except DecodeError:
        return False
    if isinstance(one, float) and isinstance(other, float):
        return _close(one, other)
    if isinstance(one, tuple) and isinstance(other, tuple):
        return len(one) == len(other) and all(map(_close, one, other))
    return one == other


def active_camera(values: Mapping[str, str]) -> str:
    """Return which camera is selected for the video in the configuration; ``front`` by default."""
    try:
        channel = int(values.get(CHANNEL_KEY, "0"))
    except ValueError:
        channel = 0
    return "bottom" if channel in (VideoChannel.BOTTOM, VideoChannel.BOTTOM_WITH_FRONT) else "front"


def _close(one: float, other: float) -> bool:
    return math.isclose(one, other, rel_tol=1e-4, abs_tol=1e-6)


def _own_entry(name: str, text: str, version: int | None) -> Entry | None:
    parameter_name = PREFIX + name.replace(":", ".")
    if not _NAME.match(parameter_name):
        return None
    key = KEYS.get(name)
    if key is None:
        return _text_entry(parameter_name, name, text, "a key unknown to Skyloop")
    try:
        value = parse_value(text, key.default)
    except DecodeError:
        return _text_entry(parameter_name, name, text, f"{key.text}; the drone's value is not of the usual type")
    reason = _OURS.get(name)
    choices = _choices(name, version) or key.choices
    has_default = not (key.read_only or reason) and (not choices or key.default in choices)
    parameter = Parameter(
        name=parameter_name,
        type=_TYPES[type(key.default)],
        value=value,
        unit=key.unit,
        minimum=key.low,
        maximum=key.high,
        default=key.default if has_default else None,
        choices=choices,
        read_only=key.read_only or reason is not None,
        description=reason or key.text,
    )
    return Entry(_widened(parameter), name, key.default)


def _choices(name: str, version: int | None) -> tuple[int, ...]:
    """Return a key's allowed values if they depend on the drone's version."""
    if name == CHANNEL_KEY:
        return tuple(range(len(_CHANNELS[version or 2])))
    if name == "video:video_codec":
        return tuple(codec.value for codec in VideoCodec if codec and (codec < VideoCodec.MP4_360P) is (version == 1))
    return ()


def _text_entry(parameter_name: str, name: str, text: str, description: str) -> Entry:
    parameter = Parameter(parameter_name, ParameterType.TEXT, text, read_only=True, description=description)
    return Entry(parameter, name, "")


def _common_entry(common: _Common, text: str) -> Entry | None:
    key = KEYS[common.key]
    try:
        value = parse_value(text, key.default)
    except DecodeError:
        return None
    whole = isinstance(key.default, int) and common.divisor == 1
    parameter = Parameter(
        name=common.name,
        type=ParameterType.INT if whole else ParameterType.FLOAT,
        value=_si(value, common.divisor),
        unit=common.unit,
        minimum=key.low / common.divisor if key.low is not None else None,
        maximum=key.high / common.divisor if key.high is not None else None,
        default=_si(key.default, common.divisor),
        description=f"{common.text} ({common.key})",
    )
    return Entry(_widened(parameter), common.key, key.default, common.divisor)


def _si(value: bool | float | str | tuple[float, ...], divisor: float) -> Value:
    return value / divisor if divisor != 1 and isinstance(value, int | float) else value


def _channel_entry(text: str, version: int | None) -> Entry | None:
    names = _CHANNELS[version or 2]
    if not text.isdecimal() or int(text) >= len(names):
        return None
    parameter = Parameter(
        name="camera.active",
        type=ParameterType.TEXT,
        value=names[int(text)],
        default=names[0],
        choices=names,
        description=f"the camera whose video the drone sends ({CHANNEL_KEY})",
    )
    return Entry(parameter, CHANNEL_KEY, 0, names=names)


def _widened(parameter: Parameter) -> Parameter:
    """Widen the range to include the current value, which proves that this drone allows more than is documented."""
    value = parameter.value
    if parameter.choices and value not in parameter.choices:
        return msgspec.structs.replace(parameter, choices=(*parameter.choices, value))
    if isinstance(value, bool) or not isinstance(value, int | float):
        return parameter
    low, high = parameter.minimum, parameter.maximum
    return msgspec.structs.replace(
        parameter, minimum=low if low is None else min(low, value), maximum=high if high is None else max(high, value)
    )


# Commands that are not actions ---------------------------------------------------------------------------------------

#: Sends a command in each of a given number of ticks.
Send = Callable[[AtMessage, int], None]

_REPEATS: Final = 3  #: number of ticks in which a command is sent, because any datagram may be lost
_MAGNETOMETER: Final = 0  #: device number for ``CALIB``
_HALF_TURN: Final = 3.1416  #: π rounded up [rad], so that π itself is within the range


def _switch(name: str, description: str, *, momentary: bool) -> Parameter:
    """Return a switch, which triggers an action each time it is written if ``momentary`` is True."""
    return Parameter(name, ParameterType.BOOL, False, default=False, description=description, momentary=momentary)


def _animation(name: str, names: Iterable[str], description: str) -> Parameter:
    none, kind = NO_ANIMATION, ParameterType.TEXT
    return Parameter(name, kind, none, default=none, choices=(none, *names), description=description, momentary=True)


def _number(name: str, value: float, unit: str, low: float, high: float, description: str) -> Parameter:
    return Parameter(name, ParameterType.FLOAT, value, unit, low, high, value, description=description)


_LEDS: Final = _animation("leds.animation", LED_ANIMATIONS, "LED animation to play (LED); none: does nothing")
_LEDS_FREQUENCY: Final = _number("leds.frequency", 2.0, "1/s", 0.1, 50.0, "frequency of the next LED animation")
_LEDS_DURATION: Final = _number("leds.duration", 3.0, "s", 0.0, 3600.0, "its duration, in whole seconds; 0: forever")
_TRIM: Final = _switch(
    "ardrone.flat_trim", "true: the drone uses its attitude as level (FTRIM); only on the ground", momentary=True
)
_CALIBRATE: Final = _switch(
    "ardrone.calibrate_magnetometer",
    "true: the drone turns once on the spot to calibrate its magnetometer (CALIB); only in flight",
    momentary=True,
)
_ABSOLUTE: Final = _switch(
    "ardrone.absolute_control",
    "true: roll and pitch refer to ardrone.absolute_heading instead of the drone's nose (PCMD_MAG)",
    momentary=False,
)
_HEADING: Final = _number(
    "ardrone.absolute_heading",
    0.0,
    "rad",
    -_HALF_TURN,
    _HALF_TURN,
    "heading that absolute control refers to: 0 is magnetic north, positive counter-clockwise",
)


def _flight_animations(version: int | None) -> Parameter:
    known = FLIGHT_ANIMATIONS[:FIRST_FLIP] if version == 1 else FLIGHT_ANIMATIONS
    text = "flight animation to perform (ANIM, sent once); only in flight"
    return _animation("ardrone.flight_animation", (name for name, _ in known), text)


class Commands:
    """The commands that are not actions, presented as parameters with values."""

    def __init__(self, setpoints: ArdroneSetpoints, send: Send) -> None:
        self._setpoints = setpoints
        self._send = send
        self._values: dict[str, Value] = {}

    def parameters(self, version: int | None) -> list[Parameter]:
        """Return the parameters for this version of the drone."""
        known = [_LEDS, _LEDS_FREQUENCY, _LEDS_DURATION, _TRIM, _flight_animations(version)]
        if version != 1:
            known += [_CALIBRATE, _ABSOLUTE, _HEADING]
        return [self._present(parameter) for parameter in known]

    def write(self, parameter: Parameter, value: Value) -> Value:
        """Send a command and return the parameter's new value.

        Raises :class:`ParameterError` for an invalid value, or if the drone must be on the ground (or in the air) and
        is not.
        """
        value = checked_value(parameter, value)
        name = parameter.name
        if name == _LEDS.name:
            self._light(str(value))
        elif name == _TRIM.name and value:
            self._give(("FTRIM", ()), on_ground=True)
        elif name == _CALIBRATE.name and value:
            self._give(("CALIB", (_MAGNETOMETER,)), on_ground=False)
        elif name == "ardrone.flight_animation" and value != NO_ANIMATION:
            self._fly(str(value))
        self._values[name] = value
        self._setpoints.reference_rad = self._reference()
        return value

    def _present(self, parameter: Parameter) -> Parameter:
        return msgspec.structs.replace(parameter, value=self._values.get(parameter.name, parameter.value))

    def _reference(self) -> float | None:
        if not self._values.get(_ABSOLUTE.name, False):
            return None
        heading = self._values.get(_HEADING.name, 0.0)
        assert isinstance(heading, float)
        return heading

    def _light(self, name: str) -> None:
        self._condition()
        if name == NO_ANIMATION:
            return
        frequency = self._values.get(_LEDS_FREQUENCY.name, _LEDS_FREQUENCY.value)
        duration = self._values.get(_LEDS_DURATION.name, _LEDS_DURATION.value)
        assert isinstance(frequency, float)
        assert isinstance(duration, float)
        self._send(("LED", (LED_ANIMATIONS.index(name), frequency, round(duration))), _REPEATS)

    def _fly(self, name: str) -> None:
        number = next(at for at, (known, _) in enumerate(FLIGHT_ANIMATIONS) if known == name)
        # Sent only once, because a repeat would fly the animation again.
        self._give(("ANIM", (number, FLIGHT_ANIMATIONS[number][1])), on_ground=False, times=1)

    def _give(self, message: AtMessage, *, on_ground: bool, times: int = _REPEATS) -> None:
        condition = self._condition()
        if on_ground and condition.flying:
            raise _refused(f"{message[0]} is for a drone that stands level on the ground: land first")
        if not on_ground and (not condition.flying or condition.emergency or self._setpoints.stop.active):
            raise _refused(f"{message[0]} is for a drone in the air: take off first")
        self._send(message, times)

    def _condition(self) -> Condition:
        condition = self._setpoints.condition
        if condition is None:
            raise _refused("no data from the drone")
        return condition


def _refused(why: str) -> ParameterError:
    return ParameterError(why, code=Refusal.WRONG_STATE)
