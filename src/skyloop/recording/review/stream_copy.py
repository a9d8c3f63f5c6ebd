"""Recorded H.264 into MP4 as it came: access units are copied, and nothing is decoded or encoded."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from fractions import Fraction
from io import BytesIO
from pathlib import Path
from typing import Any, Final

from skyloop.clock import NS_PER_S
from skyloop.errors import FileFormatError
from skyloop.files import replacing
from skyloop.messages.image_header import MAX_PIXELS
from skyloop.recording.pictures import Picture
from skyloop.wire.h264 import IDR, PPS, SLICE, SPS, START, unit_type, units

TIME_BASE: Final = Fraction(1, 90_000)  #: of the files: the clock of video
MAX_FILES: Final = 50  #: a stream that changes more often is encoded instead
_LONGEST_STEP: Final = round(3600 / TIME_BASE)  #: a longer one is shortened to that: 31 bits hold no six hours
_USUAL_STEP: Final = round(1 / 30 / TIME_BASE)  #: how long a picture is shown after which none comes


@dataclass(frozen=True, slots=True)
class Video:
    """A video that was written."""

    path: Path
    frames: int
    begin_s: float  #: when its first frame was captured, since that of the first video's
    width: int
    height: int
    copied: bool  #: whether the frames are as the vehicle encoded them


@dataclass(frozen=True, slots=True)
class Contents:
    """What an access unit holds."""

    parameters: bytes  #: its sequence and picture parameter sets in Annex B form; empty unless it has both
    is_picture: bool  #: whether it has a slice of a picture


def contents(unit: bytes) -> Contents:
    """Return what an access unit in Annex B form holds. Pure. ITU-T H.264, 7.3.1 and 7.4.1."""
    found = units(unit)
    kinds = {unit_type(one) for one in found}
    sets = [one for one in found if unit_type(one) in (SPS, PPS)] if {SPS, PPS} <= kinds else []
    return Contents(b"".join(START + one for one in sets), bool(kinds & {SLICE, IDR}))


def numbered(path: Path, number: int) -> Path:
    """Return the name of a video's file: ``film.mp4``, then ``film-2.mp4`` and so on."""
    return path if number == 1 else path.with_name(f"{path.stem}-{number}{path.suffix}")


class TooManyChangesError(FileFormatError):
    """The stream changes so often that a file for each part of it would be of no use."""


class StreamCopy:
    """Writes one camera's frames, in their order, to a video; where the stream changes, to another one.

    A stream changes with its parameter sets: MP4 has one of them, at its beginning. Frames that can't be decoded, and
    those up to the next key frame, are left out; the one before them stands until then.

    Args:
        path: The first file.
        opened: Closes the files; they are in their places only then.
    """

    def __init__(self, path: Path, opened: ExitStack) -> None:
        self.videos: list[Video] = []  #: those that are complete
        self.left_out = 0
        self._path = path
        self._opened = opened
        self._file: _File | None = None
        self._whole = False  # whether the frame before was copied
        self._first_ns = 0

    def add(self, picture: Picture) -> None:
        """Copy a frame, or leave it out.

        Raises:
            TooManyChangesError: It would need more than :data:`MAX_FILES` files.
            OSError: The file can't be written.
        """
        file = self._file_for(picture)
        self._whole = file is not None
        if file is None:
            self.left_out += 1
        else:
            file.write(picture.compressed, picture.header.captured_ns, key=picture.record.key)

    def close(self) -> None:
        """Complete the last video."""
        file, self._file = self._file, None
        if file is not None:
            begin_s = (file.first_ns - self._first_ns) / NS_PER_S
            self.videos.append(Video(file.path, file.frames, begin_s, file.width, file.height, copied=True))
            file.close()

    def _file_for(self, picture: Picture) -> _File | None:
        """Return the file for a frame, or None for one that can't be decoded."""
        key = picture.record.key
        if not picture.can_be_decoded or not (key or self._whole):
            return None
        found = contents(picture.compressed)
        if not found.is_picture:
            return None
        if not key:
            return self._file
        if not found.parameters:
            return None  # a key frame without them can't be decoded
        if self._file is None or self._file.parameters != found.parameters:
            template = _template(picture.compressed)
            if template is None:
                return None
            self._next(picture, found.parameters, template)
        return self._file

    def _next(self, picture: Picture, parameters: bytes, template: _Template) -> None:
        self.close()
        number = len(self.videos) + 1
        if number > MAX_FILES:
            raise TooManyChangesError(f"the stream changes more than {MAX_FILES} times")
        path = numbered(self._path, number)
        part = self._opened.enter_context(replacing(path))
        captured_ns = picture.header.captured_ns
        self._first_ns = self._first_ns if self.videos else captured_ns
        self._file = _File(path, part, captured_ns, parameters, template, self._opened)


@dataclass(frozen=True, slots=True)
class _Template:
    """What a key frame says of its stream."""

    stream: Any  # of PyAV
    width: int
    height: int
    close: Callable[[], object]


def _template(key: bytes) -> _Template | None:
    """Let FFmpeg read a key frame's parameter sets; None where it can't."""
    import av

    limits: Any = [{"max_pixels": str(MAX_PIXELS)}]  # a damaged size must not make it ask for gigabytes
    try:
        container = av.open(BytesIO(key), format="h264", stream_options=limits)
    except (av.error.FFmpegError, ValueError):
        return None
    stream = container.streams.video[0]
    if 0 < stream.width * stream.height <= MAX_PIXELS and stream.codec_context.extradata:
        return _Template(stream, stream.width, stream.height, container.close)
    container.close()
    return None


class _File:
    """One MP4 file that is written."""

    def __init__(
        self, path: Path, part: Path, first_ns: int, parameters: bytes, template: _Template, opened: ExitStack
    ) -> None:
        import av

        self.path = path
        self.first_ns = first_ns
        self.parameters = parameters
        self.width, self.height = template.width, template.height
        self.frames = 0
        # PyAV would open the file only with the first frame, and raise errors of its own kinds.
        self._target = opened.enter_context(part.open("wb"))
        self._container: Any = opened.enter_context(av.open(self._target, "w", format="mp4"))
        self._stream = self._container.add_stream_from_template(template.stream)
        self._stream.time_base = TIME_BASE
        template.close()
        self._stamp = -1
        self._shortened = 0

    def write(self, unit: bytes, captured_ns: int, *, key: bool) -> None:
        """Append a frame; a time that is not later than the one before is taken for the next possible one."""
        import av

        packet: Any = av.Packet(unit)
        stamp = round((captured_ns - self.first_ns) / NS_PER_S / TIME_BASE) - self._shortened
        stamp = max(self._stamp + 1, stamp)
        if stamp > self._stamp + _LONGEST_STEP:
            self._shortened += stamp - self._stamp - _LONGEST_STEP
            stamp = self._stamp + _LONGEST_STEP
        packet.pts = packet.dts = self._stamp = stamp
        packet.duration = _USUAL_STEP  # of the last frame alone: others end with the next one
        packet.time_base, packet.stream, packet.is_keyframe = TIME_BASE, self._stream, key
        self._container.mux(packet)
        self.frames += 1

    def close(self) -> None:
        self._container.close()
        self._target.close()
