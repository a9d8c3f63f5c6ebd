"""UVLC pictures written bit by bit, each with one feature of the format."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from skyloop.errors import DecodeError
from skyloop.vehicles.ardrone.wire.uvlc import MAX_PACKET, SIZES, PictureType, UvlcDecoder, UvlcPicture, is_p264
from tests.vehicles.ardrone.wire.uvlc_bits import (
    END,
    GREY,
    NOT_CODED,
    P264,
    PLAIN,
    aligned,
    grey,
    group,
    header,
    level,
    macroblock,
    packet,
    picture,
    run,
    with_first,
)

# A real drone's datagram in the README of djtrance/ardrone1_video_decoder, in the order of the stream.
REAL_START = bytes.fromhex("00008243 e000033c 6bf2dda9")


def decode(bits: str) -> UvlcPicture:
    return UvlcDecoder().decode(packet(bits))


def luma(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the luma of a picture without colour, where all channels are equal."""
    assert (pixels[..., 0] == pixels[..., 2]).all()
    assert (pixels[..., 0] == pixels[..., 1]).all()
    return pixels[..., 0]


def zigzag() -> list[tuple[int, int]]:
    """Return (row, column) in the order of the stream, walked diagonal by diagonal."""
    cells = []
    for diagonal in range(15):
        rows = range(max(0, diagonal - 7), min(7, diagonal) + 1)
        cells += [(row, diagonal - row) for row in (rows if diagonal % 2 else reversed(rows))]
    return cells


def block_of(coefficients: dict[int, int], quality: int = 2, mean: int = GREY) -> NDArray[np.uint8]:
    """Return the samples of a block from its levels by index, by the definition of the inverse cosine transform."""
    samples = np.zeros((8, 8))
    for place, value in {0: mean, **coefficients}.items():
        i, j = zigzag()[place]
        scale = (math.sqrt(0.5) if i == 0 else 1.0) * (math.sqrt(0.5) if j == 0 else 1.0) / 4
        size = value * (1 + quality * (1 + i + j))
        for y in range(8):
            for x in range(8):
                wave = math.cos((2 * y + 1) * i * math.pi / 16) * math.cos((2 * x + 1) * j * math.pi / 16)
                samples[y, x] += scale * size * wave
    return np.clip(np.rint(samples), 0, 255).astype(np.uint8)


def first_block(pairs: str, quality: int = 2, mean: int = GREY) -> NDArray[np.uint8]:
    """Return the samples of the first block of a picture that contains these pairs."""
    quant = 31 if quality == 2 else quality
    means = [mean] + [round(1024 / (1 + quality))] * 5
    groups = [[macroblock(means, {0: pairs}), *[grey(quant)] * 4], *[[PLAIN] * 5] * 3]
    decoded = decode(picture(groups, quants=(quant, 31, 31, 31)))
    return luma(decoded.pixels[:8, :8])


# Header and groups ----------------------------------------------------------------------------------------------------


def test_the_header_is_the_one_of_a_real_drone() -> None:
    bits = "".join(f"{byte:08b}" for byte in REAL_START)
    start = header(form=2, resolution=2, quant=31, number=6627)
    assert bits.startswith(start)
    # The rest: a coded macroblock whose blocks all have more than their mean, and no quantiser change.
    assert bits[len(start) :].startswith("0" + "10111111")
    decoded = decode(large_picture(2, 2, start=start))
    assert (decoded.width, decoded.height, decoded.number) == (320, 240, 6627)
    assert (decoded.type, decoded.quant) == (PictureType.INTRA, 31)


def large_picture(form: int, resolution: int, start: str) -> str:
    base = {1: (88, 72), 2: (160, 120)}[form]
    columns, groups = (side << (resolution - 1) >> 4 for side in base)
    bits = start + PLAIN * columns
    for number in range(1, groups):
        bits = aligned(bits) + group(number) + PLAIN * columns
    return aligned(bits) + END


