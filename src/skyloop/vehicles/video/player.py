"""Plays video files (PaVE streams, and everything that PyAV opens) into a sink according to their own time stamps."""

from __future__ import annotations

import itertools
import stat
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import monotonic_ns, nanoseconds, seconds
from skyloop.drivers.base import Sink
from skyloop.drivers.h264 import Unit
from skyloop.drivers.live_container import Units
from skyloop.drivers.live_video import CheckedRelay, StreamRelay
from skyloop.errors import FileFormatError, SkyloopError, UsageError
from skyloop.messages import EventKind, Feedback, Intrinsics, LinkState, Severity, Value
from skyloop.messages.frame import H264
from skyloop.pyav import limit_memory
from skyloop.vehicles.ardrone.pave_decoder import PaveDecoder, av
from skyloop.vehicles.ardrone.wire.pave import Codec, PaveFrame, PaveParser

if TYPE_CHECKING:
    from av.container import InputContainer

FFmpegError = av.error.FFmpegError

CHUNK: Final = 1 << 16  #: number of bytes per read
SNIFF: Final = 1 << 18  #: a PaVE stream contains a header within this many bytes, wherever the stream was cut
DEFAULT_FPS: Final = 30.0  #: frame rate if the file does not specify it
_TURNED: Final = frozenset({"mov", "mp4", "matroska", "webm"})  #: formats that can store a rotation


@dataclass(frozen=True, slots=True)
class DecodedImage:
    """A decoded image and its stamp on the stream's own clock [s], not yet converted to BGR."""

    stamp_s: float
    frame: av.VideoFrame
    coded: Unit | None = None  #: the encoded image, if it is relayed unchanged
    number: int = 0  #: the image's number in the stream
    reason: str = ""  #: reason for not relaying this image of a relayed stream
    turns: int = 0  #: number of counter-clockwise quarter turns that make the image upright


def is_device(path: Path) -> bool:
    """Return whether a path names a device, present or not, rather than a file."""
    if path.is_relative_to("/dev"):
        return True
    try:
        return stat.S_ISCHR(path.stat().st_mode)
    except OSError:
        return False


def open_file(path: Path) -> Source:
    """Open a video file of any supported format."""
    try:
        with path.open("rb") as file:
            head = file.read(SNIFF)
    except OSError as error:
        if "%" in path.name:  # this is a pattern for a numbered image sequence, which PyAV supports
            return ContainerSource(str(path))
        raise UsageError(f"video://{path}: {error.strerror}") from error
    if path.suffix == ".pave" or PaveParser().feed(head):
        return PaveSource(path)
    return ContainerSource(str(path))


class ContainerSource:
    """One pass over a file or image sequence that PyAV opens."""

    def __init__(self, name: str) -> None:
        self._name = name
        self.damaged = 0  #: number of pieces so far that could not be decoded
        self.stream = ""  #: ``h264`` if images in this codec can be relayed unchanged, else empty
        try:
            self._container: InputContainer = av.open(name)
        except (FFmpegError, OSError, ValueError) as error:
            raise self._error("cannot be opened", error) from error
        videos = self._container.streams.video
        if not videos:
            self._container.close()
            raise FileFormatError(f"{name} contains no video stream")
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
        stamp_s = -1.0 / self.fps
        coded: dict[int | None, tuple[int, Unit | None]] = {}  # keyed by stamp, because decoders delay images
        for number, packet in enumerate(self._packets()):
            if self.stream and packet.size:
                coded[packet.pts] = number, self._units.of(packet)
            try:
                images = packet.decode()
            except (FFmpegError, ValueError):  # after a damaged packet, the decoder continues with the next one
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
            self.damaged += 1  # the file is truncated, but everything before the cut is usable

    def close(self) -> None:
        self._container.close()

    def _error(self, what: str, error: Exception) -> Exception:
        cause = getattr(error, "strerror", None) or str(error)
        return FileFormatError(f"{self._name} {what} as a video: {cause}")


