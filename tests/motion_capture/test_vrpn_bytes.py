"""VRPN's bytes, from its public description; and bytes that only resemble them."""

from __future__ import annotations

import math
import struct
from contextlib import suppress
from typing import Final

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.errors import DecodeError
from skyloop.motion_capture.vrpn import (
    COOKIE,
    COOKIE_SIZE,
    DISCONNECT,
    MAX_NAMES,
    MAX_PAYLOAD,
    POS_QUAT,
    SENDER_DESCRIPTION,
    TYPE_DESCRIPTION,
    Decoder,
    TrackerPose,
)
from tests.motion_capture.vrpn import encode_description, encode_message, encode_pose

#: Written by hand from Format_Of_Protocol.txt.
GOLDEN_COOKIE: Final = bytes.fromhex("7672706e3a207665722e2030372e333820203000 00000000")
GOLDEN_SENDER: Final = bytes.fromhex(
    "00000024 00000000 00000000 00000001 ffffffff 00000000"  # 24 + 12 bytes, sender 1, description of a sender
    "00000008 547261636b657200 00000000"  # 8 bytes with the NUL, "Tracker", padding
)
GOLDEN_TYPE: Final = bytes.fromhex(
    "00000032 00000000 00000000 00000005 fffffffe 00000000"  # 24 + 26 bytes, type 5, description of a type
    "00000016 7672706e5f547261636b657220506f735f5175617400 000000000000"
)
GOLDEN_POSE: Final = bytes.fromhex(
    "00000058 65a0bc00 0007a120 00000001 00000005 00000000"  # 24 + 64 bytes, 1705032704.5 s, sender 1, type 5
    "00000002 00000002"  # sensor 2, and again as padding
    "3ff8000000000000 bfd0000000000000 4000000000000000"  # 1.5, -0.25, 2
    "0000000000000000 0000000000000000 3fe3333333333333 3fe999999999999a"  # 0, 0, 0.6, 0.8
)
POSE: Final = TrackerPose("Tracker", 2, (1.5, -0.25, 2.0), (0.0, 0.0, 0.6, 0.8))
GREETING: Final = GOLDEN_COOKIE + GOLDEN_SENDER + GOLDEN_TYPE

numbers = st.floats(width=64, allow_nan=False)
poses = st.builds(
    TrackerPose,
    st.just("Tracker"),
    st.integers(-(2**31), 2**31 - 1),
    st.tuples(numbers, numbers, numbers),
    st.tuples(numbers, numbers, numbers, numbers),
)


def encoded(pose: TrackerPose) -> bytes:
    return encode_pose(1, 5, pose.sensor, pose.position, pose.quaternion)


def test_encoding_gives_the_golden_bytes() -> None:
    assert COOKIE == GOLDEN_COOKIE
    assert encode_description(SENDER_DESCRIPTION, 1, "Tracker") == GOLDEN_SENDER
    assert encode_description(TYPE_DESCRIPTION, 5, POS_QUAT) == GOLDEN_TYPE
    made = encode_pose(1, 5, 2, POSE.position, POSE.quaternion, seconds=0x65A0BC00, microseconds=500_000)
    assert made == GOLDEN_POSE


def test_golden_bytes_decode_to_the_pose_with_its_sensor() -> None:
    assert Decoder().feed(GREETING + GOLDEN_POSE) == [POSE]


@given(st.lists(poses, max_size=5), st.lists(st.integers(0, 700), max_size=12))
def test_poses_decode_however_the_stream_is_cut(sent: list[TrackerPose], cuts: list[int]) -> None:
    stream = GREETING + b"".join(map(encoded, sent))
    decoder, got, at = Decoder(), [], 0
    for cut in [*sorted(cuts), len(stream)]:
        got += decoder.feed(stream[at:cut])
        at = max(at, cut)
    assert got == sent


@given(st.binary(max_size=400))
def test_any_bytes_decode_or_are_a_decode_error(data: bytes) -> None:
    for begin in (b"", COOKIE, GREETING):
        decoder = Decoder()
        with suppress(DecodeError):
            decoder.feed(begin + data)
        assert len(decoder._pending) <= 24 + MAX_PAYLOAD + 8


@given(st.integers(0, len(GREETING + GOLDEN_POSE) - 1), st.integers(1, 255))
def test_one_wrong_byte_causes_no_crash(at: int, change: int) -> None:
    stream = bytearray(GREETING + GOLDEN_POSE)
    stream[at] ^= change
    try:
        found = Decoder().feed(bytes(stream))
    except DecodeError:
        return
    assert len(found) <= 1


