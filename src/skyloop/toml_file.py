"""Read TOML files into msgspec structs; errors give the place, the value and the allowed values."""

from __future__ import annotations

import difflib
import re
import reprlib
import sys
import threading
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final, TypeVar

import msgspec
from msgspec import inspect

from skyloop.errors import FileFormatError

T = TypeVar("T")

MAX_BYTES: Final = 1 << 18  #: maximum size of a file [bytes]; the largest world included takes 5 kB
#: Maximum number of parts in a key. For every key, a parser visits all tables above it; 10,000 parts take minutes.
MAX_DEPTH: Final = 16
MAX_WHOLE: Final = (1 << 63) - 1  #: TOML's limit; larger numbers are neither displayed nor used
#: Held during conversions: msgspec inspects a struct's fields on first use, and crashes if two threads do so at once.
_converting = threading.Lock()
_SHOWN: Final = 80  #: maximum length of a wrong value in a message [characters]
# Possessive quantifiers, and matching only at the start of a part, avoid backtracking: a miss is as fast as a match.
_PART = r"""(?:[A-Za-z0-9_-]++|"[^"\n]*+"|'[^'\n]*+')"""
_DEEP_KEY = re.compile(rf"(?<![A-Za-z0-9_-]){_PART}(?:[ \t]*+\.[ \t]*+{_PART}){{{MAX_DEPTH},}}+")
_WHERE = re.compile(r" - at `\$((?:\.\w+|\[\d+\])+)`$")  # how a msgspec error ends
_STEP = re.compile(r"\.(\w+)|\[(\d+)\]")
_KINDS = {bool: "a boolean", int: "a whole number", float: "a number", str: "a string", list: "a list", dict: "a table"}


@dataclass(frozen=True, slots=True)
class Place:
    """A table in a file, for error messages."""

    source: str  #: name of the file
    table: str = ""  #: name of the table; empty for top-level keys

    def under(self, key: str) -> Place:
        """Return the place of a table within this table."""
        return Place(self.source, f"{self.table}.{key}" if self.table else key)

    def item(self, key: str, number: int, name: object) -> Place:
        """Return the place of one table in an array of tables, by its name or by its number, counted from 1."""
        place = self.under(key).table
        return Place(self.source, f"{place} {name!r}" if isinstance(name, str) and name else f"{place} #{number}")

    def error(self, key: str, problem: str) -> FileFormatError:
        """Create an error about a key in the table."""
        where = [self.source, f"[{self.table}]"] if self.table else [self.source]
        return FileFormatError(f"{', '.join(where)}, key {key!r}: {problem}")

    def wrong(self, key: str, value: object, wanted: str) -> FileFormatError:
        """Create an error about a wrong value of a key."""
        kind = _KINDS.get(type(value), type(value).__name__)
        return self.error(key, f"{_shown(value)} ({kind}) given, but it must be {wanted}")


def parse_toml(text: str, source: str) -> dict[str, Any]:
    """Parse a file's text. Raises :class:`FileFormatError`, which names the file (``source``), on failure."""
    if _DEEP_KEY.search(text):
        raise FileFormatError(f"{source}: a key has more than {MAX_DEPTH} dotted parts")
    try:
        values: dict[str, Any] = msgspec.toml.decode(text)
    except (msgspec.DecodeError, ValueError, RecursionError) as error:  # including values that are just too large
        raise FileFormatError(f"{source}: not valid TOML: {error}") from None
    return values


def read_tables(values: Mapping[str, Any], source: str, kind: type[T]) -> T:
    """Convert the result of :func:`parse_toml` to a struct; unknown keys are errors.

    The fields of ``kind`` may be tables and lists of tables. Raises :class:`FileFormatError` if a key is missing or
    unknown, or if a value has the wrong type or is out of range.
    """
    try:
        with _converting:
            return msgspec.convert(values, kind)
    except msgspec.ValidationError as error:
        raise _explained(str(error), values, source, kind) from None


def _explained(message: str, values: Any, source: str, kind: type[Any]) -> FileFormatError:
    """Add the given value and a hint to msgspec's error, which names only the place and the expected type."""
    place, key, value, info = Place(source), "", values, inspect.type_info(kind)
    found = _WHERE.search(message)
    for name, number in _STEP.findall(found.group(1)) if found else ():
        if name:
            place = place.under(key) if key else place
            key, info, value = name, _fields(info, value)[name][0], value[name]
        else:
            index, several = int(number), _plain(info)
            info = several.item_types[index] if isinstance(several, inspect.TupleType) else several.item_type
            value = value[index]
            if _tables(info) and not isinstance(value, dict):
                return place.wrong(key, value, _wanted(several, place.under(key)))
            if _tables(info):
                place, key = place.item(key, index + 1, value.get("name")), ""
    if isinstance(value, dict) and _tables(info):
        return _wrong_key(place.under(key) if key else place, value, _fields(info, value), message)
    choices = _choices(info)
    if isinstance(value, str) and choices:
        return place.error(key, f"{value!r} is not known here; {_hint(value, choices)}")
    return place.wrong(key, value, _wanted(info, place.under(key)))


