"""The drone's keys as parameters: their own names and units, and the names that all drivers share in SI. Pure."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import msgspec

from skyloop.errors import DecodeError, ParameterError, UnknownNameError
from skyloop.messages import Parameter, ParameterType, Refusal, Value
from skyloop.wire.ardrone.configuration import format_value, parse_value
from skyloop.wire.ardrone.keys import KEYS, VideoChannel, VideoCodec

PREFIX: Final = "ardrone."
_NAME: Final = re.compile(r"[a-z0-9_]+(\.[a-z0-9_]+)*\Z")
_TYPES: Final[dict[type, ParameterType]] = {
    bool: ParameterType.BOOL,
    int: ParameterType.INT,
    float: ParameterType.FLOAT,
    tuple: ParameterType.VECTOR,
    str: ParameterType.TEXT,
}
#: Keys that the driver itself writes, or that have a parameter of their own which checks the drone's state.
_OURS: Final = {
    "general:navdata_demo": "the option navdata of the address decides",
    "general:navdata_options": "the option navdata_options of the address decides",
    "custom:session_id": "the driver decides",
    "custom:profile_id": "the driver decides",
    "custom:application_id": "the driver decides",
    "control:flight_anim": "write ardrone.flight_animation instead",
    "leds:leds_anim": "write leds.animation instead",
}


@dataclass(frozen=True, slots=True)
class _Common:
    """A name that all drivers share, and the key behind it; the key's number by ``divisor`` is SI."""

    name: str
    key: str
    unit: str = ""
    divisor: float = 1.0
    text: str = ""


_MILLI: Final = 1000.0
_COMMON: Final = (
    _Common("limits.tilt", "control:euler_angle_max", "rad", 1.0, "greatest roll and pitch, in force now"),
    _Common("limits.climb", "control:control_vz_max", "m/s", _MILLI, "greatest climb and descent, in force now"),
    _Common("limits.yaw_rate", "control:control_yaw", "rad/s", 1.0, "greatest yaw rate, in force now"),
    _Common("limits.altitude", "control:altitude_max", "m", _MILLI, "ceiling; 100 means none"),
    *(
        common
        for where in ("indoor", "outdoor")
        for common in (
            _Common(f"limits.{where}.tilt", f"control:{where}_euler_angle_max", "rad", 1.0, f"of {where} flight"),
            _Common(f"limits.{where}.climb", f"control:{where}_control_vz_max", "m/s", _MILLI, f"of {where} flight"),
            _Common(f"limits.{where}.yaw_rate", f"control:{where}_control_yaw", "rad/s", 1.0, f"of {where} flight"),
        )
    ),
    _Common("camera.fps", "video:codec_fps", "1/s", 1, "pictures a second of the video"),
)
CHANNEL_KEY: Final = "video:video_channel"
_CHANNELS: Final = {
    1: ("front", "bottom", "front_with_bottom", "bottom_with_front"),
    2: ("front", "bottom"),
}


@dataclass(frozen=True, slots=True)
class Entry:
    """A parameter and the key behind it."""

    parameter: Parameter
    key: str
    like: bool | int | float | str | tuple[float, ...]  #: a value of the key's type
    divisor: float = 1.0
    names: tuple[str, ...] = ()  #: of the key's values from 0 on, where the parameter has names for them

    def to_text(self, value: Value) -> str:
        """As the drone takes it. Raises :class:`ParameterError` for a type that does not fit."""
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
        """As the drone told it. Raises :class:`skyloop.errors.DecodeError` if it can't be."""
        value = parse_value(text, self.like)
        if self.names:
            number = int(str(value))
            if not 0 <= number < len(self.names):
                raise DecodeError(f"{text!r} is no number of {', '.join(self.names)}")
            return self.names[number]
        if self.divisor != 1.0 and isinstance(value, int | float):
            return value / self.divisor
        return value


def _wrong(parameter: Parameter, what: str) -> ParameterError:
    return ParameterError(f"{parameter.name} {what}", code=Refusal.WRONG_TYPE)


def entries_of(values: Mapping[str, str], version: int | None) -> dict[str, Entry]:
    """All parameters of a configuration as it was read, by name. Keys that nothing is known of are texts, read-only."""
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


def written(entries: Mapping[str, Entry], name: str, value: Value) -> tuple[Entry, str]:
    """The key's text for a new value. Raises :class:`UnknownNameError` and :class:`ParameterError`."""
    entry = entries.get(name)
    if entry is None:
        raise UnknownNameError("parameter of the AR.Drone", name, entries)
    if entry.parameter.read_only:
        raise ParameterError(f"{name} can only be read: {entry.parameter.description}", code=Refusal.READ_ONLY)
    return entry, entry.to_text(value)


def taken(entry: Entry, wanted: str, told: str) -> bool:
    """Whether the drone's text says what was written, apart from its way to write numbers."""
    try:
        one, other = parse_value(wanted, entry.like), parse_value(told, entry.like)
    except DecodeError:
        return False
    if isinstance(one, float) and isinstance(other, float):
        return _close(one, other)
    if isinstance(one, tuple) and isinstance(other, tuple):
        return len(one) == len(other) and all(map(_close, one, other))
    return one == other


def active_camera(values: Mapping[str, str]) -> str:
    """Which camera the video shows, as far as the configuration says it."""
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
        return _text_entry(parameter_name, name, text, "a key that Skyloop does not know")
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
    """Where the versions differ."""
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


def _si(value: bool | int | float | str | tuple[float, ...], divisor: float) -> Value:
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
        description=f"the camera whose pictures the drone sends ({CHANNEL_KEY})",
    )
    return Entry(parameter, CHANNEL_KEY, 0, names=names)


def _widened(parameter: Parameter) -> Parameter:
    """A drone that has a value beyond the documented range shows that its own range is wider."""
    value = parameter.value
    if parameter.choices and value not in parameter.choices:
        return msgspec.structs.replace(parameter, choices=(*parameter.choices, value))
    if isinstance(value, bool) or not isinstance(value, int | float):
        return parameter
    low, high = parameter.minimum, parameter.maximum
    return msgspec.structs.replace(
        parameter,
        minimum=low if low is None else min(low, value),
        maximum=high if high is None else max(high, value),
    )
