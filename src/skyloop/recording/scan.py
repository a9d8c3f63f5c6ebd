"""Find the structure of an MCAP file from its index, or by a scan if the file is truncated; then read its parts.

The format is described at https://mcap.dev/spec: each record has an opcode, a length and that many bytes. Most are
chunks, which hold messages. Reading stops at a record that is cut off by the end of the file; if this record is a
chunk, the part of it that exists is read.
"""

from __future__ import annotations

import itertools
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from io import BytesIO
from pathlib import Path
from typing import IO, Any, Final

from skyloop.errors import FileFormatError, MissingExtraError, UsageError

# Limits: without them, a file of a few kilobytes could fill the memory or keep a core busy for minutes.
#: Size of a chunk, compressed and decompressed, and size of a message outside chunks [bytes]. Recorders close a chunk
#: after 1 to 4 MB. Only its last message can make it larger; the largest message is an uncompressed 4K image.
MAX_CHUNK: Final = 64 << 20
#: Maximum compression ratio of a chunk. LZ4 reaches a factor of at most 255; for nearly constant data it reaches 150.
MAX_RATIO: Final = 512
MAX_RECORD: Final = 8 << 20  #: maximum size of a metadata record, schema or channel [bytes]; Skyloop's have a few kB
#: Bytes of metadata, schemas and channels, which are kept in memory. In a recording of 100 drones they take about 1 MB.
MAX_HEAD: Final = 32 << 20
MAX_PIECES: Final = 500_000  #: maximum number of chunks; a recorder that writes one per second reaches it in five days
MAX_RECORDS: Final = 5_000_000  #: maximum number of records outside chunks; Skyloop writes a few hundred
MAX_TIME_NS: Final = (1 << 63) - 1  #: Unix time in the year 2262; later times can't be converted to a date
_RUN: Final = 4 << 20  #: size of the messages outside chunks to read at once [bytes]

try:
    from mcap.data_stream import ReadDataStream
    from mcap.exceptions import McapError
    from mcap.opcode import Opcode
    from mcap.records import Attachment, AttachmentIndex, Channel, Message, Metadata, MetadataIndex, Schema
except ImportError as error:
    raise MissingExtraError("reading a recording", "record", cause=str(error)) from error

MAGIC: Final = b"\x89MCAP0\r\n"
FRAME: Final = struct.Struct("<BQ")  #: opcode and length of a record
#: Head of a chunk: first and last time, uncompressed size and CRC, length of the compression's name.
CHUNK_HEAD: Final = struct.Struct("<QQQII")
_MESSAGE: Final = struct.Struct("<HIQQ")  #: channel, sequence, log time, publish time
_LONGEST: Final = 1 << 32  #: maximum length of a record; a longer one counts as damage
MAX_NAME: Final = 16  #: maximum length of a compression's name [bytes]

#: Exceptions that reading a damaged record may raise.
Damage: Final = (McapError, struct.error, ValueError, EOFError, MemoryError, OverflowError, RecursionError)

Record = Schema | Channel | Message

__all__ = ["Attachment", "Channel", "Message", "Metadata", "Opcode", "Schema"]  # from mcap, for our other modules


@dataclass(frozen=True, slots=True)
class Piece:
    """A chunk, or a run of messages outside chunks."""

    offset: int  #: offset of the chunk's data, or of the first record in the run
    size: int  #: size in the file [bytes]
    start_ns: int = 0  #: log times of the first and last messages; 0 if unknown
    end_ns: int = 0
    compression: str | None = None  #: a chunk's compression, ``""`` if it is not compressed; None for a run of messages
    crc: int | None = 0  #: checksum; 0 if there is none, None if it has not been read from the chunk's head yet
    unpacked: int = 0  #: uncompressed size of a chunk's records, as announced
    cut: bool = False  #: whether the file ends within this piece


@dataclass(slots=True)
class Scan:
    """The structure of a file."""

    path: Path
    size: int
    pieces: list[Piece] = field(default_factory=list)
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    metadata: list[Metadata] = field(default_factory=list)
    attachments: list[tuple[int, int]] = field(default_factory=list)  #: offset and length of each attachment
    cut: str = ""  #: why the file is incomplete; empty if the file has an index and an end
    damaged: list[str] = field(default_factory=list)  #: descriptions of unreadable parts
    head: int = 0  #: size of the metadata, schemas and channels kept in memory [bytes]

    def damage(self, what: str) -> None:
        """Add a description of an unreadable part, unless it is already listed."""
        if what not in self.damaged:
            self.damaged.append(what)


