"""One camera's frames for all pages that show them: JPEGs are encoded once for all pages; H.264 is relayed unchanged.

The drone's own thread keeps the newest pictures; pages fetch theirs on the event loop. H.264 pictures depend on earlier
ones, so a page receives all of them in order or resumes at a key frame. This module encodes nothing to H.264.
"""

from __future__ import annotations

import asyncio
import struct
import threading
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Generic, TypeVar

import msgspec

from skyloop.client.monitoring import ChannelCounter, ChannelStats
from skyloop.clock import Clock, monotonic_ns, seconds
from skyloop.cockpit.feeds import Wake, call_soon
from skyloop.extend import stream_channel
from skyloop.messages import CameraInfo, EncodedFrame
from skyloop.platform import lower_priority

if TYPE_CHECKING:
    from skyloop.client import Drone, Frame
    from skyloop.client.channels import Listener
    from skyloop.client.video import StreamChannel

JPEG_QUALITY = 80  #: quality of full-size JPEG files, 1 to 100

_LENGTH: Final = struct.Struct(">I")
_encode = msgspec.json.Encoder().encode
NICENESS: Final = 10  #: niceness of the encoding thread


#: One thread for all cameras, because encoding for many pages must not take CPU cores away from flying. The event loop
#: keeps its original priority: stick and stop commands pass through it, and a browser must not starve it.
_ENCODER: Final = ThreadPoolExecutor(1, "jpeg", initializer=partial(lower_priority, NICENESS, thread_only=True))
KEPT: Final = 16  #: number of pictures kept per stream; a page further behind resumes at a key frame
SCALES: Final = (0.25, 0.375, 0.5, 0.75, 1.0)  #: only a few scales, so that similar panes share a stream
RATES: Final = (60, 100, 150, 220, 330, 500, 750, 1100, 1700, 2500, 3700, 5500, 8000)  #: only a few rates [kbit/s]
BITS: Final = 0.12  #: bits per pixel of a video stream: chosen for a good picture
_FPS: Final = 30.0  # frame rate assumed for a camera that does not report one


P = TypeVar("P")


@dataclass(frozen=True, slots=True)
class Numbered(Generic[P]):
    """A picture for pages, with a number that stays unique in this process even if the proxy restarts.

    For H.264, the number increases by exactly one only if the picture continues the previous picture.
    """

    serial: int
    picture: P


class CameraFeed:
    """The newest frame of one camera; it is encoded at most once for all pages, and only while a page shows it."""

    def __init__(self, drone: Drone, camera: str, clock: Clock = monotonic_ns) -> None:
        self.camera = camera
        self.newest: Numbered[Frame] | None = None
        self.encoded = 0  #: number of frames encoded to JPEG
        self._drone = drone
        self._clock = clock
        self._since_ns = 0  # time at which the first page subscribed
        self._listener: Listener[Any] | None = None
        self._wakes: set[Wake] = set()
        self._serial = 0
        self._jpeg: tuple[int, asyncio.Future[bytes]] | None = None

    @property
    def wanted(self) -> bool:
        """Whether a page shows the camera."""
        return bool(self._wakes)

    def subscribe(self, wake: Wake) -> None:
        """Call ``wake`` on the loop for each newer frame, and now if there is one. The first call subscribes."""
        self._wakes.add(wake)
        if self._listener is None:
            loop = asyncio.get_running_loop()
            self._since_ns = self._clock()
            self._listener = self._drone.on_frame(lambda frame: call_soon(loop, self._put, frame), camera=self.camera)
        elif self.newest is not None:
            wake()

    def unsubscribe(self, wake: Wake) -> None:
        """Stop calling ``wake``. When the last subscriber leaves, unsubscribe from the camera."""
        self._wakes.discard(wake)
        if not self._wakes and self._listener is not None:
            self._listener.cancel()
            self._listener = self.newest = self._jpeg = None

    @property
    def age_s(self) -> float | None:
        """Age of the newest frame [s] or, until a frame follows a new subscription, the time since then.

        None while no page shows the camera, and before the very first frame, which a vehicle may take seconds to send.
        """
        if self._listener is None or not self._serial:
            return None
        return seconds(self._clock() - self._since_ns) if self.newest is None else self.newest.picture.age_s

    async def jpeg(self, picture: Numbered[Frame]) -> bytes:
        """Return the picture as a JPEG file, which is encoded on a thread, once for all pages."""
        if self._jpeg is None or self._jpeg[0] != picture.serial:
            loop = asyncio.get_running_loop()
            self._jpeg = picture.serial, loop.run_in_executor(_ENCODER, to_jpeg, picture.picture)
            self.encoded += 1
        return await asyncio.shield(self._jpeg[1])

    def close(self) -> None:
        if self._listener is not None:
            self._listener.cancel()
            self._listener = None

    def _put(self, frame: Frame) -> None:
        if self._listener is None:  # the subscription was cancelled before this call arrived
            return
        self._serial += 1
        self.newest = Numbered(self._serial, frame)
        for wake in self._wakes:
            wake()


