"""Export a camera's frames to MP4. H.264 is copied as recorded; all other images are encoded."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from fractions import Fraction
from io import BytesIO
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import NS_PER_S
from skyloop.drivers.h264 import IDR, PPS, SLICE, SPS, START, unit_type, units
from skyloop.errors import FileFormatError, MissingExtraError
from skyloop.files import replacing
from skyloop.messages.frame import MAX_PIXELS
from skyloop.pyav import require_pyav
from skyloop.recording.layout import image_topic
from skyloop.recording.pictures import RecordedImage
from skyloop.recording.reader import Progress, Recording
from skyloop.recording.review.tables import begin_ns

_TIME_BASE: Final = Fraction(1, 60_000)  #: unit that gives each image its own timestamp; MPEG-4 allows at most 65535
_CODECS: Final = ("libx264", "libopenh264", "mpeg4")  #: codecs by preference; the first one that PyAV has is used


@dataclass(frozen=True, slots=True)
class Videos:
    """The result of an export."""

    videos: tuple[Video, ...]
    left_out: int  #: number of frames that are damaged, depend on missing frames, or (when encoding) differ in size

    @property
    def frames(self) -> int:
        """Number of frames in all videos."""
        return sum(video.frames for video in self.videos)


def export_mp4(
    recording: Recording,
    drone: str,
    camera: str,
    path: Path,
    *,
    burn_time: bool = False,
    encode: bool = False,
    progress: Progress | None = None,
) -> Videos:
    """Write one camera's frames as a video with their capture times.

    H.264 is copied as recorded, without decoding, unless the time is drawn, ``encode`` is set, or some frames are JPEG
    or PNG. If its size or another parameter changes, a new file is started: ``film.mp4``, ``film-2.mp4``, … Frames that
    depend on missing frames are omitted. Otherwise, all frames are encoded into one file, omitting damaged frames and
    frames that differ in size from the first.

    ``burn_time`` draws the time since the recording's start in a corner of each frame; ``encode`` re-encodes H.264.

    Raises:
        UnknownNameError: The recording has no such drone or camera.
        FileFormatError: No frame can be decoded, or the stream changes too often to be copied.
        MissingExtraError: PyAV or OpenCV is not installed.
        UsageError: The file can't be written.
    """
    require_pyav("exporting MP4")
    recording.pictures(drone, camera)  # raises an error if a name is unknown
    if burn_time or encode or has_images(recording, drone, camera):
        return _encoded(recording, drone, camera, path, burn_time, progress)
    return _copied(recording, drone, camera, path, progress)


def has_images(recording: Recording, drone: str, camera: str) -> bool:
    """Return whether any of a camera's frames were recorded as JPEG or PNG."""
    images = image_topic(drone, camera)
    return any(series.topic == images for series in recording.series)


def _copied(recording: Recording, drone: str, camera: str, path: Path, progress: Progress | None) -> Videos:
    with ExitStack() as opened:
        copy = StreamCopy(path, opened)
        try:
            for picture in recording.pictures(drone, camera, progress=progress):
                copy.add(picture)
        except TooManyChangesError as error:
            raise FileFormatError(
                f"{recording.path}: {camera} can't be copied: {error}. Encode it: --encode, or encode=True"
            ) from None
        copy.close()
        if not copy.videos:
            raise _nothing(recording, camera)
    return Videos(tuple(copy.videos), copy.left_out)


def _encoded(
    recording: Recording, drone: str, camera: str, path: Path, burn_time: bool, progress: Progress | None
) -> Videos:
    import av

    begin = begin_ns(recording, drone) if burn_time else None
    left_out = 0
    # PyAV would not open the file until the first frame, and would raise its own exceptions.
    with replacing(path) as part:
        with part.open("wb") as file, av.open(file, "w", format="mp4") as container:
            encoder = _Encoder(container, begin)
            for captured_ns, image in _images(recording.pictures(drone, camera, progress=progress)):
                left_out += image is None or not encoder.add(image, captured_ns)
            video = encoder.close(path)
        if video is None:
            raise _nothing(recording, camera)
    return Videos((video,), left_out)


def _images(pictures: Iterator[RecordedImage]) -> Iterator[tuple[int, NDArray[np.uint8] | None]]:
    """Decode frames; yield each capture time [ns] with the image, or with None if the frame can't be decoded."""
    for picture in pictures:
        try:
            image = even(picture.pixels())
        except FileFormatError:
            image = None  # skip a damaged frame; the other frames keep their timestamps
        yield picture.header.captured_ns, image


