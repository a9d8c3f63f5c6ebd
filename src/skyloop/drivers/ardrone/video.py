"""Receives the video of an AR.Drone, decodes it, and shows the newest picture.

Two threads: one takes frames off the socket at once, so that no picture grows old in a buffer of the kernel, and makes
the connection anew for ever when it is lost; the other decodes what is wanted. Between them stands the
:class:`~skyloop.drivers.ardrone.backlog.Backlog`, which decides what is left out when decoding is late.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import Clock, monotonic_ns
from skyloop.drivers.ardrone.backlog import Backlog, Coded
from skyloop.drivers.ardrone.decoding import Decoder, make_decoder
from skyloop.drivers.ardrone.streams import CONNECT_S, POLL_S, Stream, open_stream
from skyloop.errors import UnsupportedError, UsageError

RETRY_S: Final = (0.25, 0.5, 1.0, 2.0)  #: waits between attempts to connect; the last one is repeated
REFUSALS: Final = 3  #: frames in a row of a codec that is not decoded, before it is told; one may be a flipped bit
_CLOSE_S: Final = CONNECT_S + 10 * POLL_S


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """A picture of whichever camera the drone is switched to."""

    pixels: NDArray[np.uint8]  #: BGR, (height, width, 3), C-contiguous
    width: int  #: [px]
    height: int
    captured_ns: int  #: on this host's monotonic clock; of an AR.Drone 1, which gives no stamp, when it came
    number: int  #: counts the drone's pictures, 32 bits


class Notice(Enum):
    """What a receiver tells beside pictures."""

    STREAMING = "streaming"  #: frames come
    LOST = "lost"  #: no connection, or no more; told once for each reason, tried again for ever
    UNSUPPORTED = "unsupported"  #: frames come in a codec that is not decoded here; told once a connection
    FAULT = "fault"  #: an error of this program, told once; it goes on


@dataclass(frozen=True, slots=True)
class VideoCounters:
    """What became of the frames, all connections together."""

    received: int = 0
    frames: int = 0  #: shown
    waited: int = 0  #: left out up to the next key frame, or because a newer one was shown before
    damaged: int = 0  #: broken off, stale at the start of a connection, or not to be decoded
    refused: int = 0  #: of a codec that is not decoded here
    skipped: int = 0  #: wanted, but newer ones were there
    lost_bytes: int = 0  #: of the stream that belong to no whole frame
    reconnects: int = 0  #: connections on which frames came, after the first such


class VideoReceiver:
    """The video port of one drone. ``show`` and ``told`` are called from its threads, and must return quickly.

    ``wants`` says whether anybody looks. While nobody does nothing is decoded, but the stream is read on and the frames
    since its newest key frame are kept, so that a picture is there with the first frame after somebody looks.
    """

    def __init__(
        self,
        host: str,
        port: int,
        *,
        version: int,
        show: Callable[[Picture], None],
        told: Callable[[Notice, str], None],
        wants: Callable[[], bool] = lambda: True,
        came: Callable[[Coded], None] | None = None,
        clock: Clock = monotonic_ns,
    ) -> None:
        """No I/O. Raises :class:`UsageError` for a version other than 1 and 2.

        ``came`` gets every whole frame as it came, on the reading thread.
        """
        if version not in (1, 2):
            raise UsageError(f"there is an AR.Drone 1 and an AR.Drone 2, not {version}")
        self._address = host, port
        self._version = version
        self._show = show
        self._told = told
        self._wants = wants
        self._frame_came = came
        self._clock = clock
        self._stop = threading.Event()
        self._came = threading.Condition()  # guards the backlog and the counts of the reading thread
        self._backlog = Backlog()
        self._wanted = False  # when the last frame came
        self._received = self._connections = self._broken = self._lost_bytes = 0
        self._stream: Stream | None = None
        self._shown = self._refused = 0
        self._decoder: Decoder | None = None
        self._threads: list[threading.Thread] = []

    def start(self) -> None:
        """Returns at once. Raises :class:`skyloop.errors.MissingExtraError` if no decoder is installed."""
        if self._threads:
            raise UsageError("this receiver was started before")
        self._decoder = make_decoder(self._version)
        self._threads = [
            threading.Thread(target=self._read, name="ardrone-video", daemon=True),
            threading.Thread(target=self._decode, args=(self._decoder,), name="ardrone-pictures", daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """Ends both threads. Idempotent; after it neither callback is called, unless it is called from one."""
        self._stop.set()
        with self._came:
            self._came.notify_all()
        for thread in self._threads:
            if thread is not threading.current_thread():
                thread.join(_CLOSE_S)

    @property
    def counters(self) -> VideoCounters:
        """So far; from any thread."""
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
        said = ""
        while not self._stop.is_set():
            before = self._connections
            try:
                self._follow()
            except OSError as error:
                reason = error.strerror or str(error)
            else:
                return
            if self._connections > before:
                failures, said = 0, ""
            if reason != said:
                said = reason
                self._tell(Notice.LOST, "{}:{}: {}".format(*self._address, reason))
            self._stop.wait(RETRY_S[min(failures, len(RETRY_S) - 1)])
            failures += 1

    def _follow(self) -> None:
        """One connection, from beginning to end. Raises OSError when it ends otherwise than by :meth:`stop`."""
        stream = open_stream(self._version, *self._address, self._connections, self._clock)
        with self._came:
            self._stream = stream
        streaming = False
        try:
            while not self._stop.is_set():
                frames = stream.read()
                if frames and not streaming:
                    streaming = True
                    self._tell(Notice.STREAMING, "{}:{}".format(*self._address))
                    with self._came:
                        self._connections += 1
                wanted = bool(frames) and self._wants()
                with self._came:
                    for frame in frames:
                        self._backlog.put(frame, wanted=wanted)
                    if frames:
                        self._received += len(frames)
                        self._wanted = wanted
                        self._came.notify()
                if self._frame_came is not None:
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
        said = ""
        while (taken := self._next()) is not None:
            coded, show = taken
            if coded.connection != connection:
                connection, refusals = coded.connection, 0
                decoder.restart()
            try:
                decoded = decoder.decode(coded, show=show)
                refusals = 0
                if decoded is not None:
                    number, pixels = decoded
                    height, width = pixels.shape[:2]
                    self._shown += 1
                    self._show(Picture(pixels, width, height, coded.captured_ns, number))
            except UnsupportedError as error:
                refusals += 1
                self._refused += 1
                if refusals == REFUSALS:
                    self._tell(Notice.UNSUPPORTED, str(error))
            except Exception as error:  # noqa: BLE001  a surprise of a codec or a callback must not end the video
                decoder.restart()
                if repr(error) != said:
                    said = repr(error)
                    self._tell(Notice.FAULT, said)

    def _next(self) -> tuple[Coded, bool] | None:
        """Waits for a frame while pictures are wanted; the frame, and whether to show it. None after :meth:`stop`."""
        with self._came:
            self._came.wait_for(lambda: self._stop.is_set() or (self._wanted and len(self._backlog)))
            return None if self._stop.is_set() else self._backlog.take(self._clock())

    def _tell(self, notice: Notice, text: str) -> None:
        if not self._stop.is_set():
            self._told(notice, text)
