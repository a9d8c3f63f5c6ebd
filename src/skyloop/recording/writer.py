"""The writing thread and its files: take samples from the backlog, translate and write them, and watch the disk."""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO, Any, Final, Protocol, cast

import msgspec

from skyloop import __version__
from skyloop.clock import beats, nanoseconds
from skyloop.errors import MissingExtraError, UsageError
from skyloop.messages import Severity
from skyloop.messages.frame import H264, Chain
from skyloop.recording import layout
from skyloop.recording.backlog import Backlog, Item, Rank
from skyloop.recording.layout import ClockPair, DroneRecord, End, Start
from skyloop.recording.options import MB, DiskRoom, Options, RecorderState, judge_room, numbered
from skyloop.recording.translation import Message, Schema, TranslatedImage, Translator

CHUNK: Final = MB  #: a chunk is closed at this size, or earlier by :meth:`RecordingFile.commit`
BEAT_S: Final = 0.05  #: interval between polls of the backlog, so that receiving threads need not wake the writer
_COMMIT_NS: Final = nanoseconds(0.5)  #: samples reach the file within this time, unless the disk is too slow
_REOPEN: Final = 4 * MB  #: free bytes required before a new file is opened on a disk that had been full
#: How long to keep writing to a full file until a key frame arrives: cameras not on drones send one about every 10 s.
_KEY_WAIT_NS: Final = nanoseconds(15.0)
_SILENCE_NS: Final = nanoseconds(2.0)  #: after this time without H.264, a full file does not wait for a key frame
_CHECK_NS: Final = nanoseconds(1.0)  #: interval between checks of the disk space, and between attempts to resume

Report = Callable[[str, Severity], None]
_log = logging.getLogger(__name__)


# One MCAP file: committed data stay readable whatever happens later ----------------------------------------------


class Target(Protocol):
    """An unbuffered file that is open for writing."""

    def write(self, data: Any, /) -> int | None: ...
    def truncate(self, size: int | None = None, /) -> int: ...
    def fileno(self) -> int: ...
    def close(self) -> None: ...


Opener = Callable[[Path, bool], Target]


def open_target(path: Path, overwrite: bool) -> Target:
    """Open a file for unbuffered writing. Raise ``OSError`` if the file already exists or can't be written."""
    return cast(Target, path.open("wb" if overwrite else "xb", buffering=0))


class FileOutput:
    """The MCAP writer's stream. Nothing is written to the file until :meth:`flush`, which writes all or nothing."""

    def __init__(self, target: Target) -> None:
        self.committed = 0  #: number of bytes in the file; they end at a record boundary
        self.waiting = 0  #: number of bytes that are not in the file yet
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

        Raise ``OSError`` if the disk fails; the end of the file is then unchanged.
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
    """An MCAP file that is being written; :meth:`commit` makes the messages part of the file.

    Every method raises ``OSError`` if the disk fails; after that, only :meth:`abandon` may be called.
    """

    def __init__(
        self, path: Path, start: Start, clock: ClockPair, *, overwrite: bool = False, opener: Opener = open_target
    ) -> None:
        """Create the file. ``clock`` relates monotonic time to Unix time."""
        try:
            from mcap.writer import CompressionType, Writer
        except ImportError as error:
            raise MissingExtraError("recording", "record", cause=str(error)) from None
        self.path = path  #: the file
        self.written: Counter[str] = Counter()  #: number of messages by topic
        self.count = 0  #: total number of messages
        self._target = opener(path, overwrite)
        self._output = FileOutput(self._target)
        self._writer = Writer(cast(IO[Any], self._output), chunk_size=CHUNK, compression=CompressionType.LZ4)
        self._schemas: dict[type, int] = {}
        self._channels: dict[str, int] = {}
        try:
            self._writer.start(layout.PROFILE, f"skyloop {start.skyloop}")
            self._writer.add_metadata(layout.META_CLOCK, layout.to_metadata(clock))
            self._writer.add_metadata(layout.META_RECORDING, layout.to_metadata(start))
            self._output.flush()
        except OSError:
            self.abandon()
            raise

    @property
    def size(self) -> int:
        """Size in bytes, including data that is not written yet."""
        return self._output.tell()

    @property
    def lost(self) -> bool:
        """Whether the file has been deleted. A file that was only moved is still written to."""
        try:
            return os.fstat(self._target.fileno()).st_nlink == 0
        except OSError:
            return True

    def write(self, message: Message) -> None:
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
            self._writer.add_metadata(layout.META_END, layout.to_metadata(end))
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._output.flush()
        finally:
            self._target.close()

    def abandon(self) -> None:
        """Close the file, and remove it if it is empty. It is readable up to the last commit but has no summary."""
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


