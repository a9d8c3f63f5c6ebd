"""The local transport's own packets: round trips, and DecodeError for anything else."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.errors import DecodeError
from skyloop.messages import Encoding, FrameHeader, encode
from skyloop.messages.codec import HEADER
from skyloop.transport.base import MAX_TOPIC
from skyloop.transport.local import packets

HEAD = FrameHeader("front", 1, 2, 3, 4, 5, Encoding.BGR8, 60)
SAMPLES: list[tuple[bytes, packets.Message]] = [
    (packets.hello(), packets.Hello(packets.REVISION)),
    (packets.subscribe("video/é", True), packets.Subscribe("video/é", True)),
    (packets.subscribe("feedback", False), packets.Subscribe("feedback", False)),
    (packets.release(7), packets.Release(7)),
    (packets.slot(3, 1, 1 << 40), packets.Slot(3, 1, 1 << 40)),
    (packets.named_slot(3, 1, 1 << 40, "sky-0-f"), packets.NamedSlot(3, 1, 1 << 40, "sky-0-f")),
    (packets.frame(9, encode(HEAD)), packets.Frame(9, HEAD)),
    (packets.retire(1, 4), packets.Retire(1, 4)),
    (packets.bye("because"), packets.Bye("because")),
]


@pytest.mark.parametrize(("packet", "message"), SAMPLES)
def test_round_trip(packet: bytes, message: packets.Message) -> None:
    assert packets.is_own(packet)
    assert packets.parse(packet) == message


@pytest.mark.parametrize(("packet", "_"), SAMPLES)
def test_truncated_is_refused(packet: bytes, _: packets.Message) -> None:
    for end in range(len(packet)):
        with pytest.raises(DecodeError):
            packets.parse(packet[:end])


@pytest.mark.parametrize(
    ("kind", "body"),
    [
        (0x40, b""),
        (0x41, b""),
        (0x41, b"\x02feedback"),
        (0x41, b"\x01"),
        (0x41, b"\x01" + b"x" * (MAX_TOPIC + 1)),
        (0x41, b"\x01\xff"),
        (0x42, b"123"),
        (0x43, b"1234"),
        (0x44, b"\0\0\0\0" + encode(HEAD)[:-1]),
        (0x44, b"\0\0"),
        (0x45, b""),
        (0x47, b""),
        (0x48, bytes(16)),
        (0x48, bytes(16) + b"../etc"),
        (0x48, bytes(16) + b"x" * 31),
        (0x48, bytes(16) + b"\xff"),
        (0xFF, b"1234"),
    ],
)
def test_nonsense_is_refused(kind: int, body: bytes) -> None:
    with pytest.raises(DecodeError):
        packets.parse(HEADER.pack(b"SKYL", 1, kind, 0, len(body)) + body)


def test_a_sample_is_not_the_transports_own() -> None:
    assert not packets.is_own(encode(HEAD))
    assert not packets.is_own(b"")
    assert not packets.is_own(b"x" * 12)


def test_a_long_reason_is_cut() -> None:
    message = packets.parse(packets.bye("é" * 1000))
    assert isinstance(message, packets.Bye)
    assert set(message.reason) <= {"é", "\N{REPLACEMENT CHARACTER}"}
    assert 190 < len(message.reason) <= 201


@given(st.binary(max_size=200) | st.binary(max_size=60).map(lambda tail: b"SKYL\x01" + tail))
def test_anything_is_a_message_or_a_decode_error(packet: bytes) -> None:
    try:
        message = packets.parse(packet)
    except DecodeError:
        return
    assert isinstance(message, tuple)


@given(st.sampled_from([sample for sample, _ in SAMPLES]), st.data())
def test_damage_is_a_message_or_a_decode_error(packet: bytes, data: st.DataObject) -> None:
    damaged = bytearray(packet)
    damaged[data.draw(st.integers(0, len(packet) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    try:
        message = packets.parse(bytes(damaged))
    except DecodeError:
        return
    assert isinstance(message, tuple)
