"""The PaVE parser on real captures, on pieces of them, and on damage."""

from __future__ import annotations

import random
import struct

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from skyloop.vehicles.ardrone.wire.pave import DEFAULT_MAX_PAYLOAD, FrameType, PaveFrame, PaveParser
from tests.support.recordings import content, needs_recordings

pytestmark = needs_recordings

LONG = content("ardrone2/video-8s.pave")
TORN = content("ardrone2/video-64-byte-headers.pave")
START = LONG[:200_000]


def parse(data: bytes, step: int = 1 << 20) -> tuple[list[PaveFrame], PaveParser]:
    parser = PaveParser()
    frames = [frame for at in range(0, len(data), step) for frame in parser.feed(data[at : at + step])]
    parser.end()
    return frames, parser


WHOLE = parse(START)[0]


def test_a_capture_with_68_byte_headers() -> None:
    frames, parser = parse(LONG)
    assert [frame.number for frame in frames] == list(range(190195, 190435))
    assert [n for n, frame in enumerate(frames) if frame.is_key] == list(range(0, 240, 15))
    assert {(frame.width, frame.height, frame.codec) for frame in frames} == {(640, 360, 4)}
    assert (parser.skipped_bytes, parser.broken_frames, parser.buffered) == (0, 0, 0)
    assert all(frame.payload.startswith(b"\0\0\0\1") for frame in frames)
    assert frames[-1].timestamp_ms - frames[0].timestamp_ms == pytest.approx(239 / 30.6 * 1000, rel=0.01)


def test_a_capture_with_64_byte_headers() -> None:
    frames, parser = parse(TORN)
    assert len(frames) == 20
    assert [frame.type for frame in frames[:5]] == [FrameType.P] * 3 + [FrameType.IDR, FrameType.P]
    assert parser.skipped_bytes == 0


@pytest.mark.parametrize("step", [1, 63, 64, 1448, 65536])
def test_the_size_of_the_pieces_does_not_matter(step: int) -> None:
    data = START[:60_000] if step == 1 else START
    assert parse(data, step)[0] == parse(data)[0]


def test_a_torn_start_is_skipped_and_counted() -> None:
    frames, parser = parse(START[1000:])
    assert [frame.number for frame in frames] == [frame.number for frame in WHOLE[1:]]
    assert frames[0].after_damage
    assert not any(frame.after_damage for frame in frames[1:])
    left = len(START) - sum(len(frame.payload) + 68 for frame in WHOLE)
    assert parser.skipped_bytes == len(WHOLE[0].payload) + 68 - 1000 + left


@pytest.mark.parametrize("step", [1 << 20, 1448])
def test_garbage_after_a_frame_costs_that_frame_as_it_may_have_been_inserted_within(step: int) -> None:
    cut = 68 + len(WHOLE[0].payload)
    frames, parser = parse(START[:cut] + b"rubbish PaVE and more rubbish" * 9 + START[cut:], step)
    assert [frame.payload for frame in frames] == [frame.payload for frame in WHOLE[1:]]
    assert [frame.after_damage for frame in frames[:2]] == [True, False]
    assert parser.skipped_bytes > cut + 9 * 20
    assert parser.broken_frames >= 1


def test_missing_and_extra_bytes_are_detected_by_the_next_frame() -> None:
    cut = 68 + len(WHOLE[0].payload)
    for data in (START[: cut - 2000] + START[cut + 3000 :], START[: cut - 2000] + b"more" + START[cut - 2000 :]):
        frames, parser = parse(data, 1 << 20)
        assert frames[0].number > WHOLE[0].number
        assert parser.broken_frames >= 1


def test_a_length_that_is_too_long_costs_one_frame_only() -> None:
    data = bytearray(START)
    at = 68 + len(WHOLE[0].payload)
    struct.pack_into("<I", data, at + 8, 150_000)
    frames, parser = parse(bytes(data), 1448)
    assert [frame.number for frame in frames] == [frame.number for frame in WHOLE if frame is not WHOLE[1]]
    assert parser.broken_frames >= 1


def test_a_header_with_an_absurd_length_is_ignored() -> None:
    data = bytearray(START)
    struct.pack_into("<I", data, 8, DEFAULT_MAX_PAYLOAD + 1)
    frames, parser = parse(bytes(data))
    assert frames[0].number == WHOLE[1].number
    assert parser.skipped_bytes >= 68


def test_an_advertisement_carries_nothing() -> None:
    advertisement = bytearray(START[:68])
    advertisement[31] = 1
    frames, parser = parse(bytes(advertisement) + START)
    assert [frame.payload for frame in frames] == [frame.payload for frame in WHOLE]
    assert parser.broken_frames <= 1  # the last one of the excerpt


@settings(max_examples=150, deadline=None)
@given(st.lists(st.binary(max_size=400) | st.just(b"PaVE") | st.just(START[:68]) | st.just(START[:64]), max_size=30))
def test_anything_is_survived_in_bounded_memory(pieces: list[bytes]) -> None:
    parser = PaveParser(max_payload=2048)
    fed = taken = 0
    for piece in pieces:
        fed += len(piece)
        taken += sum(len(frame.payload) for frame in parser.feed(piece))
        assert parser.buffered <= 2048 + 128 + 400
    parser.end()
    assert parser.buffered == 0
    assert parser.skipped_bytes + taken <= fed


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32), st.integers(1, 40), st.integers(1, 70_000))
def test_flipped_bits_never_raise_and_cost_only_the_frames_they_hit(seed: int, flips: int, step: int) -> None:
    data = bytearray(START)
    chance = random.Random(seed)
    for _ in range(flips):
        data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
    frames, _ = parse(bytes(data), max(step, 500))
    untouched = {frame.payload for frame in WHOLE} & {frame.payload for frame in frames}
    # A flip hits one frame; one in a frame's signature takes at worst the neighbour's end with it.
    assert len(untouched) >= len(WHOLE) - 2 * flips
