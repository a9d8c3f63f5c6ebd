"""UVLC, the video codec of the Parrot AR.Drone 1: turns one datagram into one image. Pure; NumPy only.

The drone sends one picture per datagram from its UDP port 5555, without an additional header. A picture consists of
16-line groups of 16x16 macroblocks (4:2:0), made of 8x8 cosine-transformed blocks. Each block is a 10-bit mean, then
run and level codes (see below). No recording of this video is public; the sources are:

* the **Developer Guide** for the AR.Drone SDK 1.7, and **uvlc.txt** in the Parrot SDK 1.8 and 2.0: layout and codes;
* the **Parrot SDK** itself (ARDroneLib, VLIB; its licence forbids copying code), whose encoder ran in the drone;
* **venthur/python-ardrone** (``arvideo.py``) and **djtrance/ardrone1_video_decoder**, whose authors viewed real drones'
  pictures with them: the order of the coefficients, and the steps for quantiser 31; the latter also prints the first 12
  bytes of a picture.

Where the sources disagree, this module does what is known to work with real drones:

* If a macroblock's first bit is set, it is *not coded* (Parrot SDK, both decoders; uvlc.txt says the opposite).
* Coefficients are level · (1 + q · (1 + i + j)), where q is the quantiser, or 2 if the quantiser is 31 ("the old
  table", Parrot SDK since 1.8). For quantiser 31, the only one seen from real drones, this equals python-ardrone's
  fixed table 3, 5, 7 …. No picture was found that needs the H.263-like rule mentioned in older comments in the SDK.
* The mean is unsigned (Parrot SDK, python-ardrone). The guide's example is negative, but then white would not fit.
* Groups start on a byte (uvlc.txt, Parrot SDK, python-ardrone) or on a word (djtrance): both are accepted.
* Luma and chroma use the full range of BT.601 (as in the Parrot SDK's conversion; python-ardrone used 16 to 235).
* A quantiser change (uvlc.txt: −1, −2, +1, +2; the SDK's encoder and decoder disagree) applies until the end of the
  group; at 31 it is read and ignored, as in python-ardrone.
* Macroblocks that would be partly outside the picture are not coded (Parrot SDK): of an 88x72 picture, 80x64 pixels are
  coded, and of a 160x120 picture, 160x112 pixels.
* P pictures have never been seen. Their coded macroblocks are complete in themselves (Parrot SDK). As in H.263, from
  which the guide derives the codec, uncoded macroblocks repeat the previous picture, whose number must be one lower.

There is no checksum, so a damaged packet can pass for a picture. The decoder checks everything that the format allows.

A coefficient is a *pair*: the run of zeros before it, and its level. Each code is a number of zeros, a one, and one bit
fewer than there were zeros; a level ends with its sign (Developer Guide, "Specific block entropy-encoding"):

======== ===== ======================  ======== ================ =========================
run      code                          level    code
======== ===== ======================  ======== ================ =========================
0        1                             ±1       1 s
1        01                            end      01
2 … 3    001 x                         ±2 … 3   001 x s
4 … 7    0001 xx                       ±4 … 7   0001 xx s
…        …                             …        …
======== ===== ======================  ======== ================ =========================

The end of a block is coded as a level, after a run of 0.

Reading bit by bit would be far too slow in Python. Instead, for each window of 16 bits, a table lists the whole pairs
at its beginning and the distance to the next window. The reader only steps from window to window, recording its track,
which NumPy turns into coefficients.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import DecodeError

# Constants and tables, for the emulator's encoder as well ------------------------------------------------------------

START_CODE_BITS: Final = 22  #: width of a start code
UVLC_START: Final = 0x20  #: start code of a picture and of its group 0; add k for group k
P264_START: Final = 0x40  #: start code of the drone's other codec
END_OF_PICTURE: Final = 0x3F  #: code that marks the end where group 31 would start
MAX_GROUPS: Final = 31  #: groups that start codes can number

# Widths of a header's fields, and of a block's mean.
FORMAT_BITS: Final = 2
RESOLUTION_BITS: Final = 3
TYPE_BITS: Final = 3
QUANT_BITS: Final = 5
NUMBER_BITS: Final = 32
DC_BITS: Final = 10

MACROBLOCK: Final = 16  #: side of a macroblock, and height of a group [px]
BLOCKS: Final = 6  #: blocks per macroblock: four for luma in reading order, then Cb and Cr at half resolution
SIDE: Final = 8  #: side of a block [px]
COEFFICIENTS: Final = SIDE * SIDE

FINEST_QUANT: Final = 1  #: lowest quantiser
COARSEST_QUANT: Final = 30  #: highest quantiser
TABLE_QUANT: Final = 31  #: not a step size but a mode that uses the steps of ``TABLE_QUALITY``; real drones send it
TABLE_QUALITY: Final = 2  #: quantiser with the steps of ``TABLE_QUANT``
DQUANT: Final = (-1, -2, 1, 2)  #: quantiser changes, indexed by their two-bit code

MAX_RUN_ZEROS: Final = 6  #: number of leading zeros in the longest code for a run


class PictureType(IntEnum):
    """Values of the header's picture type."""

    INTRA = 0  #: can be decoded without any other picture
    INTER = 1  #: uncoded macroblocks repeat the previous picture


