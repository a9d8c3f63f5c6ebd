"""Send the server's video. Each subscribed variant of a frame is encoded once and sent at its readers' pace.

Up to :data:`WINDOW` frames are in flight to each reader. Further frames are skipped until the reader acknowledges one.
The reader then gets the newest frame. A slow link therefore shows fewer frames, but never old ones.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import threading
from collections import deque
from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass
from typing import Final

from skyloop.clock import Clock, monotonic_ns, nanoseconds
from skyloop.errors import LinkError, MissingExtraError, UsageError
from skyloop.messages import FrameHeader
from skyloop.messages.subscription import FrameFilter, VideoRequest
from skyloop.transport.base import Pixels
from skyloop.transport.frame_encoding import encode_frame

WINDOW: Final = 2  #: maximum number of frames in flight to one reader
#: Maximum number of formats in which one camera's frames are encoded. All parts of a split format count as one format.
#: The default formats are not counted, so there is always room for a pilot, whatever others request.
MAX_FORMS: Final = 32
MAX_FORMS_EACH: Final = 8  #: maximum number of formats that one connection may read
#: A frame not acknowledged after this time is considered lost: Zenoh drops what a congested link can't carry.
LOST_NS: Final = nanoseconds(1.0)
_log = logging.getLogger(__name__)

#: Sends one encoded frame of a variant, either to all readers of the variant or only to the given connections.
Send = Callable[["FrameVariant", int, FrameHeader, bytes, "tuple[Hashable, ...] | None"], None]


@dataclass(slots=True)
class PublishedFrame:
    """A published frame."""

    number: int  #: number of the frame, counted from 1 over all cameras
    header: FrameHeader
    pixels: Pixels


class Reader:
    """The frames that are in flight to one connection."""

    __slots__ = ("_on_way", "due", "waits")

    def __init__(self) -> None:
        self._on_way: deque[tuple[int, int]] = deque()  # number of each frame, and the time when it was sent
        self.due = False  #: the newest frame should be sent to this connection
        self.waits = False  #: the connection has missed a frame

    def has_room(self, now_ns: int) -> bool:
        """Return whether another frame may be sent. Frames sent longer than :data:`LOST_NS` ago are considered lost."""
        while self._on_way and now_ns - self._on_way[0][1] > LOST_NS:
            self._on_way.popleft()
        return len(self._on_way) < WINDOW

    def promise(self, number: int, now_ns: int) -> None:
        """Mark a frame as due."""
        self._on_way.append((number, now_ns))
        self.due, self.waits = True, False

    def sent(self, number: int, now_ns: int) -> None:
        """Record that the frame that was due, or a newer frame in its place, was sent."""
        if self._on_way:
            self._on_way[-1] = (number, now_ns)
        self.due = self.waits = False

    def taken(self, number: int) -> None:
        """Record that all frames up to this number were received."""
        while self._on_way and self._on_way[0][0] <= number:
            self._on_way.popleft()


class FrameVariant:
    """One of a camera's frame formats, with the connections that read it."""

    def __init__(self, request: VideoRequest) -> None:
        self.request = request
        self.filter = FrameFilter(request)
        self.readers: dict[Hashable, Reader] = {}
        self.newest: PublishedFrame | None = None