@pytest.mark.parametrize(
    ("form", "resolution", "size"),
    [
        (1, 1, (80, 64)),
        (1, 2, (176, 144)),
        (1, 3, (352, 288)),
        (2, 1, (160, 112)),
        (2, 2, (320, 240)),
        (2, 3, (640, 480)),
    ],
)
def test_every_size_whose_groups_can_be_numbered(form: int, resolution: int, size: tuple[int, int]) -> None:
    decoded = decode(large_picture(form, resolution, header(form=form, resolution=resolution)))
    assert (decoded.width, decoded.height) == size
    assert decoded.pixels.shape == (size[1], size[0], 3)
    assert decoded.pixels.dtype == np.uint8
    assert decoded.pixels.flags.c_contiguous
    assert (decoded.pixels == 128).all()


def test_there_are_no_other_sizes() -> None:
    for form in range(4):
        for resolution in range(8):
            if (form, resolution) not in SIZES:
                with pytest.raises(DecodeError, match=f"format {form} and resolution {resolution}"):
                    decode(picture(start=header(form=form, resolution=resolution)))
    assert len(SIZES) == 6


@pytest.mark.parametrize("kind", [2, 3, 7])
def test_an_unknown_type_is_refused(kind: int) -> None:
    with pytest.raises(DecodeError, match=f"type {kind}"):
        decode(picture(start=header(kind=kind)))


def test_the_number_has_32_bits() -> None:
    assert decode(picture(start=header(number=0xFFFFFFFF))).number == 0xFFFFFFFF


def test_any_bytes_like_object_is_accepted() -> None:
    data = packet(picture())
    for given in (data, bytearray(data), memoryview(data)):
        assert (UvlcDecoder().decode(given).pixels == 128).all()


def test_groups_may_also_start_at_whole_words() -> None:
    assert (decode(picture(size=32)).pixels == 128).all()


def test_groups_must_be_in_order() -> None:
    second = aligned(header() + PLAIN * 5) + group(2) + PLAIN * 5
    with pytest.raises(DecodeError, match=r"0x0*21, got 0x0*22"):
        decode(aligned(second) + END)


def test_padding_before_a_group_must_be_zeros() -> None:
    start = header() + PLAIN * 5
    rest = picture()[len(aligned(start)) :]
    assert len(start) % 8
    assert (decode(aligned(start) + rest).pixels == 128).all()
    with pytest.raises(DecodeError, match="expected start code"):
        decode(start + "1" * (-len(start) % 8) + rest)


def test_each_group_has_its_own_quantiser() -> None:
    steps = {31: 3, 1: 2, 5: 6, 30: 31}
    groups = [[macroblock([60] * 4 + [round(1024 / step)] * 2)] * 5 for step in steps.values()]
    pixels = decode(picture(groups, quants=tuple(steps))).pixels.reshape(4, 16, 80, 3)
    for shown, step in zip(pixels, steps.values(), strict=True):
        assert np.abs(shown.astype(int) - round(60 * step / 8)).max() <= 1


@pytest.mark.parametrize("quants", [(0, 31, 31, 31), (31, 31, 0, 31)])
def test_there_is_no_quantiser_0(quants: tuple[int, ...]) -> None:
    with pytest.raises(DecodeError, match="1 to 31, got 0"):
        decode(picture(quants=quants))


# Macroblocks ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("mean", "grey"), [(0, 0), (1, 0), (8, 3), (341, 128), (680, 255)])
def test_a_mean_is_in_eighths_of_steps_of_3_and_has_no_sign(mean: int, grey: int) -> None:
    decoded = decode(picture([[macroblock([mean] * 4 + [GREY] * 2)] * 5] * 4))
    assert (luma(decoded.pixels) == grey).all()


def test_the_four_blocks_of_luma_are_in_reading_order() -> None:
    decoded = decode(with_first(macroblock([80, 160, 240, 320, GREY, GREY])))
    corner = luma(decoded.pixels)[:16, :16].reshape(2, 8, 2, 8)
    assert (corner == np.array([[30, 60], [90, 120]])[:, None, :, None]).all()
    assert (decoded.pixels[:, 16:] == 128).all()
    assert (decoded.pixels[16:] == 128).all()


