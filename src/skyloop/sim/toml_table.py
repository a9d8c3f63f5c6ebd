"""Strict reading of TOML tables: every value is asked for by key, kind and range; all others are an error.

Each error names the file, the table, the key, and what is allowed.
"""

from __future__ import annotations

import difflib
import math
import re
import reprlib
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

from skyloop.errors import FileFormatError
from skyloop.files import read_text

MAX_BYTES: Final = 1 << 18  #: of a file; the largest world that is shipped takes 5 kB
#: Parts of a key: a parser goes through all of them for each key below, which takes minutes for some ten thousand.
MAX_DEPTH: Final = 16
MAX_WHOLE: Final = (1 << 63) - 1  #: as TOML has it; larger ones are neither told nor computed with
_SHOWN: Final = 80  #: characters of a wrong value in a message
# Nothing in it is tried twice, and it begins where a part does: it is as fast for what it does not find.
_PART = r"""(?:[A-Za-z0-9_-]++|"[^"\n]*+"|'[^'\n]*+')"""
_DEEP_KEY = re.compile(rf"(?<![A-Za-z0-9_-]){_PART}(?:[ \t]*+\.[ \t]*+{_PART}){{{MAX_DEPTH},}}+")

_KINDS = {bool: "a boolean", int: "a whole number", float: "a number", str: "a text", list: "a list", dict: "a table"}


def parse_toml(text: str, source: str) -> TomlTable:
    """Parse TOML.

    Args:
        text: The file's text.
        source: The file's name, for messages.

    Raises:
        FileFormatError: It is not TOML.
    """
    if _DEEP_KEY.search(text):
        raise FileFormatError(f"{source}: a key of more than {MAX_DEPTH} parts with dots between them")
    try:
        return TomlTable(tomllib.loads(text), source, "")
    except (ValueError, RecursionError) as error:  # besides its own errors, for numbers and lists that are too large
        raise FileFormatError(f"{source}: not valid TOML: {error}") from error


def read_toml(path: Path) -> TomlTable:
    """Read and parse a file.

    Raises:
        FileFormatError: It can't be read, is too large, or is not TOML.
    """
    return parse_toml(read_text(path, "the world file", MAX_BYTES), str(path))


class TomlTable:
    """One table of the file. Ask for all keys that are allowed, then call :meth:`finish`.

    All methods that return a value raise :class:`FileFormatError` if the key is missing and has no default, or its
    value is of another kind or out of range.
    """

    def __init__(self, values: dict[str, Any], source: str, place: str) -> None:
        self._values = values
        self._source = source
        self._place = place
        self._asked: list[str] = []

    def error(self, key: str, problem: str) -> FileFormatError:
        """Return the error to raise about ``key`` (empty: about the whole table)."""
        where = [self._source]
        if self._place:
            where.append(f"[{self._place}]")
        if key:
            where.append(f"key {key!r}")
        return FileFormatError(f"{', '.join(where)}: {problem}")

    def finish(self) -> None:
        """Raise for the first key that was never asked for.

        Raises:
            FileFormatError: The table has a key that is not allowed.
        """
        for key in self._values:
            if key not in self._asked:
                raise self.error(key, "unknown key; " + _hint(key, self._asked))

    def has(self, key: str) -> bool:
        """Whether the key exists; counts as asking for it."""
        self._asked.append(key)
        return key in self._values

    def text(self, key: str, default: str | None = None) -> str:
        """Return a string."""
        value = self._get(key, "a text", default)
        if not isinstance(value, str) or not value:
            raise self._wrong(key, value, "a text that is not empty")
        return value

    def choice(self, key: str, choices: Iterable[str], default: str | None = None) -> str:
        """Return one of several strings."""
        known = list(choices)
        value = self._get(key, "one of " + ", ".join(known), default)
        if not isinstance(value, str):
            raise self._wrong(key, value, "one of " + ", ".join(known))
        if value not in known:
            raise self.error(key, f"{value!r} is not known here; {_hint(value, known)}")
        return value

    def flag(self, key: str, default: bool) -> bool:
        """Return a boolean."""
        value = self._get(key, "true or false", default)
        if not isinstance(value, bool):
            raise self._wrong(key, value, "true or false")
        return value

    def whole(self, key: str, low: int, high: int, default: int | None = None) -> int:
        """Return an integer within [low, high]."""
        wanted = f"a whole number from {low} to {high}"
        value = self._get(key, wanted, default)
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise self._wrong(key, value, wanted)
        return value

    def number(
        self, key: str, default: float | None = None, *, low: float = -math.inf, high: float = math.inf
    ) -> float:
        """Return a finite number within [low, high]."""
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
        """Return a list of ``length`` finite numbers, each within [low, high]."""
        wanted = f"a list of {length} numbers"
        value = self._get(key, wanted, default)
        return self._vector(key, value, length, wanted, low, high)

    def vectors(self, key: str, length: int, least: int) -> list[tuple[float, ...]]:
        """Return a list of at least ``least`` lists of ``length`` finite numbers."""
        wanted = f"a list of at least {least} lists of {length} numbers"
        value = self._get(key, wanted, None)
        if not isinstance(value, list) or len(value) < least:
            raise self._wrong(key, value, wanted)
        return [self._vector(key, item, length, wanted, -math.inf, math.inf) for item in value]

    def range(self, key: str, *, low: float = -math.inf, high: float = math.inf) -> tuple[float, float]:
        """Return a list [least, greatest] of two finite numbers in order."""
        least, greatest = self.vector(key, 2, low=low, high=high)
        if least > greatest:
            raise self.error(key, f"[{least:g}, {greatest:g}] is upside down; give [least, greatest]")
        return least, greatest

    def table(self, key: str) -> TomlTable:
        """Return a table within this one."""
        value = self._get(key, f"a table [{self._under(key)}]", None)
        if not isinstance(value, dict):
            raise self._wrong(key, value, f"a table [{self._under(key)}]")
        return TomlTable(value, self._source, self._under(key))

    def tables(self, key: str) -> list[TomlTable]:
        """Return an array of tables, ``[[key]]`` in the file; none when the key does not exist."""
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
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self._wrong(key, value, _wanted(low, high))
        if not -MAX_WHOLE <= value <= MAX_WHOLE and isinstance(value, int):
            raise self._wrong(key, value, _wanted(low, high))
        if not math.isfinite(value) or not low <= value <= high:
            raise self._wrong(key, value, _wanted(low, high))
        return float(value)

    def _vector(self, key: str, value: object, length: int, wanted: str, low: float, high: float) -> tuple[float, ...]:
        if not isinstance(value, list | tuple) or len(value) != length:
            raise self._wrong(key, value, wanted)
        return tuple(self._number(key, item, low, high) for item in value)

    def _wrong(self, key: str, value: object, wanted: str) -> FileFormatError:
        kind = _KINDS.get(type(value), type(value).__name__)
        return self.error(key, f"{_shown(value)} ({kind}) given, but it must be {wanted}")


def _shown(value: object) -> str:
    if isinstance(value, int) and not -MAX_WHOLE <= value <= MAX_WHOLE:
        return "a number of more than 64 bits"
    return reprlib.repr(value) if isinstance(value, list | dict) else f"{value!r:.{_SHOWN}}"


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
