"""Replies of the Tello, and which command each can belong to.

A reply does not say what it answers, and may come seconds late or twice. So a reply is taken for a command's only if it
has the shape that this command's answers have.
"""

from __future__ import annotations

import re
from enum import Enum
from typing import Final

_ERROR: Final = re.compile(r"(error|unknown command|out of range|unactive|forced stop)", re.IGNORECASE)


class Shape(Enum):
    """What an answer that is no error looks like."""

    OK = re.compile(r"ok\Z", re.IGNORECASE)
    NUMBER = re.compile(r"-?\d+(\.\d+)?\Z")  #: ``battery?``, ``wifi?``, ``sdk?``, ``speed?``, ``baro?``
    TIME = re.compile(r"\d+( ?s)?\Z")  #: ``time?``: a bare number, or with its unit
    LENGTH = re.compile(r"-?\d+ ?(mm|dm|cm)\Z")  #: ``height?``, ``tof?``
    TEMPERATURE = re.compile(r"-?\d+~-?\d+ ?C\Z")  #: ``temp?``
    NAME = re.compile(r"(?=.*[A-Za-z])(?!ok\Z)[0-9A-Za-z]{4,32}\Z")  #: ``sn?``
    FIELDS = re.compile(r"[a-z]+:-?[\d.]+;([a-z]+:-?[\d.]+;)*\Z")  #: ``attitude?``, ``acceleration?``


#: What is answered otherwise than with "ok".
READ: Final = {
    "speed?": Shape.NUMBER,
    "battery?": Shape.NUMBER,
    "time?": Shape.TIME,
    "height?": Shape.LENGTH,
    "temp?": Shape.TEMPERATURE,
    "attitude?": Shape.FIELDS,
    "baro?": Shape.NUMBER,
    "acceleration?": Shape.FIELDS,
    "tof?": Shape.LENGTH,
    "wifi?": Shape.NUMBER,
    "sdk?": Shape.NUMBER,
    "sn?": Shape.NAME,
}


def shape_of(command: str) -> Shape:
    """Of a command's answer."""
    return READ.get(command, Shape.OK)


def is_error(reply: str) -> bool:
    """Whether it reports that a command, whichever, was not executed."""
    return _ERROR.match(reply) is not None


def answers(reply: str, command: str) -> bool:
    """Whether this reply can be this command's: an answer of its shape, or an error."""
    if reply.lower().startswith("unknown command"):
        named = reply.partition(":")[2].strip()
        return named in ("", command)
    return is_error(reply) or shape_of(command).value.match(reply) is not None
