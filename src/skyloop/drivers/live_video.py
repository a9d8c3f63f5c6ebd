"""Receives a vehicle's live video, decodes it, and shows the newest picture.

Two threads: one reads frames from the socket at once, so that no picture grows old in a buffer of the kernel, and
reconnects for ever; the other decodes what is wanted. Between them stands the
:class:`~skyloop.drivers.live_frames.FrameBacklog`, which decides what is left out when decoding is late.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Final, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import Clock, monotonic_ns
from skyloop.drivers.base import Sink
from skyloop.drivers.live_frames import Coded, FrameBacklog
from skyloop.errors import UnsupportedError, UsageError
from skyloop.messages import EventKind, Intrinsics, Severity, Value

RETRY_S: Final = (0.25, 0.5, 1.0, 2.0)  #: waits between attempts to connect; the last one is repeated
REFUSALS: Final = 3  #: frames in a row of an unsupported codec before it is reported; one may be a flipped bit
_CLOSE_S: Final = 2.0


class Decoded(NamedTuple):
    """A picture that a decoder made."""

    number: int  #: counts the vehicle's pictures
    pixels: NDArray[np.uint8]  #: BGR, (height, width, 3), C-contiguous
    captured_ns: int | None = None  #: None: as the frame that was decoded last


class Stream(Protocol):
    """One connection to a vehicle's video."""

    @property
    def broken(self) -> int:
        """Frames that were begun and not finished, or stale."""

    @property
    def lost_bytes(self) -> int:
        """Bytes that belong to no whole frame."""

    def read(self) -> list[Coded]:
        """Return the frames that arrived.

        Returns after a tenth of a second at most if it can: :meth:`LiveVideo.stop` waits for it.

        Raises:
            OSError: The connection is lost.
        """

    def close(self) -> None: ...


class Decoder(Protocol):
    """Decodes the frames of one connection after the other."""

    @property
    def waited(self) -> int:
        """Frames left out because what they build on was never received, or because a newer one was shown before."""

    @property
    def damaged(self) -> int:
        """Frames that could not be decoded."""

    def restart(self) -> None:
        """Forget the stream so far: the next frame does not continue it."""

    def decode(self, coded: Coded, *, show: bool) -> Decoded | None:
        """Decode a frame. Raises nothing else, whatever a frame holds.

        Args:
            coded: The frame.
            show: Whether its picture is wanted.

        Returns:
            The picture; None if there is none, or it is not wanted.

        Raises:
            UnsupportedError: The codec is not supported.
        """


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """A picture of whichever camera the vehicle is switched to."""

    pixels: NDArray[np.uint8]  #: BGR, (height, width, 3), C-contiguous
    width: int  #: [px]
    height: int
    captured_ns: int  #: on this host's monotonic clock; of a vehicle that gives no stamp, when it came
    number: int  #: counts the vehicle's pictures, 32 bits

    def show(self, sink: Sink, camera: str, intrinsics: Intrinsics | None) -> None:
        """Publish it as a frame of a camera."""
        sink.frame(camera, self.pixels, self.captured_ns, width=self.width, height=self.height, intrinsics=intrinsics)


class VideoEvent(Enum):
    """What a receiver reports besides pictures."""

    STREAMING = "streaming"  #: frames come
    LOST = "lost"  #: no connection, or no more; reported once for each reason, tried again for ever
    UNSUPPORTED = "unsupported"  #: frames come in another codec, or are noise; reported once for each row of them
    FAULT = "fault"  #: an error of this program, reported once; the video goes on

    def publish(self, sink: Sink, where: str, text: str) -> None:
        """Publish it as an event."""
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
    """What became of the frames, all connections together."""

    received: int = 0
    frames: int = 0  #: shown
    waited: int = 0  #: left out up to the next key frame, or because a newer one was shown before
    damaged: int = 0  #: broken off, stale at the start of a connection, or not to be decoded
    refused: int = 0  #: of a kind that is not decoded here
    skipped: int = 0  #: wanted, but newer ones were there
    lost_bytes: int = 0  #: of the stream that belong to no whole frame
    reconnects: int = 0  #: connections on which frames came, after the first such

    def telemetry(self, of: str) -> dict[str, Value]:
        """Return the counters for feedback's ``native``.

        Args:
            of: Prefix of their names, before a dot.
        """
        return {f"{of}.{name}": getattr(self, name) for name in self.__dataclass_fields__}


