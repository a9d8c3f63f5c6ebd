"""Receive a vehicle's live video, decode it, and show the newest frame. Forward H.264 without decoding it.

One thread reads frames from the socket as they arrive, to keep them from ageing in a kernel buffer, and keeps
reconnecting. Another thread decodes the frames that consumers want. Between the two threads, the :class:`FrameBacklog`
decides which frames to drop when decoding falls behind.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import Clock, monotonic_ns
from skyloop.drivers.base import Sink
from skyloop.drivers.h264 import Unit
from skyloop.errors import UnsupportedError, UsageError
from skyloop.messages import EventKind, Intrinsics, Severity, Value
from skyloop.messages.frame import Chain

RETRY_S: Final = (0.25, 0.5, 1.0, 2.0)  #: pauses between connection attempts [s]; the last one repeats
REFUSALS: Final = 3  #: number of consecutive unsupported frames before this is reported; a flipped bit may cause one
_CLOSE_S: Final = 2.0  #: how long to wait for each thread to end
LATE_NS: Final = 50_000_000  #: a frame that has waited longer than this is late
KEYLESS: Final = 600  #: number of frames without a key frame before the stream is reported as not forwardable
MAX_FRAMES: Final = 120  #: 4 s of video at 30 frames/s; vehicles send a key frame every half second or second


@dataclass(frozen=True, slots=True)
class Coded:
    """An encoded frame on its arrival."""

    data: object  #: input for the vehicle's decoder
    is_key: bool  #: whether decoding can start at this frame
    captured_ns: int  #: capture time, on this host's clock
    arrived_ns: int
    connection: int  #: number of the connection; frames never depend on frames of other connections


class FrameBacklog:
    """Keeps at most :data:`MAX_FRAMES` frames in order of arrival. The newest frames win.

    While frames are wanted and decoding keeps up, every frame is decoded and shown. If decoding falls behind, frames
    before the newest key frame are dropped. The remaining frames must all be decoded, because each depends on the
    previous one, but only the newest frame is shown. While no frames are wanted, the frames since the newest key frame
    are kept. The first subscriber therefore gets an image immediately.

    ``skipped`` counts frames that were wanted but not shown because newer frames had arrived.
    """

    def __init__(self) -> None:
        self.skipped = 0
        self._frames: deque[tuple[Coded, bool]] = deque()  # frames, and whether each was wanted on arrival

    def __len__(self) -> int:
        return len(self._frames)

    def put(self, frame: Coded, *, wanted: bool) -> None:
        """Add a frame that has just been received."""
        if frame.is_key and not wanted:
            self._drop(len(self._frames))
        elif len(self._frames) == MAX_FRAMES:
            self._drop(1)  # as after any loss, frames that depend on this one are lost up to the next key frame
        self._frames.append((frame, wanted))

    def take(self, now_ns: int) -> tuple[Coded, bool]:
        """Remove the next frame to decode; return it and whether to show it. Raises ``IndexError`` if there is none."""
        if self._late(now_ns):
            keys = [n for n, (frame, _) in enumerate(self._frames) if frame.is_key]
            self._drop(keys[-1] if keys else 0)
        show = len(self._frames) == 1 or not self._late(now_ns)
        frame, wanted = self._frames.popleft()
        self.skipped += wanted and not show
        return frame, show

    def _late(self, now_ns: int) -> bool:
        return now_ns - self._frames[0][0].arrived_ns > LATE_NS

    def _drop(self, count: int) -> None:
        for _ in range(count):
            _, wanted = self._frames.popleft()
            self.skipped += wanted


class Decoded(NamedTuple):
    """A decoded frame."""

    number: int  #: the number that the vehicle gave this frame
    pixels: NDArray[np.uint8]  #: BGR, (height, width, 3), C-contiguous
    captured_ns: int | None = None  #: capture time; None: that of the last frame passed to the decoder


class Stream(Protocol):
    """One connection to a vehicle's video."""

    @property
    def broken(self) -> int:
        """Number of frames that were incomplete or outdated."""

    @property
    def lost_bytes(self) -> int:
        """Number of bytes that did not belong to any complete frame."""

    def read(self) -> list[Coded]:
        """Return the frames received. Raises ``OSError`` if the connection is lost.

        Should return within a tenth of a second, because :meth:`LiveVideo.stop` waits for it.
        """

    def close(self) -> None: ...


