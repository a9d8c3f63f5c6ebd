"""Deliver video: a camera's frames for each request, and encoded streams, decoded on a separate thread."""

from __future__ import annotations

import secrets
import threading
from collections import deque
from collections.abc import Callable, Collection, Iterable
from functools import partial
from typing import TYPE_CHECKING, Any, Final, TypedDict, Unpack

import numpy as np

from skyloop.client.channels import Channel, checked_age
from skyloop.client.connection import ProxyConnection, Scheduler
from skyloop.client.frame import FeedbackHistory, Frame, ReceivedFrame
from skyloop.client.monitoring import ChannelCounter, ChannelStats, StallWatch
from skyloop.clock import Clock
from skyloop.errors import DecodeError, UnknownNameError, UnsupportedError, UsageError
from skyloop.messages import CameraInfo, EncodedFrame, FrameHeader, StreamReport, VideoRequest, encode
from skyloop.messages.frame import H264, Chain, Pieces
from skyloop.messages.subscription import DEFAULT_QUALITY, FrameFilter, VideoEncoding
from skyloop.pyav import new_decoder, require_pyav
from skyloop.transport.base import Pixels, stream, video

if TYPE_CHECKING:
    from av.video.codeccontext import VideoCodecContext

#: Maximum number of frames waiting to be decoded. If decoding falls behind, it skips to the next key frame.
MOST_WAITING: Final = 6
IDLE_KEPT: Final = 32  #: maximum number of channels of each kind to keep; beyond this, unread channels are forgotten
ASK_AGAIN_NS: Final = 300_000_000  #: how long to wait for a key frame before requesting it again
_IDLE_S: Final = 2.0  #: time without frames after which a decoding thread ends
_PURPOSE: Final = "reading H.264"


class VideoOptions(TypedDict, total=False):
    """Options of a request for frames; see :meth:`skyloop.Drone.frames`."""

    encoding: VideoEncoding
    quality: int
    max_fps: float | None
    scale: float
    part: tuple[int, int] | None
    kbit_s: int
    max_age_s: float


def usual(camera: str) -> VideoRequest:
    """Return the default request: JPEG when frames travel over a network."""
    return VideoRequest(camera, encoding="jpeg")


class StreamOptions(TypedDict, total=False):
    """Options for H.264; without options, frames arrive as the vehicle encoded them."""

    kbit_s: int | None  #: bit rate at which the proxy encodes; equal requests share one encoder [kbit/s]
    max_fps: float | None  #: maximum number of frames per second; None: no limit
    scale: float  #: factor for width and height, greater than 0 and at most 1
    subscriber: str  #: the only subscriber; the proxy adapts the rate to its path


class VideoChannel(Channel[ReceivedFrame]):
    """Frames of one camera for one request."""

    def __init__(
        self,
        camera: CameraInfo,
        connection: ProxyConnection,
        scheduler: Scheduler,
        history: FeedbackHistory,
        request: VideoRequest | None = None,
    ) -> None:
        """Create a channel without consumers for a request for a camera's frames; by default, :func:`usual`."""
        self.camera = camera
        self.request = request or usual(camera.name)
        super().__init__(lambda on: connection.subscribe(self.request.topic, on))
        #: Name in the statistics: the camera's plain topic for the default request, otherwise the request's topic.
        self.name = video(camera.name) if self.request == usual(camera.name) else self.request.topic
        self.newest: ReceivedFrame | None = None
        self.notifier = scheduler.notifier()  #: notified of each frame
        self.counter = ChannelCounter()
        self.undecodable = 0
        self.too_old = 0  #: number of frames rejected because they exceeded a consumer's ``max_age_s``
        # A camera that misses five frames has stalled, but a fast camera gets a second.
        self.watch = StallWatch(max(1.0, 5.0 * self._period_s(camera.fps)), scheduler.clock())
        chosen = self.request.part is not None or self.request.max_fps is not None
        #: Selects the frames for this request from the full stream; None if the request includes all frames.
        self.filter = FrameFilter(self.request) if chosen else None
        self._read: ReceivedFrame | None = None  # the last result of next_frame()
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

    def picture(self, arrival: ReceivedFrame, max_age_s: float | None = None) -> Frame | None:
        """Decode the frame; if it is damaged or older than ``max_age_s`` [s], count it and return None."""
        if max_age_s is not None and arrival.age_s > max_age_s:
            self.too_old += 1
            return None
        try:
            return arrival.frame()
        except DecodeError:
            self.undecodable += 1
            return None

    def receive(self, header: FrameHeader, pixels: Pixels, now_ns: int, *, as_asked: bool) -> None:
        """Publish a frame received at ``now_ns``; ignore duplicates and frames that arrive after a newer one.

        ``as_asked``: whether the proxy prepared the frame for this request. If not, it is scaled here if necessary.
        """
        counter = self.counter
        last = counter.last_seq
        if last is not None and header.seq <= last:
            return  # a duplicate, or older than the newest frame
        offset_ns, scale = self._connection.offset_ns, 1.0 if as_asked else self.request.scale
        arrival = ReceivedFrame(header, pixels, now_ns, offset_ns, self._history, self._clock, scale)
        # Serve the consumers before updating the statistics. The previous frame is released last, because returning its
        # memory to the proxy takes longer than all other steps.
        before, self.newest = self.newest, arrival
        self.publish(arrival)
        self.notifier.notify()
        del before
        counter.follow(header.seq)
        counter.add(now_ns + offset_ns - header.published_ns, header.captured_ns - offset_ns, now_ns)
        self.watch.received_ns = now_ns

    def restart(self, now_ns: int) -> None:
        """Reset the frame number, because a newly connected proxy may count its frames from 0."""
        self.counter.last_seq = None
        self.watch.received_ns = now_ns

    def stats(self, now_ns: int) -> ChannelStats:
        return self.counter.stats(now_ns, dropped=self.dropped + self.too_old, malformed=self.undecodable)

    def _period_s(self, fps: float) -> float:
        """Return the expected time between two frames for this request [s]; 0 if unknown."""
        most = self.request.max_fps
        rate = min(fps, most) if fps > 0.0 and most is not None else fps or most or 0.0
        parts = 1 if self.request.part is None else self.request.part[1]
        return parts / rate if rate > 0.0 else 0.0