def _quarter_turns(name: str) -> int:
    """Return the number of counter-clockwise quarter turns that make a file's images upright.

    A phone held upright films sideways and stores a rotation matrix in the container, which is read with the images.
    """
    with suppress(FFmpegError, OSError, ValueError), av.open(name) as container:
        for image in itertools.islice(container.decode(container.streams.video[0]), 1):
            return round(getattr(image, "rotation", 0) / 90) % 4
    return 0


class PaveSource:
    """One pass over a file with the raw bytes from an AR.Drone 2's video port.

    Images before the first key frame (in a truncated stream, or the drone's stale first frame) and between damage and
    the next key frame are dropped because they would be smeared.
    """

    def __init__(self, path: Path) -> None:
        self.damaged = 0
        self._parser = PaveParser()
        self._file = path.open("rb")
        first = next(iter(self._parser_frames()), None)
        if first is None:
            self._file.close()
            raise FileFormatError(f"{path} contains no PaVE frame")
        self._file.seek(0)
        self._parser = PaveParser()
        self.width, self.height, self.fps = first.width, first.height, DEFAULT_FPS
        self.stream = H264 if first.codec == Codec.MPEG4_AVC else ""

    def images(self) -> Iterator[DecodedImage]:
        """Yield the images. All are decoded, because each depends on the previous one."""
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
        self._file.close()

    def _parser_frames(self) -> Iterator[PaveFrame]:
        while chunk := self._file.read(CHUNK):
            yield from self._parser.feed(chunk)
        self._parser.end()


Source = ContainerSource | PaveSource


FEEDBACK_NS: Final = 50_000_000  #: time between feedback samples
POLL_S: Final = 0.02  #: time between checks for a viewer
BEHIND_NS: Final = 250_000_000  #: lag beyond which the schedule restarts instead of rushing to catch up
GAP_S: Final = 2.0  #: maximum step between stamps; a longer step, or a step back, is a cut in the recording


class FilePacer:
    """Converts a file's own time stamps to the times at which its images are shown.

    Times never go backwards. A jump in the stamps (caused by a cut or a clock reset) counts as one ordinary period.
    """

    def __init__(self, speed: float, period_s: float) -> None:
        self._speed = speed
        self._period_s = period_s
        self._stamp_s: float | None = None
        self._due_ns = 0

    def due_ns(self, stamp_s: float, now_ns: int) -> int:
        """Return the time at which to show the image with this stamp, given that it was ready at ``now_ns``."""
        if self._stamp_s is None:
            self._due_ns = now_ns
        else:
            step_s = stamp_s - self._stamp_s
            if not 0.0 <= step_s <= GAP_S:
                step_s = self._period_s
            self._due_ns += nanoseconds(step_s / self._speed)
            if now_ns - self._due_ns > BEHIND_NS:
                self._due_ns = now_ns
        self._stamp_s = stamp_s
        return self._due_ns