class _Encoder:
    """Encodes frames of the same size as the first, with the time since ``begin_ns`` drawn on them (None: no time)."""

    def __init__(self, container: Any, begin_ns: int | None) -> None:
        self._container = container
        self._begin_ns = begin_ns
        self._stream: Any = None
        self._first_ns = 0
        self._stamp = -1
        self._frames = 0

    def add(self, image: NDArray[np.uint8], captured_ns: int) -> bool:
        """Encode a frame; if its size differs, skip it and return False."""
        import av

        if self._stream is None:
            self._stream, self._first_ns = _stream(av, self._container, image), captured_ns
        if image.shape[:2] != (self._stream.height, self._stream.width):
            return False  # the camera switched to another size, but a video can have only one
        if self._begin_ns is not None:
            _burn(image, (captured_ns - self._begin_ns) / NS_PER_S)
        self._stamp = max(self._stamp + 1, round((captured_ns - self._first_ns) / NS_PER_S / _TIME_BASE))
        frame = av.VideoFrame.from_ndarray(image, format="bgr24")
        frame.pts, frame.time_base = self._stamp, _TIME_BASE
        self._container.mux(self._stream.encode(frame))
        self._frames += 1
        return True

    def close(self, path: Path) -> Video | None:
        """Encode the remaining frames and return the video, or None if it is empty."""
        stream = self._stream
        if stream is None:
            return None
        self._container.mux(stream.encode(None))
        return Video(path, self._frames, 0.0, stream.width, stream.height, copied=False)


def _stream(av: Any, container: Any, image: NDArray[np.uint8]) -> Any:
    for codec in _CODECS:
        try:
            stream = container.add_stream(codec, rate=30)
        except (ValueError, av.error.FFmpegError):
            continue
        stream.height, stream.width = image.shape[:2]
        stream.pix_fmt = "yuv420p"
        stream.time_base = stream.codec_context.time_base = _TIME_BASE
        if codec == "libx264":
            stream.options = {"crf": "20", "preset": "veryfast"}
        else:
            stream.bit_rate = 4_000_000
        return stream
    raise MissingExtraError("encoding MP4", "video", cause=f"PyAV has none of {', '.join(_CODECS)}")


