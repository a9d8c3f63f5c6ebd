"""The Tello's video datagrams to pictures: H.264 in Annex B form, cut into pieces of 1460 bytes, without any header.

Nothing numbers the pieces. A piece that is shorter than the others ends a picture; one that begins with a start code
begins the next. Of a picture whose piece was lost in the middle the only sign is that it does not decode.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from skyloop.drivers.h264 import (
    IDR,
    PPS,
    SLICE,
    SPS,
    START,
    Sequence,
    Slice,
    missing_between,
    parse_sequence,
    parse_slice,
)
from skyloop.drivers.h264 import unit_type as type_of
from skyloop.drivers.h264 import units as units_of
from skyloop.errors import DecodeError

PIECE: Final = 1460  #: bytes of every datagram of a picture but its last
MAX_PICTURE: Final = 1 << 19  #: bytes; real ones have a fiftieth of that
_HEAD: Final = 256  # bytes in which parameter sets and the beginning of the first slice are looked for


@dataclass(frozen=True, slots=True)
class AccessUnit:
    """One picture as it came."""

    data: bytes
    is_key: bool  #: decoding can begin here
    arrived_ns: int  #: when its first piece came
    after_gap: bool  #: a picture before it is known to be missing or damaged
    whole: bool  #: nothing shows that a piece of its own is missing
    number: int = 0  #: counts the pictures that came
    width: int = 0  #: by the newest parameters [px]; 0 before the first
    height: int = 0


def pieces(picture: bytes) -> list[bytes]:
    """A picture's datagrams."""
    return [picture[at : at + PIECE] for at in range(0, len(picture), PIECE)]


class Assembly:
    """Pieces in the order of their coming to pictures. Never raises for what it is fed.

    ``stray`` counts bytes that belong to no picture, ``missing`` the pictures that the numbers in the stream show to be
    missing.
    """

    def __init__(self) -> None:
        self.stray = 0
        self.missing = 0
        self._pieces: list[bytes] = []
        self._size = 0
        self._arrived_ns = 0
        self._sequence: Sequence | None = None
        self._before: Slice | None = None
        self._gap = True  # since the last picture that was given out
        self._count = 0

    def feed(self, piece: bytes, now_ns: int) -> list[AccessUnit]:
        """A datagram that came now; the pictures that are complete with it, at most two."""
        found = []
        begins = piece.startswith(START)
        if begins and self._has_picture():
            found += self._end(whole=False)  # its last piece was lost, unless it was as long as the others
        if not begins and not self._pieces:
            self.stray += len(piece)
            self._gap = True
            return found
        if not self._pieces:
            self._arrived_ns = now_ns
        self._pieces.append(piece)
        self._size += len(piece)
        if self._size > MAX_PICTURE:
            self._drop()
        elif len(piece) < PIECE and self._has_picture():
            found += self._end(whole=True)
        return found

    def _has_picture(self) -> bool:
        """Whether a slice has come; parameter sets may come in datagrams of their own."""
        if not self._pieces:
            return False
        return any(type_of(unit) in (SLICE, IDR) for unit in units_of(self._head()))

    def _head(self) -> bytes:
        head = b""
        for piece in self._pieces:
            head += piece[:_HEAD]
            if len(piece) > _HEAD:
                break
        return head

    def _drop(self) -> None:
        self.stray += self._size
        self._pieces, self._size, self._gap = [], 0, True

    def _end(self, *, whole: bool) -> list[AccessUnit]:
        head = units_of(self._head())
        kinds = {type_of(unit) for unit in head}
        gap = self._is_gap(head)
        data = b"".join(self._pieces)
        self._pieces, self._size = [], 0
        is_key = IDR in kinds and {SPS, PPS} <= kinds
        size = (0, 0) if self._sequence is None else (self._sequence.width, self._sequence.height)
        made = AccessUnit(data, is_key, self._arrived_ns, self._gap or gap, whole, self._count, *size)
        self._gap = False
        self._count += 1
        return [made]

    def _is_gap(self, head: list[bytes]) -> bool:
        """Whether the number of this picture does not follow that of the one before. Takes note of it."""
        try:
            for unit in head:
                if type_of(unit) == SPS:
                    self._sequence = parse_sequence(unit)
            if self._sequence is None:
                return False
            now = parse_slice(next(unit for unit in head if type_of(unit) in (SLICE, IDR)), self._sequence)
        except DecodeError:
            self._before = None
            return False
        before, self._before = self._before, now
        if now.is_key or before is None:
            return False
        skipped = missing_between(before, now, self._sequence)
        self.missing += min(skipped, 1 << self._sequence.frame_number_bits - 1)
        return skipped != 0 or not now.is_first