class CameraPublisher:
    """Publishes one camera's images and feedback to a sink, waiting for the right times."""

    def __init__(
        self, sink: Sink, camera: str, intrinsics: Callable[[int, int], Intrinsics | None], stop: threading.Event
    ) -> None:
        self.sink = sink
        self.shown = 0
        self.loops = 0
        self.damaged = 0
        self._camera = camera
        self._intrinsics = intrinsics
        self.stop = stop
        self._position_s = 0.0
        self._feedback_ns = 0
        relay = StreamRelay(sink, lambda _camera, width, height: intrinsics(width, height))
        self._relay = CheckedRelay(relay, sink, camera, "recording")

    @property
    def wanted(self) -> bool:
        """Whether any client wants decoded images."""
        return self.sink.wants(self._camera)

    @property
    def wanted_encoded(self) -> bool:
        """Whether any client wants encoded images."""
        return self._relay.wanted

    def wait_until(self, due_ns: int) -> bool:
        """Wait until the given time while publishing feedback. Return False if the driver is closing."""
        while not self.stop.is_set():
            now_ns = monotonic_ns()
            self.publish_state(now_ns)
            if now_ns >= due_ns:
                return True
            self.stop.wait(seconds(min(due_ns, self._feedback_ns) - now_ns))
        return False

    def publish_state(self, now_ns: int, *, at_once: bool = False) -> None:
        """Publish feedback if it is due: only the position in the file, because nothing is flying."""
        if now_ns < self._feedback_ns and not at_once:
            return
        self._feedback_ns = now_ns + FEEDBACK_NS
        native: dict[str, Value] = {
            "video.position_s": self._position_s,
            "video.frames": self.shown,
            "video.loops": self.loops,
            "video.damaged": self.damaged,
        }
        self.sink.feedback(Feedback(captured_ns=now_ns, native=native))

    def show(self, image: DecodedImage, due_ns: int) -> bool:
        """Convert an image and publish it at ``due_ns``, its capture time. Return False if the driver is closing."""
        pixels = _bgr(image) if self.wanted else None
        if not self.wait_until(due_ns):
            return False
        self.shown += 1
        self._position_s = image.stamp_s
        if image.coded is not None:
            self._relay.take(image.coded, image.reason, due_ns, number=image.number, connection=self.loops)
        if pixels is not None:
            height, width = pixels.shape[:2]
            self.sink.frame(
                self._camera, pixels, due_ns, width=width, height=height, intrinsics=self._intrinsics(width, height)
            )
        return not self.stop.is_set()


class FilePlayer:
    """Plays a file once, or repeatedly with ``loop``."""

    def __init__(
        self, publisher: CameraPublisher, open_source: Callable[[], Source], *, loop: bool, speed: float
    ) -> None:
        self._publisher = publisher
        self._open = open_source
        self._loop = loop
        self._speed = speed

    def run(self, source: Source, *, wait: bool) -> None:
        """Play until the end or until the driver closes; with ``wait``, start only once a client wants the images."""
        publisher = self._publisher
        publisher.sink.link(LinkState.UP)
        while wait and not (publisher.wanted or publisher.wanted_encoded):
            if not publisher.wait_until(monotonic_ns() + nanoseconds(POLL_S)):
                break
        while True:
            try:
                again = self._pass(source)
            finally:
                source.close()
            if not again:
                return
            publisher.loops += 1
            try:
                source = self._open()
            except SkyloopError as error:
                publisher.sink.link(LinkState.LOST, f"cannot start over: {error}")
                return

    def _pass(self, source: Source) -> bool:
        """Play the file once; return whether to play it again."""
        publisher = self._publisher
        pacer = FilePacer(self._speed, 1.0 / source.fps)
        before = publisher.shown
        for image in source.images():
            due_ns = pacer.due_ns(image.stamp_s, monotonic_ns())
            if not publisher.show(image, due_ns):
                return False
        if not publisher.wait_until(monotonic_ns() + nanoseconds(1.0 / source.fps / self._speed)):
            return False
        if source.damaged:
            publisher.damaged += source.damaged
            text = f"{source.damaged} pieces of the recording are damaged and were skipped"
            publisher.sink.event(EventKind.VEHICLE_MESSAGE, text, Severity.WARNING, damaged=source.damaged)
        publisher.publish_state(monotonic_ns(), at_once=True)
        if publisher.shown == before:
            publisher.sink.link(LinkState.LOST, "no image of the recording can be decoded")
            return False
        if not self._loop:
            publisher.sink.link(LinkState.CLOSED, f"end of the recording after {publisher.shown} frames")
        return self._loop


def _bgr(image: DecodedImage) -> NDArray[np.uint8]:
    """Return an image as a C-contiguous BGR array, shape (h, w, 3)."""
    return np.ascontiguousarray(np.rot90(image.frame.to_ndarray(format="bgr24"), image.turns), dtype=np.uint8)