def _wrong_key(
    place: Place, table: dict[str, Any], fields: dict[str, tuple[inspect.Type, bool]], message: str
) -> FileFormatError:
    """Create the error for an unknown or missing key, or for both if one is a misspelling of the other."""
    unknown = [key for key in table if key not in fields]
    missing = [key for key, (_, required) in fields.items() if required and key not in table]
    for key in missing:
        wanted = f"missing; it must be {_wanted(fields[key][0], place.under(key))}"
        for near in difflib.get_close_matches(key, unknown, n=1, cutoff=0.6):
            return place.error(key, f"{wanted} (found {near!r}; did you mean {key!r}?)")
        if "missing" in message:
            return place.error(key, wanted)
    if unknown:
        return place.error(unknown[0], "unknown key; " + _hint(unknown[0], fields))
    return FileFormatError(f"{place.source}: {message}")


def _plain(info: inspect.Type) -> Any:
    """Return a type without its wrappers for optional values and metadata."""
    if isinstance(info, inspect.Metadata):
        return _plain(info.type)
    if isinstance(info, inspect.UnionType):
        known = [each for each in info.types if not isinstance(each, inspect.NoneType)]
        return _plain(known[0]) if len(known) == 1 else info
    return info


def _tables(info: inspect.Type) -> list[inspect.StructType]:
    """Return the kinds of tables that a value can be."""
    plain = _plain(info)
    kinds = plain.types if isinstance(plain, inspect.UnionType) else [plain]
    return [kind for kind in kinds if isinstance(kind, inspect.StructType)]


def _fields(info: inspect.Type, table: dict[str, Any]) -> dict[str, tuple[inspect.Type, bool]]:
    """Return each key's type and whether it is required; if several kinds are possible, the table names its kind."""
    kinds = _tables(info)
    tag = kinds[0].tag_field
    fields: dict[str, tuple[inspect.Type, bool]] = {}
    if tag is not None:
        fields[tag] = inspect.LiteralType(tuple(str(kind.tag) for kind in kinds)), True
    for kind in kinds:
        if tag is None or kind.tag == table.get(tag):
            fields |= {field.encode_name: (field.type, field.required) for field in kind.fields}
    return fields


def _choices(info: inspect.Type) -> tuple[str, ...]:
    plain = _plain(info)
    return tuple(map(str, plain.values)) if isinstance(plain, inspect.LiteralType) else ()


def _wanted(info: inspect.Type, place: Place) -> str:
    """Return a description of the allowed values; ``place`` is where the value is."""
    if isinstance(info, inspect.Metadata) and info.extra_json_schema:
        return str(info.extra_json_schema["description"])
    plain = _plain(info)
    if isinstance(plain, inspect.BoolType):
        return "true or false"
    if isinstance(plain, inspect.StrType):
        return "a non-empty string" if plain.min_length else "a string"
    if isinstance(plain, inspect.FloatType):
        return _range(plain.ge, plain.le)
    if isinstance(plain, inspect.TupleType):
        return f"a list of {len(plain.item_types)} numbers"
    if isinstance(plain, inspect.ListType):
        if _tables(plain.item_type):
            return f"tables written [[{place.table}]]"
        if isinstance(_plain(plain.item_type), inspect.StrType):
            return "a list of strings"
        return f"a list of at least {plain.min_length} lists of {len(_plain(plain.item_type).item_types)} numbers"
    return "one of " + ", ".join(_choices(info)) if _choices(info) else f"a table [{place.table}]"


def _range(low: float | None, high: float | None) -> str:
    """Describe a number between these bounds; bounds equal to the largest float are omitted."""
    least, most = (bound is not None and abs(bound) < sys.float_info.max for bound in (low, high))
    if least and most:
        return f"a number from {low:g} to {high:g}"
    return f"a finite number of at least {low:g}" if least else "a finite number"


def _shown(value: object) -> str:
    if isinstance(value, int) and not -MAX_WHOLE <= value <= MAX_WHOLE:
        return "a number of more than 64 bits"
    return reprlib.repr(value) if isinstance(value, list | dict) else f"{value!r:.{_SHOWN}}"


def _hint(name: str, known: Iterable[str]) -> str:
    choices = sorted(set(known))
    near = difflib.get_close_matches(name, choices, n=2, cutoff=0.5)
    if near:
        return "did you mean " + " or ".join(repr(n) for n in near) + "?"
    return "known: " + ", ".join(choices)
