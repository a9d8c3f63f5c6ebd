"""Headers of H.264 streams made by x264; damaged ones are refused."""

from __future__ import annotations

import functools
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.drivers.h264 import PPS, SPS, START, Inspector, Sequence, Unit, parse_sequence, unit_type, units
from skyloop.errors import DecodeError

av = pytest.importorskip("av")
KEYS = "keyint=6:min-keyint=6:scenecut=0:repeat-headers=1"


@functools.cache
def encoded(
    width: int = 322, height: int = 242, *, more: str = "", pixels: str = "yuv420p", b_frames: int = 0, count: int = 14
) -> tuple[bytes, ...]:
    """Return the access units of a moving square, with a key picture every six."""
    context = av.CodecContext.create("libx264", "w")
    context.width, context.height, context.pix_fmt = width, height, pixels
    context.framerate, context.time_base = Fraction(25), Fraction(1, 25)
    context.max_b_frames = b_frames
    context.options = {"preset": "medium", "x264-params": f"{KEYS}:b-adapt=0{more}"}
    made = []
    for number in range(count):
        picture = np.full((height, width, 3), 60, np.uint8)
        picture[10:50, 5 * number : 5 * number + 40] = 200
        frame = av.VideoFrame.from_ndarray(picture, format="bgr24").reformat(format=pixels)
        frame.pts, frame.time_base = number, context.time_base
        made += context.encode(frame)
    return tuple(bytes(packet) for packet in [*made, *context.encode(None)])


def inspected(stream: tuple[bytes, ...] | list[bytes], parameters: bytes = b"") -> list[Unit | None]:
    inspector = Inspector(parameters)
    return [inspector.inspect(data) for data in stream]


def sound(stream: tuple[bytes, ...] | list[bytes], parameters: bytes = b"") -> list[Unit]:
    found = [unit for unit in inspected(stream, parameters) if unit is not None]
    assert len(found) == len(stream)
    return found


@pytest.mark.parametrize(
    ("width", "height", "more", "pixels"),
    [
        (322, 242, "", "yuv420p"),
        (320, 240, ":cqm=jvt", "yuv420p"),
        (322, 242, "", "yuv422p"),
        (321, 241, ":cqm=jvt", "yuv444p"),
        (640, 360, ":slices=4", "yuv420p"),
    ],
)
def test_sizes_keys_and_numbers_of_every_profile(width: int, height: int, more: str, pixels: str) -> None:
    found = sound(encoded(width, height, more=more, pixels=pixels))
    assert {(unit.width, unit.height, unit.reason) for unit in found} == {(width, height, "")}
    assert [number for number, unit in enumerate(found) if unit.is_key] == [0, 6, 12]
    assert not any(unit.after_gap for unit in found)
    assert tuple(unit.data for unit in found) == encoded(width, height, more=more, pixels=pixels)


def test_pictures_that_refer_to_later_ones_are_reported() -> None:
    found = sound(encoded(b_frames=2))
    assert {unit.reason for unit in found} == {"", "pictures refer to later ones (B-frames)"}
    assert not any(unit.after_gap for unit in found)


def test_a_missing_picture_shows_in_the_next_one_only() -> None:
    stream = list(encoded())
    found = sound(stream[:3] + stream[4:])
    assert [number for number, unit in enumerate(found) if unit.after_gap] == [3]


def test_a_stream_joined_in_the_middle_waits_for_its_parameters() -> None:
    assert [unit is None for unit in inspected(encoded()[3:])] == [True] * 3 + [False] * 8
    assert sound(encoded()[6:])[0].is_key


def without_sets(data: bytes) -> bytes:
    return START + START.join(unit for unit in units(data) if unit_type(unit) not in (SPS, PPS))


def test_parameter_sets_from_outside_or_sent_once_precede_each_key_picture() -> None:
    whole = list(encoded())
    sets = START + START.join(unit for unit in units(whole[0]) if unit_type(unit) in (SPS, PPS))
    bare = [without_sets(data) for data in whole]
    for stream, beside in ((bare, sets), ([whole[0], *bare[1:]], b"")):
        found = sound(stream, beside)
        keys = [unit for unit in found if unit.is_key]
        assert len(keys) == 3
        assert all([unit_type(part) for part in units(unit.data)][:2] == [SPS, PPS] for unit in keys)


def test_a_key_picture_without_its_sets_does_not_count() -> None:
    assert inspected([without_sets(encoded()[0])]) == [None]
    picture_set = next(unit for unit in units(encoded()[0]) if unit_type(unit) == PPS)
    cut = encoded()[0].replace(START + picture_set, b"").replace(b"\0\0\1" + picture_set, b"")
    (found,) = sound([cut])
    assert not found.is_key
    assert found.after_gap


def test_another_size_begins_with_a_key() -> None:
    found = sound([*encoded(), *encoded(160, 120)])
    assert [unit.width for unit in found] == [322] * 14 + [160] * 14
    assert found[14].is_key
    assert not any(unit.after_gap for unit in found)


def test_a_restart_is_a_gap() -> None:
    inspector = Inspector()
    first, second, third = encoded()[:3]
    inspector.inspect(first)
    inspector.restart()
    assert [unit is not None and unit.after_gap for unit in map(inspector.inspect, (second, third))] == [True, False]


def test_a_damaged_set_does_not_replace_the_good_one() -> None:
    stream = list(encoded()[:8])
    sequence = next(unit for unit in units(stream[6]) if unit_type(unit) == SPS)
    stream[6] = stream[6].replace(sequence, sequence[:5])
    assert {unit.width for unit in sound(stream)} == {322}


def test_interlaced_pictures_are_reported() -> None:
    fields = Sequence(4, 1920, 1080, interlaced=True)
    inspector = Inspector()
    inspector._sequence = fields
    found = inspector.inspect(START + bytes([0x61]) + bytes.fromhex("9a22"))
    assert found is not None
    assert found.reason == "pictures are interlaced"


def test_numbers_may_have_gaps_where_the_stream_says_so() -> None:
    stream = list(encoded())
    inspector = Inspector()
    inspector.inspect(stream[0])
    assert inspector._sequence is not None
    inspector._sequence = Sequence(inspector._sequence.frame_number_bits, 322, 242, gaps_allowed=True)
    found = inspector.inspect(stream[2])
    assert found is not None
    assert not found.after_gap


@given(st.lists(st.binary(max_size=60) | st.binary(max_size=40).map(lambda tail: START + tail), max_size=20))
def test_any_bytes_are_accepted(stream: list[bytes]) -> None:
    inspected([encoded()[0], *stream])


@given(st.binary(max_size=80))
def test_any_set_is_read_or_refused(data: bytes) -> None:
    try:
        found = parse_sequence(b"\x67" + data)
    except DecodeError:
        return
    assert 0 < found.width <= 16384
    assert 0 < found.height <= 16384
