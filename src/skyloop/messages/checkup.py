"""What a driver finds about its vehicle before a flight, as text in one read-only parameter."""

from __future__ import annotations

from typing import Annotated, Final

import msgspec

CHECKUP: Final = "vehicle.checkup"  #: the parameter's name
MAX_TEXT: Final = 7000  #: characters of the parameter's text: its packet has to hold it

_Text = Annotated[str, msgspec.Meta(max_length=600)]


class Diagnostic(msgspec.Struct, frozen=True, array_like=True):
    """Something about a vehicle or its settings that a person may want to know before flying.

    Attributes:
        what: What was examined.
        good: Whether it is as it should be.
        detail: What was found.
        advice: What to do about it, empty if nothing.
        severe: Not good, and dangerous or sure to fail: not only a safety net that is off.
    """

    what: _Text
    good: bool
    detail: _Text
    advice: _Text = ""
    severe: bool = False


_encode = msgspec.json.Encoder().encode
_decoder = msgspec.json.Decoder(list[Diagnostic])


def encode_checkup(diagnostics: list[Diagnostic]) -> str:
    """Return diagnostics as a parameter's text; those that are good are left out first if it is too long."""
    kept = list(diagnostics)
    while len(text := _encode(kept).decode()) > MAX_TEXT:
        kept.remove(next((one for one in reversed(kept) if one.good), kept[-1]))
    return text


def decode_checkup(text: str) -> list[Diagnostic]:
    """Return the diagnostics of a parameter's text.

    Raises:
        ValueError: It has none.
    """
    return _decoder.decode(text.encode())