class FramePublisher:
    """Publishes the frames of all of a server's cameras. Thread-safe; copies, encodes and sends outside its lock."""

    def __init__(self, send: Send, name: str, clock: Clock = monotonic_ns) -> None:
        #: Returns why a topic can't be subscribed to, or an empty string if it can.
        self.topic_problem: Callable[[str], str] = lambda _: ""
        self._send = send
        self._name = name
        self._clock = clock
        self._changed = threading.Condition()
        self._variants: dict[str, dict[str, FrameVariant]] = {}  # by camera and topic
        self._threads: dict[str, threading.Thread] = {}
        self._number = 0
        self._ended = False
        self._unable: set[str] = set()  # topics whose encoding failed and has been logged

    def publish(self, header: FrameHeader, pixels: Pixels) -> int:
        """Publish a frame. Return the number of readers that miss it because they have :data:`WINDOW` frames in flight.

        If the camera has readers, copy the pixels. The camera's thread then encodes and sends them.
        """
        variants = self._variants.get(header.camera)
        if not variants:
            return 0
        with self._changed:
            wanted = [v for v in variants.values() if v.readers and v.filter.wants(header.seq, header.captured_ns)]
        if not wanted:
            return 0
        copy = pixels.reshape(-1).copy()  # unlike tobytes(), this releases the GIL
        now_ns = self._clock()
        missed = due = 0
        with self._changed:
            self._number += 1
            picture = PublishedFrame(self._number, header, copy)
            for variant in wanted:
                variant.newest = picture
                for reader in variant.readers.values():
                    if reader.has_room(now_ns):
                        reader.promise(picture.number, now_ns)
                        due += 1
                    else:
                        reader.waits = True
                        missed += 1
            if due:
                self._changed.notify_all()
        return missed

    def readers(self, camera: str) -> int:
        """Return the number of subscriptions to a camera, in all formats."""
        with self._changed:
            return sum(len(variant.readers) for variant in self._variants.get(camera, {}).values())

    def subscribe(self, key: Hashable, topic: str) -> bool:
        """Send frames to a connection from the next frame on. Return False if that fails (see :meth:`problem`)."""
        with self._changed:
            if self._problem(key, topic):
                return False
            request = VideoRequest.parse(topic)
            variants = self._variants.setdefault(request.camera, {})
            variants.setdefault(topic, FrameVariant(request)).readers.setdefault(key, Reader())
            if request.camera not in self._threads:
                thread = threading.Thread(
                    target=self._run, args=(request.camera,), name=f"skyloop-{self._name}-video", daemon=True
                )
                try:
                    thread.start()
                except RuntimeError:  # no more threads can be started
                    self._drop(request.camera, topic, key)
                    return False
                self._threads[request.camera] = thread
        return True

    def problem(self, key: Hashable, topic: str) -> str:
        """Return why a connection can't have these frames, or an empty string if it can."""
        with self._changed:
            return self._problem(key, topic)

    def _problem(self, key: Hashable, topic: str) -> str:
        if unknown := self.topic_problem(topic):
            return unknown
        try:
            request = VideoRequest.parse(topic)
        except UsageError as error:
            return str(error)
        if request.encoding == "h264":
            return f"H.264 has a separate topic: subscribe to {request.stream_topic}"
        usual = (request.plain, VideoRequest(request.camera, encoding="jpeg"))
        variants = self._variants.get(request.camera, {})
        if request in usual or (topic in variants and key in variants[topic].readers):
            return ""
        mine = [known for known, variant in variants.items() if key in variant.readers and variant.request not in usual]
        if len(mine) >= MAX_FORMS_EACH:
            return f"a connection gets at most {MAX_FORMS_EACH} formats per camera besides the default: {_listed(mine)}"
        others = {known: variant.request for known, variant in variants.items() if variant.request not in usual}
        if topic not in variants and sum(map(_cost, others.values())) + _cost(request) > MAX_FORMS:
            return f"a camera's frames are encoded in at most {MAX_FORMS} formats: choose one of {_listed(others)}"
        return ""

    def unsubscribe(self, key: Hashable, topic: str) -> None:
        with self._changed, contextlib.suppress(UsageError):
            camera = VideoRequest.parse(topic).camera
            self._drop(camera, topic, key)

    def leave(self, key: Hashable) -> None:
        """Remove a connection that has ended from all topics."""
        with self._changed:
            for camera, variants in list(self._variants.items()):
                for topic in list(variants):
                    self._drop(camera, topic, key)

    def taken(self, key: Hashable, topic: str, number: int) -> None:
        """Record up to which frame a connection has received a topic. If it missed a frame, send it the newest one."""
        with self._changed:
            for variants in self._variants.values():
                variant = variants.get(topic)
                reader = variant.readers.get(key) if variant is not None else None
                if variant is None or reader is None:
                    continue
                reader.taken(number)
                now_ns = self._clock()
                if reader.waits and variant.newest is not None and reader.has_room(now_ns):
                    reader.promise(variant.newest.number, now_ns)
                    self._changed.notify_all()

    def end(self) -> None:
        """End the cameras' threads."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        for thread in list(self._threads.values()):
            if thread is not threading.current_thread():
                thread.join()

    def _drop(self, camera: str, topic: str, key: Hashable) -> None:
        variants = self._variants.get(camera, {})
        variant = variants.get(topic)
        if variant is not None and variant.readers.pop(key, None) is not None and not variant.readers:
            del variants[topic]
            self._unable.discard(topic)
            if not variants:  # the camera's last reader has left, so its thread ends
                del self._variants[camera]
                self._changed.notify_all()

    # --- on a camera's thread ---

    def _run(self, camera: str) -> None:
        while (work := self._next(camera)) is not None:
            variant, picture, to = work
            try:
                header, data = self._encoded(variant, picture)
                self._send(variant, picture.number, header, data, to)
            except Exception:  # noqa: BLE001  (lose one frame; the next may succeed)
                _log.exception("frame %s of %s could not be sent", picture.header.seq, camera)

    def _next(self, camera: str) -> tuple[FrameVariant, PublishedFrame, tuple[Hashable, ...] | None] | None:
        """Wait until a variant's newest frame is due for readers; return variant, frame and readers (None: all).

        None at the end, or if the camera has no readers.
        """
        with self._changed:
            while not self._ended and camera in self._variants:
                variants = self._variants[camera]
                for topic, variant in variants.items():
                    due = tuple(key for key, reader in variant.readers.items() if reader.due)
                    picture = variant.newest
                    if not due or picture is None:
                        continue
                    now_ns = self._clock()
                    for key in due:
                        variant.readers[key].sent(picture.number, now_ns)
                    variants[topic] = variants.pop(topic)  # next time, the other variants come first
                    return variant, picture, None if len(due) == len(variant.readers) else due
                self._changed.wait()
            self._threads.pop(camera, None)
        return None

    def _encoded(self, variant: FrameVariant, picture: PublishedFrame) -> tuple[FrameHeader, bytes]:
        """Encode a frame as requested. If that fails, return the frame unencoded and log the failure once."""
        try:
            return encode_frame(picture.header, picture.pixels, variant.request)
        except (MissingExtraError, LinkError) as error:
            topic = variant.request.topic
            if topic not in self._unable:
                self._unable.add(topic)
                _log.warning("%s of %s is sent unencoded: %s", topic, self._name, error)
            return picture.header, picture.pixels.tobytes()


def _cost(request: VideoRequest) -> float:
    """Return the fraction of frames that must be encoded for a format."""
    return 1.0 if request.part is None else 1.0 / request.part[1]


def _listed(topics: Iterable[str]) -> str:
    return ", ".join(itertools.islice(topics, 3)) + ", …"
