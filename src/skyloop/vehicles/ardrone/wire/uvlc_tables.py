"""Numbers of the AR.Drone 1's UVLC video format that both its ends need.

Sources, by the names used in :mod:`skyloop.vehicles.ardrone.wire.uvlc`: the Parrot SDK (headers and ``uvlc.txt`` of
ARDroneLib) and the Developer Guide for the layout; venthur/python-ardrone, which showed the video of real drones, for
the order of the coefficients and for the steps at quantiser 31.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

START_CODE_BITS: Final = 22
UVLC_START: Final = 0x20  #: start code of a picture and of its group 0; group k has this + k
P264_START: Final = 0x40  #: the same of the drone's other codec
END_OF_PICTURE: Final = 0x3F  #: what would be group 31
MAX_GROUPS: Final = 31

FORMAT_BITS: Final = 2
RESOLUTION_BITS: Final = 3
TYPE_BITS: Final = 3
QUANT_BITS: Final = 5
NUMBER_BITS: Final = 32

MACROBLOCK: Final = 16  #: side of a macroblock, and height of a group [px]
BLOCKS: Final = 6  #: of a macroblock: four of luma in reading order, then Cb, Cr, at half resolution
SIDE: Final = 8  #: of a block
COEFFICIENTS: Final = SIDE * SIDE
DC_BITS: Final = 10

FINEST_QUANT: Final = 1
COARSEST_QUANT: Final = 30
TABLE_QUANT: Final = 31  #: not a size but a mode: the steps are those of ``TABLE_QUALITY``. Real drones send this one
TABLE_QUALITY: Final = 2
DQUANT: Final = (-1, -2, 1, 2)  #: what the two bits of a quantiser change stand for

MAX_RUN: Final = 63
MAX_RUN_ZEROS: Final = 6  #: leading zeros of the longest code of a run


class PictureType(IntEnum):
    """Values of the header's picture type."""

    INTRA = 0  #: complete in itself
    INTER = 1  #: what it does not code is as in the picture before


def _sizes() -> dict[tuple[int, int], tuple[int, int]]:
    base = {1: (88, 72), 2: (160, 120)}
    sizes = {(f, r): (w << r - 1, h << r - 1) for f, (w, h) in base.items() for r in range(1, 6)}
    return {code: size for code, size in sizes.items() if size[1] // MACROBLOCK <= MAX_GROUPS}


#: (format, resolution) of the header to (width, height) [px]. The header can name larger pictures, whose groups the
#: start codes can't number.
SIZES: Final = _sizes()


def _zigzag() -> NDArray[np.intp]:
    cells = [(row, column) for row in range(SIDE) for column in range(SIDE)]
    cells.sort(key=lambda cell: (sum(cell), cell[sum(cell) % 2 == 0]))
    return np.array([row * SIDE + column for row, column in cells])


#: Place of the k-th coefficient of the stream in the block, row by row, rows being vertical frequencies. Shape (64,).
ZIGZAG: Final = _zigzag()


def _steps() -> NDArray[np.int32]:
    quality = np.arange(TABLE_QUANT + 1)
    quality[TABLE_QUANT] = TABLE_QUALITY
    return (1 + quality[:, None] * (1 + ZIGZAG // SIDE + ZIGZAG % SIDE)).astype(np.int32)


#: Size of the step of each coefficient, in the stream's order, for each quantiser. Shape (32, 64).
STEPS: Final = _steps()


def _inverse_transform() -> NDArray[np.float32]:
    frequency, place = np.arange(SIDE)[:, None], np.arange(SIDE)[None, :]
    basis = np.cos((2 * place + 1) * frequency * np.pi / (2 * SIDE)) / 2
    basis[0] /= np.sqrt(2)
    return np.kron(basis, basis)[ZIGZAG].astype(np.float32)


#: Coefficients (…, 64) in the stream's order times this are samples (…, 64) row by row; its transpose goes back.
#: Orthonormal: the first coefficient is 8 times the mean.
INVERSE_TRANSFORM: Final = _inverse_transform()
