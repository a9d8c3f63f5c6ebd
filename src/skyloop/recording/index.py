"""The structure of a complete MCAP file by the index at its end, without touching what lies before it.

The index is believed only if it accounts for every byte of the file: then it says the same as
:func:`skyloop.recording.scan.scan`. The format is that of https://mcap.dev/spec: the footer says where the summary is,
with its checksum, and that has each chunk's place, size and times.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import IO, Final

from skyloop.recording.scan import (
    FRAME,
    MAGIC,
    MAX_HEAD,
    MAX_NAME,
    MAX_PIECES,
    MAX_RECORD,
    MAX_TIME_NS,
    AttachmentIndex,
    Channel,
    Damage,
    Metadata,
    MetadataIndex,
    Opcode,
    Piece,
    ReadDataStream,
    Scan,
    Schema,
    chunk_head_size,
    has_room,
    note,
    open_file,
)

_FOOTER: Final = struct.Struct("<QQI")  #: begin of the summary and of its offsets, checksum
_TAIL: Final = FRAME.size + _FOOTER.size + len(MAGIC)
_DATA_END: Final = FRAME.size + 4
_INDEX_HEAD: Final = struct.Struct("<QQQQI")  #: first and last time, offset and length, bytes of the map that follows
_INDEX_SIZES: Final = struct.Struct("<QQ")  #: of a chunk's data, packed and unpacked
_U64: Final = struct.Struct("<Q")
_U32: Final = struct.Struct("<I")


def indexed(path: str | Path) -> Scan | None:
    """Return the structure of a file by its index; None if it has none that can be relied on.

    Raises:
        UsageError: The file does not exist or can't be read.
    """
    file_path = Path(path)
    with open_file(file_path) as file:
        found = Scan(file_path, file_path.stat().st_size)
        try:
            whole = _read(found, file)
        except Damage:
            return None
    return found if whole else None


def _read(found: Scan, file: IO[bytes]) -> bool:
    """Read the index; return whether it accounts for the whole file."""
    begin = _header_end(file)
    summary = _summary(found, file)
    if not begin or summary is None:
        return False
    data, end = summary
    spans: list[tuple[int, int]] = []  # what lies between the header and the end of the data: offset and end
    metadata: list[MetadataIndex] = []
    for opcode, body in _records(data):
        if opcode == Opcode.CHUNK_INDEX:
            piece, span = _chunk(body)
            found.pieces.append(piece)
            spans.append(span)
        elif opcode == Opcode.CHANNEL:
            note(found, Channel.read(_stream(body)))
        elif opcode == Opcode.SCHEMA:
            note(found, Schema.read(_stream(body)))
        elif opcode == Opcode.METADATA_INDEX:
            index = MetadataIndex.read(_stream(body))
            metadata.append(index)
            spans.append((index.offset, index.offset + index.length))
        elif opcode == Opcode.ATTACHMENT_INDEX:
            one = AttachmentIndex.read(_stream(body))
            found.attachments.append((one.offset + FRAME.size, one.length - FRAME.size))
            spans.append((one.offset, one.offset + one.length))
    if len(found.pieces) > MAX_PIECES or not _is_gapless(sorted(spans), begin, end):
        return False
    found.pieces.sort(key=lambda piece: piece.offset)
    found.attachments.sort()
    for index in sorted(metadata, key=lambda index: index.offset):
        _keep_metadata(found, file, index)
    return not found.damaged  # what is left out of a file that holds too much depends on the order: a scan decides


def _header_end(file: IO[bytes]) -> int:
    """Return where the file's first record ends; 0 if that is no header."""
    head = file.read(len(MAGIC) + FRAME.size)
    if len(head) < len(MAGIC) + FRAME.size or not head.startswith(MAGIC):
        return 0
    opcode, length = FRAME.unpack_from(head, len(MAGIC))
    return len(head) + int(length) if opcode == Opcode.HEADER else 0


def _summary(found: Scan, file: IO[bytes]) -> tuple[bytes, int] | None:
    """Return the summary section and where the data before it end; None if it is not there, or damaged."""
    at = found.size - _TAIL
    if at < 0:
        return None
    file.seek(at)
    tail = file.read(_TAIL)
    opcode, length = FRAME.unpack_from(tail)
    begin, _, checksum = _FOOTER.unpack_from(tail, FRAME.size)
    is_footer = tail.endswith(MAGIC) and opcode == Opcode.FOOTER and length == _FOOTER.size
    if not is_footer or not checksum or not _DATA_END <= begin <= at or at - begin > MAX_HEAD:
        return None
    file.seek(begin - _DATA_END)
    data_end = file.read(_DATA_END)
    if FRAME.unpack_from(data_end) != (Opcode.DATA_END, 4):
        return None
    data = file.read(at - begin)
    if zlib.crc32(tail[: FRAME.size + _FOOTER.size - 4], zlib.crc32(data)) != checksum:
        return None
    return data, begin - _DATA_END


def _records(data: bytes) -> Iterator[tuple[int, bytes]]:
    at = 0
    while at < len(data):
        opcode, length = FRAME.unpack_from(data, at)
        at += FRAME.size + length
        if at > len(data):
            raise ValueError("a record that is longer than the summary")
        yield opcode, data[at - length : at]


def _chunk(body: bytes) -> tuple[Piece, tuple[int, int]]:
    """Return a chunk, and where it lies with the indexes of its messages."""
    start_ns, end_ns, offset, length, map_size = _INDEX_HEAD.unpack_from(body)
    at = _INDEX_HEAD.size + map_size
    (indexes,) = _U64.unpack_from(body, at)
    (name_length,) = _U32.unpack_from(body, at + _U64.size)
    at += _U64.size + _U32.size + name_length
    size, unpacked = _INDEX_SIZES.unpack_from(body, at)
    compression = body[at - name_length : at].decode("ascii")
    if name_length > MAX_NAME or length != chunk_head_size(compression) + size:
        raise ValueError("a chunk's sizes contradict each other")
    if not start_ns <= end_ns <= MAX_TIME_NS:
        start_ns = end_ns = 0
    piece = Piece(offset + length - size, size, start_ns, end_ns, compression, None, unpacked)
    return piece, (offset, offset + length + indexes)


def _is_gapless(spans: list[tuple[int, int]], begin: int, end: int) -> bool:
    """Whether spans follow each other without gaps from one offset to another."""
    for start, stop in spans:
        if start != begin or stop < start:
            return False
        begin = stop
    return begin == end


def _keep_metadata(found: Scan, file: IO[bytes], index: MetadataIndex) -> None:
    length = index.length - FRAME.size
    file.seek(index.offset)
    if not 0 <= length <= MAX_RECORD or FRAME.unpack(file.read(FRAME.size)) != (Opcode.METADATA, length):
        raise ValueError("no metadata where the index says so")
    if has_room(found, length):
        found.metadata.append(Metadata.read(_stream(file.read(length))))


def _stream(body: bytes) -> ReadDataStream:
    return ReadDataStream(BytesIO(body))
