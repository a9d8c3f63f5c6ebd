"""Commands and replies as texts."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.vehicles.tello.wire import LEVEL, READ, Sdk, TelloStick, answers, decoded, is_error, ports


def test_commands_match_the_guide() -> None:
    assert TelloStick(right=-10, forward=20, up=0, clockwise=100).text == "rc -10 20 0 100"
    assert LEVEL.text == "rc 0 0 0 0"
    assert ports(8891, 11112) == "port 8891 11112"


def test_versions_include_older_ones() -> None:
    assert Sdk.V3_0.knows(Sdk.V2_0)
    assert Sdk.V1_3.knows(Sdk.V1_3)
    assert not Sdk.V1_3.knows(Sdk.V2_0)


@pytest.mark.parametrize(
    ("command", "reply"),
    [
        ("command", "ok"),
        ("takeoff", "OK"),
        ("takeoff", "error Motor stop"),
        ("sdk?", "20"),
        ("sdk?", "unknown command: sdk?"),
        ("sdk?", "error"),
        ("wifi?", "90"),
        ("battery?", "87"),
        ("baro?", "-142.60"),
        ("time?", "12"),
        ("time?", "12s"),
        ("tof?", "100mm"),
        ("height?", "-6dm"),
        ("temp?", "83~86C"),
        ("attitude?", "pitch:0;roll:-1;yaw:12;"),
        ("acceleration?", "agx:-6.00;agy:-4.00;agz:-999.00;"),
        ("sn?", "0TQDG7REDB1X2Y"),
        ("forward 10", "out of range"),
    ],
)
def test_a_command_accepts_answers_of_its_shape_and_errors(command: str, reply: str) -> None:
    assert answers(reply, command)


@pytest.mark.parametrize(
    ("command", "reply"),
    [
        ("wifi?", "ok"),  # of a take-off answered seconds late
        ("sn?", "ok"),
        ("sdk?", "12s"),
        ("streamon", "90"),
        ("streamon", "unknown command: sdk?"),  # another command's error names it
        ("command", ""),
        ("battery?", "pitch:0;roll:-1;yaw:12;"),
    ],
)
def test_it_ignores_those_of_others(command: str, reply: str) -> None:
    assert not answers(reply, command)


@given(st.binary(max_size=400))
def test_any_bytes_give_one_line_of_text_or_none(datagram: bytes) -> None:
    text = decoded(datagram)
    if text is None:
        return
    assert text.isprintable()
    assert isinstance(is_error(text), bool)
    for command in (*READ, "takeoff"):
        answers(text, command)
