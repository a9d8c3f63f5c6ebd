"""One MCAP file of a recording. Committed data stay readable whatever happens later."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Final, Protocol, cast

import msgspec

from skyloop.errors import MissingExtraError
from skyloop.recording import layout
from skyloop.recording.layout import META_CLOCK, META_END, META_RECORDING, PROFILE, ClockPair, End, Start, to_metadata
from skyloop.recording.options import MB

if TYPE_CHECKING:
    from google.protobuf.message import Message as Protobuf

CHUNK: Final = MB  #: a chunk is closed after this many bytes, or earlier by :meth:`RecordingFile.commit`


class Target(Protocol):
    """An unbuffered file that is open for writing."""

    def write(self, data: Any, /) -> int | None: ...
    def truncate(self, size: int | None = None, /) -> int: ...
    def fileno(self) -> int: ...
    def close(self) -> None: ...


Opener = Callable[[Path, bool], Target]


def open_target(path: Path, overwrite: bool) -> Target:
    """Open a file for unbuffered writing.

    Raises:
        OSError: The file already exists, or can't be written.
    """
    return cast(Target, path.open("wb" if overwrite else "xb", buffering=0))


@dataclass(frozen=True, slots=True)
class Message:
    """A message for the file. ``kind`` is the class of a Skyloop sample, or a protobuf class."""

    topic: str
    kind: type[msgspec.Struct | Protobuf]
    data: bytes
    log_ns: int  #: Unix time
    publish_ns: int
    sequence: int = 0


@dataclass(frozen=True, slots=True)
class Schema:
    """Describes a kind of message to programs that do not know it."""

    name: str
    encoding: str  #: encoding of the schema itself
    data: bytes
    message_encoding: str

    @classmethod
    def of(cls, kind: type[Any]) -> Schema:
        """Return the schema for a :class:`Message`'s kind."""
        if issubclass(kind, msgspec.Struct):
            return cls(layout.schema_name(kind), layout.JSON_SCHEMA, layout.schema(kind), layout.JSON)
        from skyloop.recording import foxglove

        return cls(kind.DESCRIPTOR.full_name, layout.PROTOBUF, foxglove.schema(kind), layout.PROTOBUF)


class Output:
    """The MCAP writer's stream. Nothing reaches the file until :meth:`flush`, which writes everything or nothing."""

    def __init__(self, target: Target) -> None:
        self.committed = 0  #: bytes in the file, always ending at a record boundary
        self.waiting = 0  #: bytes not yet in the file
        self._target = target
        self._pieces: list[bytes] = []

    def write(self, data: bytes) -> int:
        """Append to the waiting data and return the number of bytes."""
        self._pieces.append(data)
        self.waiting += len(data)
        return len(data)

    def tell(self) -> int:
        """Return the size of the file, including waiting data [bytes]."""
        return self.committed + self.waiting

    def flush(self) -> None:
        """Write the waiting data to the file.

        Raises:
            OSError: The disk fails; the file still ends where it did before.
        """
        try:
            for piece in self._pieces:
                rest = memoryview(piece)
                while rest:
                    rest = rest[self._target.write(rest) or 0 :]
        except OSError:
            self._target.truncate(self.committed)
            raise
        else:
            self.committed += self.waiting
        finally:
            self.waiting = 0
            self._pieces.clear()


class RecordingFile:
    """An MCAP file being written; :meth:`commit` makes the messages part of the file.

    Every method raises ``OSError`` if the disk fails; after that, only :meth:`abandon` may be called.

    Attributes:
        path: The file.
        written: Number of messages by topic.
        count: Total number of messages.
    """

    def __init__(
        self, path: Path, start: Start, clock: ClockPair, *, overwrite: bool = False, opener: Opener = open_target
    ) -> None:
        """Create the file and write its metadata. ``clock`` relates monotonic to Unix time.

        Raises:
            OSError: The file can't be created or written.
            MissingExtraError: The extra ``[record]`` is not installed.
        """
        try:
            from mcap.writer import CompressionType, Writer
        except ImportError as error:
            raise MissingExtraError("recording", "record", cause=str(error)) from None
        self.path = path
        self.written: Counter[str] = Counter()
        self.count = 0  #: total number of messages
        self._target = opener(path, overwrite)
        self._output = Output(self._target)
        self._writer = Writer(cast(IO[Any], self._output), chunk_size=CHUNK, compression=CompressionType.LZ4)
        self._schemas: dict[type, int] = {}
        self._channels: dict[str, int] = {}
        try:
            self._writer.start(PROFILE, f"skyloop {start.skyloop}")
            self._writer.add_metadata(META_CLOCK, to_metadata(clock))
            self._writer.add_metadata(META_RECORDING, to_metadata(start))
            self._output.flush()
        except OSError:
            self.abandon()
            raise

    @property
    def size(self) -> int:
        """Size in bytes, including waiting data."""
        return self._output.tell()

    @property
    def lost(self) -> bool:
        """Whether the file was deleted. A file that was only moved is still written to."""
        try:
            return os.fstat(self._target.fileno()).st_nlink == 0
        except OSError:
            return True

    def write(self, message: Message) -> None:
        """Append a message."""
        channel = self._channels.get(message.topic)
        if channel is None:
            channel = self._add_channel(message)
        self._writer.add_message(channel, message.log_ns, message.data, message.publish_ns, message.sequence)
        self.written[message.topic] += 1
        self.count += 1

    def commit(self) -> None:
        """Close the chunk and write all waiting data to the file."""
        self._writer.flush()  # type: ignore[no-untyped-call]

    def close(self, end: End) -> None:
        """Write the summary and close the file."""
        try:
            self._writer.flush()  # type: ignore[no-untyped-call]
            self._writer.add_metadata(META_END, to_metadata(end))
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._output.flush()
        finally:
            self._target.close()

    def abandon(self) -> None:
        """Close the file as it is, readable up to the last commit but without a summary. Remove it if it is empty."""
        self._target.close()
        if not self._output.committed:
            self.path.unlink(missing_ok=True)

    def _add_channel(self, message: Message) -> int:
        schema = Schema.of(message.kind)
        number = self._schemas.get(message.kind)
        if number is None:
            number = self._writer.register_schema(schema.name, schema.encoding, schema.data)
            self._schemas[message.kind] = number
        channel = self._writer.register_channel(message.topic, schema.message_encoding, number)
        self._channels[message.topic] = channel
        return channel
