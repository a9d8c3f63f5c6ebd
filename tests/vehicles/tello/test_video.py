"""Pictures from H.264 with lost pieces, compared with those of an intact stream."""

from __future__ import annotations

import functools
import random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from skyloop.drivers.live_video import Coded
from skyloop.drivers.uri import parse_uri
from skyloop.vehicles.emulation.video import OneCamera
from skyloop.vehicles.tello.emulator import FRONT, GROUP, TelloPacker
from skyloop.vehicles.tello.video import TelloVideo, cameras_of, intrinsics_for
from skyloop.vehicles.tello.wire import AccessUnit, Assembly, pieces

pytest.importorskip("av")

Pixels = NDArray[np.uint8]
COUNT = 70
SETTINGS = OneCamera("front", 30.0, 600)


def scene(number: int) -> Pixels:
    """Return a picture of a bright square that wanders over noise."""
    picture = np.random.default_rng(1).integers(60, 120, (240, 320, 3)).astype(np.uint8)
    at = 20 + 2 * number
    picture[80:140, at : at + 60] = 240
    return picture


@functools.cache
def _encoded() -> tuple[bytes, ...]:
    packer = TelloPacker()
    packer.size = (320, 240)
    made = [packer.pack(scene(n), SETTINGS, 0) for n in range(COUNT)]
    return tuple(piece.data for piece in made if piece is not None)


@pytest.fixture
def stream() -> list[bytes]:
    return list(_encoded())


def units(stream: list[bytes], lost: set[tuple[int, int]] | None = None) -> list[tuple[int, AccessUnit]]:
    """Return pictures after the loss of these pieces (number of the picture, number of its piece)."""
    assembly = Assembly()
    got: list[tuple[int, AccessUnit]] = []
    for number, picture in enumerate(stream):
        for at, piece in enumerate(pieces(picture)):
            if (number, at) not in (lost or set()):
                got += [(number, unit) for unit in assembly.feed(piece, number)]
    return got


def shown(stream: list[bytes], lost: set[tuple[int, int]] | None = None, concealed: int = 2) -> dict[int, Pixels]:
    video = TelloVideo(concealed)
    pictures = {}
    for number, unit in units(stream, lost):
        decoded = video.decode(Coded(unit, unit.is_key, number, number, 0), show=True)
        if decoded is not None:
            pictures[number] = decoded[1]
    return pictures


@functools.cache
def _shown_whole() -> dict[int, Pixels]:
    return shown(list(_encoded()))


def differ(one: Pixels, other: Pixels) -> float:
    """Return the mean difference, in steps of 0 to 255."""
    return float(np.abs(one.astype(int) - other).mean())


def test_without_loss_every_picture_is_shown_and_like_the_scene(stream: list[bytes]) -> None:
    pictures = shown(stream)
    assert sorted(pictures) == list(range(COUNT))
    for number, picture in pictures.items():
        at = 20 + 2 * number
        inside = picture[90:130, at + 10 : at + 50].mean()
        assert inside > 220


def test_keys_are_as_frequent_as_a_tellos(stream: list[bytes]) -> None:
    assert [number for number, unit in units(stream) if unit.is_key] == list(range(0, COUNT, GROUP))


def test_after_a_missing_picture_the_others_are_nearly_right(stream: list[bytes]) -> None:
    whole = shown(stream)
    lost = {(10, at) for at in range(len(pieces(stream[10])))}
    damaged = shown(stream, lost)
    assert set(range(COUNT)) - damaged.keys() == {10}
    for number in range(10):
        assert np.array_equal(damaged[number], whole[number])
    assert 0 < differ(damaged[12], whole[12]) < 12
    assert np.array_equal(damaged[GROUP], whole[GROUP])  # the next key repairs it


def test_without_concealment_nothing_damaged_is_shown(stream: list[bytes]) -> None:
    whole = shown(stream)
    damaged = shown(stream, {(10, 0), (2 * GROUP + 3, 0)}, concealed=0)
    assert sorted(damaged) == [*range(10), *range(GROUP, 2 * GROUP + 3)]
    assert all(np.array_equal(pixels, whole[number]) for number, pixels in damaged.items())


def test_after_a_damaged_key_nothing_is_shown_until_the_next(stream: list[bytes]) -> None:
    assert len(pieces(stream[GROUP])) > 2
    assert sorted(shown(stream, {(GROUP, 1)})) == [*range(GROUP), *range(2 * GROUP, COUNT)]


