"""Pictures of streams: their pieces, which of them are decodable, and the size in a picture's header."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.messages import EncodedFrame, decode, encode
from skyloop.messages.frame import MAX_PIECE, Chain, Pieces, image_size, split, why_not_decoded


def test_a_chain_starts_at_a_key_picture_and_breaks_at_a_gap() -> None:
    chain = Chain()
    came = [(1, False), (2, True), (3, False), (4, False), (6, False), (7, False), (9, True), (10, False)]
    assert [number for number, key in came if chain.follows(number, key=key)] == [2, 3, 4, 9, 10]
    assert not chain.follows(10, key=False)  # a duplicate
    assert chain.follows(11, key=False)
    chain.restart()
    assert not chain.follows(12, key=False)
    assert chain.follows(13, key=True)
    assert chain.follows(1, key=True)  # the sender restarted its numbers


@given(st.lists(st.tuples(st.booleans(), st.booleans()), max_size=40))
def test_a_picture_follows_only_if_none_since_its_key_picture_is_lost(sent: list[tuple[bool, bool]]) -> None:
    chain = Chain()
    kept = {number for number, (key, lost) in enumerate(sent) if not lost and chain.follows(number, key=key)}
    for number in kept:
        since = number
        while not sent[since][0]:
            since -= 1
            assert since in kept
    assert {number for number, (key, lost) in enumerate(sent) if key and not lost} <= kept


def picture(seq: int, size: int) -> EncodedFrame:
    return EncodedFrame("front", seq, 1, 2, 64, 48, "h264", True, bytes([seq % 256]) * size)


@given(
    st.lists(st.integers(1, 3 * MAX_PIECE + 1), min_size=1, max_size=4),
    st.sets(st.integers(0, 15)),
    st.booleans(),
)
def test_a_picture_in_pieces_arrives_whole_or_not_at_all(sizes: list[int], lost: set[int], twice: bool) -> None:
    pictures = [picture(seq, size) for seq, size in enumerate(sizes)]
    pieces, number, came = Pieces(), 0, []
    whole = set()
    for one in pictures:
        complete = True
        for part in split(one):
            assert len(part.data) <= MAX_PIECE
            if number in lost:
                complete = False
            else:
                for _ in range(1 + (twice and part.piece == 0)):
                    joined = pieces.add(decode(encode(part)))  # type: ignore[arg-type]
                    came += [] if joined is None else [joined]
            number += 1
        if complete:
            whole.add(one.seq)
    assert {one.seq for one in came} == whole
    assert all(one == pictures[one.seq] for one in came)


SCAN_HEAD = b"\xff\xc0" + struct.pack(">HBHH", 11, 8, 240, 320) + bytes(4)


@pytest.mark.parametrize(
    "data",
    [
        pytest.param(b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sI", 13, b"IHDR", 4), id="a PNG cut within its size"),
        pytest.param(b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII", 13, b"iTXt", 4, 3), id="a PNG without a header"),
        pytest.param(b"\xff\xd8\xff\xd9\xff\xd9", id="a JPEG with nothing but its end"),
        pytest.param(b"\xff\xd8\xff\xe0\x00", id="a JPEG cut within a length"),
        pytest.param(b"\xff\xd8\xff\xe0\x00\x01" + SCAN_HEAD, id="a JPEG with a segment shorter than its length"),
        pytest.param(b"\xff\xd8\xff\xc0\x00\x07" + bytes(8), id="a JPEG with a frame too short for a size"),
        pytest.param(b"\xff\xd8" + SCAN_HEAD[:8], id="a JPEG cut within its size"),
        pytest.param(b"GIF89a" + bytes(20), id="neither"),
    ],
)
def test_a_damaged_header_has_no_size(data: bytes) -> None:
    assert image_size(data) is None
    assert why_not_decoded(data) == "it is neither JPEG nor PNG, or it is damaged"


@pytest.mark.parametrize(
    "before", [b"", b"\x00\x00", b"\xff", b"\xff\x01", b"\xff\xd0", b"\xff\xe0\x00\x04\x00\x00"], ids=bytes.hex
)
def test_segments_that_decoders_skip_are_skipped(before: bytes) -> None:
    data = b"\xff\xd8" + before + SCAN_HEAD
    assert image_size(data) == (320, 240)
    assert why_not_decoded(data) == ""
