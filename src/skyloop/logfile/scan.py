"""Where everything lies in an MCAP file, found without its index: one that was cut off reads like a whole one.

The format is that of https://mcap.dev/spec: records of an opcode, a length and that many bytes, most of them chunks,
which hold messages. A record that the file ends within is where reading stops; of a chunk that was cut, what is there
is read.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import IO, Any, Final

from skyloop.errors import FileFormatError, MissingExtraError, UsageError

try:
    from mcap.data_stream import ReadDataStream
    from mcap.exceptions import McapError
    from mcap.opcode import Opcode
    from mcap.records import Attachment, Channel, Message, Metadata, Schema
except ImportError as error:
    raise MissingExtraError("reading a recording", "record", cause=str(error)) from error

MAGIC: Final = b"\x89MCAP0\r\n"
_FRAME: Final = struct.Struct("<BQ")  #: opcode and length of a record
_CHUNK: Final = struct.Struct(
    "<QQQII"
)  #: first and last time, size and CRC when unpacked, length of compression's name
_MESSAGE: Final = struct.Struct("<HIQQ")  #: channel, sequence, log time, publish time
MAX_RECORD: Final = 1 << 32  #: a longer one is damage
MAX_CHUNK: Final = 1 << 30  #: unpacked
MAX_NAME: Final = 16

#: What reading a damaged record may raise.
Damage: Final = (McapError, struct.error, ValueError, EOFError, MemoryError, OverflowError)

Record = Schema | Channel | Message

__all__ = ["Channel", "Message", "Piece", "Record", "Scan", "Schema", "note", "open_file", "records", "scan"]


@dataclass(frozen=True, slots=True)
class Piece:
    """A chunk, or a run of messages that lie outside of chunks."""

    offset: int  #: of the chunk's data, or of the run's first record
    size: int  #: in the file
    start_ns: int = 0  #: log time of its first and last message; 0 if not known
    end_ns: int = 0
    compression: str | None = None  #: of a chunk, ``""`` for none; None: a run of messages
    crc: int = 0
    cut: bool = False  #: the file ends within it


@dataclass(slots=True)
class Scan:
    """What a file consists of."""

    path: Path
    size: int
    pieces: list[Piece] = field(default_factory=list)
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    metadata: list[Metadata] = field(default_factory=list)
    attachments: list[Attachment] = field(default_factory=list)
    cut: str = ""  #: why it is no whole file, in words; empty for one with index and end
    damaged: list[str] = field(default_factory=list)  #: what can't be read, in words

    def damage(self, what: str) -> None:
        """Remember what can't be read, once."""
        if what not in self.damaged:
            self.damaged.append(what)


def scan(path: str | Path) -> Scan:
    """Look through a file once. Raises :class:`UsageError` for one that is not there, :class:`FileFormatError` for one
    that is no MCAP file."""
    file_path = Path(path)
    with open_file(file_path) as file:
        found = Scan(file_path, file_path.stat().st_size)
        _check_magic(found, file.read(len(MAGIC)))
        _Scanner(found, file).run()
        if found.cut:  # channels are repeated at the end of a whole file only
            for piece in found.pieces:
                for record in records(file, piece, found.damage):
                    note(found, record)
    return found


def open_file(path: Path) -> IO[bytes]:
    """Raises :class:`UsageError` that says why it can't be read."""
    try:
        return path.open("rb")
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from error


def note(found: Scan, record: Record) -> None:
    """Remember a schema or channel."""
    if isinstance(record, Channel):
        found.channels[record.id] = record
    elif isinstance(record, Schema):
        found.schemas[record.id] = record


def records(file: IO[bytes], piece: Piece, damaged: Callable[[str], object] | None = None) -> Iterator[Record]:
    """Schemas, channels and messages of one piece, in the file's order. ``damaged`` is told of what can't be read."""
    file.seek(piece.offset)
    data = file.read(piece.size)
    try:
        if piece.compression is not None:
            data = _unpack(piece, data)
        yield from _parse(data)
    except Damage as error:
        if damaged is not None and not piece.cut:
            damaged(f"at byte {piece.offset}: {error or type(error).__name__}")


def _check_magic(found: Scan, head: bytes) -> None:
    if head == MAGIC:
        return
    if not head:
        raise FileFormatError(f"{found.path} is empty: nothing was recorded")
    raise FileFormatError(f"{found.path} is no MCAP file: it begins with {head!r} and not with {MAGIC!r}")