def scan(path: str | Path) -> Scan:
    """Scan a file once.

    Raise ``UsageError`` if the file does not exist or can't be read, and ``FileFormatError`` if it is not an MCAP file.
    """
    file_path = Path(path)
    with open_file(file_path) as file:
        found = Scan(file_path, file_path.stat().st_size)
        _check_magic(found, file.read(len(MAGIC)))
        _Scanner(found, file).run()
    return found


def find_channels(found: Scan) -> None:
    """Read all of a truncated file to find its channels, because only complete files repeat them at the end."""
    with open_file(found.path) as file:
        for piece in found.pieces:
            for record in records(file, piece, found.damage):
                note(found, record)


def attachments(found: Scan) -> Iterator[Attachment]:
    """Yield the attachments. Skip unreadable attachments and list them as damage."""
    with open_file(found.path) as file:
        for offset, length in found.attachments:
            file.seek(offset)
            try:
                yield Attachment.read(ReadDataStream(BytesIO(file.read(length))))
            except Damage as error:
                found.damage(f"at byte {offset}: {error or type(error).__name__}")


def open_file(path: Path) -> IO[bytes]:
    """Open a file for reading. Raise ``UsageError`` if the file can't be read; the message gives the reason."""
    try:
        return path.open("rb")
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from error


def note(found: Scan, record: Record) -> None:
    """Store a schema or channel, unless there are already too many."""
    if isinstance(record, Channel):
        if record.id in found.channels or has_room(found, len(record.topic) + len(str(record.metadata))):
            found.channels[record.id] = record
    elif isinstance(record, Schema) and (record.id in found.schemas or has_room(found, len(record.data))):
        found.schemas[record.id] = record


def has_room(found: Scan, size: int) -> bool:
    """Return whether ``size`` more bytes can be kept in memory; if not, list this as damage."""
    found.head += size
    if found.head > MAX_HEAD:
        found.damage(f"more than {MAX_HEAD} bytes of metadata, schemas and channels; the rest are skipped")
    return found.head <= MAX_HEAD


def records(file: IO[bytes], piece: Piece, damaged: Callable[[str], object] | None = None) -> Iterator[Record]:
    """Yield the schemas, channels and messages of a piece in file order; report what can't be read to ``damaged``."""
    try:
        if piece.size > MAX_CHUNK:
            raise ValueError(f"a part of {piece.size} bytes, but at most {MAX_CHUNK} are read at once")
        if piece.crc is None:
            piece = _with_crc(file, piece)
        file.seek(piece.offset)
        data = file.read(piece.size)
        most = len(data)  # maximum number of records, since each one takes at least one uncompressed byte
        if piece.compression is not None:
            data = _unpack(piece, data)
        yield from _parse(data, most)
    except Damage as error:
        if damaged is not None and not piece.cut:
            damaged(f"at byte {piece.offset}: {error or type(error).__name__}")


def chunk_head_size(compression: str) -> int:
    """Return the number of bytes that precede the data in a chunk's record."""
    return FRAME.size + CHUNK_HEAD.size + len(compression) + 8


def _with_crc(file: IO[bytes], piece: Piece) -> Piece:
    """Read the checksum of a chunk that is known only from the index.

    Raise ``ValueError`` if there is no chunk at that offset.
    """
    size = chunk_head_size(piece.compression or "")
    file.seek(piece.offset - size)
    head = file.read(size)
    if FRAME.unpack_from(head) != (Opcode.CHUNK, size - FRAME.size + piece.size):
        raise ValueError("the file's index points to a chunk that is not there")
    _, _, unpacked, crc, _ = CHUNK_HEAD.unpack_from(head, FRAME.size)
    if unpacked != piece.unpacked:
        raise ValueError("a chunk's size differs from the file's index")
    return replace(piece, crc=crc)


def _check_magic(found: Scan, head: bytes) -> None:
    if head == MAGIC:
        return
    if not head:
        raise FileFormatError(f"{found.path} is empty: nothing was recorded")
    raise FileFormatError(f"{found.path} is not an MCAP file: it begins with {head!r}")