def test_nothing_is_shown_before_a_whole_key(stream: list[bytes]) -> None:
    assert min(shown(stream, {(0, 1)})) == GROUP


def test_after_too_much_damage_nothing_is_shown_until_the_next_key(stream: list[bytes]) -> None:
    gone = [5, 8, 11]
    lost = {(number, at) for number in gone for at in range(len(pieces(stream[number])))}
    pictures = shown(stream, lost)
    assert max(number for number in pictures if number < GROUP) == 10
    assert GROUP in pictures


def test_a_restart_waits_for_a_key(stream: list[bytes]) -> None:
    video = TelloVideo()
    all_units = units(stream)
    for number, unit in all_units[:5]:
        assert video.decode(Coded(unit, unit.is_key, number, number, 0), show=False) is None
    video.restart()
    for number, unit in all_units[5:GROUP]:
        assert video.decode(Coded(unit, unit.is_key, number, number, 1), show=True) is None
    assert video.waited == GROUP - 5
    assert video.decode(Coded(all_units[GROUP][1], True, 0, 0, 1), show=True) is not None


def handed_on(stream: list[bytes], lost: set[tuple[int, int]] | None = None, left_out: int | None = None) -> list[int]:
    """Return the numbers of the pictures that count as whole; ``left_out`` never reaches the decoder."""
    whole: list[int] = []
    video = TelloVideo(2, lambda coded: whole.append(coded.captured_ns))
    for number, unit in units(stream, lost):
        if number != left_out:
            video.decode(Coded(unit, unit.is_key, number, number, 0), show=False)
    return whole


def test_every_picture_is_whole_without_loss_and_has_its_size(stream: list[bytes]) -> None:
    assert handed_on(stream) == list(range(COUNT))
    assert {(unit.width, unit.height) for _, unit in units(stream)} == {(320, 240)}
    assert [unit.number for _, unit in units(stream)] == list(range(COUNT))


def test_a_patched_picture_and_its_successors_are_not_whole(stream: list[bytes]) -> None:
    assert handed_on(stream, {(10, 0)}) == [*range(10), *range(GROUP, COUNT)]
    assert handed_on(stream, {(GROUP, 1)}) == [*range(GROUP), *range(2 * GROUP, COUNT)]
    assert handed_on(stream, left_out=10) == [*range(10), *range(GROUP, COUNT)]


def test_it_waits_until_a_key_can_be_shown(stream: list[bytes]) -> None:
    video = TelloVideo()
    assert video.waits
    for number, unit in units(stream)[:2]:
        video.decode(Coded(unit, unit.is_key, number, number, 0), show=False)
        assert not video.waits
    video.restart()
    assert video.waits


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32), st.floats(0.0, 0.7))
def test_any_loss_is_survived(seed: int, share: float) -> None:
    stream = list(_encoded())
    chance = random.Random(seed)
    lost = {
        (number, at)
        for number, picture in enumerate(stream)
        for at in range(len(pieces(picture)))
        if chance.random() < share
    }
    whole = _shown_whole()
    for number, picture in shown(stream, lost, concealed=0).items():
        assert np.array_equal(picture, whole[number])
    for picture in shown(stream, lost).values():
        assert picture.shape == (240, 320, 3)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32))
def test_any_flipped_bits_are_survived(seed: int) -> None:
    chance = random.Random(seed)
    stream = []
    for picture in _encoded()[:40]:
        damaged = bytearray(picture)
        for _ in range(chance.randrange(4)):
            damaged[chance.randrange(len(damaged))] ^= 1 << chance.randrange(8)
        stream.append(bytes(damaged))
    shown(stream)


def test_the_emulated_camera_matches_the_drivers() -> None:
    front, bottom = cameras_of(parse_uri("tello://d"))
    assert front.intrinsics is not None
    announced = front.intrinsics
    assert (front.width, front.height) == (FRONT.width, FRONT.height)
    assert (announced.fx, announced.fy, announced.cx, announced.cy) == (FRONT.fx, FRONT.fy, FRONT.cx, FRONT.cy)
    assert announced.distortion == FRONT.distortion
    assert front.rotation == FRONT.rotation
    assert front.position_m == FRONT.position_m
    small = intrinsics_for(front, "front", 640)
    assert small is not None
    assert small.fx == pytest.approx(FRONT.fx * 640 / 960)
    assert intrinsics_for(front, bottom.name, 320) is None
