"""Parameters' numbers, texts in chunks, modes and axes."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.errors import DecodeError
from skyloop.messages.geometry import quaternion_from_euler
from skyloop.vehicles.mavlink.wire import axes, codec
from skyloop.vehicles.mavlink.wire.codec import (
    MavlinkCodec,
    Message,
    Texts,
    bounds,
    chunks_of,
    from_field,
    is_integer,
    to_field,
)

INTEGERS = st.sampled_from([1, 2, 3, 4, 5, 6])
ANGLES = st.floats(-3.1, 3.1)


def through_a_float(field: float) -> float:
    """Return a field as it travels."""
    back: float = struct.unpack("<f", struct.pack("<f", field))[0]
    return back


def test_px4_writes_an_integers_bytes() -> None:
    """COM_DL_LOSS_T = 10 reads as 1.4e-44 otherwise."""
    assert to_field(10, 6, bytewise=True) == pytest.approx(1.4e-44, rel=0.01)
    assert from_field(1.401298464324817e-44, 6, bytewise=True) == 10


@given(INTEGERS, st.data())
def test_bytewise_integers_come_back(kind: int, data: st.DataObject) -> None:
    low, high = bounds(kind)
    value = data.draw(st.integers(low, high).filter(lambda n: not 0x7F800000 < (n & 0x7FFFFFFF) < 0x7FC00000))
    assert from_field(through_a_float(to_field(value, kind, bytewise=True)), kind, bytewise=True) == value


@given(INTEGERS, st.data())
def test_cast_integers_come_back_as_far_as_a_float_holds_them(kind: int, data: st.DataObject) -> None:
    low, high = bounds(kind)
    value = data.draw(st.integers(max(low, -(1 << 24)), min(high, 1 << 24)))
    assert from_field(through_a_float(to_field(value, kind, bytewise=False)), kind, bytewise=False) == value


@given(st.floats(width=32), st.integers(0, 20), st.booleans())
def test_any_field_is_read_or_refused(field: float, kind: int, bytewise: bool) -> None:
    try:
        value = from_field(field, kind, bytewise=bytewise)
    except DecodeError:
        return
    assert isinstance(value, int) is is_integer(kind)


def travelled(messages: list[Message]) -> list[Message]:
    sender, receiver = MavlinkCodec(1, 1), MavlinkCodec(255, 190)
    return [receiver.decode(sender.encode(message), whole=True)[0] for message in messages]


def whole_texts(messages: list[Message]) -> list[str]:
    texts = Texts()
    return [text for message in messages for _, text in texts.on_message(message)]


def test_a_px4_text_arrives_in_chunks_and_ends_in_a_tab() -> None:
    text = "Arming denied: Resolve system health failures first\t"
    messages = travelled(chunks_of(text, 2, 5))
    assert [message.text for message in messages] == ["Arming denied: Resolve system health failures firs", "t\t"]
    assert whole_texts(messages) == ["Arming denied: Resolve system health failures first"]


@given(st.text(st.characters(min_codepoint=33, max_codepoint=126), min_size=1, max_size=220))
def test_texts_come_back_whole(text: str) -> None:
    assert whole_texts(travelled(chunks_of(text, 4, 77))) == [text]


def test_a_lost_chunk_is_shown() -> None:
    messages = travelled(chunks_of("a" * 50 + "b" * 50 + "c" * 10, 4, 9))
    assert whole_texts([messages[0], messages[2]]) == ["a" * 50 + "…" + "c" * 10]


def test_a_repeated_or_late_chunk_makes_no_other_text() -> None:
    """A STATUSTEXT in chunks caused two events."""
    first, last = travelled(chunks_of("a" * 50 + "b" * 10, 4, 9))
    assert whole_texts([first, last, last, first]) == ["a" * 50 + "b" * 10]
    assert whole_texts([last, first, last]) == ["…" + "b" * 10]
    again = travelled(chunks_of("c" * 50 + "d" * 10, 4, 9))
    assert whole_texts([first, last, *again]) == ["a" * 50 + "b" * 10, "c" * 50 + "d" * 10], "after a reboot"


def test_texts_without_an_end_are_returned_and_dropped() -> None:
    texts = Texts()
    told = [whole for n in range(1, 40) for whole in texts.on_message(travelled(chunks_of("x" * 60, 4, n))[0])]
    assert len(told) == 31


def test_texts_hold_no_control_characters() -> None:
    (message,) = travelled(chunks_of("\x1b[31mred\x07", 4, 0))
    assert whole_texts([message]) == ["[31mred"]


def test_modes_have_names() -> None:
    assert codec.copter_mode(4) == "GUIDED"
    assert codec.copter_mode(99) == "MODE_99"
    assert codec.px4_mode(codec.px4_custom("AUTO.LAND")) == "AUTO.LAND"
    assert codec.px4_mode(codec.px4_custom("OFFBOARD")) == "OFFBOARD"
    assert codec.px4_mode(17 << 16) == "MODE_17.0"


@given(ANGLES, st.floats(-1.5, 1.5), ANGLES)
def test_angles_come_back_from_their_quaternion(roll: float, pitch: float, yaw: float) -> None:
    back = axes.angles_of(quaternion_from_euler(roll, pitch, yaw))
    for one, other in zip(back, (roll, pitch, yaw), strict=True):
        assert abs(math.remainder(one - other, math.tau)) < 1e-6


def test_quaternions_have_w_first_in_messages_only() -> None:
    ours = (0.1, 0.2, 0.3, 0.9)
    assert axes.to_wire(ours) == [0.9, 0.1, 0.2, 0.3]
    assert axes.from_wire([0.9, 0.1, 0.2, 0.3]) == ours


@given(ANGLES)
def test_headings_turn_both_ways(yaw: float) -> None:
    assert abs(math.remainder(axes.yaw_between(axes.yaw_between(yaw)) - yaw, math.tau)) < 1e-9


def test_north_stays_north() -> None:
    assert axes.yaw_between(0.0) == pytest.approx(math.pi / 2)
    assert axes.swap(1.0, 2.0, 3.0) == (2.0, 1.0, -3.0)
    assert axes.flip(1.0, 2.0, 3.0) == (1.0, -2.0, -3.0)
