"""Parse the parts of H.264 needed to separate frames and detect missing, reordered or resized frames. Pure.

ITU-T H.264: sections 7.3 and 7.4 (units, parameter sets, slice headers), 7.4.3 (picture numbers), Annexes B and E.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

from skyloop.errors import DecodeError

SLICE, IDR, SPS, PPS = 1, 5, 7, 8  #: types of NAL units
START: Final = b"\0\0\0\1"
MAX_SETS: Final = 8  #: maximum number of parameter sets of each kind to store; cameras send one set
_ANY_START: Final = re.compile(rb"\x00\x00\x01")
_HEADER_BYTES: Final = 32  # number of bytes that suffice for the start of a slice header
_SET_BYTES: Final = 512  # number of bytes that suffice for a sequence parameter set with scaling lists
_CHROMA_PROFILES: Final = frozenset({100, 110, 122, 244, 44, 83, 86, 118, 128})
_ALL_COLOURS: Final = 3  # chroma_format_idc for 4:4:4
_MAX_BLOCKS: Final = 1024  # maximum number of macroblocks per side (16384 pixels)
_MAX_CYCLE: Final = 255  # largest num_ref_frames_in_pic_order_cnt_cycle
_B: Final = 1  # slice_type of B slices, modulo 5


@dataclass(frozen=True, slots=True)
class Sequence:
    """The fields of a sequence parameter set that this module uses."""

    frame_number_bits: int
    width: int  #: width of the displayed image [px]
    height: int
    interlaced: bool = False  #: whether pictures may be fields
    colour_planes: bool = False  #: whether the colour planes are encoded separately
    gaps_allowed: bool = False  #: whether the sender may skip frames and thereby leave gaps in their numbers


@dataclass(frozen=True, slots=True)
class Slice:
    """The fields at the start of a slice header."""

    is_key: bool
    is_first: bool  #: whether it is the first slice of its frame
    is_reference: bool
    frame_number: int
    is_b: bool = False  #: whether it may depend on later frames


def units(stream: bytes) -> list[bytes]:
    """Split data in Annex B format into NAL units; bytes before the first start code are skipped."""
    return [unit.rstrip(b"\0") for unit in _ANY_START.split(stream)[1:] if unit.rstrip(b"\0")]


def unit_type(unit: bytes) -> int:
    return unit[0] & 31


def parse_sequence(unit: bytes) -> Sequence:
    """Parse a sequence parameter set (7.3.2.1.1). Raises :class:`DecodeError`."""
    bits = _Bits(unit[1:_SET_BYTES])
    profile = bits.take(8)
    bits.take(16)  # constraint flags and level
    bits.exp_golomb()  # number of this set
    chroma, planes = 1, False
    if profile in _CHROMA_PROFILES:
        chroma = bits.exp_golomb()
        planes = chroma == _ALL_COLOURS and bool(bits.take(1))
        bits.exp_golomb()  # bit depth of luma
        bits.exp_golomb()  # bit depth of chroma
        bits.take(1)  # lossless transform bypass
        if bits.take(1):  # scaling lists are present
            for number in range(12 if chroma == _ALL_COLOURS else 8):
                if bits.take(1):
                    _skip_scaling_list(bits, 16 if number < 6 else 64)
    frame_number_bits = bits.exp_golomb() + 4
    _skip_order(bits)
    bits.exp_golomb()  # number of reference frames
    gaps_allowed = bool(bits.take(1))
    columns, rows = bits.exp_golomb() + 1, bits.exp_golomb() + 1
    frames_only = bits.take(1)
    rows *= 2 - frames_only
    if frame_number_bits > 16 or columns > _MAX_BLOCKS or rows > _MAX_BLOCKS or chroma > _ALL_COLOURS:
        raise DecodeError("impossible numbers in a sequence parameter set")
    if not frames_only:
        bits.take(1)  # macroblock-adaptive frame/field coding
    bits.take(1)  # direct_8x8_inference_flag
    width, height = columns * 16, rows * 16
    if bits.take(1):  # the image is cropped
        across = 2 if chroma in (1, 2) and not planes else 1
        down = (2 if chroma == 1 and not planes else 1) * (2 - frames_only)
        left, right, top, bottom = (bits.exp_golomb() for _ in range(4))
        width -= across * (left + right)
        height -= down * (top + bottom)
    if width < 1 or height < 1:
        raise DecodeError("a sequence parameter set crops its pictures to nothing")
    return Sequence(frame_number_bits, width, height, not frames_only, planes, gaps_allowed)


def parse_slice(unit: bytes, sequence: Sequence) -> Slice:
    """Parse the start of a slice header (7.3.3). Raises :class:`DecodeError`."""
    bits = _Bits(unit[1:_HEADER_BYTES])
    first = bits.exp_golomb()
    kind = bits.exp_golomb()
    bits.exp_golomb()  # number of its parameter set
    if sequence.colour_planes:
        bits.take(2)  # colour plane
    number = bits.take(sequence.frame_number_bits)
    return Slice(unit_type(unit) == IDR, first == 0, bool(unit[0] & 0x60), number, kind % 5 == _B)


def missing_between(before: Slice, now: Slice, sequence: Sequence) -> int:
    """Return how many reference frames are missing between two received ones, according to their numbers (7.4.3)."""
    if now.is_key:
        return 0
    turns = 1 << sequence.frame_number_bits
    return (now.frame_number - before.frame_number - before.is_reference) % turns


def _skip_order(bits: _Bits) -> None:
    """Skip the fields of the picture order count, which has three types."""
    kind = bits.exp_golomb()
    if kind == 0:
        bits.exp_golomb()
    elif kind == 1:
        bits.take(1)
        bits.exp_golomb()
        bits.exp_golomb()
        cycle = bits.exp_golomb()
        if cycle > _MAX_CYCLE:
            raise DecodeError("the cycle in a sequence parameter set is too long")
        for _ in range(cycle):
            bits.exp_golomb()


def _skip_scaling_list(bits: _Bits, size: int) -> None:
    last = following = 8
    for _ in range(size):
        if following:
            code = bits.exp_golomb()
            following = (last + ((code + 1) // 2 if code % 2 else -(code // 2))) % 256
        last = following or last


class _Bits:
    def __init__(self, data: bytes) -> None:
        data = data.replace(b"\0\0\3", b"\0\0")
        self._value = int.from_bytes(data, "big")
        self._left = 8 * len(data)

    def take(self, count: int) -> int:
        if count > self._left:
            raise DecodeError("a NAL unit ends too early")
        self._left -= count
        return self._value >> self._left & ((1 << count) - 1)

    def exp_golomb(self) -> int:
        zeros = 0
        while not self.take(1):
            zeros += 1
            if zeros > 31:
                raise DecodeError("a number in a NAL unit is too large")
        return (1 << zeros | self.take(zeros)) - 1


@dataclass(frozen=True, slots=True)
class Unit:
    """An access unit plus the inspector's findings."""

    data: bytes  #: the unit in Annex B format; if it is a key frame, it includes the parameter sets
    is_key: bool  #: whether decoding can start here: an IDR picture with known parameter sets
    after_gap: bool  #: whether frames are missing before this one, or it is the first frame
    width: int  #: width [px]
    height: int
    reason: str = ""  #: why frames of this stream can't be forwarded without decoding; empty if they can be


