"""Strict reading of TOML tables: every value is asked for by key, kind and range, and what nobody asked for is an
error. Each refusal names the file, the table, the key, and what would be right."""

from __future__ import annotations

import difflib
import math
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from skyloop.errors import FileFormatError

_KINDS = {bool: "a boolean", int: "a whole number", float: "a number", str: "a text", list: "a list", dict: "a table"}


def parse_toml(text: str, source: str) -> TomlTable:
    """Parse ``text``; ``source`` is the file's name for messages. Raises :class:`FileFormatError`."""
    try:
        return TomlTable(tomllib.loads(text), source, "")
    except tomllib.TOMLDecodeError as error:
        raise FileFormatError(f"{source}: not valid TOML: {error}") from error


def read_toml(path: Path) -> TomlTable:
    """Read and parse a file. Raises :class:`FileFormatError` when it can't be read, is not UTF-8 or is not TOML."""
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise FileFormatError(f"{path}: not UTF-8 text: {error}") from error
    except OSError as error:
        raise FileFormatError(f"{path}: can't be read: {error.strerror or error}") from error
    return parse_toml(text, str(path))


class TomlTable:
    """One table of the file. Ask for all keys that may be there, then call :meth:`finish`."""

    def __init__(self, values: dict[str, Any], source: str, place: str) -> None:
        self._values = values
        self._source = source
        self._place = place
        self._asked: list[str] = []

    def error(self, key: str, problem: str) -> FileFormatError:
        """The error to raise about ``key`` (empty: about the whole table)."""
        where = [self._source]
        if self._place:
            where.append(f"[{self._place}]")
        if key:
            where.append(f"key {key!r}")
        return FileFormatError(f"{', '.join(where)}: {problem}")

    def finish(self) -> None:
        """Refuse the first key that was never asked for."""
        for key in self._values:
            if key not in self._asked:
                raise self.error(key, "unknown key; " + _hint(key, self._asked))

    def has(self, key: str) -> bool:
        """Whether the key is there; counts as asking for it."""
        self._asked.append(key)
        return key in self._values

    def text(self, key: str, default: str | None = None) -> str:
        value = self._get(key, "a text", default)
        if not isinstance(value, str) or not value:
            raise self._wrong(key, value, "a text that is not empty")
        return value

    def choice(self, key: str, choices: Iterable[str], default: str | None = None) -> str:
        known = list(choices)
        value = self._get(key, "one of " + ", ".join(known), default)
        if not isinstance(value, str):
            raise self._wrong(key, value, "one of " + ", ".join(known))
        if value not in known:
            raise self.error(key, f"{value!r} is not known here; {_hint(value, known)}")
        return value

    def flag(self, key: str, default: bool) -> bool:
        value = self._get(key, "true or false", default)
        if not isinstance(value, bool):
            raise self._wrong(key, value, "true or false")
        return value

    def whole(self, key: str, low: int, high: int, default: int | None = None) -> int:
        wanted = f"a whole number from {low} to {high}"
        value = self._get(key, wanted, default)
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise self._wrong(key, value, wanted)
        return value

    def number(
        self, key: str, default: float | None = None, *, low: float = -math.inf, high: float = math.inf
    ) -> float:
        """A finite number within [low, high]."""
        return self._number(key, self._get(key, _wanted(low, high), default), low, high)

    def vector(
        self,
        key: str,
        length: int,
        default: tuple[float, ...] | None = None,
        *,
        low: float = -math.inf,
        high: float = math.inf,
    ) -> tuple[float, ...]:
        """A list of ``length`` finite numbers, each within [low, high]."""
        wanted = f"a list of {length} numbers"
        value = self._get(key, wanted, default)
        return self._vector(key, value, length, wanted, low, high)

    def vectors(self, key: str, length: int, least: int) -> list[tuple[float, ...]]:
        """A list of at least ``least`` lists of ``length`` finite numbers."""
        wanted = f"a list of at least {least} lists of {length} numbers"
        value = self._get(key, wanted, None)
        if not isinstance(value, list) or len(value) < least:
            raise self._wrong(key, value, wanted)
        return [self._vector(key, item, length, wanted, -math.inf, math.inf) for item in value]

    def range(self, key: str, *, low: float = -math.inf, high: float = math.inf) -> tuple[float, float]:
        """A list [least, greatest] of two finite numbers in order."""
        least, greatest = self.vector(key, 2, low=low, high=high)
        if least > greatest:
            raise self.error(key, f"[{least:g}, {greatest:g}] is upside down; give [least, greatest]")
        return least, greatest

    def table(self, key: str) -> TomlTable:
        """A table within this one."""
        value = self._get(key, f"a table [{self._under(key)}]", None)
        if not isinstance(value, dict):
            raise self._wrong(key, value, f"a table [{self._under(key)}]")
        return TomlTable(value, self._source, self._under(key))

    def tables(self, key: str) -> list[TomlTable]:
        """An array of tables, ``[[key]]`` in the file; none when the key is not there."""
        wanted = f"tables written [[{self._under(key)}]]"
        value = self._get(key, wanted, [])
        if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
            raise self._wrong(key, value, wanted)
        return [TomlTable(item, self._source, self._item_place(key, item, n)) for n, item in enumerate(value, 1)]

    def _item_place(self, key: str, item: dict[str, Any], number: int) -> str:
        name = item.get("name")
        return f"{self._under(key)} {name!r}" if isinstance(name, str) and name else f"{self._under(key)} #{number}"

    def _under(self, key: str) -> str:
        return f"{self._place}.{key}" if self._place else key

    def _get(self, key: str, wanted: str, default: object) -> Any:
        self._asked.append(key)
        if key in self._values:
            return self._values[key]
        if default is None:
            raise self.error(key, f"missing; it must be {wanted}{self._misspelt(key)}")
        return default

    def _misspelt(self, key: str) -> str:
        near = difflib.get_close_matches(key, [k for k in self._values if k not in self._asked], n=1, cutoff=0.6)
        return f" (there is {near[0]!r}; did you mean {key!r}?)" if near else ""

    def _number(self, key: str, value: object, low: float, high: float) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise self._wrong(key, value, _wanted(low, high))
        if not low <= value <= high:
            raise self._wrong(key, value, _wanted(low, high))
        return float(value)

    def _vector(self, key: str, value: object, length: int, wanted: str, low: float, high: float) -> tuple[float, ...]:
        if not isinstance(value, list | tuple) or len(value) != length:
            raise self._wrong(key, value, wanted)
        return tuple(self._number(key, item, low, high) for item in value)

    def _wrong(self, key: str, value: object, wanted: str) -> FileFormatError:
        kind = _KINDS.get(type(value), type(value).__name__)
        return self.error(key, f"{value!r} ({kind}) given, but it must be {wanted}")


def _wanted(low: float, high: float) -> str:
    if math.isinf(low) and math.isinf(high):
        return "a finite number"
    if math.isinf(high):
        return f"a finite number of at least {low:g}"
    return f"a number from {low:g} to {high:g}"


def _hint(name: str, known: Iterable[str]) -> str:
    choices = sorted(set(known))
    near = difflib.get_close_matches(name, choices, n=2, cutoff=0.5)
    if near:
        return "did you mean " + " or ".join(repr(n) for n in near) + "?"
    return "known: " + ", ".join(choices)