def to_jpeg(frame: Frame, quality: int = JPEG_QUALITY) -> bytes:
    """Encode a frame (BGR) as a JPEG file; raise ``ValueError`` if OpenCV could not encode it."""
    import cv2

    done, data = cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise ValueError(f"frame {frame.seq} of {frame.camera} could not be encoded to JPEG")
    return bytes(data.data)


def pack(head: dict[str, Any], *jpegs: bytes) -> bytes:
    """Return a binary message: length of the head (4 bytes, big-endian), the head in JSON, the JPEG files."""
    text = _encode(head)
    return b"".join((_LENGTH.pack(len(text)), text, *jpegs))


FPS: Final = 12.0  #: maximum frame rate of each camera
WIDTHS: Final = (160, 240, 320, 480)  #: frame widths [pixels]; the width a page requests is rounded up to one of them
QUALITY: Final = 70  #: quality of small JPEG files, 1 to 100


@dataclass(frozen=True, slots=True)
class SmallFrame:
    """A frame as a JPEG file; ``serial`` counts the frames of its feed."""

    serial: int
    jpeg: bytes
    seq: int
    captured_ns: int  #: capture time on the proxy's clock
    width: int
    height: int


class SmallFeed:
    """A camera's newest frame in one size, encoded as a JPEG file while a page shows it. Used on the event loop.

    ``width``: the width to which frames are scaled down [pixels]; smaller frames are left unchanged.
    """

    def __init__(self, drone: Drone, camera: CameraInfo, width: int, clock: Clock = monotonic_ns) -> None:
        self.camera = camera.name
        self.newest: SmallFrame | None = None  #: replaced as a whole by the drone's receiving thread
        self.encoded = 0  #: number of frames encoded to JPEG
        self._drone = drone
        self._scale = min(1.0, width / camera.width) if camera.width > 0 else 1.0
        self._clock = clock
        self._since_ns = 0
        self._pages = 0
        self._listener: Listener[Any] | None = None

    @property
    def wanted(self) -> bool:
        return self._pages > 0

    @property
    def age_s(self) -> float | None:
        """Age of the newest frame [s]; see :attr:`CameraFeed.age_s`."""
        if not self.wanted or not self.encoded:
            return None
        newest, now_ns = self.newest, self._clock()
        if newest is None:
            return seconds(now_ns - self._since_ns)
        return seconds(now_ns + self._drone.clock_offset_ns - newest.captured_ns)

    def subscribe(self) -> None:
        """Add a page that shows the camera; the first one subscribes to the camera.

        Raise ``SkyloopError`` if the drone was closed or no longer has this camera.
        """
        if self._listener is None:
            self._since_ns = self._clock()
            # Inline, because the callback does very little, whereas a thread per camera would be woken for each frame.
            self._listener = self._drone.on_frame(
                self._put, camera=self.camera, inline=True, encoding="jpeg", max_fps=FPS, scale=self._scale
            )
        self._pages += 1

    def unsubscribe(self) -> None:
        """Remove a page that no longer shows the camera; when no pages are left, unsubscribe from the camera."""
        self._pages -= 1
        if self._pages == 0:
            self.close()

    def close(self) -> None:
        """Unsubscribe from the camera. Idempotent."""
        if self._listener is not None:
            self._listener.cancel()
            self._listener = self.newest = None

    def _put(self, frame: Frame) -> None:
        """Encode a frame and store the result. Runs on the drone's receiving thread."""
        jpeg = to_jpeg(frame, QUALITY)
        self.encoded += 1
        height, width = frame.shape[:2]
        self.newest = SmallFrame(self.encoded, jpeg, frame.seq, frame.captured_ns, width, height)