class _Scanner:
    """One pass over the records of a file."""

    def __init__(self, found: Scan, file: IO[bytes]) -> None:
        self._found = found
        self._file = file
        self._offset = len(MAGIC)
        self._run_start: int | None = None  # start of a run of messages outside chunks

    def run(self) -> None:
        found, file = self._found, self._file
        for number in itertools.count():
            if number >= MAX_RECORDS or len(found.pieces) >= MAX_PIECES:
                found.cut = f"it is read only up to byte {self._offset}: it has too many records"
                break
            frame = file.read(FRAME.size)
            if len(frame) < FRAME.size:
                found.cut = "it has no end: its writer was stopped" if not frame else "it ends within a record"
                break
            opcode, length = FRAME.unpack(frame)
            if length > _LONGEST or opcode == 0:
                found.cut = f"there is no record at byte {self._offset}: the file is damaged from there on"
                break
            end = self._offset + FRAME.size + length
            if opcode != Opcode.MESSAGE or self._run_size() + length > _RUN:
                self._end_run()
            if end > found.size:
                found.cut = f"it ends within a record, {end - found.size} bytes short"
                if opcode == Opcode.CHUNK:
                    self._chunk(found.size - self._offset - FRAME.size, cut=True)
                break
            if opcode == Opcode.FOOTER:
                return
            self._record(opcode, length)
            self._offset = end
            file.seek(end)
        self._end_run()

    def _record(self, opcode: int, length: int) -> None:
        if opcode == Opcode.CHUNK:
            self._chunk(length, cut=False)
        elif opcode == Opcode.MESSAGE:
            if self._run_start is None:
                self._run_start = self._offset
        elif opcode == Opcode.ATTACHMENT:
            self._found.attachments.append((self._offset + FRAME.size, length))
        elif opcode in _KEPT:
            try:
                self._keep(_KEPT[opcode], length)
            except Damage as error:
                self._found.damage(f"at byte {self._offset}: {error or type(error).__name__}")

    def _keep(self, read: Callable[[ReadDataStream], Any], length: int) -> None:
        if length > MAX_RECORD:
            raise ValueError(f"a record of {length} bytes, but at most {MAX_RECORD} are read")
        record = read(ReadDataStream(BytesIO(self._file.read(length))))
        if not isinstance(record, Metadata):
            note(self._found, record)
        elif has_room(self._found, length):
            self._found.metadata.append(record)

    def _chunk(self, length: int, *, cut: bool) -> None:
        head = self._file.read(CHUNK_HEAD.size)
        if len(head) < CHUNK_HEAD.size:
            return
        start_ns, end_ns, unpacked, crc, name_length = CHUNK_HEAD.unpack(head)
        if not start_ns <= end_ns <= MAX_TIME_NS:
            start_ns = end_ns = 0
        name = self._file.read(min(name_length, MAX_NAME))
        offset = self._offset + FRAME.size + CHUNK_HEAD.size + name_length + 8
        size = length - CHUNK_HEAD.size - name_length - 8
        if size > 0:
            compression = name.decode("ascii", "replace")
            self._found.pieces.append(Piece(offset, size, start_ns, end_ns, compression, crc, unpacked, cut))

    def _run_size(self) -> int:
        return 0 if self._run_start is None else self._offset - self._run_start

    def _end_run(self) -> None:
        if self._run_start is not None:
            self._found.pieces.append(Piece(self._run_start, self._offset - self._run_start))
            self._run_start = None


_KEPT: Final[dict[int, Callable[[ReadDataStream], Any]]] = {
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.METADATA: Metadata.read,
}


def _unpack(piece: Piece, data: bytes) -> bytes:
    """Decompress a chunk's records; if the chunk is truncated, recover as many as its compression format allows.

    Nothing is decompressed if the chunk announces too much, and otherwise at most one byte more than it announces, to
    notice an excess.
    """
    size = piece.unpacked
    if size > min(MAX_CHUNK, MAX_RATIO * len(data)) and not piece.cut:
        raise ValueError(
            f"{len(data)} bytes claim to unpack to {size}, but at most {MAX_RATIO} times as many and "
            f"at most {MAX_CHUNK} are allowed"
        )
    size = min(size, MAX_CHUNK, MAX_RATIO * len(data))
    if piece.compression == "":
        unpacked = data
    elif piece.compression == "zstd":
        import zstandard

        try:
            unpacked = zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK).stream_reader(data).read(size + 1)
        except zstandard.ZstdError as error:
            raise ValueError(str(error)) from None
    elif piece.compression == "lz4":
        import lz4.frame

        try:
            unpacked = lz4.frame.LZ4FrameDecompressor().decompress(data, size + 1)
        except RuntimeError as error:
            raise ValueError(str(error)) from None
    else:
        raise ValueError(f"its compression {piece.compression!r} is neither zstd nor lz4")
    if len(unpacked) > size and not piece.cut:
        raise ValueError(f"it contains more than the {size} bytes that it announces")
    if piece.crc and not piece.cut and zlib.crc32(unpacked) != piece.crc:
        raise ValueError("its checksum is wrong")
    return unpacked