@given(st.integers(0, len(GREETING + GOLDEN_POSE) - 1))
def test_a_truncated_stream_is_not_a_pose(size: int) -> None:
    assert Decoder().feed((GREETING + GOLDEN_POSE)[:size]) == []


def test_undescribed_messages_are_skipped() -> None:
    decoder = Decoder()
    assert decoder.feed(COOKIE + GOLDEN_POSE) == [], "sender and type are unknown"
    assert decoder.feed(GOLDEN_SENDER + GOLDEN_POSE) == []
    assert decoder.feed(encode_message(1, 4, b"text") + encode_message(9, -3, b"10.0.0.1\0")) == []
    assert decoder.feed(GOLDEN_TYPE + encode_message(1, 5, GOLDEN_POSE[24:])) == [POSE]
    assert decoder.feed(encode_pose(2, 5, 0, POSE.position, POSE.quaternion)) == [], "another sender"


def test_a_number_described_again_has_the_new_name() -> None:
    decoder = Decoder()
    assert decoder.feed(GREETING + encode_description(SENDER_DESCRIPTION, 1, "Wand") + GOLDEN_POSE) == [
        TrackerPose("Wand", POSE.sensor, POSE.position, POSE.quaternion)
    ]


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"HTTP/1.1 400 Bad Request\r\n\r\n", "version 7 begins with b'vrpn: ver. 07.', got b'HTTP/1.1 400 Bad'"),
        (b"h", "got b'h'"),
        (b"vrpn: ver. 06.02  0".ljust(24, b"\0"), "version 7"),
        (COOKIE + struct.pack(">IIIiiI", 23, 0, 0, 0, 0, 0), "from 24 to 64024 bytes, got 23"),
        (COOKIE + struct.pack(">IIIiiI", 0, 0, 0, 0, 0, 0), "got 0"),
        (COOKIE + struct.pack(">IIIiiI", 2**32 - 1, 0, 0, 0, 0, 0), "got 4294967295"),
        (COOKIE + struct.pack(">IIIiiI", 24 + MAX_PAYLOAD + 1, 0, 0, 0, 0, 0), "got 64025"),
        (COOKIE + encode_message(0, DISCONNECT, b""), "ends the connection"),
        (COOKIE + encode_message(1, SENDER_DESCRIPTION, b"\0"), "at least 4 bytes, got 1"),
        (COOKIE + encode_message(1, SENDER_DESCRIPTION, struct.pack(">I", 0)), "got 0 in 4 bytes"),
        (COOKIE + encode_message(1, TYPE_DESCRIPTION, struct.pack(">I", 9) + b"short\0"), "got 9 in 10 bytes"),
        (COOKIE + encode_message(1, TYPE_DESCRIPTION, struct.pack(">I", 500) + b"x" * 500), "to 100 bytes, got 500"),
        (GREETING + encode_message(1, 5, bytes(63)), "a VRPN pose has 64 bytes, got 63"),
        (GREETING + encode_message(1, 5, bytes(72)), "got 72"),
    ],
)
def test_other_bytes_are_refused_with_the_reason(data: bytes, said: str) -> None:
    with pytest.raises(DecodeError, match=said):
        Decoder().feed(data)


def test_a_server_with_endless_descriptions_is_dropped() -> None:
    decoder = Decoder()
    decoder.feed(COOKIE)
    for number in range(MAX_NAMES):
        assert decoder.feed(encode_description(SENDER_DESCRIPTION, number, f"t{number}")) == []
    with pytest.raises(DecodeError, match="more than 2000 senders or types"):
        decoder.feed(encode_description(SENDER_DESCRIPTION, MAX_NAMES, "one more"))


def test_a_name_in_no_encoding_and_one_with_control_characters_can_be_printed() -> None:
    decoder = Decoder()
    decoder.feed(GREETING)
    for raw, shown in ((b"H\xfcpfer\0", "H\\xfcpfer"), (b"\x1b[2J\0", "\\x1b[2J"), (b"cut\0off\0", "cut")):
        decoder.feed(encode_message(1, SENDER_DESCRIPTION, struct.pack(">I", len(raw)) + raw))
        (pose,) = decoder.feed(GOLDEN_POSE)
        assert pose.tracker == shown


def test_nan_is_left_to_the_pose_checks() -> None:
    (pose,) = Decoder().feed(GREETING + encode_pose(1, 5, 0, (math.nan, math.inf, 0.0), POSE.quaternion))
    assert math.isnan(pose.position[0])


def test_the_cookie_has_the_expected_size() -> None:
    assert len(COOKIE) == COOKIE_SIZE == 24
