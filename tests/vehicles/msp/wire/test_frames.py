"""MSP frames: written frames are read again, among any other bytes, and nothing makes the parser raise."""

from __future__ import annotations

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from skyloop.vehicles.msp.wire.frames import LONG, MOST, Direction, MspFrame, Parser, crc8, encode, whole_frames, xor

directions = st.sampled_from(Direction)
frames = st.one_of(
    st.builds(MspFrame, st.integers(0, 254), st.binary(max_size=300), directions),
    st.builds(MspFrame, st.integers(0, 0xFFFF), st.binary(max_size=300), directions),
)


def test_known_bytes() -> None:
    """From the wikis of Betaflight and INAV, and replies of Betaflight 4.6.0."""
    assert encode(MspFrame(1)) == bytes.fromhex("244d3c000101")
    assert encode(MspFrame(100), version=2) == bytes.fromhex("24583c00640000008f")
    assert Parser().feed(bytes.fromhex("244d3e030100012f2c")) == [MspFrame(1, b"\0\1\x2f", Direction.REPLY)]
    assert crc8(b"123456789") == 0xBC  # the catalogue's check value of CRC-8/DVB-S2
    assert xor(b"\1\2\4") == 7


@given(st.lists(frames, max_size=5), st.integers(1, 40))
def test_round_trip_in_any_pieces(sent: list[MspFrame], size: int) -> None:
    data = b"".join(encode(frame) for frame in sent)
    parser = Parser()
    found = [frame for at in range(0, len(data), size) for frame in parser.feed(data[at : at + size])]
    assert found == sent
    assert (parser.skipped, parser.damaged) == (0, 0)


@pytest.mark.parametrize("size", [254, 255, 256, 700, MOST])
@pytest.mark.parametrize("version", [1, 2])
def test_long_payloads(size: int, version: int) -> None:
    frame = MspFrame(116, (bytes(range(256)) * 4)[:size], Direction.REPLY)
    assert Parser().feed(encode(frame, version=version)) == [frame]


@given(frames)
def test_both_versions_encode_it(frame: MspFrame) -> None:
    assert Parser().feed(encode(frame, version=2)) == [frame]


@given(st.binary(max_size=60).filter(lambda data: b"$" not in data), frames)
def test_noise_before_a_frame_is_skipped(noise: bytes, frame: MspFrame) -> None:
    parser = Parser()
    assert parser.feed(noise + encode(frame)) == [frame]
    assert parser.skipped == len(noise)


@given(frames, st.integers(0, 310), frames)
@example(MspFrame(1, b"$"), 5, MspFrame(2))  # the rest passes the check: its ``xor`` is the next frame's ``$``
def test_a_frame_that_lost_a_byte_spoils_no_other(first: MspFrame, at: int, second: MspFrame) -> None:
    whole = encode(first)
    lost = at % len(whole)
    parser = Parser()
    rest = encode(second) + bytes(MOST + 8)  # later bytes end the search for the broken frame's end
    found = parser.feed(whole[:lost] + whole[lost + 1 :] + rest)
    passed_by_chance = [frame for frame in found if frame != second]  # an eight-bit check: once in 256
    assert second in found or passed_by_chance


@given(st.lists(st.binary(max_size=80), max_size=20))
@example([b"$X>\0\0\0\xff\xff", b"$M>\xff\1\xff\xff"])
@example([b"$" * 70])
def test_nothing_raises_and_little_is_kept(pieces: list[bytes]) -> None:
    parser = Parser()
    for piece in pieces:
        parser.feed(piece)
    assert len(parser._kept) <= MOST + 9 + 80


def test_reset_forgets_an_incomplete_frame() -> None:
    parser = Parser()
    parser.feed(encode(MspFrame(5, b"abc"))[:-2])
    parser.reset()
    assert parser.feed(encode(MspFrame(6))) == [MspFrame(6)]


@pytest.mark.parametrize(
    ("frame", "version"),
    [
        (MspFrame(255), 1),
        (MspFrame(0x2000), 1),
        (MspFrame(1), 3),
        (MspFrame(0x10000), None),
        (MspFrame(1, bytes(0x10000)), None),
    ],
)
def test_a_frame_that_can_not_be_encoded(frame: MspFrame, version: int | None) -> None:
    with pytest.raises(ValueError, match="function"):
        encode(frame, version=version)


@given(st.lists(st.tuples(frames, st.booleans()), max_size=5))
@example([(MspFrame(105, bytes(300)), False), (MspFrame(105), False)])
def test_frames_encoded_in_a_row_are_found_one_by_one(row: list[tuple[MspFrame, bool]]) -> None:
    made = [encode(frame, version=2 if newer or frame.function >= LONG else 1) for frame, newer in row]
    assert list(whole_frames(b"".join(made))) == made