@pytest.mark.parametrize(
    ("y", "cb", "cr", "bgr"),
    # Steps of 3/8: 76 84 255, 150 44 21, 29 255 107 are red, green and blue in full-range BT.601.
    [(203, 227, 680, (0, 0, 254)), (400, 116, 57, (0, 255, 0)), (77, 680, 286, (254, 0, 0))],
)
def test_colours_are_of_the_full_range(y: int, cb: int, cr: int, bgr: tuple[int, int, int]) -> None:
    decoded = decode(picture([[macroblock([y] * 4 + [cb, cr])] * 5] * 4))
    assert np.abs(decoded.pixels.astype(int) - bgr).max() <= 2


def test_chroma_belongs_to_two_by_two_pixels() -> None:
    pairs = run(0) + level(20)  # falls from left to right
    decoded = decode(with_first(macroblock([GREY] * 6, {5: pairs})))
    red = decoded.pixels[:16, :16, 2].astype(float)
    cr = block_of({1: 20}).astype(float)
    expected = np.clip(np.rint(128 + 1.402 * (cr - 128)), 0, 255).repeat(2, axis=0).repeat(2, axis=1)
    assert np.abs(red - expected).max() <= 1


def test_a_macroblock_that_is_not_coded_is_all_zero() -> None:
    decoded = decode(picture([[NOT_CODED, *[PLAIN] * 4], *[[PLAIN] * 5] * 3]))
    assert (decoded.pixels[:16, :16] == (0, 136, 0)).all()  # zeros mean no light and the least chroma
    assert (decoded.pixels[:, 16:] == 128).all()


def test_a_description_has_its_last_bit_set() -> None:
    with pytest.raises(DecodeError, match="macroblock 0 of group 0: its description is 0x3f"):
        decode(with_first("0" + "00111111" + PLAIN))


def test_the_message_names_the_place() -> None:
    with pytest.raises(DecodeError, match="macroblock 3 of group 2: its description"):
        decode(picture([[PLAIN] * 5] * 2 + [[PLAIN] * 3 + ["0" * 9, PLAIN], [PLAIN] * 5]))


@pytest.mark.parametrize(("change", "difference"), [("00", -1), ("01", -2), ("10", 1), ("11", 2)])
def test_a_quantiser_change_counts_to_the_end_of_its_group(change: str, difference: int) -> None:
    def shade(quant: int) -> int:
        return round(160 * (1 + quant) / 8)

    def flat(quant: int, dquant: str = "") -> str:
        return macroblock([160] * 4 + [round(1024 / (1 + quant))] * 2, dquant=dquant)

    after = 4 + difference
    groups = [[flat(4), flat(after, change), flat(after), flat(after), flat(after)], *[[flat(4)] * 5] * 3]
    pixels = decode(picture(groups, quants=(4,) * 4)).pixels
    assert np.abs(pixels[:16, :16].astype(int) - shade(4)).max() <= 1
    assert np.abs(pixels[:16, 16:].astype(int) - shade(after)).max() <= 1
    assert np.abs(pixels[16:].astype(int) - shade(4)).max() <= 1


def test_a_quantiser_change_of_the_fixed_table_is_read_and_ignored() -> None:
    assert (decode(with_first(macroblock([GREY] * 6, dquant="01"))).pixels == 128).all()


@pytest.mark.parametrize(("quant", "change"), [(1, "00"), (2, "01"), (30, "10"), (29, "11")])
def test_a_quantiser_stays_in_its_range(quant: int, change: str) -> None:
    with pytest.raises(DecodeError, match="its quantiser would be"):
        decode(
            picture(
                [[macroblock([1] * 6, dquant=change), *[PLAIN] * 4], *[[PLAIN] * 5] * 3], quants=(quant, 31, 31, 31)
            )
        )


# Coefficients ---------------------------------------------------------------------------------------------------------


def test_the_worked_example_of_the_developer_guide() -> None:
    # −26 (the mean, unsigned in real pictures), −3, 0, 0, 0, 0, 7, −5: the guide's bits for everything after the mean.
    bits = "1" + "00111" + "000100" + "0001110" + "1" + "0001011"
    assert bits == run(0) + level(-3) + run(4) + level(7) + run(0) + level(-5)
    assert (first_block(bits) == block_of({1: -3, 6: 7, 7: -5})).all()


