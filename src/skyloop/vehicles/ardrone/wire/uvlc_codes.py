"""UVLC's constants for encoder and decoder, and a fast reader for its run and level codes. Pure.

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
with which it begins and the distance to the next window. The reader only steps from window to window, recording its
track, which NumPy turns into coefficients.

Sources, named as in :mod:`skyloop.vehicles.ardrone.wire.uvlc`: the Parrot SDK (ARDroneLib's headers and ``uvlc.txt``)
and the Developer Guide for the layout; venthur/python-ardrone, which displayed real drones' video, for the order of the
coefficients and the steps for quantiser 31.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import DecodeError

START_CODE_BITS: Final = 22
UVLC_START: Final = 0x20  #: start code of a picture and of its group 0; group k has this plus k
P264_START: Final = 0x40  #: start code of the drone's other codec
END_OF_PICTURE: Final = 0x3F  #: marks the end where group 31 would start
MAX_GROUPS: Final = 31

FORMAT_BITS: Final = 2
RESOLUTION_BITS: Final = 3
TYPE_BITS: Final = 3
QUANT_BITS: Final = 5
NUMBER_BITS: Final = 32

MACROBLOCK: Final = 16  #: side of a macroblock, and height of a group [px]
BLOCKS: Final = 6  #: blocks in a macroblock: four for luma in reading order, then Cb and Cr at half resolution
SIDE: Final = 8  #: side of a block [px]
COEFFICIENTS: Final = SIDE * SIDE
DC_BITS: Final = 10

FINEST_QUANT: Final = 1
COARSEST_QUANT: Final = 30
TABLE_QUANT: Final = 31  #: not a step size but a mode that uses the steps of ``TABLE_QUALITY``; real drones send it
TABLE_QUALITY: Final = 2
DQUANT: Final = (-1, -2, 1, 2)  #: quantiser changes, indexed by their two-bit code

MAX_RUN_ZEROS: Final = 6  #: number of leading zeros in the longest code for a run


class PictureType(IntEnum):
    """Values of the header's picture type."""

    INTRA = 0  #: complete in itself
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


#: Multiplying coefficients (…, 64) in stream order by this gives samples (…, 64) row by row; its transpose is the
#: inverse. Orthonormal: the first coefficient is 8 times the mean.
INVERSE_TRANSFORM: Final = _inverse_transform()


WINDOW: Final = 16  #: bits per table lookup
PADDING: Final = 32  #: zero bytes appended to the packet, so that no lookup goes past the end
_PAIRS: Final = 5  #: maximum number of whole pairs in a window, as the shortest takes 3 bits
_MAX_LEVEL_ZEROS: Final = 11  #: allows levels below 2048; pictures of 8-bit samples have none greater

Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class PairTable:
    """The pairs with which each window of 16 bits begins."""

    step: NDArray[np.int8]  #: (65536,) bits in the whole pairs; negative if the block ends with them, 0 without any
    count: NDArray[np.int64]  #: (65536,) number of pairs
    advance: NDArray[np.int64]  #: (65536 · 5,) run + 1 of each pair
    level: NDArray[np.int16]  #: (65536 · 5,) level of each pair


@cache
def pair_table() -> PairTable:
    """Return the table, which is built at first use (taking tens of milliseconds)."""
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
        self._ends: list[int] = []  # number of visits at the end of each block
        self._long: list[tuple[int, int, int]] = []  # for each pair longer than a window: visit, run + 1 and level

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
            raise DecodeError(f"{zeros} zeros do not begin a code of a run")
        zeros, level, at = self._read_value(at)
        if zeros == 1 or zeros > _MAX_LEVEL_ZEROS:
            raise DecodeError(f"{zeros} zeros do not begin a code of a level after a run of {run}")
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

        Shape (blocks, 64). Raises DecodeError for a block with more than 64.
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

        ends = np.concatenate([[0], np.concatenate([[0], pairs_after])[self._ends]])  # in pairs, for each block
        travelled = np.concatenate([[0], np.cumsum(advance)])
        pairs = np.diff(ends)
        place = travelled[1:] - np.repeat(travelled[ends[:-1]], pairs)
        if place.size and place.max() >= COEFFICIENTS:
            raise DecodeError(f"a block has a coefficient {place.max()}; {COEFFICIENTS - 1} is the last")
        levels = np.zeros((pairs.size, COEFFICIENTS), np.float32)
        levels[np.repeat(np.arange(pairs.size), pairs), place] = level
        return levels
