"""Damaged packets: only one kind of error, no hang, and no picture from damage that the format reveals."""

from __future__ import annotations

import contextlib

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from skyloop.errors import DecodeError
from skyloop.vehicles.ardrone.emulator.video import encode
from skyloop.vehicles.ardrone.wire.uvlc import UvlcDecoder, UvlcPicture
from tests.vehicles.ardrone.wire.uvlc_bits import START, aligned, packet
from tests.vehicles.ardrone.wire.uvlc_pictures import noise, scenery

SHOWN = (encode(scenery(88, 72), 9), encode(noise(88, 72), 9, quant=3), encode(scenery(176, 144), 9))
packets = st.sampled_from(SHOWN)


def outcome(data: bytes) -> UvlcPicture | None:
    """Return the picture or None; errors other than DecodeError propagate."""
    with contextlib.suppress(DecodeError):
        decoded = UvlcDecoder().decode(data)
        assert decoded.pixels.shape == (decoded.height, decoded.width, 3)
        return decoded
    return None


@pytest.mark.parametrize("data", SHOWN)
def test_a_torn_packet_is_not_a_picture(data: bytes) -> None:
    assert outcome(data) is not None
    for size in range(0, len(data), 4 if len(data) < 3000 else 36):
        assert outcome(data[:size]) is None


@given(packets, st.integers(0, 1 << 20), st.integers(1, 400))
def test_a_missing_piece_raises_nothing_else(data: bytes, at: int, size: int) -> None:
    start = at % len(data)
    outcome(data[:start] + data[start + size :])


@given(packets, st.binary(min_size=1, max_size=300))
@example(SHOWN[0], bytes(4))
@example(SHOWN[0], bytes(8))
def test_a_packet_with_trailing_data_is_not_a_picture(data: bytes, more: bytes) -> None:
    decoded = outcome(data + more)
    assert (decoded is None) == (len(more) != 4 or any(more))


@given(packets, st.lists(st.integers(0, 1 << 24), min_size=1, max_size=8))
def test_flipped_bits_raise_nothing_else(data: bytes, places: list[int]) -> None:
    damaged = bytearray(data)
    for place in places:
        damaged[place // 8 % len(damaged)] ^= 1 << place % 8
    outcome(bytes(damaged))


@given(st.binary(max_size=400))
@example(b"")
def test_random_bytes_are_not_a_picture(data: bytes) -> None:
    assert outcome(data) is None


@given(st.integers(0, 2**59 - 1), st.binary(max_size=400))
def test_random_bits_after_a_start_code_are_no_picture(fields: int, data: bytes) -> None:
    bits = START + f"{fields:059b}" + "".join(f"{byte:08b}" for byte in data)
    assert outcome(packet(aligned(bits, 32))) is None


def test_the_longest_packets_end_soon() -> None:
    start = SHOWN[0][:12]
    rng = np.random.default_rng(1)
    for rest in (bytes(65_000), b"\xff" * 65_000, b"\xdb\xb6\x6d" * 21_667, rng.bytes(65_000)):
        assert outcome(start + rest[: len(rest) // 4 * 4]) is None


def test_two_in_five_single_flips_are_detected() -> None:
    # The others hit a mean, a sign or the last bits of a run or level, and make an equally valid picture: the only
    # checksum is UDP's.
    data = SHOWN[2]
    seen = 0
    flips = np.random.default_rng(5).choice(8 * len(data), 400, replace=False)
    for bit in flips:
        damaged = bytearray(data)
        damaged[bit // 8] ^= 1 << bit % 8
        seen += outcome(bytes(damaged)) is None
    assert seen > 0.4 * len(flips)


def test_a_decoder_continues_after_damage() -> None:
    decoder = UvlcDecoder()
    for data in SHOWN:
        with pytest.raises(DecodeError):
            decoder.decode(data[:-8])
        assert decoder.decode(data).number == 9