@pytest.mark.parametrize("place", range(1, 64))
def test_each_coefficient_has_its_place_and_step(place: int) -> None:
    assert np.abs(first_block(run(place - 1) + level(9)).astype(int) - block_of({place: 9})).max() <= 1


@pytest.mark.parametrize("value", [1, -1, 2, -3, 4, -7, 8, 15, -16, 31, 32, -63, 64, -127, 128, 180])
def test_each_level(value: int) -> None:
    assert np.abs(first_block(run(0) + level(value)).astype(int) - block_of({1: value})).max() <= 1


@pytest.mark.parametrize(("zeros", "value"), [(0, 180), (15, -33), (31, 20), (40, -16), (62, 33), (62, -20)])
def test_pairs_longer_than_a_window_between_short_ones(zeros: int, value: int) -> None:
    long = run(zeros) + level(value)
    assert len(long) >= 16
    if zeros:
        wanted = {1: 1, zeros + 2: value} if zeros < 62 else {63: value}
        bits = (run(0) + level(1) if zeros < 62 else "") + long
    else:
        wanted, bits = {1: value, 2: -1, 5: 1}, long + run(0) + level(-1) + run(2) + level(1)
    assert np.abs(first_block(bits).astype(int) - block_of(wanted)).max() <= 1


def test_a_block_may_have_all_its_coefficients() -> None:
    values = {place: (-1) ** place * (1 + place % 3) for place in range(1, 64)}
    bits = "".join(run(0) + level(value) for value in values.values())
    assert np.abs(first_block(bits).astype(int) - block_of(values)).max() <= 1


def test_a_block_marked_as_having_coefficients_may_have_none() -> None:
    assert (first_block("") == 128).all()


@pytest.mark.parametrize("quality", [1, 2, 7, 30])
def test_steps_grow_with_the_quantiser_and_the_frequency(quality: int) -> None:
    mean = round(1024 / (1 + quality))
    bits = run(0) + level(3) + run(2) + level(-2)
    expected = block_of({1: 3, 4: -2}, quality, mean)
    assert np.abs(first_block(bits, quality, mean).astype(int) - expected).max() <= 1


@pytest.mark.parametrize(
    ("pairs", "match"),
    [
        (run(62) + level(1) + run(0) + level(1), "a coefficient 64, but the last is 63"),
        (run(40) + level(1) + run(40) + level(1), "a coefficient 82"),
        (run(64) + level(1), "7 zeros cannot begin a run's code"),
        ("0" * 16, "zeros cannot begin a run's code"),
        (run(3) + "01", "1 zeros cannot begin a level's code after a run of 3"),
        (run(0) + "0" * 12 + "1" * 13, "12 zeros cannot begin a level's code"),
        (run(0) + level(206), "exceeds the range of a valid picture"),
        (run(13) + level(-115), "exceeds the range of a valid picture"),
    ],
)
def test_impossible_coefficients(pairs: str, match: str) -> None:
    with pytest.raises(DecodeError, match=match):
        first_block(pairs)


def test_an_impossible_mean() -> None:
    with pytest.raises(DecodeError, match="exceeds the range of a valid picture"):
        decode(with_first(macroblock([GREY] * 5 + [685])))


# The end --------------------------------------------------------------------------------------------------------------


def test_zeros_may_fill_the_last_word() -> None:
    bits = aligned(picture(), 32)
    assert (decode(bits + "0" * 32).pixels == 128).all()
    for tail in ("0" * 64, "0" * 31 + "1", "1" * 32):
        with pytest.raises(DecodeError, match="follow the picture's end"):
            decode(bits + tail)


def test_a_picture_ends_after_its_last_group() -> None:
    bits = picture()[: -len(END)]
    with pytest.raises(DecodeError, match=r"expected start code 0x0*3f"):
        decode(bits)
    with pytest.raises(DecodeError, match=r"0x0*3f, got 0x0*24"):
        decode(bits + group(4) + PLAIN * 5 + END)
    with pytest.raises(DecodeError, match="macroblock 4 of group 0"):
        decode(aligned(header() + PLAIN * 4) + END)


