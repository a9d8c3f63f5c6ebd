"""The configuration of the AR.Drone: how the values of its keys are written, and the dump on TCP port 5559. Pure.

A key is set by ``AT*CONFIG`` with its value as text. The drone sends all of them, one ``section:key = value`` a line
and a zero byte at the end. Source: AR.Drone SDK 2.0.1 (``ardrone_tool/Control``) and a dump of an AR.Drone 1 with
firmware 1.7.4.
"""

from __future__ import annotations

import math
from typing import Final

from skyloop.errors import DecodeError
from skyloop.vehicles.ardrone.wire.keys import Value

PORT: Final = 5559
END_OF_DUMP: Final = b"\0"
DEFAULT_ID: Final = "00000000"  #: of the session, user and application that everybody shares


def format_value(value: Value) -> str:
    """As the drone writes it: ``TRUE``, ``3000``, ``2.094395e-01``, ``{ 1.0e+00 2.0e+00 }``."""
    if isinstance(value, bool):
        return "TRUE" if value else "FALSE"
    if isinstance(value, float):
        return f"{value:e}"
    if isinstance(value, tuple):
        return "{ " + " ".join(f"{each:e}" for each in value) + " }"
    return str(value)


def parse_value(text: str, like: Value) -> Value:
    """A value of the same type as ``like``. Raises :class:`DecodeError` for a text that can't be one."""
    text = text.strip()
    try:
        if isinstance(like, bool):
            return {"TRUE": True, "FALSE": False, "1": True, "0": False}[text.upper()]
        if isinstance(like, int):
            return int(text)
        if isinstance(like, float):
            return _finite(text)
        if isinstance(like, tuple):
            return tuple(_finite(each) for each in text.strip("{}").split())
    except (KeyError, ValueError):
        raise DecodeError(f"{text!r} is no {type(like).__name__}") from None
    return text


def format_dump(values: dict[str, Value]) -> bytes:
    """All keys as the drone sends them."""
    lines = "".join(f"{name} = {format_value(value)}\n" for name, value in values.items())
    return lines.encode("latin-1", "replace") + END_OF_DUMP


def parse_dump(dump: bytes) -> dict[str, str]:
    """The texts of all keys. Lines that say nothing are left out, of a key that stands twice the last line counts."""
    values = {}
    for line in dump.split(END_OF_DUMP, 1)[0].decode("latin-1").splitlines():
        name, equals, value = line.partition("=")
        if equals and ":" in name:
            values[name.strip().lower()] = value.strip()
    return values


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(text)
    return value
