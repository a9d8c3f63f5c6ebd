"""MSP frames: version 1, its long form for 255 or more bytes, and version 2. Pure.

A version 1 frame is ``$M``, direction, size, function, payload and xor; a version 2 frame is ``$X``, direction, flags,
function (16 bits), size (16 bits), payload and CRC-8/DVB-S2 (INAV's wiki, "MSP V2").
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from typing import Final

MOST: Final = 1024  #: longest payload that the parser waits for; the longest in use, mode names, is below 700 bytes
LONG: Final = 255  #: version 1 size meaning that the next two bytes hold the actual size
LARGEST: Final = 0xFFFF  #: largest function number and payload size, which have 16 bits


class Direction(Enum):
    """The direction of a frame, as given by its third byte."""

    REQUEST = ord("<")  #: sent to the flight controller
    REPLY = ord(">")
    ERROR = ord("!")  #: the flight controller refuses or does not support the function


_DIRECTIONS: Final = {each.value: each for each in Direction}
_V2: Final = struct.Struct("<BHH")


@dataclass(frozen=True, slots=True)
class MspFrame:
    function: int  #: 0 to 65535; 255 and greater only in version 2
    payload: bytes = b""  #: at most 65535 bytes
    direction: Direction = Direction.REQUEST


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = (crc << 1 ^ 0xD5 if crc & 0x80 else crc << 1) & 0xFF
        table.append(crc)
    return tuple(table)


_CRC: Final = _crc_table()


def crc8(data: bytes) -> int:
    """Return the CRC-8/DVB-S2 of the data: polynomial 0xD5, not reflected, initial value 0."""
    crc = 0
    for byte in data:
        crc = _CRC[crc ^ byte]
    return crc


def xor(data: bytes) -> int:
    """Return the exclusive OR of all bytes, which is version 1's checksum."""
    made = 0
    for byte in data:
        made ^= byte
    return made


def encode(frame: MspFrame, *, version: int | None = None) -> bytes:
    """Return a frame's bytes, by default in the lowest version that can represent it. Raises ``ValueError``."""
    function, payload = frame.function, frame.payload
    if not 0 <= function <= LARGEST or len(payload) > LARGEST:
        raise ValueError(f"function {function} with {len(payload)} bytes does not fit into a frame")
    if version is None:
        version = 1 if function < LONG else 2
    if version == 2:
        checked = _V2.pack(0, function, len(payload)) + payload
        return b"$X" + bytes((frame.direction.value,)) + checked + bytes((crc8(checked),))
    if version != 1 or function >= LONG:
        raise ValueError(f"version {version} of MSP has no function {function}")
    size = bytes((min(len(payload), LONG), function))
    if len(payload) >= LONG:
        size += struct.pack("<H", len(payload))
    return b"$M" + bytes((frame.direction.value,)) + size + payload + bytes((xor(size + payload),))


def whole_frames(data: bytes) -> Iterator[bytes]:
    """Yield the frames in ``data``, which must be the output of :func:`encode`."""
    while data:
        if data[1:2] == b"X":
            size = 9 + int.from_bytes(data[6:8], "little")
        else:
            size = 6 + data[3] if data[3] < LONG else 8 + int.from_bytes(data[5:7], "little")
        yield data[:size]
        data = data[size:]


class Parser:
    """Finds frames in a byte stream that may contain other bytes. Never raises.

    After a bad checksum, the search resumes at the byte after the ``$``, so that a frame with missing bytes does not
    also spoil the next frame. ``skipped`` counts the bytes outside frames; ``damaged`` counts the bad checksums.
    """

    def __init__(self) -> None:
        self._kept = bytearray()
        self.skipped = 0
        self.damaged = 0

    def reset(self) -> None:
        """Discard an incomplete frame, because the next bytes come from a new connection."""
        self._kept.clear()

    def feed(self, data: bytes) -> list[MspFrame]:
        """Return the frames that these bytes complete."""
        self._kept += data
        found: list[MspFrame] = []
        at = 0
        while True:
            start = self._kept.find(b"$", at)
            if start < 0:
                self.skipped += len(self._kept) - at
                at = len(self._kept)
                break
            self.skipped += start - at
            at = start
            taken = self._frame(at, found)
            if taken == 0:
                break  # incomplete
            if taken < 0:
                self.skipped += 1
                at += 1
            else:
                at += taken
        del self._kept[:at]
        return found

    def _frame(self, at: int, found: list[MspFrame]) -> int:
        """Return the length of the frame at this ``$``; 0 if the frame is incomplete, -1 if there is no frame."""
        kept = self._kept
        left = len(kept) - at
        if left < 3:
            return -1 if left == 2 and kept[at + 1] not in b"MX" else 0
        direction = _DIRECTIONS.get(kept[at + 2])
        if kept[at + 1] not in b"MX" or direction is None:
            return -1
        head = self._head(at, left)
        if head is None:
            return 0
        function, begin, size = head
        if size > MOST:
            return -1
        length = begin + size + 1
        if left < length:
            return 0
        checked = bytes(kept[at + 3 : at + length - 1])
        check = crc8(checked) if kept[at + 1] == ord("X") else xor(checked)
        if check != kept[at + length - 1]:
            self.damaged += 1
            return -1
        found.append(MspFrame(function, bytes(kept[at + begin : at + begin + size]), direction))
        return length

    def _head(self, at: int, left: int) -> tuple[int, int, int] | None:
        """Return the function, and the start and size of the payload; None until they have arrived."""
        kept = self._kept
        if kept[at + 1] == ord("X"):
            if left < 8:
                return None
            _, function, size = _V2.unpack_from(kept, at + 3)
            return function, 8, size
        if left < 5:
            return None
        size, function = kept[at + 3], kept[at + 4]
        if size < LONG:
            return function, 5, size
        if left < 7:
            return None
        return function, 7, kept[at + 5] | kept[at + 6] << 8
