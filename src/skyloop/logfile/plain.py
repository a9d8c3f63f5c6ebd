"""Our own samples as JSON objects with a schema, and the way back. Pure, and without the MCAP library.

The keys are the fields of a sample's class. What is not known is absent; a number that is not finite is null; the
members of a union are told apart by a key of their own (``action``, ``shape``).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Any, Final, TypeVar

import msgspec
from msgspec import inspect

from skyloop.errors import FileFormatError
from skyloop.messages import ACTION_NAMES, Points, Polyline, Text

T = TypeVar("T")


def encode(sample: msgspec.Struct) -> bytes:
    """A sample as JSON."""
    return msgspec.json.encode(to_plain(sample))


def decode(data: bytes | memoryview, kind: type[T]) -> T:
    """The way back. Raises :class:`FileFormatError` for anything else."""
    try:
        plain = msgspec.json.decode(data)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise FileFormatError(f"a message that is not JSON: {error}") from None
    return from_plain(plain, kind)


#: How the members of a union are told apart in JSON: key and value.
_TAGS: Final[dict[type, tuple[str, str]]] = {
    **{action: ("action", name) for action, name in ACTION_NAMES.items()},
    Polyline: ("shape", "polyline"),
    Points: ("shape", "points"),
    Text: ("shape", "text"),
}


def to_plain(value: Any) -> Any:
    """A sample as dict, list, text, number and bool."""
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
    """The way back. Raises :class:`FileFormatError`."""
    restore = _restorer(kind)  # type: ignore[arg-type]
    try:
        return msgspec.convert(restore(plain), kind)
    except (msgspec.ValidationError, TypeError, ValueError, LookupError, AttributeError) as error:
        raise FileFormatError(f"a message that can't be understood as {kind.__name__}: {error!r}") from None


_Restore = Callable[[Any], Any]


@cache
def _restorer(kind: Any) -> _Restore:
    """From a JSON value to what ``msgspec.convert`` takes for this type."""
    return _restore_type(inspect.type_info(kind))


def _restore_type(info: inspect.Type) -> _Restore:
    if isinstance(info, inspect.Metadata):
        return _restore_type(info.type)
    if isinstance(info, inspect.FloatType):
        return lambda value: math.nan if value is None else value
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

    def restore(value: dict[str, Any]) -> Any:
        restored = {name: item(value[name]) if name in value else default() for name, item, default in fields}
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
            return only(value)
        return [math.nan if one is None else one for one in value] if isinstance(value, list) else value

    return restore


# Schemas -------------------------------------------------------------------------------------------------------


def schema_name(kind: type[msgspec.Struct]) -> str:
    return f"skyloop.{kind.__name__}"


@cache
def schema(kind: type[msgspec.Struct]) -> bytes:
    """The JSON schema of a sample, in the few words that viewers understand: no references, no choice of types.

    (Foxglove's and Lichtblick's readers want "type": "object" at the root and one type for each property and item.)
    A property that may be of several types, such as a parameter's value, is therefore not listed: others are allowed.
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
    """Empty for what can't be said."""
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
    if items.get("type") == "array":  # viewers know no arrays of arrays: points are shown as they are drawn, elsewhere
        return {}
    return {"type": "array", "items": items} if items else {}


def _object(structs: list[inspect.StructType]) -> dict[str, Any]:
    """One object with the properties of all of them."""
    properties: dict[str, Any] = {}
    for struct in structs:
        if struct.cls in _TAGS:
            properties[_TAGS[struct.cls][0]] = {"type": "string"}
        for field in struct.fields:
            described = _schema_of(field.type)
            if described:
                properties[field.name] = described
    return {"type": "object", "properties": properties}
