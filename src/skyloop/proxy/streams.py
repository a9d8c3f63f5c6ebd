"""Encode H.264 as subscribers request it: each format once, on a separate thread, for all of its subscribers.

A format with a fixed rate is shared by all who request it. A format named after a subscriber is for that subscriber
alone. The rate and size of such a format adapt to the path (:mod:`skyloop.proxy.core.stream_rate`). If the vehicle
itself sends H.264, such a stream forwards it while the path can carry it, and is otherwise encoded here.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from skyloop.clock import Clock, nanoseconds
from skyloop.errors import MissingExtraError, UsageError
from skyloop.messages import CameraInfo, EncodedFrame, Encoding, FrameHeader, StreamReport, VideoRequest, encode
from skyloop.messages.frame import H264, MAX_ENCODED, split, why_not_decoded
from skyloop.messages.subscription import MAX_KBIT_S, RateLimiter
from skyloop.proxy.core.stream_rate import StreamRate, picture_form
from skyloop.proxy.events import Counters
from skyloop.proxy.topics import Variants
from skyloop.pyav import H264Encoder, require_pyav
from skyloop.transport.base import TransportServer
from skyloop.transport.frame_encoding import resized_header

MAX_FORMS: Final = 16  #: maximum number for all cameras together, because each needs its own encoder
KEY_NS: Final = nanoseconds(0.3)  #: minimum time between requests for key frames
IDLE_S: Final = 1.0  #: a stream's thread ends after this time without subscribers
GOOD_BITS: Final = 0.2  #: number of bits per pixel beyond which images hardly improve
_FORMATS: Final = {Encoding.BGR8: "bgr24", Encoding.RGB8: "rgb24", Encoding.MONO8: "gray"}
_CHANNELS: Final = {Encoding.BGR8: 3, Encoding.RGB8: 3, Encoding.MONO8: 1}
_FPS: Final = 30.0  # assumed frame rate of cameras that do not announce one
_BETTER_NS: Final = nanoseconds(3.0)  # wait before enlarging the image, because each change costs a key frame
#: Fractions of the path's rate up to which forwarding the vehicle's own stream may start, and may continue.
_BEGIN_SHARE: Final = 0.9
_KEEP_SHARE: Final = 1.25
#: If forwarding overloads the path, it is retried after this time. The time doubles with each failure, up to a maximum.
_TRY_AGAIN_NS: Final = nanoseconds(5.0)
_TRY_AT_MOST_NS: Final = nanoseconds(80.0)
_OWN_KBIT_S: Final = 12_000  # highest rate tried for the vehicle's own stream [kbit/s]
_MEASURE_NS: Final = nanoseconds(1.0)  # time over which the rate of the vehicle's own stream is averaged
_OWN_SILENT_NS: Final = nanoseconds(1.0)  # if no frame arrives for this long, the vehicle has stopped sending


_Picture = tuple[FrameHeader, NDArray[np.uint8]]


class StreamForm:
    """One camera's H.264 in one format. The form's thread calls ``publish``, or ``fail`` with a readable reason."""

    def __init__(
        self,
        topic: str,
        request: VideoRequest,
        camera: CameraInfo,
        publish: Callable[[EncodedFrame], None],
        fail: Callable[[str], None],
        clock: Clock,
    ) -> None:
        self.topic = topic
        self.request = request
        self.asked_ns = 0
        self.skipped = 0  #: number of frames that were not encoded because the path or the encoder was busy
        self._fps = camera.fps if camera.fps > 0.0 else _FPS
        if request.max_fps is not None:
            self._fps = min(self._fps, request.max_fps)
        self._publish = publish
        self._fail = fail
        self._clock = clock
        good = round(camera.width * camera.height * request.scale**2 * self._fps * GOOD_BITS / 1000)
        self._kbit_s = request.kbit_s or min(max(good, 100), MAX_KBIT_S)
        own = bool(camera.stream) and request.scale == 1.0 and request.max_fps is None
        most_kbit_s = max(self._kbit_s, _OWN_KBIT_S) if own else self._kbit_s
        self._rate = StreamRate(most_kbit_s, clock()) if request.subscriber else None
        #: Whether the vehicle's own stream may be forwarded.
        self.takes_own = own and self._rate is not None
        self._passing = False  # whether that stream is being forwarded; True only while its frames keep arriving
        self._own_ns = 0  # time at which its newest frame arrived
        self._limiter = RateLimiter(request.max_fps)
        self._scale, self._better_ns = request.scale, clock()
        self._changed = threading.Condition()  # guards everything below, and the rate
        self._newest: _Picture | None = None
        self._subscribers = 0
        self._wants_key = True
        self._key_ns = -KEY_NS
        self._thread: threading.Thread | None = None
        self._ended = False
        self._encoder: H264Encoder | None = None
        self._needs_encoder = False  # whether a new encoder is needed
        self._own_kbit_s = 0.0  # rate of the vehicle's own stream; 0 if unknown
        self._own_bytes, self._own_since_ns = 0, 0
        self._try_ns, self._again_ns = 0, _TRY_AGAIN_NS
        self._seq = clock() // 1_000_000  # the current time, so that a recreated stream continues with higher numbers

    @property
    def passing(self) -> bool:
        """Whether the vehicle's own stream is being forwarded; False if the vehicle has stopped sending the stream."""
        return self._passing and self._clock() - self._own_ns < _OWN_SILENT_NS

    @property
    def max_fps(self) -> float:
        """Maximum rate at which the stream uses frames; infinity if it uses all of them."""
        return self._limiter.max_hz

    def _encode_again(self) -> None:
        """Switch back to encoding, starting with a key frame. The caller holds the lock."""
        self._passing, self._wants_key, self._needs_encoder = False, True, True

    def asked(self) -> None:
        """Handle a new subscription. A subscriber that returns after a lost link won't acknowledge earlier frames."""
        with self._changed:
            self._wants_key = True
            if self._rate is not None:
                self._rate.forget()

    def wants(self, header: FrameHeader, subscribers: int) -> bool:
        """Return whether a frame must be encoded. Call it once per frame, on the thread that publishes it."""
        with self._changed:
            self._wants_key = self._wants_key or subscribers > self._subscribers
            self._subscribers = subscribers
            if not subscribers or self.passing:
                return False
            if self._passing:  # the vehicle has stopped sending the stream
                self._encode_again()
            if self._rate is not None and not self._rate.may_send(self._clock()):
                self.skipped += 1
                return False
            return self._limiter.in_time(header.captured_ns)

    def put(self, header: FrameHeader, pixels: NDArray[np.uint8]) -> None:
        """Queue a frame for encoding. It replaces a frame that is waiting, and its bytes must not change afterwards."""
        with self._changed:
            if self._ended:
                return
            self.skipped += self._newest is not None
            self._newest = header, pixels
            if self._thread is None:
                name = f"skyloop-h264-{self.request.camera}"
                self._thread = threading.Thread(target=self._run, name=name, daemon=True)
                self._thread.start()
            self._changed.notify()

    def report(self, report: StreamReport, now_ns: int) -> None:
        """Handle a subscriber's report of the newest frame it received and of whether it needs a key frame."""
        with self._changed:
            self._wants_key = self._wants_key or report.wants_key
            # A number that this stream never sent would distort the measurement of the path.
            if self._rate is not None and report.seq <= self._seq:
                self._rate.acknowledged(report.seq, now_ns)

    def own(self, picture: EncodedFrame, subscribers: int) -> EncodedFrame | None:
        """Handle a complete frame encoded by the vehicle; return it ready to publish, or None to drop it."""
        rate, now_ns = self._rate, self._clock()
        with self._changed:
            self._measure(len(picture.data), now_ns)
            self._own_ns = now_ns
            if rate is None or not subscribers or not self._own_kbit_s:
                self._passing = False
                return None
            fits = rate.may_send(now_ns)
            # Each frame refers to the previous one. After a skipped frame, encode until the vehicle's next key frame.
            if self._passing and (self._wants_key or not fits or self._own_kbit_s > _KEEP_SHARE * rate.kbit_s):
                if not self._wants_key:  # the stream overloaded the path
                    self._try_ns = now_ns + self._again_ns
                    self._again_ns = min(2 * self._again_ns, _TRY_AT_MOST_NS)
                self._encode_again()
            begins = picture.key and fits and now_ns >= self._try_ns
            if not self._passing and begins and self._own_kbit_s <= _BEGIN_SHARE * rate.kbit_s:
                self._passing, self._wants_key = True, False
            if not self._passing:
                return None
            self._seq += 1
            rate.sent(self._seq, len(picture.data), now_ns)
            return msgspec.structs.replace(picture, seq=self._seq, topic=self.topic)

    def _measure(self, size: int, now_ns: int) -> None:
        self._own_bytes += size
        passed_ns = now_ns - self._own_since_ns
        if passed_ns >= _MEASURE_NS:
            # After a pause, the average would be too low, so a new measurement starts instead.
            if passed_ns < 2 * _MEASURE_NS:
                self._own_kbit_s = self._own_bytes * 8e6 / passed_ns
            self._own_bytes, self._own_since_ns = 0, now_ns

    def end(self) -> None:
        """End the thread after its current frame, and wait for it."""
        with self._changed:
            self._ended = True
            self._changed.notify()
            thread = self._thread
        if thread is not None:
            thread.join()

    def _run(self) -> None:
        while (picture := self._next()) is not None:
            try:
                self._encode(picture)
            except Exception as error:  # noqa: BLE001  (one frame is lost; the next may work)
                self._encoder = None
                self._fail(f"{self.topic}: a picture of {self.request.camera} can't be encoded: {error}")
            del picture

    def _next(self) -> _Picture | None:
        with self._changed:
            if not self._changed.wait_for(lambda: self._newest is not None or self._ended, IDLE_S) or self._ended:
                # This thread holds the lock, so a later put() will start another thread.
                self._thread = None
                self._encoder = None
                self._wants_key = True
                return None
            picture, self._newest = self._newest, None
            return picture

    def _encode(self, picture: _Picture) -> None:
        original, pixels = picture
        kbit_s = self._follow_path(original)
        header = resized_header(original, *_even(original, self._scale))
        with self._changed:
            encoder = None if self._needs_encoder else self._encoder
            self._needs_encoder = False
        size = (header.width, header.height)
        if encoder is None or (encoder.width, encoder.height) != size or not encoder.carries(kbit_s):
            varies = self._rate is not None
            encoder = self._encoder = H264Encoder(*size, self._fps, kbit_s, varies=varies)
        elif abs(kbit_s - encoder.kbit_s) > 0.02 * encoder.kbit_s:
            encoder.set_rate(kbit_s)
        now_ns = self._clock()
        with self._changed:
            key = self._wants_key and now_ns - self._key_ns >= KEY_NS
        data, is_key = encoder.encode(*_image(original, pixels), header.captured_ns, key=key)
        if not data:
            return
        if len(data) > MAX_ENCODED:
            raise UsageError(f"it has {len(data)} bytes, at most {MAX_ENCODED} are sent")
        with self._changed:
            if self._passing:
                return  # the vehicle's own stream has replaced this one
            self._seq += 1
            seq = self._seq
            if is_key:
                self._wants_key, self._key_ns = False, now_ns
            if self._rate is not None:
                self._rate.sent(seq, len(data), self._clock())
        times = (header.captured_ns, header.published_ns)
        self._publish(
            EncodedFrame(header.camera, seq, *times, *size, H264, is_key, data, header.intrinsics, self.topic)
        )

    def _follow_path(self, header: FrameHeader) -> int:
        """Choose the rate, and the frame size and frame rate that match it; return the rate [kbit/s]."""
        if self._rate is None:
            return self._kbit_s
        now_ns = self._clock()
        with self._changed:
            kbit_s = min(round(self._rate.kbit_s), self._kbit_s)
            pixels_1_s = header.width * header.height * self._fps * self.request.scale**2
            scale, share = picture_form(kbit_s, pixels_1_s)
            scale *= self.request.scale
            if scale < self._scale or now_ns - self._better_ns > _BETTER_NS:
                self._scale, self._better_ns = scale, now_ns
            elif scale == self._scale:
                self._better_ns = now_ns
            if share < 1.0 or self.request.max_fps is not None:
                self._limiter.max_hz = self._fps * share
            else:
                self._limiter.max_hz = math.inf
        return kbit_s


