"""AT commands: our own can be read back, and those of other programs can be read."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.errors import UsageError
from skyloop.vehicles.ardrone.wire.at import (
    MAX_LINE,
    AtCommand,
    Ctrl,
    Pcmd,
    Ref,
    format_command,
    parse_commands,
    to_bits,
    to_float,
)

FLOATS = st.floats(allow_nan=False, allow_infinity=False, width=32)
TEXTS = st.text(st.characters(codec="latin-1", exclude_characters='"\r\n'), max_size=60)
NAMES = st.from_regex(r"[A-Z_]{1,12}", fullmatch=True)


def test_lines_of_the_developer_guide() -> None:
    assert format_command("REF", 101, int(Ref.FIXED | Ref.TAKEOFF)) == b"AT*REF=101,290718208\r"
    assert format_command("REF", 102, int(Ref.FIXED)) == b"AT*REF=102,290717696\r"
    assert format_command("REF", 103, int(Ref.FIXED | Ref.EMERGENCY)) == b"AT*REF=103,290717952\r"
    assert format_command("PCMD", 7, int(Pcmd.PROGRESSIVE), -0.8, 0.0, 0.5, 0.0) == (
        b"AT*PCMD=7,1,-1085485875,0,1056964608,0\r"
    )
    assert format_command("CONFIG", 5, "general:navdata_demo", "TRUE") == (
        b'AT*CONFIG=5,"general:navdata_demo","TRUE"\r'
    )
    assert format_command("CTRL", 6, Ctrl.CLEAR_ACK, 0) == b"AT*CTRL=6,5,0\r"
    assert format_command("COMWDG", 9) == b"AT*COMWDG=9\r"


@pytest.mark.parametrize(
    ("value", "bits"),
    [(-0.8, -1085485875), (0.5, 1056964608), (0.0, 0), (1.0, 1065353216), (-1.0, -1082130432), (0.05, 1028443341)],
)
def test_floats_as_bits(value: float, bits: int) -> None:
    assert to_bits(value) == bits
    assert math.isclose(to_float(bits), value, rel_tol=1e-6)


@given(FLOATS)
def test_any_float_survives_a_round_trip(value: float) -> None:
    assert to_float(to_bits(value)) == value


@given(st.integers(-(2**40), 2**40))
def test_bits_beyond_32_are_cut_off(bits: int) -> None:
    assert struct.pack("<f", to_float(bits))[:2] == struct.pack("<I", bits & 0xFFFFFFFF)[:2] or math.isnan(
        to_float(bits)
    )


@given(NAMES, st.integers(0, 2**31 - 1), st.lists(st.integers(-(2**31), 2**31 - 1) | TEXTS, max_size=6))
def test_round_trip(name: str, sequence: int, arguments: list[int | str]) -> None:
    line = format_command(name, sequence, *arguments)
    assert parse_commands(line) == ([AtCommand(name, sequence, tuple(arguments))], 0)


@given(st.lists(st.tuples(NAMES, st.integers(0, 10**6)), max_size=8), st.sampled_from([b"\r", b"\n", b"\r\n"]))
def test_several_commands_in_a_datagram(commands: list[tuple[str, int]], end: bytes) -> None:
    datagram = b"".join(format_command(name, sequence).rstrip(b"\r") + end for name, sequence in commands)
    assert parse_commands(datagram) == ([AtCommand(name, sequence, ()) for name, sequence in commands], 0)


@given(st.binary(max_size=400))
def test_anything_can_be_parsed(datagram: bytes) -> None:
    commands, malformed = parse_commands(datagram)
    assert malformed >= 0
    assert all(command.name.isascii() for command in commands)


@pytest.mark.parametrize(
    "line",
    [
        b"AT*REF\r",
        b"AT*REF=\r",
        b"AT*REF=1,\r",
        b"AT*REF=x\r",
        b"REF=1\r",
        b"AT*REF=1,2.5\r",
        b'AT*CONFIG=1,"a\r',
        b"AT*ref=1\r",
        b" AT*REF=1\r",
        b"AT*REF=1," + b"1" * 12 + b"\r",
        b'AT*CONFIG=1,"' + b"a" * MAX_LINE + b'"\r',
    ],
)
def test_malformed_lines_are_counted_and_the_others_accepted(line: bytes) -> None:
    assert parse_commands(line + b"AT*COMWDG=2\r") == ([AtCommand("COMWDG", 2, ())], 1)


def test_a_zero_byte_at_the_end_is_not_part_of_the_command() -> None:
    assert parse_commands(b"AT*COMWDG=2\r\0") == ([AtCommand("COMWDG", 2, ())], 0)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ((math.nan,), "not finite"),
        ((math.inf,), "not finite"),
        (('a"b',), "quote"),
        (("a\rb",), "line break"),
        (("a" * MAX_LINE,), "at most 1024"),
    ],
)
def test_arguments_that_cannot_be_sent(arguments: tuple[float | str, ...], says: str) -> None:
    with pytest.raises(UsageError, match=says):
        format_command("CONFIG", 1, *arguments)