def even(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Drop an odd last row or column of an image, because video codecs need even sizes."""
    height, width = image.shape[0] & ~1, image.shape[1] & ~1
    return np.ascontiguousarray(image[:height, :width])


def _burn(image: NDArray[np.uint8], seconds: float) -> None:
    try:
        import cv2
    except ImportError as error:
        raise MissingExtraError("burning the time into frames", "vision", cause=str(error)) from None
    minutes, rest = divmod(abs(seconds), 60.0)
    text = f"{'-' if seconds < 0 else ''}{int(minutes):02d}:{rest:06.3f}"
    scale = max(0.35, image.shape[0] / 720)
    at = (round(12 * scale), image.shape[0] - round(14 * scale))
    for colour, thickness in (((0, 0, 0), 5), ((255, 255, 255), 2)):
        width = max(1, round(thickness * scale))
        cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, width, cv2.LINE_AA)


def _nothing(recording: Recording, camera: str) -> FileFormatError:
    return FileFormatError(f"{recording.path}: no frame of {camera} can be decoded")


# Copying --------------------------------------------------------------------------------------------------------


TIME_BASE: Final = Fraction(1, 90_000)  #: time base of the files; the one commonly used for video
MAX_FILES: Final = 50  #: maximum number of files; a stream that would need more is encoded instead
_LONGEST_STEP: Final = round(3600 / TIME_BASE)  #: longest step between frames; 31 bits hold less than seven hours
_USUAL_STEP: Final = round(1 / 30 / TIME_BASE)  #: duration of the last image of a file


@dataclass(frozen=True, slots=True)
class Video:
    """A video that was written."""

    path: Path
    frames: int
    begin_s: float  #: capture time of the video's first frame, relative to that of the first video
    width: int
    height: int
    copied: bool  #: whether the frames are in the vehicle's own encoding


@dataclass(frozen=True, slots=True)
class Contents:
    """The contents of an access unit."""

    parameters: bytes  #: sequence and picture parameter sets in Annex B format; empty unless both are present
    is_picture: bool  #: whether it contains a slice of a picture


def contents(unit: bytes) -> Contents:
    """Parse an access unit in Annex B format. Pure. See ITU-T H.264, 7.3.1 and 7.4.1."""
    found = units(unit)
    kinds = {unit_type(one) for one in found}
    sets = [one for one in found if unit_type(one) in (SPS, PPS)] if {SPS, PPS} <= kinds else []
    return Contents(b"".join(START + one for one in sets), bool(kinds & {SLICE, IDR}))


def numbered(path: Path, number: int) -> Path:
    """Return the path of a numbered video: ``film.mp4``, then ``film-2.mp4`` and so on."""
    return path if number == 1 else path.with_name(f"{path.stem}-{number}{path.suffix}")


class TooManyChangesError(FileFormatError):
    """Raised when the stream changes too often to write a file for each part."""


class StreamCopy:
    """Copies one camera's frames to a video in the order given, and starts a new video when the stream changes.

    The stream changes when its parameter sets change, because an MP4 file has only one set, at its start. A frame that
    can't be decoded is left out, together with all frames up to the next key frame; the frame before them stays on
    screen until then. ``opened``: closes the files, which receive their final names only at that point.
    """

    def __init__(self, path: Path, opened: ExitStack) -> None:
        self.videos: list[Video] = []  #: completed videos
        self.left_out = 0
        self._path = path
        self._opened = opened
        self._file: _File | None = None
        self._whole = False  # whether the previous frame was copied
        self._first_ns = 0

    def add(self, picture: RecordedImage) -> None:
        """Copy a frame or skip it.

        Raise ``TooManyChangesError`` if the stream would need more than :data:`MAX_FILES` files, and ``OSError`` if the
        file can't be written.
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

    def _file_for(self, picture: RecordedImage) -> _File | None:
        """Return the file to write a frame to, or None if the frame can't be decoded."""
        key = picture.record.key
        if not picture.can_be_decoded or not (key or self._whole):
            return None
        found = contents(picture.compressed)
        if not found.is_picture:
            return None
        if not key:
            return self._file
        if not found.parameters:
            return None  # a key frame without parameter sets can't be decoded
        if self._file is None or self._file.parameters != found.parameters:
            template = _template(picture.compressed)
            if template is None:
                return None
            self._next(picture, found.parameters, template)
        return self._file

    def _next(self, picture: RecordedImage, parameters: bytes, template: _Template) -> None:
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
    """The stream parameters read from a key frame."""

    stream: Any  # a PyAV stream
    width: int
    height: int
    close: Callable[[], object]


def _template(key: bytes) -> _Template | None:
    """Let FFmpeg read the parameter sets of a key frame; return None if it can't."""
    import av

    limits: Any = [{"max_pixels": str(MAX_PIXELS)}]  # prevents a corrupted size from allocating gigabytes
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
    """One MP4 file being written."""

    def __init__(
        self, path: Path, part: Path, first_ns: int, parameters: bytes, template: _Template, opened: ExitStack
    ) -> None:
        import av

        self.path = path
        self.first_ns = first_ns
        self.parameters = parameters
        self.width, self.height = template.width, template.height
        self.frames = 0
        # PyAV would not open the file until the first frame, and would raise its own exceptions.
        self._target = opened.enter_context(part.open("wb"))
        self._container: Any = opened.enter_context(av.open(self._target, "w", format="mp4"))
        self._stream = self._container.add_stream_from_template(template.stream)
        self._stream.time_base = TIME_BASE
        template.close()
        self._stamp = -1
        self._shortened = 0

    def write(self, unit: bytes, captured_ns: int, *, key: bool) -> None:
        """Append a frame. If its time is not later than that of the previous frame, use the next possible time."""
        import av

        packet: Any = av.Packet(unit)
        stamp = round((captured_ns - self.first_ns) / NS_PER_S / TIME_BASE) - self._shortened
        stamp = max(self._stamp + 1, stamp)
        if stamp > self._stamp + _LONGEST_STEP:
            self._shortened += stamp - self._stamp - _LONGEST_STEP
            stamp = self._stamp + _LONGEST_STEP
        packet.pts = packet.dts = self._stamp = stamp
        packet.duration = _USUAL_STEP  # used only for the last frame; others end when the next one starts
        packet.time_base, packet.stream, packet.is_keyframe = TIME_BASE, self._stream, key
        self._container.mux(packet)
        self.frames += 1

    def close(self) -> None:
        self._container.close()
        self._target.close()
