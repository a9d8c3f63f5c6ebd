"""Parrot's PaVE video encapsulation (AR.Drone 2): bytes in, frames out. Pure.

Each frame consists of a little-endian header that starts with ``PaVE``, and one payload; the drone sends them back to
back on TCP port 5555. The layout comes from ``video_encapsulation.h`` in the AR.Drone SDK 2.0.1 and was checked against
two captures from real drones. Headers have 64 bytes in early firmware and 68 in later; a field gives their size.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Final

from skyloop.errors import UsageError

SIGNATURE: Final = b"PaVE"
MIN_HEADER: Final = 64  #: size of the shortest header [bytes]
MAX_HEADER: Final = 128  #: size of the longest plausible header [bytes]
MAX_SIDE: Final = 4096  #: longest plausible side of an image [px]
DEFAULT_MAX_PAYLOAD: Final = 1 << 20  #: size in bytes; the drone's 720p key frames are smaller than 100 kB

_HEADER: Final = struct.Struct("<4sBBHI4HIIBBBBIIHBBBBHI")  # up to and including advertised_size, 52 bytes
_ADVERTISEMENT: Final = 1  #: control flag of a header without a payload
_RESERVED: Final = struct.Struct("<I3f")  # last 16 bytes of a long header; the last 12 of a short one are zeros
_VERSION: Final = 2  #: version of the format
_MACROBLOCK: Final = 16  #: side of a macroblock [px]


class Codec(IntEnum):
    """Values of the header's codec field."""

    VLIB = 1
    P264 = 2
    MPEG4_VISUAL = 3
    MPEG4_AVC = 4  #: H.264, in Annex B form


class FrameType(IntEnum):
    """Values of the header's frame type field."""

    UNKNOWN = 0
    IDR = 1  #: needs no earlier frame and includes the stream's parameters
    I = 2  # noqa: E741  the name used in the format's documentation
    P = 3
    HEADERS = 4  #: parameters only, no picture


@dataclass(frozen=True, slots=True)
class PaveFrame:
    """One frame of the stream, as sent by the drone."""

    codec: int  #: one of :class:`Codec`, or another number
    type: int  #: one of :class:`FrameType`, or another number
    number: int  #: the drone's frame count
    timestamp_ms: int  #: time on the drone's own clock
    width: int  #: width of the displayed image [px]
    height: int
    stream_id: int
    payload: bytes
    after_damage: bool  #: whether bytes were skipped between the previous frame and this one

    @property
    def is_key(self) -> bool:
        """Whether decoding can begin here."""
        return self.type == FrameType.IDR


@dataclass(frozen=True, slots=True)
class _Header:
    size: int
    payload_size: int
    frame: PaveFrame  #: frame whose payload is still empty


