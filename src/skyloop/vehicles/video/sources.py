"""Where a recording's pictures come from: files that PyAV opens, and files of PaVE streams.

All open at construction, and raise :class:`skyloop.errors.UsageError` or :class:`FileFormatError` that name the file.
"""

from __future__ import annotations

import itertools
import stat
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Protocol

from skyloop.drivers.h264 import Unit
from skyloop.drivers.live_container import Units
from skyloop.errors import FileFormatError, UsageError
from skyloop.messages.frame import H264
from skyloop.pyav import limit_memory
from skyloop.vehicles.ardrone.pave_decoder import PaveDecoder, av
from skyloop.vehicles.ardrone.wire.pave import Codec, PaveFrame, PaveParser

if TYPE_CHECKING:
    from av.container import InputContainer

FFmpegError = av.error.FFmpegError

CHUNK: Final = 1 << 16
SNIFF: Final = 1 << 18  #: a PaVE stream that was torn open somewhere shows its next header well within this
DEFAULT_FPS: Final = 30.0
_TURNED: Final = frozenset({"mov", "mp4", "matroska", "webm"})  #: formats that can say that a picture is to be turned


@dataclass(frozen=True, slots=True)
class DecodedImage:
    """A decoded image and its stamp on the stream's own clock [s]; not yet converted to BGR."""

    stamp_s: float
    frame: av.VideoFrame
    coded: Unit | None = None  #: what it was decoded from, if that is handed on as it came
    number: int = 0  #: of what it was decoded from, in the stream
    reason: str = ""  #: why what it was decoded from is not handed on, of a stream that is
    turns: int = 0  #: quarter turns counter-clockwise that make it upright


class Source(Protocol):
    """One pass over a recording."""

    width: int
    height: int
    fps: float
    damaged: int  #: pieces that could not be decoded so far
    stream: str  #: codec in which pictures can be had as they come, ``h264``, or empty

    def images(self) -> Iterator[DecodedImage]:
        """Yield the pictures in order, until the recording ends."""

    def close(self) -> None: ...


def is_device(path: Path) -> bool:
    """Return whether the path names a device, there or not, rather than a file."""
    if path.is_relative_to("/dev"):
        return True
    try:
        return stat.S_ISCHR(path.stat().st_mode)
    except OSError:
        return False


def open_file(path: Path) -> Source:
    """Open a recording, whatever its format.

    Raises:
        UsageError: It can't be read.
        FileFormatError: It holds no video that is known here.
    """
    try:
        with path.open("rb") as file:
            head = file.read(SNIFF)
    except OSError as error:
        if "%" in path.name:  # a numbered sequence of pictures: PyAV understands the pattern
            return ContainerSource(str(path))
        raise UsageError(f"video://{path}: {error.strerror}") from error
    if path.suffix == ".pave" or PaveParser().feed(head):
        return PaveSource(path)
    return ContainerSource(str(path))


class ContainerSource:
    """A file, or files, that PyAV opens.

    Raises:
        FileFormatError: It can't be opened, or holds no video.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self.damaged = 0
        self.stream = ""
        try:
            self._container: InputContainer = av.open(name)
        except (FFmpegError, OSError, ValueError) as error:
            raise self._error("cannot be opened", error) from error
        videos = self._container.streams.video
        if not videos:
            self._container.close()
            raise FileFormatError(f"{name} holds no video stream")
        self._stream = videos[0]
        limit_memory(self._stream.codec_context)
        self._stream.thread_type = "AUTO"
        self.width, self.height = self._stream.codec_context.width, self._stream.codec_context.height
        self.turns = _quarter_turns(name) if _TURNED & {*self._container.format.name.split(",")} else 0
        if self.turns % 2:
            self.width, self.height = self.height, self.width
        self.fps = float(self._stream.average_rate or self._stream.guessed_rate or DEFAULT_FPS)
        if not (self.width and self.height):
            self._container.close()
            raise FileFormatError(f"{name}: its frame size is missing: it is damaged or cut off")
        self._units = Units(self._stream, self._stream.codec_context)
        if not self._units.reason and not self._stream.codec_context.has_b_frames and not self.turns:
            self.stream = H264

    def images(self) -> Iterator[DecodedImage]:
        """See :meth:`Source.images`."""
        stamp_s = -1.0 / self.fps
        coded: dict[int | None, tuple[int, Unit | None]] = {}  # by the stamp: decoders hold pictures back
        for number, packet in enumerate(self._packets()):
            if self.stream and packet.size:
                coded[packet.pts] = number, self._units.of(packet)
            try:
                images = packet.decode()
            except (FFmpegError, ValueError):  # a damaged packet; the decoder goes on with the next one
                self.damaged += 1
                continue
            for image in images:
                if image.is_corrupt:
                    self.damaged += 1
                    continue
                stamp_s = image.time if image.time is not None else stamp_s + 1.0 / self.fps
                at, unit = coded.pop(image.pts, (0, None))
                reason = self._units.reason if self.stream else ""
                yield DecodedImage(stamp_s, image, unit, at, reason, self.turns)

    def _packets(self) -> Iterator[av.Packet[av.VideoStream]]:
        try:
            yield from self._container.demux(self._stream)
        except (FFmpegError, OSError, ValueError):
            self.damaged += 1  # a file that was cut off: what came so far was good

    def close(self) -> None:
        """Close the file."""
        self._container.close()

    def _error(self, what: str, error: Exception) -> Exception:
        cause = getattr(error, "strerror", None) or str(error)
        return FileFormatError(f"{self._name} {what} as a video: {cause}")


def _quarter_turns(name: str) -> int:
    """Return how often a file's pictures are turned counter-clockwise to be upright.

    A phone held upright films as if it lay on its side, and says so in the container, by a matrix that comes with the
    pictures.
    """
    with suppress(FFmpegError, OSError, ValueError), av.open(name) as container:
        for image in itertools.islice(container.decode(container.streams.video[0]), 1):
            return round(getattr(image, "rotation", 0) / 90) % 4
    return 0


class PaveSource:
    """A file of the raw bytes of an AR.Drone 2's video port.

    Pictures before the first key frame (a stream torn open, or the drone's stale first frame) and after damage up to
    the next key frame are left out: they would be smeared.

    Raises:
        FileFormatError: It holds no frame.
    """

    def __init__(self, path: Path) -> None:
        self._name = str(path)
        self.damaged = 0
        self._parser = PaveParser()
        self._file = path.open("rb")
        first = next(iter(self._parser_frames()), None)
        if first is None:
            self._file.close()
            raise FileFormatError(f"{path} holds no frame of a PaVE stream")
        self._file.seek(0)
        self._parser = PaveParser()
        self.width, self.height, self.fps = first.width, first.height, DEFAULT_FPS
        self.stream = H264 if first.codec == Codec.MPEG4_AVC else ""

    def images(self) -> Iterator[DecodedImage]:
        """See :meth:`Source.images`. Every picture is decoded: each needs the one before."""
        decoder = PaveDecoder()
        for frame in self._parser_frames():
            image = decoder.decode(frame)
            self.damaged = decoder.damaged + self._parser.broken_frames
            if image is not None:
                unit = None
                if frame.codec == Codec.MPEG4_AVC:
                    unit = Unit(frame.payload, frame.is_key, frame.after_damage, frame.width, frame.height)
                yield DecodedImage(frame.timestamp_ms / 1000.0, image, unit, frame.number)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _parser_frames(self) -> Iterator[PaveFrame]:
        while chunk := self._file.read(CHUNK):
            yield from self._parser.feed(chunk)
        self._parser.end()
