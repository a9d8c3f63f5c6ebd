"""A parameter's number in the float field of ``PARAM_VALUE`` and ``PARAM_SET``, in both ways that autopilots write it.

ArduPilot converts integers to floats; PX4 puts the integer's bytes there. ``AUTOPILOT_VERSION.capabilities`` says which
(``PARAM_ENCODE_BYTEWISE``).
"""

from __future__ import annotations

import math
import struct
from typing import Final

from skyloop.errors import DecodeError

BYTEWISE: Final = 0x10  #: of the capabilities
REAL32: Final = 9
#: ``MAV_PARAM_TYPE``: how an integer lies in the four bytes, its least and its greatest value.
_INTEGERS: Final = {
    1: ("<B3x", 0, 0xFF),
    2: ("<b3x", -0x80, 0x7F),
    3: ("<H2x", 0, 0xFFFF),
    4: ("<h2x", -0x8000, 0x7FFF),
    5: ("<I", 0, 0xFFFFFFFF),
    6: ("<i", -0x80000000, 0x7FFFFFFF),
}


def is_integer(kind: int) -> bool:
    """Whether this ``MAV_PARAM_TYPE`` is a whole number."""
    return kind in _INTEGERS


def bounds(kind: int) -> tuple[int, int]:
    """Least and greatest value of an integer's type."""
    _, low, high = _INTEGERS[kind]
    return low, high


def from_field(field: float, kind: int, *, bytewise: bool) -> int | float:
    """The number. Raises :class:`DecodeError` for a type that is not known or an integer that is none."""
    if not is_integer(kind):
        if kind != REAL32:
            raise DecodeError(f"a parameter of type {kind} is not known")
        return field
    if not bytewise:
        if not math.isfinite(field):
            raise DecodeError(f"{field} is no whole number")
        return round(field)
    form, _, _ = _INTEGERS[kind]
    number: int = struct.unpack(form, struct.pack("<f", field))[0]
    return number


def to_field(value: float, kind: int, *, bytewise: bool) -> float:
    """The field for a number that fits its type. Raises ``struct.error`` for one that does not."""
    if not (bytewise and is_integer(kind)):
        return float(value)
    field: float = struct.unpack("<f", struct.pack(_INTEGERS[kind][0], int(value)))[0]
    return field