class Inspector:
    """Inspects the access units of a stream in order, without decoding them.

    It stores parameter sets, which a stream may send only once, and puts them in front of each key frame. If a stream
    has several sequence parameter sets, the last set is used.

    Args:
        parameters: Parameter sets from outside the stream (from SDP or a container), in Annex B format.
    """

    def __init__(self, parameters: bytes = b"") -> None:
        self._sets: dict[int, dict[bytes, bytes]] = {SPS: {}, PPS: {}}  # parameter sets by type and number
        self._sequence: Sequence | None = None
        self._before: Slice | None = None
        for unit in units(parameters):
            self._remember(unit)

    def inspect(self, data: bytes) -> Unit | None:
        """Inspect the next access unit, in Annex B format; return None if it contains no picture.

        Also returns None if the headers of its picture are damaged or unknown; the next unit then follows a gap.
        """
        found = units(data)
        kinds = {unit_type(unit) for unit in found}
        for unit in found:
            self._remember(unit)
        slices = [unit for unit in found if unit_type(unit) in (SLICE, IDR)]
        if not slices or self._sequence is None:
            if slices:
                self._before = None
            return None
        try:
            heads = [parse_slice(unit, self._sequence) for unit in slices]
        except DecodeError:
            self._before = None
            return None
        now, before = heads[0], self._before
        is_key = IDR in kinds and all(self._sets.values())
        self._before = now
        gap = not now.is_first or (not is_key and (before is None or self._is_missing(before, now)))
        if is_key and not {SPS, PPS} <= kinds:
            sets = [known for of_kind in self._sets.values() for known in of_kind.values()]
            data = START + START.join([*sets, *(unit for unit in found if unit_type(unit) not in (SPS, PPS))])
        return Unit(data, is_key, gap, self._sequence.width, self._sequence.height, self._reason(heads))

    def restart(self) -> None:
        """Record that frames were skipped: the next frame does not continue the last one."""
        self._before = None

    def _is_missing(self, before: Slice, now: Slice) -> bool:
        assert self._sequence is not None
        return not self._sequence.gaps_allowed and missing_between(before, now, self._sequence) != 0

    def _reason(self, heads: list[Slice]) -> str:
        assert self._sequence is not None
        if any(head.is_b for head in heads):
            return "pictures refer to later ones (B-frames)"
        return "pictures are interlaced" if self._sequence.interlaced else ""

    def _remember(self, unit: bytes) -> None:
        kind = unit_type(unit)
        if kind not in self._sets:
            return
        if kind == SPS:
            try:
                sequence = parse_sequence(unit)
            except DecodeError:
                return  # the parameter set is damaged: keep the previous set and leave the damaged one to the decoder
            if sequence != self._sequence:
                self._sequence, self._before = sequence, None
                for known in self._sets.values():
                    known.clear()
        known = self._sets[kind]
        number = _set_number(unit)
        if number not in known and len(known) >= MAX_SETS:
            known.clear()
        known[number] = unit


def _set_number(unit: bytes) -> bytes:
    """Return the number that identifies a parameter set."""
    bits = _Bits(unit[4 if unit_type(unit) == SPS else 1 :][:_HEADER_BYTES])
    try:
        return bytes([bits.exp_golomb() % 256])
    except DecodeError:
        return b""