def rounded_width(wish: int) -> int:
    """Round a width [pixels] up to one of :data:`WIDTHS`, or down to the largest width."""
    return next((width for width in WIDTHS if width >= wish), WIDTHS[-1])


@dataclass(frozen=True, slots=True)
class FeedFormat:
    """The encoding of a camera's stream; by default, the encoding chosen by the vehicle.

    ``kbit_s``: the bit rate of a stream that all subscribers with the same values share. ``subscriber``: the name of
    the only subscriber, whose path determines the rate and size.
    """

    kbit_s: int | None = None
    scale: float = 1.0
    max_fps: float | None = None
    subscriber: str = ""

    @property
    def kind(self) -> str:
        """The kind of stream: ``vehicle`` (its own encoding), ``shared``, or ``own`` for a single page."""
        if self.subscriber:
            return "own"
        return "vehicle" if self.kbit_s is None else "shared"


def form_for(camera: CameraInfo, width: int, max_fps: float | None = None) -> FeedFormat:
    """Return the encoding that all panes of about the same size share.

    ``width``: width of the pane [device pixels], or 0 for full size. ``max_fps``: maximum number of pictures per
    second, None for no limit.
    """
    scale = 1.0
    if 0 < width < camera.width:
        scale = next(step for step in SCALES if step * camera.width >= width)
    if camera.stream == "h264" and scale == 1.0 and max_fps is None:
        return FeedFormat()
    fps = camera.fps if camera.fps > 0.0 else _FPS
    fps = fps if max_fps is None else min(fps, max_fps)
    good_kbit_s = camera.width * camera.height * scale**2 * fps * BITS / 1000
    return FeedFormat(next((rate for rate in RATES if rate >= good_kbit_s), RATES[-1]), scale, max_fps)