class _Scanner:
    """One pass over the records of a file."""

    def __init__(self, found: Scan, file: IO[bytes]) -> None:
        self._found = found
        self._file = file
        self._offset = len(MAGIC)
        self._run_start: int | None = None  # of messages outside of chunks

    def run(self) -> None:
        found, file = self._found, self._file
        while True:
            frame = file.read(_FRAME.size)
            if len(frame) < _FRAME.size:
                found.cut = "it has no end: whoever wrote it was stopped" if not frame else "it ends within a record"
                break
            opcode, length = _FRAME.unpack(frame)
            if length > MAX_RECORD or opcode == 0:
                found.cut = f"what stands at byte {self._offset} is no record: the file is damaged from there on"
                break
            end = self._offset + _FRAME.size + length
            if opcode != Opcode.MESSAGE:
                self._end_run()
            if end > found.size:
                found.cut = f"it ends within a record, {end - found.size} bytes short"
                if opcode == Opcode.CHUNK:
                    self._chunk(found.size - self._offset - _FRAME.size, cut=True)
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
        elif opcode in _KEPT:
            try:
                self._keep(_KEPT[opcode](ReadDataStream(BytesIO(self._file.read(length)))))
            except Damage as error:
                self._found.damage(f"at byte {self._offset}: {error or type(error).__name__}")

    def _keep(self, record: Any) -> None:
        if isinstance(record, Metadata):
            self._found.metadata.append(record)
        elif isinstance(record, Attachment):
            self._found.attachments.append(record)
        else:
            note(self._found, record)

    def _chunk(self, length: int, *, cut: bool) -> None:
        head = self._file.read(_CHUNK.size)
        if len(head) < _CHUNK.size:
            return
        start_ns, end_ns, _, crc, name_length = _CHUNK.unpack(head)
        name = self._file.read(min(name_length, MAX_NAME))
        offset = self._offset + _FRAME.size + _CHUNK.size + name_length + 8
        size = length - _CHUNK.size - name_length - 8
        if size > 0:
            compression = name.decode("ascii", "replace")
            self._found.pieces.append(Piece(offset, size, start_ns, end_ns, compression, crc, cut))

    def _end_run(self) -> None:
        if self._run_start is not None:
            self._found.pieces.append(Piece(self._run_start, self._offset - self._run_start))
            self._run_start = None


_KEPT: Final[dict[int, Callable[[ReadDataStream], Any]]] = {
    Opcode.SCHEMA: Schema.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.METADATA: Metadata.read,
    Opcode.ATTACHMENT: Attachment.read,
}


def _unpack(piece: Piece, data: bytes) -> bytes:
    """A chunk's records. What is left of a chunk that was cut, if its compression allows that."""
    if piece.compression == "":
        unpacked = data
    elif piece.compression == "zstd":
        import zstandard

        try:
            unpacked = zstandard.ZstdDecompressor().stream_reader(data).read(MAX_CHUNK)
        except zstandard.ZstdError as error:
            raise ValueError(str(error)) from None
    elif piece.compression == "lz4":
        import lz4.frame

        try:
            unpacked = lz4.frame.LZ4FrameDecompressor().decompress(data, MAX_CHUNK)
        except RuntimeError as error:
            raise ValueError(str(error)) from None
    else:
        raise ValueError(f"its compression {piece.compression!r} is neither zstd nor lz4")
    if piece.crc and not piece.cut and zlib.crc32(unpacked) != piece.crc:
        raise ValueError("its checksum is wrong")
    return unpacked


def _parse(data: bytes) -> Iterator[Record]:
    """Records until the data end; one that is cut there is left out."""
    at, size = 0, len(data)
    while at + _FRAME.size <= size:
        opcode, length = _FRAME.unpack_from(data, at)
        begin = at + _FRAME.size
        at = begin + length
        if at > size:
            return
        if opcode == Opcode.MESSAGE:
            channel_id, sequence, log_ns, publish_ns = _MESSAGE.unpack_from(data, begin)
            yield Message(channel_id, log_ns, data[begin + _MESSAGE.size : at], publish_ns, sequence)
        elif opcode == Opcode.CHANNEL:
            yield Channel.read(ReadDataStream(BytesIO(data[begin:at])))
        elif opcode == Opcode.SCHEMA:
            yield Schema.read(ReadDataStream(BytesIO(data[begin:at])))