def build_header(
    *,
    payload_size: int,
    type: FrameType,
    number: int,
    timestamp_ms: int,
    width: int,
    height: int,
    codec: Codec = Codec.MPEG4_AVC,
    stream_id: int = 1,
    position: int = 0,
    sps_size: int = 0,
    pps_size: int = 0,
    header_size: int = 68,
    attitude_rad: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> bytes:
    """Return the header for a frame with one slice and one chunk. Numbers too large for their fields wrap around.

    ``width`` and ``height`` [px] are those of the image, although it is encoded in whole macroblocks. ``position`` is
    the size of all earlier payloads without their ``sps_size`` and ``pps_size``. ``attitude_rad``, the drone's theta,
    phi and psi, exists only in the 68-byte header (seen in a capture, not documented). Raises :class:`UsageError`
    unless ``header_size`` is 64 or 68.
    """
    if header_size not in (MIN_HEADER, _HEADER.size + _RESERVED.size):
        raise UsageError(f"header_size must be 64, as in early firmware, or 68, got {header_size}")
    encoded_width, encoded_height = (-(-side // _MACROBLOCK) * _MACROBLOCK for side in (width, height))
    sides = encoded_width, encoded_height, width, height
    low, high = position & 0xFFFFFFFF, position >> 32 & 0xFFFFFFFF
    head = _HEADER.pack(
        *(SIGNATURE, _VERSION, codec, header_size, payload_size, *sides, number & 0xFFFFFFFF),
        *(timestamp_ms & 0xFFFFFFFF, 1, 0, type, 0, low, high, stream_id, 1, 0, sps_size, pps_size, 0, payload_size),
    )
    return head + (_RESERVED.pack(2, *attitude_rad) if header_size > MIN_HEADER else bytes(MIN_HEADER - len(head)))


class PaveParser:
    """Splits a byte stream into frames, however the input is divided or damaged.

    After damage it resynchronises on the next header: ``skipped_bytes`` counts bytes that do not belong to any frame;
    ``broken_frames`` counts truncated frames. At most one frame (``max_payload`` and a header) is buffered in addition
    to the bytes from the last call.
    """

    def __init__(self, max_payload: int = DEFAULT_MAX_PAYLOAD) -> None:
        self.max_payload = max_payload
        self.frames = 0
        self.skipped_bytes = 0
        self.broken_frames = 0
        self._buffer = bytearray()
        self._header: _Header | None = None  # header of the frame at the buffer's start
        self._searched = 0  # position up to which the buffer has been searched for a header
        self._damaged = False

    @property
    def buffered(self) -> int:
        """Number of bytes held back until their frame is complete."""
        return len(self._buffer)

    def feed(self, data: bytes | bytearray | memoryview) -> list[PaveFrame]:
        """Add bytes from the stream; return the frames that they complete. Never raises, regardless of input."""
        self._buffer += data
        frames: list[PaveFrame] = []
        while (header := self._header or self._find_header()) is not None:
            if self._break_off(header):
                continue
            if len(self._buffer) < header.size + header.payload_size:
                break
            if not self._is_followed_well(header):
                self.broken_frames += 1
                self._skip(len(SIGNATURE))
                continue
            frame = self._take_frame(header)
            if frame.payload:
                frames.append(frame)
        return frames

    def end(self) -> None:
        """Handle the end of the stream: drop the bytes of an incomplete frame."""
        if self._header is not None:
            self.broken_frames += 1
        self._skip(len(self._buffer))

    def _find_header(self) -> _Header | None:
        """Move the buffer's start to the next plausible header; return None if that needs more bytes."""
        while (start := self._buffer.find(SIGNATURE)) >= 0:
            self._skip(start)
            if len(self._buffer) < MIN_HEADER:
                return None
            header = _read_header(self._buffer, 0, self.max_payload)
            if header is not None:
                self._header, self._searched = header, header.size
                return header
            self._skip(len(SIGNATURE))
        self._skip(max(0, len(self._buffer) - len(SIGNATURE) + 1))
        return None

    def _break_off(self, header: _Header) -> bool:
        """Return whether another frame begins within this frame's payload, as after a wrong length or missing bytes.

        Without this check, one flipped bit in a length could lose all the frames within that length.
        """
        limit = min(header.size + header.payload_size, len(self._buffer))
        while (inner := self._buffer.find(SIGNATURE, self._searched, limit)) >= 0:
            self._searched = inner
            if inner + MIN_HEADER > len(self._buffer):
                return False  # there are not enough bytes to tell yet
            if _read_header(self._buffer, inner, self.max_payload) is not None:
                self.broken_frames += 1
                self._skip(inner)
                return True
            self._searched = inner + 1
        self._searched = max(self._searched, limit - len(SIGNATURE) + 1)
        return False

    def _is_followed_well(self, header: _Header) -> bool:
        """Return whether another frame begins right after this one; if not, some bytes of this frame are wrong."""
        end = header.size + header.payload_size
        return SIGNATURE.startswith(self._buffer[end : end + len(SIGNATURE)])

    def _take_frame(self, header: _Header) -> PaveFrame:
        end = header.size + header.payload_size
        payload = bytes(memoryview(self._buffer)[header.size : end])
        del self._buffer[:end]
        damaged, self._damaged, self._header = self._damaged, False, None
        self.frames += 1
        return replace(header.frame, payload=payload, after_damage=damaged)

    def _skip(self, count: int) -> None:
        if count:
            self.skipped_bytes += count
            self._damaged = True
            del self._buffer[:count]
            self._header = None


def _read_header(buffer: bytearray, at: int, max_payload: int) -> _Header | None:
    """Return the header at a position, from which at least MIN_HEADER bytes remain; None if it is not valid."""
    fields = _HEADER.unpack_from(buffer, at)
    _, version, codec, size, payload_size, encoded_width, encoded_height, width, height, number, timestamp_ms = fields[
        :11
    ]
    frame_type, control, stream_id = fields[13], fields[14], fields[17]
    if not (1 <= version <= 15 and 1 <= codec <= 15 and frame_type <= 15 and MIN_HEADER <= size <= MAX_HEADER):
        return None
    if payload_size > max_payload or not (width <= encoded_width <= MAX_SIDE and height <= encoded_height <= MAX_SIDE):
        return None
    if control & _ADVERTISEMENT:
        payload_size = 0  # an advertisement announces a size but has no payload
    frame = PaveFrame(codec, frame_type, number, timestamp_ms, width, height, stream_id, b"", after_damage=False)
    return _Header(size, payload_size, frame)