# The writing thread ----------------------------------------------------------------------------------------------


def free_space(folder: Path) -> int:
    """Return the free bytes on a folder's disk. Raise ``OSError`` if the disk can't be read."""
    return shutil.disk_usage(folder).free


class FileWriter:
    """Writes a backlog to one file, or to several files in turn. Public attributes can be read from any thread."""

    def __init__(
        self,
        path: Path,
        options: Options,
        backlog: Backlog,
        drones: Sequence[DroneRecord],
        translators: Sequence[Translator],
        clock: ClockPair,
        report: Report,
        *,
        opener: Opener = open_target,
        free: Callable[[Path], int] = free_space,
    ) -> None:
        """Initialise without opening a file.

        ``report`` is called on the writing thread and, for the first file, on the thread that calls :meth:`start`.
        """
        self.state = RecorderState.STARTING  #: state of the recorder
        self.reason = ""  #: reason why the recorder is paused or has failed
        self.files: list[Path] = []  #: all files, oldest first
        self.room = DiskRoom.ALL  #: which samples to write, depending on the space left on the disk
        self.unwritable = 0  #: number of samples that could not be translated
        self.unwritable_why = ""  #: channel and error of the last sample that could not be written
        #: functions that return the totals of dropped and missed samples, by drone and channel
        self.dropped: Callable[[], dict[str, dict[str, int]]] = dict
        self.missed: Callable[[], dict[str, dict[str, int]]] = dict
        self.each_second: Callable[[], None] = lambda: None  #: called every second on the writing thread
        self._path = path
        self._options = options
        self._backlog = backlog
        self._translators = translators
        self._clock = clock
        self._report = report
        self._opener = opener
        self._free = free
        self._floor = round(options.min_free_mb * MB)
        self._start = Start(
            layout.VERSION, __version__, tuple(drones), clock.unix_ns, options=msgspec.to_builtins(options)
        )
        self._file: RecordingFile | None = None
        self._uncommitted: list[Item] = []
        self._closed_bytes = self._closed_messages = 0
        self._now_ns = clock.monotonic_ns
        self._opened_ns = self._commit_due_ns = self._check_due_ns = 0
        self._due_ns = 0  # time at which a new file became due
        self._chains: dict[tuple[int, str], Chain] = {}  # H.264 chains in this file, by drone and channel
        self._encoded_ns = 0  # time of the last H.264 frame written
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="skyloop-recorder", daemon=True)

    def start(self) -> None:
        """Open the first file and start the thread.

        Raise ``UsageError`` if the file can't be written or the disk is too full.
        """
        folder = self._path.parent
        try:
            free = self._free(folder)
            self.room = judge_room(free, self._floor, DiskRoom.ALL)
            if self.room is DiskRoom.NOTHING:
                raise UsageError(
                    f"{folder} has {free / MB:.0f} MB left, but recording keeps {self._floor / MB:.0f} MB free: "
                    "choose another folder, or a lower min_free_mb (--min-free-mb)"
                )
            self._open()
        except OSError as error:
            raise UsageError(f"can't record to {self._path}: {_why(error)}") from error
        self._thread.start()

    def stop(self, timeout_s: float = 10.0) -> None:
        """Write all received samples and close the file; if the disk hangs, leave this to the thread. Idempotent."""
        self._closing.set()
        if self._thread.ident is not None:
            self._thread.join(timeout_s)

    @property
    def shown_reason(self) -> str:
        """The reason why recording is paused, has failed or is leaving out frames."""
        short = self.state is RecorderState.RECORDING and self.room is DiskRoom.NO_FRAMES
        return "the disk is nearly full: no frames are recorded" if short else self.reason

    @property
    def path(self) -> Path:
        """The current file or, if there is none, the previous one."""
        return self.files[-1] if self.files else self._path

    @property
    def bytes(self) -> int:
        """Bytes written so far to all files, including waiting data."""
        file = self._file
        return self._closed_bytes + (0 if file is None else file.size)

    @property
    def messages(self) -> int:
        """Messages written so far to all files."""
        file = self._file
        return self._closed_messages + (0 if file is None else file.count)

    # The thread ------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            self._work()
        except Exception as error:  # noqa: BLE001 (the state must never claim that recording continues)
            self._fail(error)

    def _work(self) -> None:
        for _ in beats(BEAT_S, self._closing):
            self.step(time.monotonic_ns())
        self._check_due_ns = 0  # makes a paused recording try once more, and writes the final counts
        self.step(time.monotonic_ns())
        self._end()

    def _fail(self, error: Exception) -> None:
        """Stop after an unexpected error: set the state, report the error and preserve the committed data."""
        self.state, self.reason = RecorderState.FAILED, f"an error in the recorder: {error!r:.300}"
        _log.exception("the recording to %s ends", self.path)
        file, self._file = self._file, None
        with contextlib.suppress(Exception):
            if file is not None:
                file.abandon()
                self._count(file)
        with contextlib.suppress(Exception):
            text = f"the recording to {self.path} has ended ({self.reason}): data on disk is safe, nothing is added"
            self._report(text, Severity.ERROR)

    def step(self, now_ns: int) -> None:
        """Do the work that is due at the given time [ns, monotonic]. Called by the writing thread, or by a test."""
        self._now_ns = now_ns
        try:
            if now_ns >= self._check_due_ns:
                self._check_due_ns = now_ns + _CHECK_NS
                self._check_disk()
                self.each_second()
            if self._file is not None:
                self._write()
                self._rotate_when_due()
        except OSError as error:
            self._pause(_why(error))

    def _write(self) -> None:
        """Translate and write all waiting samples, committing when due; start a new file, if due, at a key frame."""
        while taken := self._backlog.take(CHUNK):
            key = next((n for n, item in enumerate(taken) if _is_key(item)), None) if self._rotation_due() else None
            if key is None:
                self._write_batch(taken)
                continue
            try:
                self._write_batch(taken[:key])
                self._rotate()
            except OSError:
                self._backlog.put_back(taken[key:])
                raise
            self._write_batch(taken[key:])
        if self._now_ns >= self._commit_due_ns:
            self._commit()

    def _write_batch(self, items: Sequence[Item]) -> None:
        file = self._file
        assert file is not None
        batch = [item for item in items if self._admits(item)]
        self._uncommitted += batch  # done before writing, so that nothing is lost if the disk fails midway
        for item in batch:
            for message in self._messages(item):
                file.write(message)
        if sum(item.size for item in self._uncommitted) >= CHUNK:
            self._commit()

    def _messages(self, item: Item) -> list[Message]:
        """Return all of a sample's messages, or none if the sample can't be translated."""
        try:
            return list(self._translators[item.drone].messages(item))
        except Exception as error:  # noqa: BLE001 (samples contain whatever applications send)
            self._backlog.count(item)
            self.unwritable += 1
            self.unwritable_why = f"{item.channel}: {error!r:.200}"
            _log.warning("a sample of %s can't be recorded: %r", item.channel, error)
            return []

    def _admits(self, item: Item) -> bool:
        if item.rank is not Rank.FRAME or (self.room is DiskRoom.ALL and self._follows(item)):
            return True
        self._backlog.count(item)
        return False

    def _follows(self, item: Item) -> bool:
        """Return whether a frame can be decoded using this file alone."""
        if not isinstance(item.sample, TranslatedImage) or item.sample.record.format != H264:
            return True
        record = item.sample.record
        chain = self._chains.setdefault((item.drone, item.channel), Chain())
        follows = chain.follows(record.header.seq, key=record.key)
        if follows:
            self._encoded_ns = self._now_ns
        return follows

    def _commit(self) -> None:
        assert self._file is not None
        self._file.commit()
        self._uncommitted.clear()
        self._commit_due_ns = self._now_ns + _COMMIT_NS

    def _rotation_due(self) -> bool:
        file, options = self._file, self._options
        assert file is not None
        by_size = options.rotate_mb is not None and file.size >= options.rotate_mb * MB
        return by_size or (
            options.rotate_s is not None and self._now_ns - self._opened_ns >= nanoseconds(options.rotate_s)
        )

    def _rotate_when_due(self) -> None:
        """Start a new file when one is due. With H.264, :meth:`_write` does so at a key frame, unless none arrives."""
        if not self._rotation_due():
            return
        self._due_ns = self._due_ns or self._now_ns
        silent = self._now_ns - self._encoded_ns >= _SILENCE_NS
        if not self._chains or silent or self._now_ns - self._due_ns >= _KEY_WAIT_NS:
            self._rotate()

    def _rotate(self) -> None:
        self._close("rotated")
        self._open()

    # Files -----------------------------------------------------------------------------------------------------

    def _open(self) -> None:
        number = len(self.files) + 1
        # The user did not choose the name of a file that follows a pause, so this file must not overwrite anything.
        overwrite = self._options.overwrite and (number == 1 or self._options.rotates)
        first = number == 1 and not self._options.rotates
        path = self._path if first else self._next_free(number, overwrite)
        start = msgspec.structs.replace(self._start, file=number)
        file = RecordingFile(path, start, self._clock, overwrite=overwrite, opener=self._opener)
        try:
            for translator in self._translators:
                for message in translator.prelude(self._now_ns):
                    file.write(message)
            file.commit()
        except OSError:
            file.abandon()
            raise
        self._file = file
        self._opened_ns = self._now_ns
        self._due_ns = 0
        self._chains.clear()
        self.files.append(path)
        self.state, self.reason = RecorderState.RECORDING, ""
        self._report(f"recording to {path}", Severity.INFO)

    def _next_free(self, number: int, overwrite: bool) -> Path:
        path = numbered(self._path, number)
        while path.exists() and not overwrite:
            number += 1
            path = numbered(self._path, number)
        return path

    def _close(self, reason: str) -> None:
        file = self._file
        assert file is not None
        end = End(reason, time.time_ns(), dict(file.written), self.dropped(), self.missed())
        file.close(end)
        self._file = None
        self._uncommitted.clear()
        self._count(file)

    def _count(self, file: RecordingFile) -> None:
        self._closed_bytes += file.size
        self._closed_messages += file.count

    def _pause(self, why: str) -> None:
        """Pause because writing to the disk failed. Samples that are not committed yet wait for the next file."""
        file, self._file = self._file, None
        if file is not None:
            file.abandon()
            self._count(file)
            self._backlog.put_back(self._uncommitted)
            self._uncommitted.clear()
        if (self.state, self.reason) != (RecorderState.PAUSED, why):
            self.state, self.reason = RecorderState.PAUSED, why
            self._report(f"recording paused ({why}): data on disk is safe, new frames are dropped", Severity.ERROR)

    def _check_disk(self) -> None:
        file = self._file
        if file is not None and file.lost:
            self._pause(f"{file.path} was removed")
            return
        free = self._free(self.path.parent)
        self._judge_room(free)
        if self._file is None and self.room is not DiskRoom.NOTHING and free >= _REOPEN:
            self._open()

    def _judge_room(self, free: int) -> None:
        before = self.room
        self.room = room = judge_room(free, self._floor, before)
        if room is before:
            return
        left = f"{free / MB:.0f} MB left in {self.path.parent}"
        if room is DiskRoom.NOTHING:
            if self._file is not None:
                self._close("rotated")
            self._pause(left)
        elif room is DiskRoom.NO_FRAMES:
            self._report(f"{left}: frames are no longer recorded", Severity.WARNING)
        else:
            self._report(f"{left}: everything is recorded again", Severity.INFO)

    def _end(self) -> None:
        try:
            if self._file is not None:
                self._close("closed")
        except OSError as error:
            self._pause(_why(error))
        self.state = RecorderState.FAILED if self.state is RecorderState.PAUSED else RecorderState.CLOSED


def _is_key(item: Item) -> bool:
    """Return whether a stream can be decoded starting at this frame."""
    sample = item.sample
    return isinstance(sample, TranslatedImage) and sample.record.format == H264 and sample.record.key


def _why(error: OSError) -> str:
    """Describe an error to the user."""
    place = f": {error.filename}" if error.filename else ""
    return f"{error.strerror or error}{place}"
