"""Export of a camera's frames to MP4: H.264 as it came, anything else encoded."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import NS_PER_S
from skyloop.errors import FileFormatError, MissingExtraError
from skyloop.files import replacing
from skyloop.pyav import require_pyav
from skyloop.recording.layout import image_topic
from skyloop.recording.pictures import Picture
from skyloop.recording.reader import Progress, Recording
from skyloop.recording.review.stream_copy import StreamCopy, TooManyChangesError, Video
from skyloop.recording.review.tables import begin_ns

_TIME_BASE: Final = Fraction(1, 60_000)  #: each picture keeps its own time; MPEG-4 takes no more than 65535
_CODECS: Final = ("libx264", "libopenh264", "mpeg4")  #: the first that this PyAV has


@dataclass(frozen=True, slots=True)
class Videos:
    """What an export wrote."""

    videos: tuple[Video, ...]
    left_out: int  #: frames that are damaged, build on missing ones, or for an encoder have another size

    @property
    def frames(self) -> int:
        """Frames of all videos."""
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
    """Write one camera's frames as a video with the times of their capture.

    H.264 is copied as it was recorded, without decoding it, if nothing is drawn into the frames. Where its size or
    another of its parameters changes, a further file begins: ``film.mp4``, ``film-2.mp4``, … Frames that build on
    missing ones are left out. All else is encoded into one file; damaged frames, and frames of another size than the
    first, are left out.

    Args:
        recording: The recording.
        drone: The drone's name.
        camera: The camera's name.
        path: The file.
        burn_time: Whether to draw the time since the recording's start into a corner of each frame.
        encode: Whether to encode H.264 as well.
        progress: Called with the share that was read, 0 to 1.

    Raises:
        UnknownNameError: The recording has no such drone or camera.
        FileFormatError: No frame can be decoded, or the stream changes too often to be copied.
        MissingExtraError: PyAV or OpenCV is not installed.
        UsageError: The file can't be written.
    """
    require_pyav("exporting MP4")
    recording.pictures(drone, camera)  # raises for an unknown name
    if burn_time or encode or has_images(recording, drone, camera):
        return _encoded(recording, drone, camera, path, burn_time, progress)
    return _copied(recording, drone, camera, path, progress)


def has_images(recording: Recording, drone: str, camera: str) -> bool:
    """Whether frames of a camera were recorded as JPEG or PNG, all of them or some."""
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
    # PyAV would open the file only with the first frame, and raise errors of its own kinds.
    with replacing(path) as part:
        with part.open("wb") as file, av.open(file, "w", format="mp4") as container:
            encoder = _Encoder(container, begin)
            for captured_ns, image in _images(recording.pictures(drone, camera, progress=progress)):
                left_out += image is None or not encoder.add(image, captured_ns)
            video = encoder.close(path)
        if video is None:
            raise _nothing(recording, camera)
    return Videos((video,), left_out)


def _images(pictures: Iterator[Picture]) -> Iterator[tuple[int, NDArray[np.uint8] | None]]:
    """Decode frames: yield the time of capture [ns], and the image or None for one that can't be decoded."""
    for picture in pictures:
        try:
            image = even(picture.pixels())
        except FileFormatError:
            image = None  # a damaged frame is left out; the others keep their times
        yield picture.header.captured_ns, image


class _Encoder:
    """Encodes frames of the first one's size into a video.

    Args:
        container: PyAV's.
        begin_ns: From when the time counts that is burnt in; None to burn in none.
    """

    def __init__(self, container: Any, begin_ns: int | None) -> None:
        self._container = container
        self._begin_ns = begin_ns
        self._stream: Any = None
        self._first_ns = 0
        self._stamp = -1
        self._frames = 0

    def add(self, image: NDArray[np.uint8], captured_ns: int) -> bool:
        """Encode a frame; return False for one of another size, which is left out."""
        import av

        if self._stream is None:
            self._stream, self._first_ns = _stream(av, self._container, image), captured_ns
        if image.shape[:2] != (self._stream.height, self._stream.width):
            return False  # the camera was switched to another size, and a video has only one
        if self._begin_ns is not None:
            _burn(image, (captured_ns - self._begin_ns) / NS_PER_S)
        self._stamp = max(self._stamp + 1, round((captured_ns - self._first_ns) / NS_PER_S / _TIME_BASE))
        frame = av.VideoFrame.from_ndarray(image, format="bgr24")
        frame.pts, frame.time_base = self._stamp, _TIME_BASE
        self._container.mux(self._stream.encode(frame))
        self._frames += 1
        return True

    def close(self, path: Path) -> Video | None:
        """Encode what waits; return what was written, or None if that is nothing."""
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
    """Return an image without an odd last row or column, as video codecs want it."""
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
