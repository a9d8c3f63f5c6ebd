"""The AR.Drone's AT commands (UDP port 5556): format and parse their text lines. Pure.

A command is ``AT*NAME=sequence[,argument]*`` and a carriage return. A datagram can hold several commands, but no
command spans two. Numbers are signed decimals, strings are in double quotes, and a float is sent as the signed integer
with the same 32 bits. Source: Parrot AR.Drone Developer Guide, chapter 6, and ``at_msgs.h`` in the AR.Drone SDK 2.0.1.
"""

from __future__ import annotations

import math
import re
import struct
from dataclasses import dataclass
from enum import IntEnum, IntFlag
from typing import Final, TypeAlias

from skyloop.errors import UsageError

PORT: Final = 5556  #: UDP
MAX_LINE: Final = 1024  #: maximum length of a line [characters]; the drone drops longer ones
SILENCE_RESET_S: Final = 2.0  #: time without commands after which the drone expects the sequence to restart at 1

Argument: TypeAlias = int | float | str
#: A command's name, and the arguments that follow its sequence number.
AtMessage: TypeAlias = tuple[str, tuple[Argument, ...]]


class Ref(IntFlag):
    """Bits of ``REF``."""

    EMERGENCY = 1 << 8  #: each change from 0 to 1 cuts the motors or, in an emergency, ends the emergency
    TAKEOFF = 1 << 9  #: 1: take off and stay in the air; 0: land and stay on the ground
    FIXED = 0x11540000  #: bits 18, 20, 22, 24 and 28: the guide requires them, but no drone seems to need them


class Pcmd(IntFlag):
    """Flags in ``PCMD`` and ``PCMD_MAG``."""

    HOVER = 0  #: the four values are ignored
    PROGRESSIVE = 1  #: the drone follows the four values
    COMBINED_YAW = 2
    ABSOLUTE = 4  #: the values are relative to a heading (``PCMD_MAG`` only)


class Ctrl(IntEnum):
    """Modes of ``CTRL``."""

    NONE = 0
    UPDATE = 1
    PIC_UPDATE = 2
    GET_LOGS = 3
    GET_CONFIGURATION = 4  #: request the configuration over the control port
    CLEAR_ACK = 5
    GET_CUSTOM_IDS = 6  #: request the custom ids over the control port


@dataclass(frozen=True, slots=True)
class AtCommand:
    """One line as received; ``arguments`` are texts and integers (for floats, their bits: see :func:`to_float`)."""

    name: str
    sequence: int
    arguments: tuple[int | str, ...]


def format_command(name: str, sequence: int, *arguments: Argument) -> bytes:
    """Return one line; raise :class:`UsageError` for a float that is not finite, a quote in a text, or a long line."""
    words = [str(sequence), *(_word(argument) for argument in arguments)]
    line = f"AT*{name}={','.join(words)}\r".encode("latin-1", "replace")
    if len(line) > MAX_LINE:
        raise UsageError(f"AT*{name} of {len(line)} characters: the drone takes at most {MAX_LINE}")
    return line


def to_bits(value: float) -> int:
    """Return the signed integer with the same 32 bits as this float: 0.5 is 1056964608."""
    return int(struct.unpack("<i", struct.pack("<f", value))[0])


def to_float(bits: int) -> float:
    """Return the float with these 32 bits; higher bits are ignored."""
    return float(struct.unpack("<f", struct.pack("<I", bits & 0xFFFFFFFF))[0])


_LINE: Final = re.compile(rb"AT\*([A-Z_]+)=(-?\d{1,10})((?:,(?:-?\d{1,11}|\"[^\"\r\n]*\"))*)\Z")
_ARGUMENT: Final = re.compile(rb",(?:(-?\d+)|\"([^\"]*)\")")


def parse_commands(datagram: bytes) -> tuple[list[AtCommand], int]:
    """Return a datagram's commands, and the number of invalid lines, which a drone ignores. Never raises."""
    commands, malformed = [], 0
    for line in re.split(rb"[\r\n]+", datagram.rstrip(b"\0")):
        if not line:
            continue
        found = _LINE.match(line) if len(line) < MAX_LINE else None
        if found is None:
            malformed += 1
            continue
        arguments = tuple(
            int(number) if number else text.decode("latin-1") for number, text in _ARGUMENT.findall(found[3])
        )
        commands.append(AtCommand(found[1].decode("ascii"), int(found[2]), arguments))
    return commands, malformed


def _word(argument: Argument) -> str:
    if isinstance(argument, str):
        if '"' in argument or "\r" in argument or "\n" in argument:
            raise UsageError(f"{argument!r} can't be sent to the drone: it contains a quote or a line break")
        return f'"{argument}"'
    if isinstance(argument, float):
        if not math.isfinite(argument):
            raise UsageError(f"{argument} can't be sent to the drone: it is not finite")
        return str(to_bits(argument))
    return str(int(argument))
