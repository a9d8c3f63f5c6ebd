"""Values and dumps of the configuration: written, read, and compared with those of real drones."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.errors import DecodeError
from skyloop.vehicles.ardrone.wire.configuration import (
    END_OF_DUMP,
    KEYS,
    Value,
    format_dump,
    format_value,
    parse_dump,
    parse_value,
)

FLOATS = st.floats(allow_nan=False, allow_infinity=False, width=32)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (True, "TRUE"),
        (False, "FALSE"),
        (3000, "3000"),
        (0.2094395, "2.094395e-01"),
        ((1.0, -2.0), "{ 1.000000e+00 -2.000000e+00 }"),
        ("My ARDrone", "My ARDrone"),
    ],
)
def test_values_as_the_drone_writes_them(value: Value, text: str) -> None:
    assert format_value(value) == text
    assert parse_value(text, value) == value


@given(st.booleans() | st.integers(-(2**31), 2**31 - 1))
def test_whole_values_survive_a_round_trip(value: Value) -> None:
    assert parse_value(format_value(value), value) == value


@given(FLOATS)
def test_floats_keep_seven_digits(value: float) -> None:
    back = parse_value(format_value(value), 0.0)
    assert isinstance(back, float)
    assert math.isclose(back, value, rel_tol=1e-6, abs_tol=1e-44)


@given(st.lists(FLOATS, min_size=1, max_size=9))
def test_vectors_survive_a_round_trip(values: list[float]) -> None:
    back = parse_value(format_value(tuple(values)), (0.0,))
    assert isinstance(back, tuple)
    assert back == pytest.approx(values, rel=1e-6, abs=1e-44)


@pytest.mark.parametrize(("text", "like"), [("1", True), ("true", True), ("0.25", 0.0), (" 7 ", 0)])
def test_alternative_spellings_of_values(text: str, like: Value) -> None:
    assert parse_value(text, like) == (0.25 if like == 0.0 and isinstance(like, float) else 7 if like == 0 else True)


@pytest.mark.parametrize(
    ("text", "like"),
    [("maybe", True), ("1.5", 0), ("", 0), ("nan", 0.0), ("inf", 0.0), ("{ 1.0 x }", (0.0,)), ("{ nan }", (0.0,))],
)
def test_texts_of_another_type(text: str, like: Value) -> None:
    with pytest.raises(DecodeError, match="is no"):
        parse_value(text, like)


def test_a_dump_survives_a_round_trip() -> None:
    values = {name: key.default for name, key in KEYS.items()}
    dump = format_dump(values)
    assert dump.endswith(END_OF_DUMP)
    texts = parse_dump(dump)
    assert texts.keys() == values.keys()
    for name, value in values.items():
        assert format_value(parse_value(texts[name], value)) == format_value(value)


def test_a_dump_written_by_hand() -> None:
    dump = (
        b"general:num_version_config            = 1\n"
        b"general:num_version_soft              = 1.7.4\r\n"
        b"nothing to see here\n"
        b"section = without colon\n"
        b"GENERAL:Ardrone_Name = a = b\n"
        b"general:num_version_config            = 2\n"
        b"control:gyros_offset = { 1.0e+00 2.0e+00 3.0e+00 }\n"
        b"\0general:after_the_end = 1\n"
    )
    assert parse_dump(dump) == {
        "general:num_version_config": "2",
        "general:num_version_soft": "1.7.4",
        "general:ardrone_name": "a = b",
        "control:gyros_offset": "{ 1.0e+00 2.0e+00 3.0e+00 }",
    }


@given(st.binary(max_size=500))
def test_any_dump_can_be_read(dump: bytes) -> None:
    assert all(":" in name for name in parse_dump(dump))