def _sizes() -> dict[tuple[int, int], tuple[int, int]]:
    base = {1: (88, 72), 2: (160, 120)}
    sizes = {(f, r): (w << r - 1, h << r - 1) for f, (w, h) in base.items() for r in range(1, 6)}
    return {code: size for code, size in sizes.items() if size[1] // MACROBLOCK <= MAX_GROUPS}


#: (width, height) [px] by the header's (format, resolution). The header can specify larger pictures, but start codes
#: cannot number their groups.
SIZES: Final = _sizes()


def _zigzag() -> NDArray[np.intp]:
    cells = [(row, column) for row in range(SIDE) for column in range(SIDE)]
    cells.sort(key=lambda cell: (sum(cell), cell[sum(cell) % 2 == 0]))
    return np.array([row * SIDE + column for row, column in cells])


#: Position in the block, row by row, of the stream's k-th coefficient; rows are vertical frequencies. Shape (64,).
ZIGZAG: Final = _zigzag()


def _steps() -> NDArray[np.int32]:
    quality = np.arange(TABLE_QUANT + 1)
    quality[TABLE_QUANT] = TABLE_QUALITY
    return (1 + quality[:, None] * (1 + ZIGZAG // SIDE + ZIGZAG % SIDE)).astype(np.int32)


#: Step size of each coefficient, in stream order, for each quantiser. Shape (32, 64).
STEPS: Final = _steps()


def _inverse_transform() -> NDArray[np.float32]:
    frequency, place = np.arange(SIDE)[:, None], np.arange(SIDE)[None, :]
    basis = np.cos((2 * place + 1) * frequency * np.pi / (2 * SIDE)) / 2
    basis[0] /= np.sqrt(2)
    return np.kron(basis, basis)[ZIGZAG].astype(np.float32)


#: Multiplying coefficients (…, 64) in stream order by this matrix gives samples (…, 64) row by row; its transpose is
#: its inverse. Orthonormal: the first coefficient is 8 times the mean.
INVERSE_TRANSFORM: Final = _inverse_transform()


# Run and level codes -------------------------------------------------------------------------------------------------

WINDOW: Final = 16  #: number of bits per table lookup
PADDING: Final = 32  #: number of zero bytes appended to the packet, so that no lookup goes past the end
_PAIRS: Final = 5  #: maximum number of whole pairs in a window; the shortest pair takes 3 bits
_MAX_LEVEL_ZEROS: Final = 11  #: limit that allows levels below 2048; pictures of 8-bit samples have no greater levels

Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class PairTable:
    """The pairs at the beginning of each window of 16 bits."""

    step: NDArray[np.int8]  #: (65536,) bits in the whole pairs; negative if the block ends with them, 0 for none
    count: NDArray[np.int64]  #: (65536,) number of pairs
    advance: NDArray[np.int64]  #: (65536 · 5,) run + 1 of each pair
    level: NDArray[np.int16]  #: (65536 · 5,) level of each pair


@cache
def pair_table() -> PairTable:
    """Return the table, which is built on first use (taking tens of milliseconds)."""
    rest = np.arange(1 << WINDOW)
    used = np.zeros_like(rest)
    count = np.zeros_like(rest)
    going = np.ones(rest.size, bool)
    ended = np.zeros(rest.size, bool)
    advance = np.zeros((rest.size, _PAIRS), np.int64)
    level = np.zeros((rest.size, _PAIRS), np.int16)
    for k in range(_PAIRS + 1):
        run_zeros, run, run_bits = _value(rest)
        level_zeros, magnitude, level_bits = _value(rest << run_bits & 0xFFFF)
        end = level_zeros == 1
        bits = np.minimum(run_bits + level_bits + ~end, WINDOW + 1)
        whole = going & (used + bits <= WINDOW) & (run_zeros <= MAX_RUN_ZEROS) & ~(end & (run > 0))
        ended |= whole & end
        pair = whole & ~end
        if k < _PAIRS:
            negative = (rest << (bits - 1) & 0x8000) != 0
            advance[pair, k] = run[pair] + 1
            magnitude = np.maximum(magnitude, 1)  # the code without zeros means run 0, but level 1
            level[pair, k] = np.where(negative, -magnitude, magnitude)[pair]
        count += pair
        used += np.where(whole, bits, 0)
        rest = np.where(whole, rest << bits & 0xFFFF, rest)
        going = pair
    step = np.where(ended, -used, used).astype(np.int8)
    return PairTable(step, count, advance.ravel(), level.ravel())


def _value(window: Ints) -> tuple[Ints, Ints, Ints]:
    """Return each window's count of leading zeros, the unsigned number coded there, and the code's width in bits."""
    zeros = WINDOW - np.frexp(window.astype(np.float64))[1].astype(np.int64)
    extra = np.maximum(zeros - 1, 0)
    tail = (window << (zeros + 1) & 0xFFFF) >> (WINDOW - extra)
    return zeros, np.where(zeros > 0, 1 << extra | tail, 0), zeros + 1 + extra


def bit_windows(packet: bytes) -> NDArray[np.uint16]:
    """Return, for each bit in stream order, the 16 bits that begin with it; bits beyond the packet's end are zero.

    The stream is a sequence of 32-bit little-endian words, each read from its most significant bit; ``packet`` must
    consist of whole words. Shape (8 · (bytes + about 30),).
    """
    words = np.frombuffer(packet, dtype="<u4").astype(">u4")
    stream = np.concatenate([words.view(np.uint8), np.zeros(PADDING, np.uint8)]).astype(np.uint32)
    three = stream[:-2] << 16 | stream[1:-1] << 8 | stream[2:]
    return (three[:, None] >> np.arange(8, 0, -1, dtype=np.uint32)).astype(np.uint16).ravel()


class BlockWalker:
    """Steps through the pairs of blocks, recording its track."""

    def __init__(self, windows: NDArray[np.uint16]) -> None:
        self._table = pair_table()
        self._windows = windows
        self.window = windows.data  #: the windows as a memory view, which is faster for single lookups
        self._steps = self._table.step[windows].data
        self._visits: list[int] = []  # positions of the windows with whole pairs, and of the long pairs [bits]
        self._ends: list[int] = []  # number of entries in ``_visits`` at the end of each block
        self._long: list[tuple[int, int, int]] = []  # visit, run + 1 and level of each pair longer than a window

    def walk(self, at: int) -> int:
        """Read the next block's pairs from bit ``at`` to the end of the block; return the position of the bit after it.

        Raises DecodeError for an invalid code, which includes bits beyond the packet.
        """
        visits, steps = self._visits, self._steps
        while (step := steps[at]) >= 0:
            visits.append(at)
            at = at + step if step else self._long_pair(at)
        visits.append(at)
        self._ends.append(len(visits))
        return at - step

    def skip(self) -> None:
        """Add a block without pairs."""
        self._ends.append(len(self._visits))

    def _long_pair(self, at: int) -> int:
        """Read one pair that is invalid or does not fit in a window; return the position of the bit after it."""
        zeros, run, at = self._read_value(at)
        if zeros > MAX_RUN_ZEROS:
            raise DecodeError(f"{zeros} zeros cannot begin a run's code")
        zeros, level, at = self._read_value(at)
        if zeros == 1 or zeros > _MAX_LEVEL_ZEROS:
            raise DecodeError(f"{zeros} zeros cannot begin a level's code after a run of {run}")
        level = max(level, 1)
        negative = self.window[at] >> (WINDOW - 1)
        self._long.append((len(self._visits) - 1, run + 1, -level if negative else level))
        return at + 1

    def _read_value(self, at: int) -> tuple[int, int, int]:
        """Return a code's count of leading zeros, its number without a sign, and the position of the bit after it."""
        zeros = WINDOW - self.window[at].bit_length()
        at += zeros + 1
        if zeros < 2:
            return zeros, zeros, at
        extra = zeros - 1
        return zeros, 1 << extra | self.window[at] >> (WINDOW - extra), at + extra

    def levels(self) -> NDArray[np.float32]:
        """Return the levels of all blocks so far, in stream order; those at the position of the mean are 0.

        Shape (blocks, 64). Raises DecodeError for a block with more than 64 levels.
        """
        count = self._table.count[keys := self._windows[np.array(self._visits, np.int64)].astype(np.int64)]
        long_visit, long_advance, long_level = np.array(self._long, np.int64).reshape(-1, 3).T
        count[long_visit] = 1
        pairs_after = np.cumsum(count)
        pairs_before = pairs_after - count
        source = np.repeat(keys * _PAIRS - pairs_before, count) + np.arange(count.sum())
        advance, level = self._table.advance[source], self._table.level[source]
        advance[pairs_before[long_visit]] = long_advance
        level[pairs_before[long_visit]] = long_level

        ends = np.concatenate([[0], np.concatenate([[0], pairs_after])[self._ends]])  # counted in pairs, for each block
        travelled = np.concatenate([[0], np.cumsum(advance)])
        pairs = np.diff(ends)
        place = travelled[1:] - np.repeat(travelled[ends[:-1]], pairs)
        if place.size and place.max() >= COEFFICIENTS:
            raise DecodeError(f"a block has a coefficient {place.max()}, but the last is {COEFFICIENTS - 1}")
        levels = np.zeros((pairs.size, COEFFICIENTS), np.float32)
        levels[np.repeat(np.arange(pairs.size), pairs), place] = level
        return levels


# Pictures ------------------------------------------------------------------------------------------------------------

MAX_PACKET: Final = 65_535  #: maximum size of a picture, which is one datagram [bytes]
_MAX_TAIL_BITS: Final = 64  # more zero bits than this after the end of the picture are too many for padding
# Upper bounds for the coefficients of 8-bit samples, allowing for the rounding of a fixed-point transform. A level may
# also be rounded up by half a step.
_MAX_DC: Final = 2048
_MAX_AC: Final = 1024

Samples = NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class UvlcHeader:
    """The fields of a picture before its first macroblock."""

    number: int  #: the drone's picture count, 32 bits
    type: PictureType
    quant: int  #: quantiser in the picture's header
    width: int  #: width of the coded part [px]
    height: int


@dataclass(frozen=True, slots=True, eq=False)
class UvlcPicture(UvlcHeader):
    """One image from the drone's camera."""

    pixels: NDArray[np.uint8]  #: BGR, (height, width, 3), C-contiguous


def is_p264(packet: bytes | bytearray | memoryview) -> bool:
    """Return whether a datagram begins like a picture in P264, the drone's other codec, which is not supported."""
    return len(packet) >= 4 and int.from_bytes(bytes(packet[:4]), "little") >> (32 - START_CODE_BITS) == P264_START


def is_intra(packet: bytes | bytearray | memoryview) -> bool:
    """Return whether a datagram starts with the header of an intra picture, which needs no other picture."""
    head = int.from_bytes(bytes(packet[:4]), "little")
    kind = head >> (32 - START_CODE_BITS - FORMAT_BITS - RESOLUTION_BITS - TYPE_BITS) & (1 << TYPE_BITS) - 1
    return head >> (32 - START_CODE_BITS) == UVLC_START and kind == PictureType.INTRA


class UvlcDecoder:
    """Decodes one drone's pictures in order of arrival. Not thread-safe."""

    def __init__(self) -> None:
        self._last: tuple[UvlcHeader, Samples] | None = None

    def decode(self, packet: bytes | bytearray | memoryview) -> UvlcPicture:
        """Return the picture in a datagram.

        Raises DecodeError for anything but one complete picture: truncated or damaged data, another codec
        (:func:`is_p264`), or changes to a picture other than the previous one. It can then decode the next picture.
        """
        reader = _Reader(bytes(packet))
        header = reader.read_header()
        before = self._before(header)
        reader.read_groups(header)
        samples = reader.samples(before)
        self._last = header, samples
        pixels = _bgr(samples, header.width, header.height)
        return UvlcPicture(header.number, header.type, header.quant, header.width, header.height, pixels)

    def _before(self, header: UvlcHeader) -> Samples | None:
        """Return the samples that a picture depends on; None if the picture is complete in itself."""
        if header.type is PictureType.INTRA:
            return None
        if self._last is None:
            raise DecodeError(f"picture {header.number} updates a picture that never arrived")
        last, samples = self._last
        if header.number != last.number + 1 & 0xFFFFFFFF:
            raise DecodeError(f"picture {header.number} updates the one before it, but {last.number} was the last")
        if (header.width, header.height) != (last.width, last.height):
            raise DecodeError(
                f"picture {header.number} of {header.width}x{header.height} updates one of {last.width}x{last.height}"
            )
        return samples


class _Reader:
    """Reads one packet from start to end."""

    def __init__(self, packet: bytes) -> None:
        if len(packet) > MAX_PACKET:
            raise DecodeError(f"{len(packet)} bytes are too many for a picture; a datagram has at most {MAX_PACKET}")
        if len(packet) % 4 or not packet:
            raise DecodeError(f"{len(packet)} bytes are not a whole number of 4-byte words: the packet is torn")
        self._walker = BlockWalker(bit_windows(packet))
        self._window = self._walker.window
        self._end = 8 * len(packet)
        self._at = 0
        self._coded: list[bool] = []  # whether each macroblock is coded
        self._quants: list[int] = []  # quantiser of each coded macroblock
        self._means: list[int] = []  # mean of each block in the coded macroblocks

    def read_header(self) -> UvlcHeader:
        code = self._read(START_CODE_BITS)
        if code == P264_START:
            raise DecodeError("P264 pictures are not supported: set video:video_codec to UVLC (0x20)")
        if code != UVLC_START:
            raise DecodeError(f"a UVLC picture must begin with {UVLC_START:#08x}, got {code:#08x}")
        form, resolution = self._read(FORMAT_BITS), self._read(RESOLUTION_BITS)
        if (form, resolution) not in SIZES:
            raise DecodeError(f"no picture has format {form} and resolution {resolution}")
        kind = self._read(TYPE_BITS)
        if kind not in (PictureType.INTRA, PictureType.INTER):
            raise DecodeError(f"unknown picture type {kind}")
        quant = self._read_quant()
        width, height = (side - side % MACROBLOCK for side in SIZES[form, resolution])
        return UvlcHeader(self._read(NUMBER_BITS), PictureType(kind), quant, width, height)

    def read_groups(self, header: UvlcHeader) -> None:
        """Read all groups and the end of the picture."""
        quant = header.quant
        for group in range(header.height // MACROBLOCK):
            if group:
                self._read_start(UVLC_START + group)
                quant = self._read_quant()
            self._read_macroblocks(group, header.width // MACROBLOCK, quant)
        self._read_start(END_OF_PICTURE)
        if self._end - self._at >= _MAX_TAIL_BITS or not self._only_zeros(self._at, self._end):
            raise DecodeError(f"{self._end - self._at} bits follow the picture's end")

    def _read_start(self, code: int) -> None:
        """Advance to the next byte or word boundary, where there must be a start code."""
        starts = [-(-self._at // size) * size for size in (8, 32)]
        found = [self._window[start] << 6 | self._window[start + WINDOW] >> (WINDOW - 6) for start in starts]
        for start, value in zip(starts, found, strict=True):
            if value == code and start + START_CODE_BITS <= self._end and self._only_zeros(self._at, start):
                self._at = start + START_CODE_BITS
                return
        raise DecodeError(f"expected start code {code:#08x}, got {found[0]:#08x}")

    def _only_zeros(self, start: int, end: int) -> bool:
        looks = range(start, end, WINDOW)
        return all(self._window[at] >> max(0, WINDOW - (end - at)) == 0 for at in looks)

    def _read(self, bits: int) -> int:
        value = 0
        while bits:
            part = min(bits, WINDOW)
            value = value << part | self._window[self._at] >> (WINDOW - part)
            self._at += part
            bits -= part
        if self._at > self._end:
            raise DecodeError(f"the packet of {self._end // 8} bytes ends in the middle of a picture")
        return value

    def _read_quant(self) -> int:
        if not (quant := self._read(QUANT_BITS)):
            raise DecodeError(f"the quantiser must be from {FINEST_QUANT} to {TABLE_QUANT}, got 0")
        return quant

    def _read_macroblocks(self, group: int, count: int, quant: int) -> None:
        for k in range(count):
            try:
                quant = self._read_macroblock(quant)
                # This check is enough, because the windows extend beyond the packet by more than one empty macroblock.
                if self._at > self._end:
                    raise DecodeError("the packet ends before it does")
            except DecodeError as error:
                raise DecodeError(f"macroblock {k} of group {group}: {error}") from None

    def _read_macroblock(self, quant: int) -> int:
        """Read a macroblock and return the quantiser that applies from here on."""
        at, window = self._at, self._window
        coded = window[at] < 0x8000
        self._coded.append(coded)
        if not coded:
            self._at += 1
            return quant
        described = window[at] >> 7
        if not described & 0x80:
            raise DecodeError(f"its description is {described:#04x}, without the bit that is always set")
        at += 9
        if described & 0x40:
            quant = _changed_quant(quant, window[at] >> 14)
            at += 2
        self._quants.append(quant)
        walker = self._walker
        for block in range(BLOCKS):
            self._means.append(window[at] >> (WINDOW - DC_BITS))
            at += DC_BITS
            if described >> block & 1:
                at = walker.walk(at)
            else:
                walker.skip()
        self._at = at
        return quant

    def samples(self, before: Samples | None) -> Samples:
        """Return the samples of all macroblocks in stream order. Shape (macroblocks, 6, 64)."""
        coded = np.array(self._coded)
        samples = np.zeros((coded.size, BLOCKS, COEFFICIENTS), np.uint8) if before is None else before.copy()
        levels = self._walker.levels()
        levels[:, 0] = self._means
        steps = np.repeat(STEPS[self._quants], BLOCKS, axis=0).astype(np.float32)
        coefficients = levels * steps
        limits = np.full(COEFFICIENTS, _MAX_AC, np.float32)
        limits[0] = _MAX_DC
        if (np.abs(coefficients) > limits + steps / 2).any():
            raise DecodeError("a coefficient exceeds the range of a valid picture")
        values = coefficients @ INVERSE_TRANSFORM
        np.clip(np.rint(values, out=values), 0, 255, out=values)
        samples[coded] = values.astype(np.uint8).reshape(-1, BLOCKS, COEFFICIENTS)
        return samples


def _changed_quant(quant: int, code: int) -> int:
    if quant == TABLE_QUANT:
        return quant
    changed = quant + DQUANT[code]
    if not FINEST_QUANT <= changed <= COARSEST_QUANT:
        raise DecodeError(f"its quantiser would be {changed}, outside {FINEST_QUANT} to {COARSEST_QUANT}")
    return changed


def _bgr(samples: Samples, width: int, height: int) -> NDArray[np.uint8]:
    """Convert macroblocks (macroblocks, 6, 64) to a picture (height, width, 3)."""
    groups, columns = height // MACROBLOCK, width // MACROBLOCK
    blocks = samples.reshape(groups, columns, BLOCKS, SIDE, SIDE)
    luma = blocks[:, :, :4].reshape(groups, columns, 2, 2, SIDE, SIDE).transpose(0, 2, 4, 1, 3, 5)
    chroma = blocks[:, :, 4:].transpose(2, 0, 3, 1, 4).reshape(2, height // 2, width // 2)
    cb, cr = chroma.astype(np.int32) - 128
    # BT.601, full range, in 256ths; one chroma sample for each 2x2 pixels.
    shifts = (454 * cb, -88 * cb - 183 * cr, 359 * cr)
    quads = luma.reshape(height // 2, 2, width // 2, 2).astype(np.int16)
    pixels = np.empty((height, width, 3), np.uint8)
    for channel, shift in enumerate(shifts):
        shifted = quads + (shift + 128 >> 8).astype(np.int16)[:, None, :, None]
        pixels[..., channel] = np.clip(shifted, 0, 255, out=shifted).reshape(height, width)
    return pixels