class Decoder(Protocol):
    """Decodes the frames of one connection after another."""

    @property
    def waited(self) -> int:
        """Number of frames skipped because a frame they depend on was missing, or a newer frame had been shown."""

    @property
    def damaged(self) -> int:
        """Number of frames that could not be decoded."""

    def restart(self) -> None:
        """Forget the stream so far: the next frame does not continue it."""

    def decode(self, coded: Coded, *, show: bool) -> Decoded | None:
        """Decode a frame and return it; return None if it contains no image or if ``show`` is False.

        Raises :class:`UnsupportedError` for an unsupported codec, and no other error, whatever the frame contains.
        """


@dataclass(frozen=True, slots=True, eq=False)
class LiveFrame:
    """A frame from the vehicle's selected camera."""

    pixels: NDArray[np.uint8]  #: BGR, (height, width, 3), C-contiguous
    width: int  #: width [px]
    height: int
    captured_ns: int  #: capture time on this host's monotonic clock; arrival time if the vehicle sends no timestamps
    number: int  #: number that the vehicle gave the frame, 32 bits

    def show(self, sink: Sink, camera: str, intrinsics: Intrinsics | None) -> None:
        """Publish this image as a frame of a camera."""
        sink.frame(camera, self.pixels, self.captured_ns, width=self.width, height=self.height, intrinsics=intrinsics)


class VideoEvent(Enum):
    """Events reported by a receiver."""

    STREAMING = "streaming"  #: frames are arriving
    LOST = "lost"  #: the connection was lost or is not established yet; reported once per reason, retried forever
    UNSUPPORTED = "unsupported"  #: frames use an unsupported codec, or the data is invalid; reported once per series
    FAULT = "fault"  #: an error in this program, reported once; the video continues

    def publish(self, sink: Sink, where: str, text: str) -> None:
        """Publish this event to the sink."""
        kind, severity = _EVENTS[self]
        sink.event(kind, f"{where} {self.value}: {text}", severity, where=where)


_EVENTS: Final = {
    VideoEvent.STREAMING: (EventKind.VEHICLE_MESSAGE, Severity.INFO),
    VideoEvent.LOST: (EventKind.VEHICLE_MESSAGE, Severity.WARNING),
    VideoEvent.UNSUPPORTED: (EventKind.DRIVER_ERROR, Severity.ERROR),
    VideoEvent.FAULT: (EventKind.DRIVER_ERROR, Severity.ERROR),
}


@dataclass(frozen=True, slots=True)
class VideoCounters:
    """Numbers of frames in all connections, by what became of them."""

    received: int = 0
    frames: int = 0  #: frames shown
    waited: int = 0  #: frames skipped up to the next key frame, or because a newer frame had been shown
    damaged: int = 0  #: frames that were cut off, outdated at the start of a connection, or undecodable
    refused: int = 0  #: frames of an unsupported kind
    skipped: int = 0  #: frames that were wanted but replaced by newer frames before decoding
    lost_bytes: int = 0  #: bytes that did not belong to a complete frame
    reconnects: int = 0  #: connections that delivered frames, not counting the first

    def telemetry(self, of: str) -> dict[str, Value]:
        """Return the counters for ``native`` in feedback; ``of`` is the prefix of their names, without the dot."""
        return {f"{of}.{name}": getattr(self, name) for name in self.__dataclass_fields__}


