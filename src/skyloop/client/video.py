"""Channels of video: frames of a camera as one request wants them, and encoded streams, decoded on a thread."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Final, TypedDict

import numpy as np

from skyloop.client.channels import Channel
from skyloop.client.connection import ProxyConnection, Scheduler
from skyloop.client.frame import Arrival, FeedbackHistory, Frame, SmallArrival
from skyloop.client.monitoring import ChannelCounter, ChannelStats, StallWatch
from skyloop.clock import Clock
from skyloop.errors import DecodeError
from skyloop.messages import CameraInfo, EncodedFrame, FrameHeader, StreamReport, VideoRequest, encode
from skyloop.messages.frame import H264, Chain, Pieces
from skyloop.messages.subscription import FrameFilter, VideoEncoding
from skyloop.pyav import new_decoder
from skyloop.transport.base import Pixels, video

if TYPE_CHECKING:
    from av.video.codeccontext import VideoCodecContext

#: Pictures that may wait to be decoded. With more, decoding is too slow for what comes: they are left out up to a key.
MOST_WAITING: Final = 6
ASK_AGAIN_NS: Final = 300_000_000  #: how long to wait for a key picture before it is asked for again
_IDLE_S: Final = 2.0
_PURPOSE: Final = "reading H.264"


class VideoOptions(TypedDict, total=False):
    """How frames are requested; see :meth:`skyloop.Drone.frames`."""

    encoding: VideoEncoding
    quality: int
    max_fps: float
    scale: float
    part: tuple[int, int]
    kbit_s: int
    max_age_s: float


def usual(camera: str) -> VideoRequest:
    """Return the request of a consumer that asks for nothing in particular: JPEG where frames travel over a network."""
    return VideoRequest(camera, encoding="jpeg")


class VideoChannel(Channel[Arrival]):
    """Frames of one camera, as one request wants them."""

    def __init__(
        self,
        camera: CameraInfo,
        connection: ProxyConnection,
        scheduler: Scheduler,
        history: FeedbackHistory,
        request: VideoRequest | None = None,
    ) -> None:
        """Make a channel without consumers.

        Args:
            camera: The camera.
            connection: Where its topics are subscribed to.
            scheduler: Source of the time and of waiting.
            history: Looked up for the state at a frame's capture.
            request: How frames are wanted; None: see :func:`usual`.
        """
        self.camera = camera
        self.request = request or usual(camera.name)
        super().__init__(lambda on: connection.subscribe(self.request.topic, on))
        #: Names its statistics: the camera's plain topic for the usual request, else the request's own.
        self.name = video(camera.name) if self.request == usual(camera.name) else self.request.topic
        self.newest: Arrival | None = None
        self.notifier = scheduler.notifier()  #: notified with each frame
        self.counter = ChannelCounter()
        self.undecodable = 0
        self.too_old = 0  #: frames that a consumer got and, by its ``max_age_s``, did not want
        self.watch = StallWatch(max(1.0, 5.0 * self._period_s(camera.fps)), scheduler.clock())
        self.filter = FrameFilter(self.request)  #: chooses the plain frames that this request asks for
        self._read: Arrival | None = None  # what next_frame() gave last
        self._connection = connection
        self._history = history
        self._clock = scheduler.clock

    @property
    def unread(self) -> bool:
        """Whether there is a frame that :meth:`read` has not returned yet."""
        return self.newest is not self._read

    def read(self) -> Frame | None:
        """Return the newest frame and mark it as read; None if there is none or it can't be decoded."""
        self._read = arrival = self.newest
        return None if arrival is None else self.picture(arrival)

    def picture(self, arrival: Arrival, max_age_s: float | None = None) -> Frame | None:
        """Decode the frame; None, and counted, if its pixels can't be decoded, or it is too old.

        Args:
            arrival: The frame.
            max_age_s: Oldest age since the capture that is accepted [s]; None: any.
        """
        if max_age_s is not None and arrival.age_s > max_age_s:
            self.too_old += 1
            return None
        try:
            return arrival.frame()
        except DecodeError:
            self.undecodable += 1
            return None

    def receive(self, header: FrameHeader, pixels: Pixels, now_ns: int, *, as_asked: bool) -> None:
        """Publish a frame that came; ignores one that is repeated or was overtaken.

        Args:
            header: Describes the pixels.
            pixels: Bytes of the frame, shape (size,), uint8.
            now_ns: When it came, on this process's clock.
            as_asked: Whether the proxy made it for this request; if False it is scaled here where needed.
        """
        counter = self.counter
        last = counter.last_seq
        if last is not None and header.seq <= last:
            return  # repeated or overtaken
        offset_ns, scale = self._connection.offset_ns, self.request.scale
        if as_asked or scale == 1.0:
            arrival = Arrival(header, pixels, now_ns, offset_ns, self._history, self._clock)
        else:
            arrival = SmallArrival(header, pixels, now_ns, offset_ns, self._history, self._clock, scale)
        # Consumers first, then the statistics. The previous frame is released last: giving its memory back to the proxy
        # takes longer than all of this.
        before, self.newest = self.newest, arrival
        self.publish(arrival)
        self.notifier.notify()
        del before
        counter.follow(header.seq)
        counter.add(now_ns + offset_ns - header.published_ns, header.captured_ns - offset_ns, now_ns)
        self.watch.received_ns = now_ns

    def restart(self, now_ns: int) -> None:
        """Reset the frame number: a proxy was connected, which may count its frames from 0."""
        self.counter.last_seq = None
        self.watch.received_ns = now_ns

    def stats(self, now_ns: int) -> ChannelStats:
        """Return the statistics at ``now_ns``."""
        return self.counter.stats(now_ns, dropped=self.dropped + self.too_old, malformed=self.undecodable)

    def _period_s(self, fps: float) -> float:
        """Expected time between two frames of this request [s]; 0 if unknown."""
        most = self.request.max_fps
        rate = min(fps, most) if fps > 0.0 and most is not None else fps or most or 0.0
        parts = 1 if self.request.part is None else self.request.part[1]
        return parts / rate if rate > 0.0 else 0.0