class StreamChannel(Channel[EncodedFrame]):
    """Delivers the complete frames of one stream in order of arrival; frames may be missing."""

    def __init__(self, topic: str, connection: ProxyConnection, clock: Clock) -> None:
        super().__init__(lambda on: connection.subscribe(topic, on))
        self.topic = topic
        self.decoder: StreamDecoder | None = None  #: decodes frames for consumers that need images
        self._connection = connection
        self._clock = clock
        self._encoded_here = "?" in topic  # whether the proxy encodes the stream and needs reports of arrivals
        self._pieces = Pieces()
        self._asked_ns = -ASK_AGAIN_NS

    def receive(self, part: EncodedFrame) -> None:
        """Handle a received part of a frame, on the receiving thread."""
        picture = self._pieces.add(part)
        if picture is None:
            return
        if self.decoder is not None and self._connection.adapts_frames:  # otherwise, frames arrive unchanged
            self.decoder.put(picture)
        self.publish(picture)

    def report(self, seq: int, *, wants_key: bool = False) -> None:
        """Report the newest frame to the proxy, which adapts its rate to the path accordingly. Thread-safe.

        ``wants_key``: whether a missing frame prevents decoding; a key frame is requested at most every 0.3 s.
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
    """Decodes one stream, in order, on its own thread. After an undecodable frame, it skips to the next key frame.

    ``deliver`` is called on that thread with each image's header, pixels (BGR) and arrival time [ns].
    """

    def __init__(
        self, stream: StreamChannel, deliver: Callable[[FrameHeader, Pixels, int], None], clock: Clock, name: str
    ) -> None:
        self.dropped = 0  #: number of frames not shown because of a gap, damage, or too many frames at once
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
        """Queue an encoded frame; called on the receiving thread."""
        with self._changed:
            follows = picture.codec == H264 and self._chain.follows(picture.seq, key=picture.key)
            if picture.key:  # earlier frames are no longer needed
                self.dropped += len(self._waiting)
                self._waiting.clear()
            elif follows and len(self._waiting) >= MOST_WAITING:
                self._chain.restart()
                follows = False  # decoding has fallen behind: skip to the next key frame
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
            self._running = False  # the stream may continue after a pause, so keep the decoder
            return None

    def _leave_out(self) -> None:
        """Skip a damaged frame and all frames that depend on it."""
        with self._changed:
            self.dropped += 1
            while self._waiting and not self._waiting[0][0].key:
                self._waiting.popleft()
                self.dropped += 1
            if not self._waiting:
                self._chain.restart()

    def _decode(self, picture: EncodedFrame) -> Pixels | None:
        """Return the image in BGR; None if it is damaged."""
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


class VideoChannels:
    """Channels of all cameras and their streams. Thread-safe; video arrives on the receiving thread."""

    def __init__(self, connection: ProxyConnection, scheduler: Scheduler, history: FeedbackHistory) -> None:
        self.channels: dict[str, VideoChannel] = {}  #: channels for the default request, by camera
        self.by_topic: dict[str, VideoChannel] = {}  #: all channels, keyed by the topic of their request
        self.streams: dict[str, StreamChannel] = {}  #: by topic
        self.subscriber = secrets.token_hex(8)  #: identifies streams whose rate is adapted to the path of this client
        self._connection = connection
        self._scheduler = scheduler
        self._history = history
        self._making = threading.RLock()  # ensures that two threads requesting the same channel get the same object

    def channel(  # written out: a misspelt limit on a frame's age must be a TypeError
        self,
        camera: str | None = None,
        *,
        encoding: VideoEncoding | None = None,
        quality: int | None = None,
        max_fps: float | None = None,
        scale: float = 1.0,
        part: tuple[int, int] | None = None,
        kbit_s: int | None = None,
        max_age_s: float | None = None,
    ) -> VideoChannel:
        """Return the channel of a camera's frames as requested; see :meth:`skyloop.Drone.frames`.

        ``max_age_s`` is only validated here; the consumer passes it to :meth:`VideoChannel.picture`. Also raises
        :class:`MissingExtraError` if H.264 is requested and PyAV is not installed.
        """
        self._connection.check_open()
        checked_age(max_age_s)
        channels = self.channels
        if not channels:
            raise UnsupportedError("this vehicle has no camera")
        channel = next(iter(channels.values())) if camera is None else channels.get(camera)
        if channel is None:
            raise UnknownNameError("camera", str(camera), channels)
        if encoding in ("raw", "h264") and quality is not None:
            raise UsageError(f'quality={quality!r} needs encoding="jpeg", and the encoding is {encoding!r}')
        if encoding == "h264":
            require_pyav(_PURPOSE)
        request = VideoRequest(
            channel.camera.name,
            encoding="jpeg" if encoding is None else encoding,
            quality=DEFAULT_QUALITY if quality is None else quality,
            max_fps=max_fps,
            scale=scale,
            part=part,
            kbit_s=kbit_s,
            subscriber=self.subscriber if encoding == "h264" and kbit_s is None else "",
        )
        return channel if request == channel.request else self.made(channel.camera, request)

    def stream(self, camera: str | None = None, **how: Unpack[StreamOptions]) -> StreamChannel:
        """Return the channel of a camera's H.264; see :func:`skyloop.extend.stream_channel`."""
        return self._made_stream(VideoRequest(self.channel(camera).camera.name, encoding="h264", **how))

    def made(self, camera: CameraInfo, request: VideoRequest | None = None) -> VideoChannel:
        """Return the channel of a camera's frames as requested (None: :func:`usual`); create it on the first call."""
        topic = (request or usual(camera.name)).topic
        with self._making:
            channel = self.by_topic.get(topic)
            if channel is None:
                forget_idle(self.by_topic, keep=self.channels.values())
                channel = VideoChannel(camera, self._connection, self._scheduler, self._history, request)
                if channel.request.encoding == "h264":
                    encoded, deliver = self._made_stream(channel.request), partial(channel.receive, as_asked=True)
                    encoded.decoder = StreamDecoder(
                        encoded, deliver, self._scheduler.clock, f"skyloop-decode-{camera.name}"
                    )
                self.by_topic[topic] = channel
        return channel

    def _made_stream(self, request: VideoRequest) -> StreamChannel:
        """Return the channel of an encoded stream; create it on the first call. ``request`` has ``encoding="h264"``."""
        topic = request.stream_topic
        with self._making:
            channel = self.streams.get(topic)
            if channel is None:
                decoded = [one.request for one in self.by_topic.values() if one.request.encoding == "h264"]
                forget_idle(self.streams, keep={self.streams.get(one.stream_topic) for one in decoded})
                channel = self.streams[topic] = StreamChannel(topic, self._connection, self._scheduler.clock)
        return channel

    def connected(self, cameras: Iterable[CameraInfo], now_ns: int) -> None:
        """Store the cameras of a newly connected proxy, which may count its frames from 0."""
        for channel in tuple(self.by_topic.values()):
            channel.restart(now_ns)
        # The proxy may have restarted with different cameras, and its first camera may be a different one.
        self.channels = {one.name: self.channels.get(one.name) or self.made(one) for one in cameras}

    def renew(self, flows: bool, now_ns: int) -> None:
        """Resubscribe to cameras that have stalled while other samples still arrive (``flows``)."""
        for channel in tuple(self.by_topic.values()):
            if channel.watch.stalled(flows, now_ns):
                self._connection.resubscribe(channel.request.topic)

    def receive(self, header: FrameHeader, pixels: Pixels, now_ns: int, topic: str = "") -> None:
        """Deliver a frame to its channels.

        ``topic`` names the request that the frame answers; empty: a plain frame of the camera, for all its channels.
        """
        if topic:
            channel = self.by_topic.get(topic)
            if channel is not None:
                channel.receive(header, pixels, now_ns, as_asked=True)
            return
        for channel in tuple(self.by_topic.values()):
            mine, chosen = channel.subscribed and channel.camera.name == header.camera, channel.filter
            if mine and (chosen is None or chosen.wants(header.seq, header.captured_ns)):
                channel.receive(header, pixels, now_ns, as_asked=False)

    def receive_encoded(self, picture: EncodedFrame, now_ns: int) -> None:  # noqa: ARG002  (the signature of all handlers)
        channel = self.streams.get(picture.topic or stream(picture.camera))
        if channel is not None:
            channel.receive(picture)


def forget_idle(channels: dict[Any, Any], keep: Collection[Channel[Any] | None] = ()) -> None:
    """Forget the oldest unread channels to make room for one new channel."""
    for name, channel in list(channels.items()):
        if len(channels) < IDLE_KEPT:
            return
        if not channel.subscribed and channel not in keep:
            del channels[name]
