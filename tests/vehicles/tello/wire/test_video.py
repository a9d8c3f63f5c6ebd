"""Pictures from video datagrams, with losses in any order."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyloop.drivers.h264 import START, Slice, parse_sequence, parse_slice, units
from skyloop.errors import DecodeError
from skyloop.vehicles.tello.wire import MAX_PICTURE, PIECE, AccessUnit, Assembly, pieces

#: From a real Tello.
SPS = bytes.fromhex("674d402895a03c05b9")
PPS = bytes.fromhex("68ee3880")


def picture(number: int, size: int, *, key: bool = False) -> bytes:
    """Return the beginning of a slice with this frame number, and filling without start codes."""
    bits = f"1{'00110' if not key else '0001000'}1{number % 256:08b}1"  # first macroblock 0, type, parameter set 0
    bits += "1" * (-len(bits) % 8)
    head = bytes([0x65 if key else 0x61]) + int(bits, 2).to_bytes(len(bits) // 8, "big")
    unit = (START + SPS + START + PPS if key else b"") + START + head
    return unit + b"\xa5" * (size - len(unit))


def group(sizes: list[int]) -> list[bytes]:
    return [picture(n, size, key=n == 0) for n, size in enumerate(sizes)]


def fed(assembly: Assembly, datagrams: list[bytes]) -> list[AccessUnit]:
    return [unit for at, datagram in enumerate(datagrams) for unit in assembly.feed(datagram, at)]


def test_a_real_tellos_parameters() -> None:
    sequence = parse_sequence(SPS)
    assert (sequence.width, sequence.height, sequence.frame_number_bits) == (960, 720, 8)
    assert parse_slice(units(picture(77, 100))[0], sequence) == Slice(False, True, True, 77)
    assert parse_slice(units(picture(0, 100, key=True))[2], sequence) == Slice(True, True, True, 0)


def test_pictures_come_out_unchanged() -> None:
    sent = group([30_000, 11_000, 1_000, PIECE + 1, 9_999])
    got = fed(Assembly(), [piece for each in sent for piece in pieces(each)])
    assert [unit.data for unit in got] == sent
    assert [unit.is_key for unit in got] == [True, False, False, False, False]
    assert all(unit.whole for unit in got)
    assert [unit.after_gap for unit in got] == [
        True,
        False,
        False,
        False,
        False,
    ]  # the time before the first one is unknown


def test_a_picture_of_full_pieces_only_ends_with_the_next() -> None:
    sent = group([5_000, 2 * PIECE, 700])
    got = fed(Assembly(), [piece for each in sent for piece in pieces(each)])
    assert [unit.data for unit in got] == sent
    assert [unit.whole for unit in got] == [True, False, True]  # a lost piece would go unnoticed


def test_parameter_sets_may_arrive_in_separate_datagrams() -> None:
    key = picture(0, 4_000, key=True)
    assembly = Assembly()
    head = START + SPS + START + PPS
    got = fed(assembly, [START + SPS, START + PPS, *pieces(key[len(head) :])])
    assert [unit.data for unit in got] == [key]
    assert got[0].is_key
    assert got[0].arrived_ns == 0


def test_a_lost_end_is_detected_at_the_next_beginning() -> None:
    sent = group([5_000, 5_000, 5_000])
    datagrams = [*pieces(sent[0]), *pieces(sent[1])[:-1], *pieces(sent[2])]
    got = fed(Assembly(), datagrams)
    assert [unit.whole for unit in got] == [True, False, True]


def test_a_lost_beginning_drops_the_rest_and_is_counted() -> None:
    sent = group([5_000, 5_000, 5_000])
    assembly = Assembly()
    got = fed(assembly, [*pieces(sent[0]), *pieces(sent[1])[1:], *pieces(sent[2])])
    assert [unit.data for unit in got] == [sent[0], sent[2]]
    assert got[1].after_gap
    assert assembly.stray == 5_000 - PIECE
    assert assembly.missing == 1


def test_the_numbers_reveal_missing_pictures() -> None:
    sent = group([2_000] * 300)
    assembly = Assembly()
    kept = [sent[0], sent[1], *sent[5:]]
    got = fed(assembly, [piece for each in kept for piece in pieces(each)])
    assert [unit.data for unit in got if unit.after_gap] == [sent[0], sent[5]]
    assert assembly.missing == 3


def test_an_endless_picture_is_dropped() -> None:
    assembly = Assembly()
    flood = b"\xa5" * PIECE
    got = fed(assembly, [picture(0, PIECE, key=True), *([flood] * (MAX_PICTURE // PIECE + 10))])
    assert got == []
    assert assembly.stray > MAX_PICTURE


@pytest.mark.parametrize("unit", [b"", b"\x67", b"\x67\x64\x00\x28\xff", b"\x67\x4d\x40\x28" + b"\0" * 8])
def test_broken_parameters_are_refused(unit: bytes) -> None:
    with pytest.raises(DecodeError):
        parse_sequence(unit)


@given(st.lists(st.binary(max_size=PIECE + 5) | st.binary(max_size=40).map(lambda tail: START + tail), max_size=40))
def test_any_datagrams_are_survived(datagrams: list[bytes]) -> None:
    assembly = Assembly()
    got = fed(assembly, datagrams)
    assert sum(len(unit.data) for unit in got) + assembly.stray <= sum(map(len, datagrams))


@given(st.integers(0, 2**32), st.floats(0.0, 0.6))
def test_with_any_loss_the_output_consists_of_input_pieces(seed: int, lost: float) -> None:
    chance = random.Random(seed)
    sent = group([chance.randrange(600, 20_000) for _ in range(20)])
    kept = [piece for each in sent for piece in pieces(each) if chance.random() >= lost]
    assembly = Assembly()
    got = fed(assembly, kept)
    waiting = sum(map(len, kept)) - assembly.stray - sum(len(unit.data) for unit in got)
    assert 0 <= waiting <= MAX_PICTURE
    assert all(unit.data.startswith(START) for unit in got)
    if not lost:
        assert [unit.data for unit in got] == sent or waiting


@given(st.binary(max_size=40))
def test_any_unit_is_read_or_refused(data: bytes) -> None:
    sequence = parse_sequence(SPS)
    for parse in (parse_sequence, lambda unit: parse_slice(unit, sequence)):
        try:
            parse(data)
        except DecodeError:
            continue
