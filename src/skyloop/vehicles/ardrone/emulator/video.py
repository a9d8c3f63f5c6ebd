"""The AR.Drones' cameras, clock, video formats and encoders. Pure.

An AR.Drone 1 encodes its video with UVLC. The encoder shares only the tables with the decoder,
:mod:`skyloop.vehicles.ardrone.wire.uvlc`, which documents the format and its sources. Like the Parrot SDK's encoder,
this one sends only intra pictures, codes every macroblock, truncates levels towards zero, continues the Developer
Guide's table of levels beyond its end at 127 by the table's own rule, and pads each picture with zeros to a whole word.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import UsageError
from skyloop.sim.camera import BOTTOM_CAMERA, FRONT_CAMERA
from skyloop.vehicles.ardrone.emulator.logic import VideoSettings
from skyloop.vehicles.ardrone.wire import uvlc
from skyloop.vehicles.ardrone.wire.configuration import VideoCodec
from skyloop.vehicles.ardrone.wire.pave import Codec, FrameType, build_header
from skyloop.vehicles.emulation.video import Encoder, Format, Piece

_NS_PER_US: Final = 1000
_NS_PER_MS: Final = 1_000_000
_US_PER_S: Final = 1_000_000
_SECOND_BITS: Final = 11  #: upper bits of navdata's time
_MICROSECOND_BITS: Final = 21  #: lower bits of navdata's time


@dataclass(frozen=True, slots=True)
class DroneClock:
    """Time since the drone was switched on. Arguments are times on this host's monotonic clock [ns]."""

    booted_ns: int

    def navdata_time(self, at_ns: int) -> int:
        """Return the time with seconds in the upper 11 bits and microseconds in the lower 21; it wraps after 2048 s."""
        s, us = divmod((at_ns - self.booted_ns) // _NS_PER_US, _US_PER_S)
        return s % (1 << _SECOND_BITS) << _MICROSECOND_BITS | us

    def milliseconds(self, at_ns: int) -> int:
        """Return the time in milliseconds, as in the video's headers."""
        return (at_ns - self.booted_ns) // _NS_PER_MS


_DIAGONAL_1_PX: Final = math.hypot(176, 144)
_FOCAL_1_PX: Final = BOTTOM_CAMERA.fx * _DIAGONAL_1_PX / math.hypot(BOTTOM_CAMERA.width, BOTTOM_CAMERA.height)

FRONT_2: Final = replace(
    FRONT_CAMERA,
    width=640,
    height=360,
    fx=561.999146,
    fy=561.782697,
    cx=307.433982,
    cy=190.144373,
    distortion=(-0.50758, 0.24911, 0.000579, 0.000996, 0.0),
)
#: Model of the transmitted image: the centre of the sensor's 320×240 image, enlarged to twice the size.
BOTTOM_2_SENT: Final = replace(
    BOTTOM_CAMERA, width=640, height=360, fx=686.994766, fy=688.195055, cx=329.323208, cy=159.323007
)
BOTTOM_2: Final = BOTTOM_2_SENT.scaled(0.5)
FRONT_1: Final = replace(FRONT_CAMERA, fps=15.0)
BOTTOM_1: Final = replace(
    BOTTOM_CAMERA, width=176, height=144, fps=15.0, fx=_FOCAL_1_PX, fy=_FOCAL_1_PX, cx=87.5, cy=71.5
)

CAMERAS: Final = {1: (FRONT_1, BOTTOM_1), 2: (FRONT_2, BOTTOM_2)}  #: front and bottom cameras by version


_PAVE: Final = {"h264": Codec.MPEG4_AVC, "mpeg4": Codec.MPEG4_VISUAL}  #: codec field of the frame headers
MP4_360P: Final = Format("mpeg4", 640, 360, 0)
H264_360P: Final = Format("h264", 640, 360, 1)
H264_720P: Final = Format("h264", 1280, 720, 2)
#: Format of the live video for each value of ``video:video_codec``.
FORMATS: Final = {
    VideoCodec.MP4_360P: MP4_360P,
    VideoCodec.H264_360P: H264_360P,
    VideoCodec.MP4_360P_H264_720P: MP4_360P,
    VideoCodec.H264_720P: H264_720P,
    VideoCodec.MP4_360P_SLRS: MP4_360P,
    VideoCodec.H264_360P_SLRS: H264_360P,
    VideoCodec.H264_720P_SLRS: H264_720P,
    VideoCodec.H264_AUTO_RESIZE: H264_360P,
    VideoCodec.MP4_360P_H264_360P: MP4_360P,
}


class PavePacker:
    """Packs an AR.Drone 2's images: a PaVE header, then the image encoded in H.264 or MPEG-4."""

    def __init__(self, clock: DroneClock, header_size: int, attitude: Callable[[], tuple[float, float, float]]) -> None:
        self._clock = clock
        self._header_size = header_size
        self._attitude = attitude
        self._made: tuple[tuple[Format, float, int], Encoder] | None = None
        self._number = 0
        self._position = 0

    def pack(self, picture: NDArray[np.uint8], settings: VideoSettings, captured_ns: int) -> Piece | None:
        """Encode an image and add its header; return None if the encoder produced no output."""
        form = FORMATS[settings.codec]
        wanted = form, settings.fps, settings.bitrate_kbps
        if self._made is None or self._made[0] != wanted:
            self._made = wanted, Encoder(*wanted)
        encoded = self._made[1].encode(picture)
        if encoded is None:
            return None
        self._number += 1
        header = build_header(
            payload_size=len(encoded.payload),
            type=FrameType.IDR if encoded.key else FrameType.P,
            number=self._number,
            timestamp_ms=self._clock.milliseconds(captured_ns),
            width=form.width,
            height=form.height,
            codec=_PAVE[form.codec],
            stream_id=form.stream_id,
            position=self._position,
            sps_size=encoded.sps_size,
            pps_size=encoded.pps_size,
            header_size=self._header_size,
            attitude_rad=self._attitude(),
        )
        self._position += len(encoded.payload) - encoded.sps_size - encoded.pps_size
        return Piece(header + encoded.payload, encoded.key)


class UvlcPacker:
    """Packs an AR.Drone 1's images: one intra picture per datagram."""

    def __init__(self) -> None:
        self._number = 0

    def pack(self, picture: NDArray[np.uint8], _settings: VideoSettings, _captured_ns: int) -> Piece | None:
        self._number += 1
        return Piece(encode(picture, self._number & 0xFFFFFFFF), starts=True)


MAX_DATAGRAM: Final = 65_507  #: maximum payload of a UDP datagram over IPv4 in bytes
_COARSER: Final = (4, 8, 16, uvlc.COARSEST_QUANT)  # quantisers to try in turn if an image needs too many bytes
_END_OF_BLOCK: Final = 0b101, 3  # run 0, then the code reserved for the end of a block
_CODES: Final = {size: code for code, size in uvlc.SIZES.items()}

# Conversion of BGR to YCbCr: BT.601, full range.
_LUMA: Final = np.array([0.114, 0.587, 0.299], np.float32)
_CB: Final = 0.5 / (1 - 0.114)
_CR: Final = 0.5 / (1 - 0.299)

Ints = NDArray[np.int64]


def encode(
    picture: NDArray[np.uint8], number: int, *, quant: int = uvlc.TABLE_QUANT, max_bytes: int = MAX_DATAGRAM
) -> bytes:
    """Encode an image (BGR, uint8, shape (height, width, 3), with one of the format's sizes) as one datagram.

    Macroblocks that would be partly outside the image are omitted, as the format requires. ``quant`` is 1 (finest) to
    30, or 31, which is like 2 and is the value that real drones use; an image that would need more than ``max_bytes``
    is quantised more coarsely. Raises :class:`UsageError` if an argument is out of range, or if the image never fits.
    """
    _check(picture, number, quant)
    height, width = picture.shape[:2]
    coefficients = _coefficients(picture)
    fineness = uvlc.TABLE_QUALITY if quant == uvlc.TABLE_QUANT else quant
    for q in (quant, *(coarser for coarser in _COARSER if coarser > fineness)):
        packet = _pack(_quantised(coefficients, q), _CODES[width, height], q, number)
        if len(packet) <= max_bytes:
            return packet
    raise UsageError(f"a {width}x{height} image takes {len(packet)} bytes even at the coarsest, more than {max_bytes}")


def _check(picture: NDArray[np.uint8], number: int, quant: int) -> None:
    if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3:
        raise UsageError(f"an image must be uint8 (height, width, 3), got {picture.dtype} {picture.shape}")
    if picture.shape[1::-1] not in _CODES:
        sizes = ", ".join(f"{w}x{h}" for w, h in sorted(_CODES))
        raise UsageError(f"UVLC does not support {picture.shape[1]}x{picture.shape[0]} images, only {sizes}")
    if not 0 <= number < 1 << uvlc.NUMBER_BITS:
        raise UsageError(f"picture number {number} does not fit in {uvlc.NUMBER_BITS} bits")
    if not uvlc.FINEST_QUANT <= quant <= uvlc.TABLE_QUANT:
        raise UsageError(f"quantiser must be from {uvlc.FINEST_QUANT} to {uvlc.TABLE_QUANT}, got {quant}")


def _coefficients(picture: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return an image's transformed macroblocks in stream order. Shape (groups, columns, 6, 64)."""
    groups, columns = picture.shape[0] // uvlc.MACROBLOCK, picture.shape[1] // uvlc.MACROBLOCK
    pixels = picture[: groups * uvlc.MACROBLOCK, : columns * uvlc.MACROBLOCK].astype(np.float32)
    luma = pixels @ _LUMA
    quads = pixels.reshape(groups * uvlc.SIDE, 2, columns * uvlc.SIDE, 2, 3)
    blue, green, red = np.moveaxis(quads.mean(axis=(1, 3)), -1, 0)
    small = _LUMA[0] * blue + _LUMA[1] * green + _LUMA[2] * red
    samples = np.empty((groups, columns, uvlc.BLOCKS, uvlc.SIDE, uvlc.SIDE), np.float32)
    samples[:, :, :4] = (
        luma.reshape(groups, 2, uvlc.SIDE, columns, 2, uvlc.SIDE)
        .transpose(0, 3, 1, 4, 2, 5)
        .reshape(groups, columns, 4, uvlc.SIDE, uvlc.SIDE)
    )
    for k, chroma in enumerate(((blue - small) * _CB, (red - small) * _CR), start=4):
        samples[:, :, k] = (chroma + 128).reshape(groups, uvlc.SIDE, columns, uvlc.SIDE).transpose(0, 2, 1, 3)
    flat = samples.reshape(-1, uvlc.COEFFICIENTS) @ uvlc.INVERSE_TRANSFORM.T
    return flat.reshape(groups, columns, uvlc.BLOCKS, uvlc.COEFFICIENTS)


def _quantised(coefficients: NDArray[np.float32], quant: int) -> Ints:
    levels: Ints = (coefficients / uvlc.STEPS[quant].astype(np.float32)).astype(np.int64)
    # The mean is rounded because truncation would darken the picture. As in the Parrot SDK, the mean is never 0.
    mean = np.rint(coefficients[..., 0] / uvlc.STEPS[quant][0])
    levels[..., 0] = np.clip(mean, 1, (1 << uvlc.DC_BITS) - 1)
    return levels


def _pack(levels: Ints, size_code: tuple[int, int], quant: int, number: int) -> bytes:
    """Return the packet for quantised macroblocks, shape (groups, columns, 6, 64)."""
    start = [uvlc.UVLC_START, *size_code, uvlc.PictureType.INTRA, quant, number]
    widths = [
        uvlc.START_CODE_BITS,
        uvlc.FORMAT_BITS,
        uvlc.RESOLUTION_BITS,
        uvlc.TYPE_BITS,
        uvlc.QUANT_BITS,
        uvlc.NUMBER_BITS,
    ]
    bits = [_bits(np.array(start), np.array(widths))]
    for group, macroblocks in enumerate(levels):
        if group:
            bits += [
                _filling(bits, 8),
                _bits(np.array([uvlc.UVLC_START + group, quant]), np.array([uvlc.START_CODE_BITS, uvlc.QUANT_BITS])),
            ]
        bits.append(_bits(*_group_codes(macroblocks)))
    bits += [_filling(bits, 8), _bits(np.array([uvlc.END_OF_PICTURE]), np.array([uvlc.START_CODE_BITS]))]
    bits.append(_filling(bits, 32))
    return np.packbits(np.concatenate(bits)).view(">u4").astype("<u4").tobytes()


def _filling(bits: list[NDArray[np.uint8]], size: int) -> NDArray[np.uint8]:
    """Return the zero bits needed to reach the next multiple of ``size`` bits."""
    return np.zeros(-sum(map(len, bits)) % size, np.uint8)


def _group_codes(levels: Ints) -> tuple[Ints, Ints]:
    """Return the consecutive codes for a group's macroblocks (columns, 6, 64), and the width of each in bits."""
    blocks = levels.reshape(-1, uvlc.COEFFICIENTS)
    values, widths, block_of_pair = _pair_codes(blocks)
    pairs = np.bincount(block_of_pair, minlength=len(blocks))
    described = 0x80 | ((pairs > 0).reshape(-1, uvlc.BLOCKS) << np.arange(uvlc.BLOCKS)).sum(axis=1)
    # A block's mean comes before its pairs and, in the first block, after the macroblock's description.
    is_first = np.arange(len(blocks)) % uvlc.BLOCKS == 0
    ends = np.cumsum(1 + is_first + pairs)
    means = ends - pairs - 1
    descriptions = means[is_first] - 1
    is_pair = np.ones(ends[-1], bool)
    is_pair[means] = is_pair[descriptions] = False
    all_values, all_widths = np.empty((2, ends[-1]), np.int64)
    all_values[descriptions], all_widths[descriptions] = described, 1 + 8  # the 0 bit for "coded", then 8 bits
    all_values[means], all_widths[means] = blocks[:, 0], uvlc.DC_BITS
    all_values[is_pair], all_widths[is_pair] = values, widths
    return all_values, all_widths


def _pair_codes(blocks: Ints) -> tuple[Ints, Ints, Ints]:
    """Return a code for each nonzero coefficient, with its width in bits and its block's index.

    A code includes the run of zeros before its coefficient, and the last code in a block includes the end of the block.
    """
    block, place = np.nonzero(blocks[:, 1:])
    level = blocks[block, place + 1]
    starts = np.diff(block, prepend=-1) != 0
    ends = np.diff(block, append=-1) != 0
    before = np.where(starts, -1, np.roll(place, 1))
    run_value, run_width = _prefixed(place - before - 1)
    level_value, level_width = _prefixed(np.abs(level))
    # Unlike a run of 1, a level of 1 has no zero before its one bit.
    level_width -= np.abs(level) == 1
    value = (run_value << level_width | level_value) << 1 | (level < 0)
    width = run_width + level_width + 1
    end, end_width = _END_OF_BLOCK
    return np.where(ends, value << end_width | end, value), width + end_width * ends, block


def _prefixed(number: Ints) -> tuple[Ints, Ints]:
    """Return the numbers' codes and each code's width in bits.

    A number is coded as one zero for each of its bits, then those bits; 0 is coded as a one.
    """
    size = np.frexp(number.astype(np.float64))[1].astype(np.int64)
    tail = np.maximum(size - 1, 0)
    return np.where(number > 0, number, 1), size + 1 + tail


def _bits(values: Ints, widths: Ints) -> NDArray[np.uint8]:
    """Return the bits of consecutive numbers, each beginning with its most significant bit."""
    ends = np.cumsum(widths)
    down = np.repeat(ends, widths) - np.arange(ends[-1]) - 1
    return (np.repeat(values, widths) >> down & 1).astype(np.uint8)