class Streams(Variants[StreamForm]):
    """All encoded streams of a vehicle's cameras."""

    def __init__(self, server: TransportServer, counters: Counters, clock: Clock, fail: Callable[[str], None]) -> None:
        super().__init__(MAX_FORMS, server.subscribers, clock)
        self._publish_packet = server.publish
        self._counts = counters.counts
        self._fail = fail

    def problem(self, topic: str, request: VideoRequest, camera: CameraInfo) -> str:
        """Reserve a place for a format and return ""; if it can't be subscribed to, return the reason. Thread-safe."""
        if request.kbit_s is None and not request.subscriber:
            return (
                f"{topic[:100]!r} has no rate: add kbit_s=…, or subscriber=NAME for as much as the path to one "
                "subscriber carries"
            )
        try:
            require_pyav("encoding H.264")
        except MissingExtraError as error:
            return str(error)
        if self.claim(topic, lambda: StreamForm(topic, request, camera, self.publish, self._fail, self._clock)):
            if (form := self.find(topic)) is not None:
                form.asked()
            return ""
        return (
            f"this proxy encodes video in at most {MAX_FORMS} formats, and all are in use: subscribe to one of "
            f"{', '.join(form.topic for form in self.known if not form.request.subscriber) or 'its frames as JPEG'}"
        )

    def wanted_fps(self, camera: str) -> float:
        """Return the highest frame rate among this camera's encoded streams that have subscribers."""
        watched = (
            one.max_fps
            for one in self.known
            if one.request.camera == camera and not one.passing and self._subscribers(one.topic)
        )
        return max(watched, default=0.0)

    def wants_own(self, camera: str) -> bool:
        """Return whether any format may forward the vehicle's own stream from this camera."""
        return any(
            one.request.camera == camera and one.takes_own and self._subscribers(one.topic) for one in self.known
        )

    def frame(self, header: FrameHeader, pixels: NDArray[np.uint8]) -> None:
        """Queue a frame for the streams that need it. The frame is copied once if any stream does."""
        camera = header.camera
        wanted = [
            form
            for form in self.known
            if form.request.camera == camera and form.wants(header, self._subscribers(form.topic))
        ]
        if not wanted:
            return
        copy = pixels.reshape(-1).copy()  # unlike tobytes(), this lets other threads run
        for form in wanted:
            form.put(header, copy)

    def own(self, picture: EncodedFrame) -> None:
        """Publish a frame that the vehicle encoded, both unchanged and in the streams that forward it."""
        self.publish(picture)
        for form in self.known:
            if form.takes_own and form.request.camera == picture.camera:
                sent = form.own(picture, self._subscribers(form.topic))
                if sent is not None:
                    self.publish(sent)

    def report(self, report: StreamReport) -> str:
        """Handle a subscriber's report. Return why it makes no sense, or an empty string."""
        if (form := self.find(report.topic)) is not None:
            form.report(report, self._clock())
            return ""
        return "" if report.topic.startswith("stream/") else f"a report of {report.topic[:64]!r}, which is not a stream"

    def publish(self, picture: EncodedFrame) -> None:
        """Publish a frame, split into as many packets as needed. Thread-safe."""
        camera, missed = picture.camera, 0
        for piece in split(picture):
            missed = max(missed, self._publish_packet(picture.topic or f"stream/{camera}", encode(piece)))
        self._counts[f"streams.{camera}.published"] += 1
        if missed:
            self._counts[f"streams.{camera}.missed"] += missed

    def end(self) -> None:
        for form in self.known:
            form.end()


def _even(header: FrameHeader, scale: float) -> tuple[int, int]:
    """Return the width and height of the image [px]. Both are even, as colours have half the resolution."""
    return max(2, round(header.width * scale / 2) * 2), max(2, round(header.height * scale / 2) * 2)


def _image(header: FrameHeader, pixels: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], str]:
    """Return a frame's image and FFmpeg's name for its format."""
    channels = _CHANNELS.get(header.encoding)
    if channels is not None:
        shape = (header.height, header.width, 3) if channels == 3 else (header.height, header.width)
        return pixels.reshape(shape), _FORMATS[header.encoding]
    if why_not := why_not_decoded(pixels.data):
        raise UsageError(why_not)
    import cv2

    image: Any = cv2.imdecode(pixels, cv2.IMREAD_COLOR)
    if image is None:
        raise UsageError("it is a damaged JPEG")
    return image, "bgr24"