def _parse(data: bytes, most: int) -> Iterator[Record]:
    """Yield records up to the end of the data; skip a record that is cut off there.

    Raise ``ValueError`` if there are more than ``most`` records.
    """
    at, size = 0, len(data)
    for number in itertools.count():
        if at + FRAME.size > size:
            return
        if number >= most:
            raise ValueError(f"more than {most} records in {most} bytes; the rest are skipped")
        opcode, length = FRAME.unpack_from(data, at)
        begin = at + FRAME.size
        at = begin + length
        if at > size:
            return
        if opcode != Opcode.MESSAGE and length > MAX_RECORD:
            raise ValueError(f"a record of {length} bytes, but at most {MAX_RECORD} are read")
        if opcode == Opcode.MESSAGE:
            channel_id, sequence, log_ns, publish_ns = _MESSAGE.unpack_from(data, begin)
            yield Message(channel_id, log_ns, data[begin + _MESSAGE.size : at], publish_ns, sequence)
        elif opcode == Opcode.CHANNEL:
            yield Channel.read(ReadDataStream(BytesIO(data[begin:at])))
        elif opcode == Opcode.SCHEMA:
            yield Schema.read(ReadDataStream(BytesIO(data[begin:at])))


# The index ------------------------------------------------------------------------------------------------------
#
# Opens a file without reading all of its records. The index is trusted only if it accounts for every byte of the file,
# in which case it must agree with scan(). The footer holds the offset and checksum of the summary, which lists the
# offset, size and times of each chunk.


_FOOTER: Final = struct.Struct("<QQI")  #: offset of the summary, offset of its offset section, checksum
_TAIL: Final = FRAME.size + _FOOTER.size + len(MAGIC)
_DATA_END: Final = FRAME.size + 4
_INDEX_HEAD: Final = struct.Struct("<QQQQI")  #: first and last time, offset, length, bytes in the map that follows
_INDEX_SIZES: Final = struct.Struct("<QQ")  #: sizes of a chunk's data, first compressed, then uncompressed
_U64: Final = struct.Struct("<Q")
_U32: Final = struct.Struct("<I")


def indexed(path: str | Path) -> Scan | None:
    """Return the structure of a file from its index, or None if it has no reliable index.

    Raise ``UsageError`` if the file does not exist or can't be read.
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
    spans: list[tuple[int, int]] = []  # offset and end of each part between the header and the end of data
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
    return not found.damaged  # oversized content was skipped, but its order matters, so a scan is needed


def _header_end(file: IO[bytes]) -> int:
    """Return the end of the file's first record, or 0 if that is not a header."""
    head = file.read(len(MAGIC) + FRAME.size)
    if len(head) < len(MAGIC) + FRAME.size or not head.startswith(MAGIC):
        return 0
    opcode, length = FRAME.unpack_from(head, len(MAGIC))
    return len(head) + int(length) if opcode == Opcode.HEADER else 0


def _summary(found: Scan, file: IO[bytes]) -> tuple[bytes, int] | None:
    """Return the summary section and the offset of the end of the data before it; None if it is missing or damaged."""
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
            raise ValueError("a record extends beyond the summary")
        yield opcode, data[at - length : at]


def _chunk(body: bytes) -> tuple[Piece, tuple[int, int]]:
    """Return a chunk and its extent in the file, including its message indexes."""
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
    """Return whether spans cover the range between two offsets without gaps."""
    for start, stop in spans:
        if start != begin or stop < start:
            return False
        begin = stop
    return begin == end


def _keep_metadata(found: Scan, file: IO[bytes], index: MetadataIndex) -> None:
    length = index.length - FRAME.size
    file.seek(index.offset)
    if not 0 <= length <= MAX_RECORD or FRAME.unpack(file.read(FRAME.size)) != (Opcode.METADATA, length):
        raise ValueError("the file's index points to metadata that is not there")
    if has_room(found, length):
        found.metadata.append(Metadata.read(_stream(file.read(length))))


def _stream(body: bytes) -> ReadDataStream:
    return ReadDataStream(BytesIO(body))
