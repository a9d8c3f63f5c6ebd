"""Pictures through the emulated drone's encoder and the decoder, which share only the format's tables."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from skyloop.errors import UsageError
from skyloop.vehicles.ardrone.emulator.video import MAX_DATAGRAM, encode
from skyloop.vehicles.ardrone.wire.uvlc import SIZES, UvlcDecoder, UvlcPicture
from tests.vehicles.ardrone.wire.uvlc_bits import GREY, header, level, macroblock, packet, picture, run
from tests.vehicles.ardrone.wire.uvlc_pictures import Picture, noise, scenery

Planes = NDArray[np.float64]


def through(shown: Picture, number: int = 1, quant: int = 31) -> UvlcPicture:
    return UvlcDecoder().decode(encode(shown, number, quant=quant))


def luma(shown: Picture) -> Planes:
    return shown.astype(float) @ (0.114, 0.587, 0.299)


def psnr_db(one: Planes, other: Planes) -> float:
    return float(10 * np.log10(255**2 / np.mean((one - other) ** 2)))


@pytest.mark.parametrize("size", sorted(SIZES.values()))
def test_every_size(size: tuple[int, int]) -> None:
    shown = scenery(*size)
    decoded = through(shown, 77)
    assert (decoded.width, decoded.height) == tuple(side // 16 * 16 for side in size)
    assert decoded.number == 77
    assert psnr_db(luma(decoded.pixels), luma(shown[: decoded.height, : decoded.width])) > 34


@pytest.mark.parametrize(
    ("quant", "at_least_db"), [(1, 39.0), (2, 37.5), (31, 37.5), (8, 31.0), (16, 28.0), (30, 26.0)]
)
def test_the_quality_of_each_quantiser(quant: int, at_least_db: float) -> None:
    shown = scenery()
    decoded = through(shown, quant=quant)
    assert decoded.quant == quant
    assert psnr_db(luma(decoded.pixels), luma(shown)) > at_least_db


def test_a_coarser_quantiser_takes_fewer_bytes() -> None:
    sizes = [len(encode(scenery(), 1, quant=quant)) for quant in (1, 2, 4, 8, 16, 30)]
    assert sizes == sorted(sizes, reverse=True)
    assert len(set(sizes)) == len(sizes)
    assert len(encode(scenery(), 1, quant=31)) == sizes[1]


@pytest.mark.parametrize("bgr", [(0, 0, 0), (255, 255, 255), (255, 0, 0), (0, 255, 0), (0, 0, 255), (40, 130, 220)])
def test_plain_colours_stay(bgr: tuple[int, int, int]) -> None:
    shown = np.broadcast_to(np.array(bgr, np.uint8), (144, 176, 3))
    assert np.abs(through(shown).pixels.astype(int) - bgr).max() <= 3


@pytest.mark.parametrize(("quant", "at_least_db"), [(1, 45.0), (31, 41.0)])
def test_the_sharpest_edges_need_levels_beyond_127(quant: int, at_least_db: float) -> None:
    shown = np.zeros((144, 176, 3), np.uint8)
    shown.reshape(144, 22, 2, 4, 3)[:, :, 1] = 255
    assert psnr_db(luma(through(shown, quant=quant).pixels), luma(shown)) > at_least_db


@given(st.integers(0, 2**32 - 1), st.integers(0, 100), st.integers(1, 31))
def test_the_mean_of_any_block_is_within_half_a_step(number: int, seed: int, quant: int) -> None:
    shown = noise(88, 72, seed)
    shown[:] = shown[..., :1]
    decoded = UvlcDecoder().decode(encode(shown, number, quant=quant))
    assert decoded.number == number
    off = (luma(decoded.pixels) - luma(shown[:64, :80])).reshape(8, 8, 10, 8).mean(axis=(1, 3))
    quality = 2 if quant == 31 else quant
    assert np.abs(off).max() < (1 + quality) / 8 / 2 + 1.0  # and the rounding of samples and of chroma


def test_a_plain_picture_matches_the_format_bit_by_bit() -> None:
    plain = np.full((72, 88, 3), 128, np.uint8)
    assert encode(plain, 5) == packet(picture())  # by hand


def test_coefficients_match_the_format_bit_by_bit() -> None:
    # The first cosine across a block; level 20 of step 5, and slightly more so that truncation does not give 19.
    x = np.arange(8)
    shown = np.full((72, 88, 3), 128.0)
    shown[:8, :8] += (102 * np.sqrt(0.5) / 4 * np.cos((2 * x + 1) * np.pi / 16))[:, None]
    first = macroblock([GREY] * 6, {0: run(0) + level(20)})
    rows = [[first, *[macroblock([GREY] * 6)] * 4], *[[macroblock([GREY] * 6)] * 5] * 3]
    by_hand = UvlcDecoder().decode(packet(picture(rows, start=header())))
    decoded = through(np.rint(shown).astype(np.uint8))
    assert np.abs(decoded.pixels.astype(int) - by_hand.pixels).max() <= 3
    assert decoded.pixels[0, 0, 0] > decoded.pixels[0, 7, 0] + 30


# The encoder's arguments ----------------------------------------------------------------------------------------------


def test_a_picture_too_busy_for_a_datagram_is_coded_coarser() -> None:
    busy = encode(noise(640, 480), 1)
    assert len(busy) <= MAX_DATAGRAM
    assert UvlcDecoder().decode(busy).quant == 16
    limited = encode(scenery(), 1, max_bytes=3500)
    assert len(limited) <= 3500
    assert UvlcDecoder().decode(limited).quant > 2
    assert all(len(encode(noise(640, 480), 1, quant=quant)) <= MAX_DATAGRAM for quant in (1, 4, 31))


def test_a_picture_too_busy_for_the_coarsest_is_refused() -> None:
    with pytest.raises(UsageError, match=r"bytes even at the coarsest, more than 1000"):
        encode(noise(), 1, max_bytes=1000)


@pytest.mark.parametrize(
    ("shown", "number", "quant", "match"),
    [
        (np.zeros((240, 321, 3), np.uint8), 1, 31, "not support 321x240 images, only 88x72, 160x120, 176x144"),
        (np.zeros((240, 320), np.uint8), 1, 31, r"got uint8 \(240, 320\)"),
        (np.zeros((240, 320, 3), np.float32), 1, 31, "got float32"),
        (np.zeros((240, 320, 3), np.uint8), -1, 31, "-1 does not fit"),
        (np.zeros((240, 320, 3), np.uint8), 1 << 32, 31, "32 bits"),
        (np.zeros((240, 320, 3), np.uint8), 1, 0, "1 to 31, got 0"),
        (np.zeros((240, 320, 3), np.uint8), 1, 32, "1 to 31, got 32"),
    ],
)
def test_invalid_arguments(shown: Picture, number: int, quant: int, match: str) -> None:
    with pytest.raises(UsageError, match=match):
        encode(shown, number, quant=quant)
