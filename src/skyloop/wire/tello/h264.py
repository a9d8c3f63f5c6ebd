"""As much of H.264 as it takes to separate pictures and to detect that one is missing. ITU-T H.264, 7.3 and 7.4."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

from skyloop.errors import DecodeError

SLICE, IDR, SPS, PPS = 1, 5, 7, 8  #: types of NAL units
START: Final = b"\0\0\0\1"
_ANY_START: Final = re.compile(rb"\x00\x00\x01")
_HEADER_BYTES: Final = 32  # more than the beginning of a slice header, or a whole SPS, takes
_CHROMA_PROFILES: Final = frozenset({100, 110, 122, 244, 44, 83, 86, 118, 128})


@dataclass(frozen=True, slots=True)
class Sequence:
    """What a sequence parameter set says that is needed here."""

    frame_number_bits: int
    width: int  #: [px], cropping not taken off
    height: int


@dataclass(frozen=True, slots=True)
class Slice:
    """The beginning of a slice's header."""

    is_key: bool
    is_first: bool  #: of its picture
    is_reference: bool
    frame_number: int


def units(stream: bytes) -> list[bytes]:
    """The NAL units of a piece of stream in Annex B form. What comes before the first start code is left out."""
    return [unit.rstrip(b"\0") for unit in _ANY_START.split(stream)[1:] if unit.rstrip(b"\0")]


def unit_type(unit: bytes) -> int:
    return unit[0] & 31


def parse_sequence(unit: bytes) -> Sequence:
    """A sequence parameter set. Raises :class:`DecodeError`."""
    bits = _Bits(unit[1:])
    profile = bits.take(8)
    bits.take(16)
    bits.exp_golomb()
    if profile in _CHROMA_PROFILES:
        raise DecodeError(f"profile {profile} is none that a Tello sends")
    frame_number_bits = bits.exp_golomb() + 4
    order_type = bits.exp_golomb()
    if order_type == 0:
        bits.exp_golomb()
    elif order_type == 1:
        raise DecodeError("picture order of type 1 is none that a Tello sends")
    bits.exp_golomb()  # reference frames
    bits.take(1)
    width, height = bits.exp_golomb() + 1, bits.exp_golomb() + 1
    if frame_number_bits > 16 or width > 512 or height > 512:
        raise DecodeError("numbers in a sequence parameter set that can't be")
    return Sequence(frame_number_bits, width * 16, height * 16)


def parse_slice(unit: bytes, sequence: Sequence) -> Slice:
    """The beginning of a slice of frame pictures. Raises :class:`DecodeError`."""
    bits = _Bits(unit[1:_HEADER_BYTES])
    first = bits.exp_golomb()
    bits.exp_golomb()  # type
    bits.exp_golomb()  # parameter set
    return Slice(unit_type(unit) == IDR, first == 0, bool(unit[0] & 0x60), bits.take(sequence.frame_number_bits))


class _Bits:
    def __init__(self, data: bytes) -> None:
        data = data[:_HEADER_BYTES].replace(b"\0\0\3", b"\0\0")
        self._value = int.from_bytes(data, "big")
        self._left = 8 * len(data)

    def take(self, count: int) -> int:
        if count > self._left:
            raise DecodeError("a NAL unit that ends too early")
        self._left -= count
        return self._value >> self._left & ((1 << count) - 1)

    def exp_golomb(self) -> int:
        zeros = 0
        while not self.take(1):
            zeros += 1
            if zeros > 16:
                raise DecodeError("a number in a NAL unit that is too large")
        return (1 << zeros | self.take(zeros)) - 1