class LiveVideo:
    """Receives the video of one vehicle.

    While no frames are wanted, nothing is decoded. The stream is still read, and the frames since its newest key frame
    are kept to give a new subscriber an image immediately. Nothing is sent or received before :meth:`start`.

    Args:
        place: Human-readable description of where the video comes from.
        connect: Opens a connection, given the number of earlier ones that delivered frames; raises OSError on failure.
            Called on the reading thread.
        make_decoder: Creates the decoder; raises MissingExtraError if no decoder is installed. Called on the thread
            that calls :meth:`start`.
        show: Called with each frame on the decoding thread; must return quickly.
        on_event: Called with each event and its text, on either thread; must return quickly.
        wants: Returns whether decoded frames are wanted. Called on the reading thread.
        wants_checked: Returns whether to decode frames even if none are wanted, because undamaged frames are forwarded.
            Called on the reading thread.
        came: Called on the reading thread with every complete frame on its arrival.
        clock: A monotonic clock [ns].
        name: Name of the reading thread; the decoding thread's name begins with it.
    """

    def __init__(
        self,
        place: str,
        *,
        connect: Callable[[int], Stream],
        make_decoder: Callable[[], Decoder],
        show: Callable[[LiveFrame], None],
        on_event: Callable[[VideoEvent, str], None],
        wants: Callable[[], bool] = lambda: True,
        wants_checked: Callable[[], bool] = lambda: False,
        came: Callable[[Coded], None] | None = None,
        clock: Clock = monotonic_ns,
        name: str = "video",
    ) -> None:
        """Store the arguments. No I/O."""
        self._place = place
        self._connect = connect
        self._make_decoder = make_decoder
        self._show = show
        self._on_event = on_event
        self._wants = wants
        self._wants_checked = wants_checked
        self._on_frame = came
        self._clock = clock
        self._name = name
        self._stop = threading.Event()
        self._changed = threading.Condition()  # guards the backlog and the reading thread's counts
        self._backlog = FrameBacklog()
        self._wanted = False  # whether frames were wanted on the last frame's arrival
        self._shows = False  # whether frames are wanted for display, and not only decoded as a check
        self._received = self._connections = self._broken = self._lost_bytes = 0
        self._stream: Stream | None = None
        self._shown = self._refused = 0
        self._decoder: Decoder | None = None
        self._threads: list[threading.Thread] = []

    def start(self) -> None:
        """Start both threads. Returns immediately."""
        if self._threads:
            raise UsageError("this receiver has already been started")
        self._decoder = self._make_decoder()
        self._threads = [
            threading.Thread(target=self._read, name=self._name, daemon=True),
            threading.Thread(target=self._decode, args=(self._decoder,), name=f"{self._name}-pictures", daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """Stop both threads. Idempotent. No callback runs afterwards, unless a callback calls this method.

        Takes up to 4 s; a connection that takes longer to open or read is left to end on its own.
        """
        self._stop.set()
        with self._changed:
            self._changed.notify_all()
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(_CLOSE_S)

    @property
    def counters(self) -> VideoCounters:
        """The current counters. Thread-safe."""
        with self._changed:
            stream, decoder = self._stream, self._decoder
            return VideoCounters(
                received=self._received,
                frames=self._shown,
                waited=decoder.waited if decoder else 0,
                damaged=(decoder.damaged if decoder else 0) + self._broken + (stream.broken if stream else 0),
                refused=self._refused,
                skipped=self._backlog.skipped,
                lost_bytes=self._lost_bytes + (stream.lost_bytes if stream else 0),
                reconnects=max(0, self._connections - 1),
            )

    # The reading thread ------------------------------------------------------------------------------------------

    def _read(self) -> None:
        failures = 0
        reported = ""
        while not self._stop.is_set():
            before = self._connections
            try:
                self._follow()
            except OSError as error:
                reason = error.strerror or str(error)
            except Exception as error:  # noqa: BLE001  no error of a demuxer may end this thread silently
                reason = repr(error)
            else:
                return
            if self._connections > before:
                failures, reported = 0, ""
            if reason != reported:
                reported = reason
                self._emit(VideoEvent.LOST, f"{self._place}: {reason}")
            self._stop.wait(RETRY_S[min(failures, len(RETRY_S) - 1)])
            failures += 1

    def _follow(self) -> None:
        """Serve one connection from its beginning to its end."""
        stream = self._connect(self._connections)
        with self._changed:
            self._stream = stream
        streaming = False
        try:
            while not self._stop.is_set():
                frames = stream.read()
                if frames and not streaming:
                    streaming = True
                    self._emit(VideoEvent.STREAMING, self._place)
                    with self._changed:
                        self._connections += 1
                shows = bool(frames) and self._wants()
                wanted = shows or (bool(frames) and self._wants_checked())
                with self._changed:
                    for frame in frames:
                        self._backlog.put(frame, wanted=wanted)
                    if frames:
                        self._received += len(frames)
                        self._wanted, self._shows = wanted, shows
                        self._changed.notify()
                if self._on_frame is not None and not self._stop.is_set():
                    for frame in frames:
                        self._on_frame(frame)
        finally:
            stream.close()
            with self._changed:
                self._stream = None
                self._broken += stream.broken
                self._lost_bytes += stream.lost_bytes

    # The decoding thread -----------------------------------------------------------------------------------------

    def _decode(self, decoder: Decoder) -> None:
        connection = -1
        refusals = 0
        reported = ""
        while (taken := self._next()) is not None:
            coded, show = taken
            if coded.connection != connection:
                connection, refusals = coded.connection, 0
                decoder.restart()
            try:
                decoded = decoder.decode(coded, show=show)
                refusals = 0
                if decoded is not None:
                    number, pixels, captured_ns = decoded
                    height, width = pixels.shape[:2]
                    self._shown += 1
                    if not self._stop.is_set():
                        taken_ns = coded.captured_ns if captured_ns is None else captured_ns
                        self._show(LiveFrame(pixels, width, height, taken_ns, number))
            except UnsupportedError as error:
                refusals += 1
                self._refused += 1
                if refusals == REFUSALS:
                    self._emit(VideoEvent.UNSUPPORTED, str(error))
            except Exception as error:  # noqa: BLE001  no error of a codec or a callback may end the video
                decoder.restart()
                if repr(error) != reported:
                    reported = repr(error)
                    self._emit(VideoEvent.FAULT, reported)

    def _next(self) -> tuple[Coded, bool] | None:
        """Wait for a frame to decode. Return the frame, and whether to show it; None after :meth:`stop`."""
        with self._changed:
            self._changed.wait_for(lambda: self._stop.is_set() or (self._wanted and len(self._backlog)))
            if self._stop.is_set():
                return None
            coded, newest = self._backlog.take(self._clock())
            return coded, newest and self._shows

    def _emit(self, event: VideoEvent, text: str) -> None:
        if not self._stop.is_set():
            self._on_event(event, text)


class StreamRelay:
    """Forwards H.264 while it is wanted. Starts with a key frame, and starts again with one after a gap.

    Works the same way whether or not frames are also decoded. Not thread-safe.
    """

    def __init__(self, sink: Sink, intrinsics: Callable[[str, int, int], Intrinsics | None]) -> None:
        self._sink = sink
        self._intrinsics = intrinsics
        self._chain = Chain()
        self._source: tuple[str, int] | None = None  # camera and connection of the previous frame

    def wanted(self, camera: str) -> bool:
        """Return whether anyone wants a camera's stream. If not, it later restarts with a key frame."""
        wanted = self._sink.wants_stream(camera)
        if not wanted:
            self.restart()
        return wanted

    def restart(self) -> None:
        """Restart the stream with the next key frame."""
        self._source = None

    def take(
        self, camera: str, unit: Unit, captured_ns: int, *, number: int, connection: int, picture: bool = True
    ) -> bool:
        """Forward an undamaged frame if it is wanted and decodable after the last one; return whether it was forwarded.

        ``captured_ns`` is also the capture time of the decoded frame. ``number`` counts the frames received on the
        connection; skipped frames appear as gaps. ``picture``: False if the unit contains only parameter sets, which
        are not forwarded.
        """
        if not self.wanted(camera):
            return False
        source = camera, connection
        if unit.after_gap or source != self._source:
            self._chain.restart()
        self._source = source
        if not self._chain.follows(number, key=unit.is_key) or not picture:
            return False
        self._sink.stream(
            camera,
            unit.data,
            captured_ns,
            width=unit.width,
            height=unit.height,
            key=unit.is_key,
            intrinsics=self._intrinsics(camera, unit.width, unit.height),
        )
        return True


class CheckedRelay:
    """Forwards the H.264 of a camera whose stream is not known in advance. If it can't, it reports the reason once.

    Not thread-safe.
    """

    def __init__(self, relay: StreamRelay, sink: Sink, camera: str, where: str) -> None:
        self._relay = relay
        self._sink = sink
        self._camera = camera
        self._where = where
        self._refused = (-1, "")  # number of the refused connection, and why it was refused
        self._waited = 0
        self._reported = ""

    @property
    def wanted(self) -> bool:
        """Whether anyone currently wants the stream."""
        return self._relay.wanted(self._camera)

    def take(self, unit: Unit | None, reason: str, captured_ns: int, *, number: int, connection: int) -> None:
        """Forward an undamaged encoded frame; see :meth:`StreamRelay.take`.

        ``unit`` is None if its headers are unknown. ``reason``: why it can't be forwarded for the rest of the
        connection; empty if it can be.
        """
        if not self.wanted:
            return
        if reason:
            self._refused = connection, reason
        if self._refused[0] == connection:
            self._report(self._refused[1])
            return
        taken = unit is not None and self._relay.take(
            self._camera, unit, captured_ns, number=number, connection=connection
        )
        self._waited = 0 if taken else self._waited + 1
        if self._waited == KEYLESS:
            self._report(f"{KEYLESS} pictures without a key picture (IDR) with parameters: configure the encoder")

    def _report(self, why: str) -> None:
        if why != self._reported:
            self._reported = why
            text = f"{self._where}: {why}: only decoded frames are available, not the original stream"
            self._sink.event(EventKind.VEHICLE_MESSAGE, text, Severity.WARNING, where=self._where)
