"""Convert Skyloop's own samples to JSON objects with a schema and back, and read their times. Pure; does not use MCAP.

The keys are the field names of the sample's class. Unknown values are absent, numbers that are not finite are null, and
an extra key (``action``, ``shape``) distinguishes the members of a union.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any, Final, TypeVar

import msgspec
from msgspec import inspect

from skyloop.clock import NS_PER_S
from skyloop.errors import FileFormatError
from skyloop.messages import (
    ACTION_NAMES,
    Annotation,
    Applied,
    CameraInfo,
    Event,
    Feedback,
    LogEntry,
    Points,
    Polyline,
    Text,
)

T = TypeVar("T")

MAX_DEPTH: Final = 64  #: maximum nesting of lists and objects in a sample; processors' results use a few levels
MIN_INT: Final = -(1 << 63)  #: the range of 64-bit integers
MAX_INT: Final = (1 << 63) - 1


def encode(sample: msgspec.Struct) -> bytes:
    """Encode a sample as JSON."""
    return msgspec.json.encode(to_plain(sample))


def decode(data: bytes | memoryview, kind: type[T]) -> T:
    """Decode a sample from JSON. Raise ``FileFormatError`` if the data do not describe a sample of that type."""
    return from_plain(from_json(data), kind)


def from_json(data: bytes | memoryview | str) -> Any:
    """Decode arbitrary JSON. Raise ``FileFormatError`` if the data are not JSON or are nested too deeply."""
    try:
        return msgspec.json.decode(data)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise FileFormatError(f"a message is not JSON: {error}") from None


#: The key and value that identify each member of a union in JSON.
_TAGS: Final[dict[type, tuple[str, str]]] = {
    **{action: ("action", name) for action, name in ACTION_NAMES.items()},
    Polyline: ("shape", "polyline"),
    Points: ("shape", "points"),
    Text: ("shape", "text"),
}


#: Field names in recordings with layout 1, by current name.
_FORMER: Final[dict[type, dict[str, str]]] = {
    Feedback: {
        "roll_rad": "roll",
        "pitch_rad": "pitch",
        "yaw_rad": "yaw",
        "altitude_m": "altitude",
        "velocity_m_s": "velocity",
        "angular_velocity_rad_s": "angular_velocity",
        "acceleration_m_s2": "acceleration",
        "position_m": "position",
    },
    CameraInfo: {"position_m": "position"},
}


def to_plain(value: Any) -> Any:
    """Convert a sample to dicts, lists, strings, numbers and booleans."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, msgspec.Struct):
        tag = _TAGS.get(type(value))
        plain = {} if tag is None else {tag[0]: tag[1]}
        for name in value.__struct_fields__:
            field = getattr(value, name)
            if field is not None:
                plain[name] = to_plain(field)
        return plain
    if isinstance(value, dict):
        return {key: to_plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [to_plain(item) for item in value]
    if isinstance(value, frozenset):
        return sorted(value)
    return value


def from_plain(plain: Any, kind: type[T]) -> T:
    """Convert plain values back to a sample.

    Raise ``FileFormatError`` if the values do not describe a sample of that type.
    """
    restore = _restorer(kind)  # type: ignore[arg-type]
    try:
        return msgspec.convert(restore(plain), kind)
    except (msgspec.ValidationError, TypeError, ValueError, LookupError, AttributeError, RecursionError) as error:
        raise FileFormatError(f"a message can't be read as {kind.__name__}: {error!r:.300}") from None


def limited(value: Any, depth: int = MAX_DEPTH) -> Any:
    """Return a JSON value unchanged if other programs can read it and it has at most ``depth`` levels of nesting.

    Raise ``ValueError`` if an integer has more than 64 bits, which neither NumPy nor a packet can hold, or if the value
    is nested too deeply.
    """
    if isinstance(value, dict | list):
        if depth <= 0:
            raise ValueError(f"it is nested more than {MAX_DEPTH} deep")
        for one in value.values() if isinstance(value, dict) else value:
            limited(one, depth - 1)
    elif type(value) is int and not MIN_INT <= value <= MAX_INT:
        raise ValueError("a whole number with more than 64 bits")
    return value


_Restore = Callable[[Any], Any]


@cache
def _restorer(kind: Any) -> _Restore:
    """Return a function that prepares a JSON value for conversion to this type by ``msgspec.convert``."""
    return _restore_type(inspect.type_info(kind))


def _restore_type(info: inspect.Type) -> _Restore:
    if isinstance(info, inspect.Metadata):
        return _restore_type(info.type)
    if isinstance(info, inspect.FloatType):
        return lambda value: math.nan if value is None else value
    if isinstance(info, inspect.IntType | inspect.AnyType):
        return limited
    if isinstance(info, inspect.StructType):
        return _restore_struct(info)
    if isinstance(info, inspect.UnionType):
        return _restore_union(info)
    if isinstance(info, inspect.DictType):
        item = _restore_type(info.value_type)
        return lambda value: {key: item(one) for key, one in value.items()}
    if isinstance(info, inspect.VarTupleType):
        item = _restore_type(info.item_type)
        return lambda value: [item(one) for one in value]
    if isinstance(info, inspect.TupleType):
        items = [_restore_type(one) for one in info.item_types]
        return lambda value: [item(one) for item, one in zip(items, value, strict=True)]
    return lambda value: value


def _restore_struct(info: inspect.StructType) -> _Restore:
    fields = [(field.name, _restore_type(field.type), _default(field)) for field in info.fields]
    tag = [] if info.tag is None else [info.tag]
    former = _FORMER.get(info.cls, {})

    def restore(value: dict[str, Any]) -> Any:
        restored = {}
        for name, item, default in fields:
            key = name if name in value else former.get(name, name)
            restored[name] = item(value[key]) if key in value else default()
        return [*tag, *restored.values()] if info.array_like else restored

    return restore


def _default(field: inspect.Field) -> Callable[[], Any]:
    if field.default_factory is not msgspec.NODEFAULT:
        return field.default_factory  # type: ignore[no-any-return]
    if field.default is not msgspec.NODEFAULT:
        plain = msgspec.to_builtins(field.default)
        return lambda: plain

    def missing() -> Any:
        if isinstance(field.type, inspect.FloatType):
            return math.nan
        raise KeyError(f"the field {field.name} is missing")

    return missing


def _restore_union(info: inspect.UnionType) -> _Restore:
    structs = {
        _TAGS[one.cls][1]: (_TAGS[one.cls][0], _restore_type(one))
        for one in info.types
        if isinstance(one, inspect.StructType) and one.cls in _TAGS
    }
    others = [one for one in info.types if not isinstance(one, inspect.NoneType)]
    nothing = None if len(others) < len(info.types) else math.nan
    only = _restore_type(others[0]) if len(others) == 1 else None

    def restore(value: Any) -> Any:
        if value is None:
            return nothing
        if structs:
            key = next(iter(structs.values()))[0]
            return structs[value[key]][1](value)
        if only is not None:
            restored = only(value)
            # A vector with an unknown component is unknown as a whole; our own samples contain only finite numbers.
            unknown = nothing is None and isinstance(restored, list) and any(one != one for one in restored)
            return None if unknown else restored
        return (
            [math.nan if one is None else limited(one) for one in value] if isinstance(value, list) else limited(value)
        )

    return restore


# Schemas -------------------------------------------------------------------------------------------------------


def schema_name(kind: type[msgspec.Struct]) -> str:
    """Return the schema name of a sample."""
    return f"skyloop.{kind.__name__}"


@cache
def schema(kind: type[msgspec.Struct]) -> bytes:
    """Return a sample's JSON schema, limited to what viewers can interpret: no references and no unions.

    (Foxglove and Lichtblick require "type": "object" at the root and one type for each property and item.) A property
    with several possible types, such as a parameter's value, is therefore not listed; the schema allows unlisted
    properties. The description is the first line of the class's docstring.
    """
    info = inspect.type_info(kind)
    described = {"title": schema_name(kind), "description": (kind.__doc__ or "").partition("\n")[0], **_schema_of(info)}
    return msgspec.json.encode(described)


_SIMPLE: Final = (
    (inspect.BoolType, "boolean"),
    (inspect.IntType, "integer"),
    (inspect.FloatType, "number"),
    (inspect.StrType, "string"),
    (inspect.EnumType, "string"),
)


def _schema_of(info: inspect.Type) -> dict[str, Any]:
    """Return a type's schema; empty if it can't be described."""
    if isinstance(info, inspect.Metadata):
        return _schema_of(info.type)
    for kind, name in _SIMPLE:
        if isinstance(info, kind):
            return {"type": name}
    if isinstance(info, inspect.DictType):
        return {"type": "object", "properties": {}}
    if isinstance(info, inspect.VarTupleType | inspect.FrozenSetType):
        return _array(_schema_of(info.item_type))
    if isinstance(info, inspect.TupleType):
        return _array(_schema_of(info.item_types[0]))
    if isinstance(info, inspect.StructType):
        return _object([info])
    if isinstance(info, inspect.UnionType):
        others = [one for one in info.types if not isinstance(one, inspect.NoneType)]
        if len(others) == 1:
            return _schema_of(others[0])
        structs = [one for one in others if isinstance(one, inspect.StructType)]
        return _object(structs) if len(structs) == len(others) else {}
    return {}


def _array(items: dict[str, Any]) -> dict[str, Any]:
    if items.get("type") == "array":  # viewers can't display arrays of arrays; points are shown as drawings instead
        return {}
    return {"type": "array", "items": items} if items else {}


def _object(structs: list[inspect.StructType]) -> dict[str, Any]:
    """Return one object schema with the properties of all structs."""
    properties: dict[str, Any] = {}
    for struct in structs:
        if struct.cls in _TAGS:
            properties[_TAGS[struct.cls][0]] = {"type": "string"}
        for field in struct.fields:
            described = _schema_of(field.type)
            if described:
                properties[field.name] = described
    return {"type": "object", "properties": properties}


# Times ----------------------------------------------------------------------------------------------------------
#
# A sample's timestamp is its time of reception on the proxy's clock: the time axis of a flight. The file's own
# timestamps are on the recorder's clock, which is unrelated to the flight if a replay runs in step with an application.


_BACK_NS: Final = 10 * NS_PER_S  #: maximum time by which a sample's own time may lie before the newest time
_AHEAD_NS: Final = 3600 * NS_PER_S  #: maximum time by which it may lie after the newest time


_TIMES: Final = ("captured_ns", "published_ns", "applied_ns", "sent_ns", "at_ns", "made_ns")


def reported_ns(value: Any) -> int | None:
    """Return a sample's time on the proxy's clock, or None if the sample has no time.

    It is the time of reception or publication where the sample states it, and of capture or completion otherwise.
    """
    if isinstance(value, Feedback):
        return value.published_ns or value.captured_ns
    if isinstance(value, Applied):
        return value.applied_ns
    if isinstance(value, Event | LogEntry):
        return value.at_ns
    if isinstance(value, Annotation):
        return value.captured_ns
    made_ns = getattr(value, "made_ns", None)  # present in the record of a result
    if made_ns is not None:
        return int(made_ns)
    header = getattr(value, "header", None)  # present in the record or picture of a frame
    return None if header is None else int(header.published_ns)


def shifted(value: Any, shift_ns: int) -> Any:
    """Return a copy of a sample with its times shifted forward by ``shift_ns``."""
    names = [name for name in _TIMES if getattr(value, name, 0)]
    if names:
        return msgspec.structs.replace(value, **{name: getattr(value, name) + shift_ns for name in names})
    if (header := getattr(value, "header", None)) is not None:  # the record of a frame
        return msgspec.structs.replace(value, header=shifted(header, shift_ns))
    record = getattr(value, "record", None)
    return value if record is None else replace(value, record=shifted(record, shift_ns))


class TimeCourse:
    """Tracks the time along a recording, sample by sample. It never runs backwards, and a single wrong time is ignored.

    If the proxy's clock restarts because its computer was rebooted, time continues from the last value, advanced by the
    time that elapsed on the recorder's clock.
    """

    def __init__(self, shift_ns: int = 0) -> None:
        """Start before the first sample; a shift that is already known may be given."""
        self.first_ns: int | None = None  #: time of the first sample that has a time
        self.newest_ns = 0  #: time of the newest sample
        #: offset that is currently added to the samples' own times, to compensate for restarts of the proxy's clock
        self.shift_ns = shift_ns
        self._doubted_ns: int | None = None  # an implausible time; accepted if the next time agrees with it
        self._log_ns = 0  # log time of the newest sample

    def follow(self, value: Any, log_ns: int = 0) -> int:
        """Return the time of the next sample in file order, recorded at ``log_ns`` (0: unknown)."""
        own_ns = reported_ns(value)
        if own_ns is None:
            return self.newest_ns
        own_ns += self.shift_ns
        if self.first_ns is None:
            self.first_ns = self.newest_ns = own_ns
        elif -_BACK_NS < own_ns - self.newest_ns < _AHEAD_NS:
            self.newest_ns = max(self.newest_ns, own_ns)
            # Only feedback dispels a doubt, or shows that a clock was set back: applications set other samples' times.
            self._doubted_ns = None if isinstance(value, Feedback) else self._doubted_ns
        elif own_ns > self.newest_ns or isinstance(value, Feedback):
            agree = self._doubted_ns is not None and abs(own_ns - self._doubted_ns) < _BACK_NS
            self._doubted_ns = own_ns
            if agree and own_ns < self.newest_ns:
                passed_ns = min(max(0, log_ns - self._log_ns), _AHEAD_NS) if log_ns and self._log_ns else 0
                self.newest_ns += passed_ns
                self.shift_ns += self.newest_ns - own_ns
                self._doubted_ns = None
            elif agree:
                self.newest_ns = own_ns
            else:
                return self.newest_ns
        else:
            return self.newest_ns
        self._log_ns = log_ns
        return self.newest_ns