class LiveVideo:
    """The video of one vehicle.

    While nobody wants pictures nothing is decoded, but the stream is read and the frames since its newest key frame are
    kept, so that a picture is there with the first frame after somebody does. No I/O happens before :meth:`start`.

    Args:
        place: Where the video comes from, for people.
        connect: Opens the connection of this number, counted from 0; raises OSError if it can't. On the reading thread.
        make_decoder: Makes the decoder; raises MissingExtraError if none is installed. On the thread of :meth:`start`.
        show: Called with each picture on the decoding thread; must return quickly.
        on_event: Called with each event and its text on either thread; must return quickly.
        wants: Whether anybody wants pictures. Called on the reading thread.
        wants_checked: Whether frames are to be decoded though nobody wants pictures, as the decoder hands on what is
            whole. Called on the reading thread.
        came: Called with every whole frame as it arrived, on the reading thread.
        clock: Monotonic, ns.
        name: Of the reading thread, and the beginning of the decoding one's.
    """

    def __init__(
        self,
        place: str,
        *,
        connect: Callable[[int], Stream],
        make_decoder: Callable[[], Decoder],
        show: Callable[[Picture], None],
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
        self._frame_came = came
        self._clock = clock
        self._name = name
        self._stop = threading.Event()
        self._came = threading.Condition()  # guards the backlog and the counts of the reading thread
        self._backlog = FrameBacklog()
        self._wanted = False  # when the last frame came
        self._shows = False  # pictures are wanted, not only checked frames
        self._received = self._connections = self._broken = self._lost_bytes = 0
        self._stream: Stream | None = None
        self._shown = self._refused = 0
        self._decoder: Decoder | None = None
        self._threads: list[threading.Thread] = []

    def start(self) -> None:
        """Start both threads. Returns at once."""
        if self._threads:
            raise UsageError("this receiver was started before")
        self._decoder = self._make_decoder()
        self._threads = [
            threading.Thread(target=self._read, name=self._name, daemon=True),
            threading.Thread(target=self._decode, args=(self._decoder,), name=f"{self._name}-pictures", daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """Stop both threads. Idempotent; no callback is called after it, unless it is called from one.

        Takes up to 4 s; a connection that takes longer to open or read is left to end by itself, unseen.
        """
        self._stop.set()
        with self._came:
            self._came.notify_all()
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(_CLOSE_S)

    @property
    def counters(self) -> VideoCounters:
        """The counters so far; from any thread."""
        with self._came:
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

    # The thread that reads ---------------------------------------------------------------------------------------

    def _read(self) -> None:
        failures = 0
        reported = ""
        while not self._stop.is_set():
            before = self._connections
            try:
                self._follow()
            except OSError as error:
                reason = error.strerror or str(error)
            except Exception as error:  # noqa: BLE001  nor may a surprise of a demuxer end it in silence
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
        """Serve one connection from beginning to end."""
        stream = self._connect(self._connections)
        with self._came:
            self._stream = stream
        streaming = False
        try:
            while not self._stop.is_set():
                frames = stream.read()
                if frames and not streaming:
                    streaming = True
                    self._emit(VideoEvent.STREAMING, self._place)
                    with self._came:
                        self._connections += 1
                shows = bool(frames) and self._wants()
                wanted = shows or (bool(frames) and self._wants_checked())
                with self._came:
                    for frame in frames:
                        self._backlog.put(frame, wanted=wanted)
                    if frames:
                        self._received += len(frames)
                        self._wanted, self._shows = wanted, shows
                        self._came.notify()
                if self._frame_came is not None and not self._stop.is_set():
                    for frame in frames:
                        self._frame_came(frame)
        finally:
            stream.close()
            with self._came:
                self._stream = None
                self._broken += stream.broken
                self._lost_bytes += stream.lost_bytes

    # The thread that decodes -------------------------------------------------------------------------------------

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
                        self._show(Picture(pixels, width, height, taken_ns, number))
            except UnsupportedError as error:
                refusals += 1
                self._refused += 1
                if refusals == REFUSALS:
                    self._emit(VideoEvent.UNSUPPORTED, str(error))
            except Exception as error:  # noqa: BLE001  a surprise of a codec or a callback must not end the video
                decoder.restart()
                if repr(error) != reported:
                    reported = repr(error)
                    self._emit(VideoEvent.FAULT, reported)

    def _next(self) -> tuple[Coded, bool] | None:
        """Wait for a frame while pictures are wanted. Return it and whether to show it; None after :meth:`stop`."""
        with self._came:
            self._came.wait_for(lambda: self._stop.is_set() or (self._wanted and len(self._backlog)))
            if self._stop.is_set():
                return None
            coded, newest = self._backlog.take(self._clock())
            return coded, newest and self._shows

    def _emit(self, event: VideoEvent, text: str) -> None:
        if not self._stop.is_set():
            self._on_event(event, text)
