"""The cameras' decoder: lost, cut, flipped or resized pictures never show, and never stop later ones."""

from __future__ import annotations

import functools
import random
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from skyloop.drivers.h264 import SPS, START, Inspector, unit_type, units
from skyloop.drivers.live_container import HOPELESS_S, STRICT_S, LiveDecoder, Piece
from skyloop.drivers.live_video import Coded
from skyloop.errors import UnsupportedError
from skyloop.vehicles.emulation.video import Encoder, Format
from tests.support.film import FPS, GROUP, HEIGHT, WIDTH, Film

av = pytest.importorskip("av")

COUNT = 4 * GROUP
PERIOD_NS = round(1e9 / FPS)
Pixels = NDArray[np.uint8]


@functools.cache
def film() -> tuple[bytes, ...]:
    made = Film()
    return tuple(made.next().payload for _ in range(COUNT))


@functools.cache
def right() -> dict[int, Pixels]:
    return shown(list(film()))


class Watched:
    """A decoder that is fed pictures; None is a lost one."""

    def __init__(self) -> None:
        self.whole: list[int] = []
        self.told: list[str] = []
        self.decoder = LiveDecoder(lambda coded: self.whole.append(coded.captured_ns // PERIOD_NS), self.told.append)
        self._inspector = Inspector()
        self._context: Any = av.CodecContext.create("h264", "r")
        self._number = 0

    def decode(self, data: bytes, now: int, *, show: bool = True) -> Pixels | None:
        """Return the picture, if one is shown. ``now`` is in periods."""
        packet: Any = av.Packet(data)
        piece = Piece(packet, self._context, self._number, self._inspector.inspect(data))
        self._number += 1
        decoded = self.decoder.decode(Coded(piece, False, now * PERIOD_NS, now * PERIOD_NS, 0), show=show)
        if decoded is not None:
            assert decoded.captured_ns == now * PERIOD_NS
        return None if decoded is None else decoded.pixels


def shown(stream: list[bytes | None]) -> dict[int, Pixels]:
    """Return the shown pictures by their positions."""
    watched = Watched()
    found = {}
    for number, data in enumerate(stream):
        pixels = None if data is None else watched.decode(data, number)
        if pixels is not None:
            found[number] = pixels
    assert watched.whole == list(found)
    return found


def expect(found: dict[int, Pixels], numbers: list[int]) -> None:
    assert sorted(found) == numbers
    assert all(np.array_equal(pixels, right()[number]) for number, pixels in found.items())


def test_all_of_an_undamaged_stream_is_shown() -> None:
    assert sorted(right()) == list(range(COUNT))


def test_after_a_lost_picture_nothing_is_shown_up_to_the_next_key() -> None:
    stream: list[bytes | None] = list(film())
    stream[3] = None
    expect(shown(stream), [0, 1, 2, *range(GROUP, COUNT)])


def test_a_cut_picture_and_its_successors_are_not_shown() -> None:
    for cut in (film()[3][:200], film()[3][: len(film()[3]) // 2] + film()[3][len(film()[3]) // 2 + 300 :]):
        stream: list[bytes | None] = list(film())
        stream[3] = cut
        expect(shown(stream), [0, 1, 2, *range(GROUP, COUNT)])


def test_a_lost_key_is_waited_out() -> None:
    stream: list[bytes | None] = list(film())
    stream[GROUP] = None
    expect(shown(stream), [*range(GROUP), *range(2 * GROUP, COUNT)])


def test_lost_parameters_keep_the_previous_ones() -> None:
    def without(data: bytes) -> bytes:
        return START + START.join(unit for unit in units(data) if unit_type(unit) != SPS)

    stream: list[bytes | None] = list(film())
    stream[GROUP] = without(film()[GROUP])
    expect(shown(stream), list(range(COUNT)))
    stream[0] = without(film()[0])
    stream[GROUP] = film()[GROUP]
    expect(shown(stream), list(range(GROUP, COUNT)))


def test_cut_parameters_keep_the_previous_ones() -> None:
    first = units(film()[GROUP])[0]
    stream: list[bytes | None] = list(film())
    stream[GROUP] = film()[GROUP].replace(first, first[:6])
    found = shown(stream)
    assert all(np.array_equal(pixels, right()[number]) for number, pixels in found.items())
    assert set(range(2 * GROUP, COUNT)) <= found.keys()


def test_another_size_is_shown_from_its_key_on() -> None:
    small = Encoder(Format("h264", WIDTH // 2, HEIGHT // 2, 0), FPS, 500, group=GROUP)
    other = []
    for number in range(GROUP + 2):
        encoded = small.encode(right()[number])
        assert encoded is not None
        other.append(encoded.payload)
    stream = [*film()[:5], *other[2:GROUP], *other[GROUP:]]  # the new size's first key is lost
    found = shown(list(stream))
    assert {number: pixels.shape[1] for number, pixels in found.items() if number >= 5} == {
        3 + GROUP: WIDTH // 2,
        4 + GROUP: WIDTH // 2,
    }


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32))
def test_flipped_bits_and_lost_pieces_end_with_the_next_whole_key(seed: int) -> None:
    chance = random.Random(seed)
    stream: list[bytes | None] = list(film())
    for number in range(3 * GROUP):
        data = bytearray(film()[number])
        if chance.random() < 0.2:
            for _ in range(chance.randrange(1, 4)):
                data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
        if chance.random() < 0.1:
            at = chance.randrange(len(data))
            del data[at : at + chance.randrange(1, 2000)]
        stream[number] = bytes(data) or None
    found = shown(stream)
    assert set(range(3 * GROUP, COUNT)) <= found.keys()
    assert all(np.array_equal(found[number], right()[number]) for number in range(3 * GROUP, COUNT))


def test_noise_is_reported_and_forgotten_once_it_ends() -> None:
    watched, noise = Watched(), np.random.default_rng(1)
    assert watched.decode(film()[0], 0) is not None
    seconds = int(HOPELESS_S * FPS)
    for number in range(1, seconds + 2):
        assert watched.decode(START + b"\x09" + noise.integers(1, 256, 300, np.uint8).tobytes(), number) is None
    with pytest.raises(UnsupportedError, match="nothing received could be decoded"):
        watched.decode(START + b"\x09", seconds + 3)
    assert watched.decode(film()[GROUP], 2 * seconds) is not None
    assert watched.decoder.damaged > 50


def test_a_stream_without_key_pictures_is_left_to_ffmpeg_until_a_whole_one() -> None:
    watched = Watched()
    assert watched.decode(film()[0], 0) is not None
    faulty = bytearray(film()[GROUP])
    faulty[-20] ^= 0x40
    numbers = range(1, int(STRICT_S * FPS) + 10)
    for number in numbers:
        with_fault = bytes(faulty) if number % GROUP == 0 else film()[2 + number % GROUP % (GROUP - 2)]
        watched.decode(with_fault, number, show=False)
    assert len(watched.told) == 1
    assert "with their damage" in watched.told[0]
    assert watched.decode(bytes(faulty), numbers[-1] + 1) is not None
    assert watched.whole == [0]
    pixels = watched.decode(film()[GROUP], numbers[-1] + 2)
    assert pixels is not None
    assert np.array_equal(pixels, right()[GROUP])
    assert watched.whole[-1] == numbers[-1] + 2


def test_only_pieces_are_accepted() -> None:
    with pytest.raises(TypeError, match="a piece of a live stream"):
        LiveDecoder().decode(Coded(b"", True, 0, 0, 0), show=True)