class StreamChannel(Channel[EncodedFrame]):
    """The pictures of one stream, whole, in the order in which they came; some may be missing.

    Args:
        topic: The stream's.
        connection: What it comes through.
        clock: This process's clock [ns].
    """

    def __init__(self, topic: str, connection: ProxyConnection, clock: Clock) -> None:
        super().__init__(lambda on: connection.subscribe(topic, on))
        self.topic = topic
        self.decoder: StreamDecoder | None = None  #: for frames that were asked for as H.264
        self._connection = connection
        self._clock = clock
        self._encoded_here = "?" in topic  # by the proxy, which wants to know what came
        self._pieces = Pieces()
        self._asked_ns = -ASK_AGAIN_NS

    def receive(self, part: EncodedFrame) -> None:
        """Take what came, on the receiving thread."""
        picture = self._pieces.add(part)
        if picture is None:
            return
        if self.decoder is not None and self._connection.variants:  # else frames come as they are
            self.decoder.put(picture)
        self.publish(picture)

    def report(self, seq: int, *, wants_key: bool = False) -> None:
        """Tell the proxy what was received, which a rate that follows the path needs. Any thread.

        Args:
            seq: The newest picture.
            wants_key: It can't be decoded, as one before it is missing; asked at most some times a second.
        """
        if not self._encoded_here:
            return
        if wants_key:
            now_ns = self._clock()
            wants_key = now_ns - self._asked_ns >= ASK_AGAIN_NS
            if wants_key:
                self._asked_ns = now_ns
        self._connection.transmit(encode(StreamReport(self.topic, seq, wants_key)))


class StreamDecoder:
    """Decodes one stream on a thread of its own, in order. What can't be decoded is left out up to a key picture.

    Args:
        stream: The pictures.
        deliver: Called with each decoded picture on the decoder's thread: its header, its pixels in BGR, and when it
            came.
        clock: This process's clock [ns].
        name: Of the thread.
    """

    def __init__(
        self, stream: StreamChannel, deliver: Callable[[FrameHeader, Pixels, int], None], clock: Clock, name: str
    ) -> None:
        self.dropped = 0  #: pictures that came and were not shown: after a gap, damaged, or too many at once
        self._stream = stream
        self._deliver = deliver
        self._clock = clock
        self._name = name
        self._changed = threading.Condition()
        self._waiting: deque[tuple[EncodedFrame, int]] = deque()
        self._chain = Chain()
        self._running = False
        self._context: VideoCodecContext | None = None

    def put(self, picture: EncodedFrame) -> None:
        """Take a picture, on the receiving thread."""
        with self._changed:
            follows = picture.codec == H264 and self._chain.follows(picture.seq, key=picture.key)
            if picture.key:  # nothing before it is of use any more
                self.dropped += len(self._waiting)
                self._waiting.clear()
            elif follows and len(self._waiting) >= MOST_WAITING:
                self._chain.restart()
                follows = False
            if follows:
                self._waiting.append((picture, self._clock()))
                if not self._running:
                    self._running = True
                    threading.Thread(target=self._run, name=self._name, daemon=True).start()
                self._changed.notify()
            else:
                self.dropped += 1
        if not follows:
            self._stream.report(picture.seq, wants_key=True)

    def _run(self) -> None:
        while (taken := self._next()) is not None:
            picture, came_ns = taken
            pixels = self._decode(picture)
            if pixels is None:
                self._leave_out()
                self._stream.report(picture.seq, wants_key=True)
                continue
            self._stream.report(picture.seq)
            height, width = pixels.shape[:2]
            header = picture.decoded(width, height)
            self._deliver(header, pixels.reshape(-1), came_ns)

    def _next(self) -> tuple[EncodedFrame, int] | None:
        with self._changed:
            if self._changed.wait_for(lambda: bool(self._waiting), _IDLE_S):
                return self._waiting.popleft()
            self._running = False  # what comes after a silence of the path still follows: the decoder stays
            return None

    def _leave_out(self) -> None:
        """Leave out a damaged picture and those that build on it."""
        with self._changed:
            self.dropped += 1
            while self._waiting and not self._waiting[0][0].key:
                self._waiting.popleft()
                self.dropped += 1
            if not self._waiting:
                self._chain.restart()

    def _decode(self, picture: EncodedFrame) -> Pixels | None:
        """Return the image, BGR; None for one that is damaged."""
        import av

        if self._context is None or picture.key:
            self._context = new_decoder(H264, _PURPOSE)
        try:
            images = self._context.decode(av.Packet(picture.data))
            image = images[-1] if images else None
            if image is None or image.is_corrupt:
                return None
            pixels = np.ascontiguousarray(image.to_ndarray(format="bgr24"), dtype=np.uint8)
        except (av.error.FFmpegError, ValueError):
            return None
        pixels.flags.writeable = False
        return pixels