@pytest.mark.parametrize("size", [0, 1, 3, 5, 191])
def test_a_packet_consists_of_whole_words(size: int) -> None:
    with pytest.raises(DecodeError, match=f"{size} bytes are not a whole number of 4-byte words"):
        UvlcDecoder().decode(packet(picture())[:size])


def test_a_packet_is_a_datagram() -> None:
    with pytest.raises(DecodeError, match="too many for a picture"):
        UvlcDecoder().decode(bytes(MAX_PACKET + 1))


@pytest.mark.parametrize("words", [1, 2])
def test_half_a_header_is_refused(words: int) -> None:
    with pytest.raises(DecodeError, match="ends in the middle"):
        UvlcDecoder().decode(packet(picture())[: 4 * words])


# Other codecs ---------------------------------------------------------------------------------------------------------


def test_p264_is_recognised_and_refused() -> None:
    data = packet(header(start=P264))
    assert is_p264(data)
    assert not is_p264(packet(picture()))
    assert not is_p264(b"")
    with pytest.raises(DecodeError, match=r"P264.*video:video_codec"):
        UvlcDecoder().decode(data)


def test_anything_else_is_refused() -> None:
    with pytest.raises(DecodeError, match="must begin with"):
        UvlcDecoder().decode(b"PaVE" + bytes(60))


# P pictures -----------------------------------------------------------------------------------------------------------


def changes(number: int, form: int = 1, resolution: int = 1) -> str:
    """Return a P picture that codes its first macroblock, in black."""
    start = header(kind=1, number=number, form=form, resolution=resolution)
    return picture([[macroblock([0] * 4 + [GREY] * 2), *[NOT_CODED] * 4], *[[NOT_CODED] * 5] * 3], start=start)


def test_uncoded_macroblocks_of_a_p_picture_stay() -> None:
    decoder = UvlcDecoder()
    before = decoder.decode(packet(with_first(macroblock([100, 200, 300, 400, GREY, GREY]))))
    kept = before.pixels.copy()
    before.pixels[:] = 7  # owned by the user by now
    after = decoder.decode(packet(changes(6)))
    assert (after.type, after.number) == (PictureType.INTER, 6)
    assert (after.pixels[:16, :16] == 0).all()
    assert (after.pixels[:, 16:] == kept[:, 16:]).all()
    assert (after.pixels[16:] == kept[16:]).all()
    again = decoder.decode(packet(changes(7)))
    assert (again.pixels == after.pixels).all()


def test_a_p_picture_may_follow_the_highest_number() -> None:
    decoder = UvlcDecoder()
    decoder.decode(packet(picture(start=header(number=0xFFFFFFFF))))
    assert decoder.decode(packet(changes(0))).number == 0


@pytest.mark.parametrize("number", [4, 5, 7, 0x80000005])
def test_a_p_picture_needs_its_predecessor(number: int) -> None:
    decoder = UvlcDecoder()
    decoder.decode(packet(picture()))
    with pytest.raises(DecodeError, match="but 5 was the last"):
        decoder.decode(packet(changes(number)))
    assert decoder.decode(packet(changes(6))).number == 6


def test_a_stream_cannot_start_with_a_p_picture() -> None:
    with pytest.raises(DecodeError, match="updates a picture that never arrived"):
        decode(changes(6))


def test_a_p_picture_has_the_size_of_its_predecessor() -> None:
    decoder = UvlcDecoder()
    decoder.decode(packet(large_picture(2, 1, header(form=2, resolution=1))))
    with pytest.raises(DecodeError, match="of 80x64 updates one of 160x112"):
        decoder.decode(packet(changes(6)))


def test_a_damaged_picture_leaves_the_decoder_as_it_was() -> None:
    decoder = UvlcDecoder()
    decoder.decode(packet(picture()))
    with pytest.raises(DecodeError):
        decoder.decode(packet(changes(6))[:-8])
    assert decoder.decode(packet(changes(6))).number == 6