class EncodedFeed:
    """The newest pictures of one H.264 stream, while a page shows it. Created and used on the event loop."""

    encoded = 0  #: number of frames encoded here; always 0, because H.264 is only relayed

    def __init__(self, drone: Drone, camera: str, form: FeedFormat, clock: Clock = monotonic_ns) -> None:
        self.camera = camera
        self.form = form
        self._counter = ChannelCounter()
        self._drone = drone
        self._clock = clock
        self._came_ns = 0  # time at which the newest picture arrived
        self._channel: StreamChannel | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._serial = 0
        self._lock = threading.Lock()  # guards the following fields
        self._wakes: dict[object, Wake | None] = {}  # by page
        self._pictures: deque[Numbered[EncodedFrame]] = deque(maxlen=KEPT)

    @property
    def wanted(self) -> bool:
        return bool(self._wakes)

    @property
    def age_s(self) -> float | None:
        """Age of the newest picture [s].

        None while no page shows the camera, before the first picture, and for a single page's stream, because its age
        depends on that page's path rather than on the camera.
        """
        with self._lock:
            newest = self._pictures[-1] if self._pictures else None
        if newest is None or not self.wanted or self.form.subscriber:
            return None
        return seconds(self._clock() + self._drone.clock_offset_ns - newest.picture.captured_ns)

    @property
    def silent_s(self) -> float:
        """Time without a picture [s]. 0 once a single page's stream has started: the page may not be accepting any."""
        with self._lock:
            silent = self.wanted and not (self._pictures and self.form.subscriber)
            return seconds(self._clock() - self._came_ns) if silent else 0.0

    def stats(self) -> ChannelStats:
        """Return the stream's statistics, as for a channel."""
        return self._counter.stats(self._clock())

    def subscribe(self, page: object, wake: Wake | None) -> None:
        """Add a page that shows the pictures; the first one subscribes to the stream, which starts with a key frame.

        ``wake``: called on the event loop for each picture, or None if the page polls. Raise ``SkyloopError`` if the
        drone was closed or no longer has this camera.
        """
        if self._channel is None:
            form = self.form
            channel = stream_channel(
                self._drone,
                self.camera,
                kbit_s=form.kbit_s,
                max_fps=form.max_fps,
                scale=form.scale,
                subscriber=form.subscriber,
            )
            self._loop = asyncio.get_running_loop()
            self._came_ns = self._clock()
            channel.add(self._put, lambda: 0)  # this consumer misses no sample
            self._channel = channel
        with self._lock:
            self._wakes[page] = wake

    def unsubscribe(self, page: object) -> None:
        """Remove a page that no longer shows the pictures; when no pages are left, unsubscribe from the stream."""
        with self._lock:
            self._wakes.pop(page, None)
        if not self.wanted:
            self.close()

    def close(self) -> None:
        """Unsubscribe from the stream. Idempotent."""
        channel, self._channel = self._channel, None
        if channel is not None:
            channel.remove(self._put)
            with self._lock:
                self._pictures.clear()

    def after(self, serial: int, *, follows: bool) -> tuple[list[Numbered[EncodedFrame]], int]:
        """Return the next pictures for a page, in order, and the number of pictures skipped before them.

        ``serial``: number of the last picture sent to the page, or 0 if none. ``follows``: whether the page can decode
        the next picture; if not, it resumes at a key frame.
        """
        with self._lock:
            newer = [one for one in self._pictures if one.serial > serial]
        for first in range(len(newer) - 1, 0, -1):
            if newer[first].picture.key:  # this one depends on no earlier picture
                break
        else:
            first = 0
        chosen = newer[first:]
        if not chosen:
            return [], 0
        starts = chosen[0].picture.key or (follows and chosen[0].serial == serial + 1)
        if not starts or chosen[-1].serial - chosen[0].serial != len(chosen) - 1:
            return [], chosen[-1].serial - serial if serial else len(chosen)
        return chosen, chosen[0].serial - serial - 1 if serial else 0

    def ask_for_key(self) -> None:
        """Request a key frame from the proxy, but at most a few times a second."""
        if self._channel is not None:
            self._channel.report(0, wants_key=True)

    def acknowledge(self, seq: int) -> None:
        """Report to the proxy which pictures the page has received, if the rate depends on that."""
        if self._channel is not None and self.form.subscriber:
            self._channel.report(seq)

    def _put(self, picture: EncodedFrame) -> None:
        """Store a picture. Runs on the drone's receiving thread."""
        with self._lock:
            last = self._pictures[-1].picture.seq if self._pictures else 0
            self._serial += 1 if picture.seq == last + 1 else 2
            self._pictures.append(Numbered(self._serial, picture))
            self._came_ns = self._clock()
            wakes = [wake for wake in self._wakes.values() if wake is not None]
        captured_ns = picture.captured_ns - self._drone.clock_offset_ns
        self._counter.follow(self._serial)
        self._counter.add(
            self._clock() - (picture.published_ns - self._drone.clock_offset_ns), captured_ns, self._clock()
        )
        if self._loop is not None:
            for wake in wakes:
                call_soon(self._loop, wake)
