"""The server end's video: each wanted variant of a frame encoded once, and no more on the way than a reader takes.

A reader has at most :data:`WINDOW` frames on the way. While it has as many, further ones pass it by, and the newest of
them is sent as soon as it has taken one: so what a slow link shows is fewer frames, never old ones.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from typing import Final

import numpy as np

from skyloop.clock import Clock, nanoseconds
from skyloop.errors import LinkError, MissingExtraError, UsageError
from skyloop.messages import FrameHeader
from skyloop.messages.video import FrameFilter, VideoRequest
from skyloop.transport.base import Pixels
from skyloop.transport.pictures import encode_frame

WINDOW: Final = 2  #: frames on the way to one reader
#: A frame of which nothing was heard for so long is taken for lost: Zenoh drops what a congested link can't carry.
LOST_NS: Final = nanoseconds(1.0)
_log = logging.getLogger(__name__)

#: Sends one encoded frame of a variant: to everybody who reads it, or to these connections.
Send = Callable[["Variant", int, FrameHeader, bytes, "tuple[Hashable, ...] | None"], None]


@dataclass(slots=True)
class Picture:
    """A frame as it was published."""

    number: int  #: from 1, over all cameras
    header: FrameHeader
    pixels: Pixels


class Reader:
    """What is on the way to one connection."""

    __slots__ = ("_on_way", "due", "waits")

    def __init__(self) -> None:
        self._on_way: deque[tuple[int, int]] = deque()  # number and when
        self.due = False  #: the newest frame is to be sent to it
        self.waits = False  #: a frame has passed it by

    def has_room(self, now_ns: int) -> bool:
        while self._on_way and now_ns - self._on_way[0][1] > LOST_NS:
            self._on_way.popleft()
        return len(self._on_way) < WINDOW

    def promise(self, number: int, now_ns: int) -> None:
        """The frame is due."""
        self._on_way.append((number, now_ns))
        self.due, self.waits = True, False

    def sent(self, number: int, now_ns: int) -> None:
        """The frame that is due was sent, or a newer one in its place."""
        if self._on_way:
            self._on_way[-1] = (number, now_ns)
        self.due = self.waits = False

    def took(self, number: int) -> None:
        while self._on_way and self._on_way[0][0] <= number:
            self._on_way.popleft()


class Variant:
    """One form of one camera's frames, and who reads it."""

    def __init__(self, request: VideoRequest) -> None:
        self.request = request
        self.filter = FrameFilter(request)
        self.readers: dict[Hashable, Reader] = {}
        self.newest: Picture | None = None


class Video:
    """All cameras of a server end. Thread-safe; nothing is copied, encoded or sent under its lock."""

    def __init__(self, send: Send, name: str, clock: Clock = time.monotonic_ns) -> None:
        self._send = send
        self._name = name
        self._clock = clock
        self._changed = threading.Condition()
        self._variants: dict[str, dict[str, Variant]] = {}  # by camera and by topic
        self._threads: dict[str, threading.Thread] = {}
        self._number = 0
        self._ended = False
        self._unable: set[str] = set()  # topics that can't be encoded, and of which that was said

    def publish(self, header: FrameHeader, pixels: Pixels) -> int:
        """Take a frame; returns to how many readers it could not be handed over."""
        variants = self._variants.get(header.camera)
        if not variants:
            return 0
        with self._changed:
            wanted = [v for v in variants.values() if v.readers and v.filter.wants(header.seq, header.captured_ns)]
        if not wanted:
            return 0
        copy = np.frombuffer(pixels.tobytes(), np.uint8)
        now_ns = self._clock()
        missed = due = 0
        with self._changed:
            self._number += 1
            picture = Picture(self._number, header, copy)
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
        """How many read this camera, in whatever form."""
        with self._changed:
            return sum(len(variant.readers) for variant in self._variants.get(camera, {}).values())

    def subscribe(self, key: Hashable, topic: str) -> bool:
        """A connection wants frames, from the next one on; False if this is no request for video."""
        try:
            request = VideoRequest.parse(topic)
        except UsageError:
            return False
        with self._changed:
            variants = self._variants.setdefault(request.camera, {})
            variants.setdefault(topic, Variant(request)).readers.setdefault(key, Reader())
            if request.camera not in self._threads:
                thread = threading.Thread(
                    target=self._run, args=(request.camera,), name=f"skyloop-{self._name}-video", daemon=True
                )
                self._threads[request.camera] = thread
                thread.start()
        return True

    def unsubscribe(self, key: Hashable, topic: str) -> None:
        """A connection wants them no longer."""
        with self._changed, contextlib.suppress(UsageError):
            camera = VideoRequest.parse(topic).camera
            self._drop(camera, topic, key)

    def leave(self, key: Hashable) -> None:
        """A connection has ended."""
        with self._changed:
            for camera, variants in list(self._variants.items()):
                for topic in list(variants):
                    self._drop(camera, topic, key)

    def took(self, key: Hashable, topic: str, number: int) -> None:
        """A connection has taken the frames of a topic up to this one."""
        with self._changed:
            for variants in self._variants.values():
                variant = variants.get(topic)
                reader = variant.readers.get(key) if variant is not None else None
                if variant is None or reader is None:
                    continue
                reader.took(number)
                now_ns = self._clock()
                if reader.waits and variant.newest is not None and reader.has_room(now_ns):
                    reader.promise(variant.newest.number, now_ns)
                    self._changed.notify_all()

    def end(self) -> None:
        """End the threads."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        for thread in self._threads.values():
            if thread is not threading.current_thread():
                thread.join()

    def _drop(self, camera: str, topic: str, key: Hashable) -> None:
        variants = self._variants.get(camera, {})
        variant = variants.get(topic)
        if variant is not None and variant.readers.pop(key, None) is not None and not variant.readers:
            del variants[topic]

    # --- the thread of a camera ---

    def _run(self, camera: str) -> None:
        while (work := self._next(camera)) is not None:
            variant, picture, to = work
            try:
                header, data = self._encoded(variant, picture)
                self._send(variant, picture.number, header, data, to)
            except Exception:  # noqa: BLE001  (one frame less; the next one may be better)
                _log.exception("frame %s of %s could not be sent", picture.header.seq, camera)

    def _next(self, camera: str) -> tuple[Variant, Picture, tuple[Hashable, ...] | None] | None:
        """A variant with readers that are due, its newest frame and those readers (None: all); None at the end."""
        with self._changed:
            while not self._ended:
                for variant in self._variants.get(camera, {}).values():
                    due = tuple(key for key, reader in variant.readers.items() if reader.due)
                    picture = variant.newest
                    if not due or picture is None:
                        continue
                    now_ns = self._clock()
                    for key in due:
                        variant.readers[key].sent(picture.number, now_ns)
                    return variant, picture, None if len(due) == len(variant.readers) else due
                self._changed.wait()
        return None

    def _encoded(self, variant: Variant, picture: Picture) -> tuple[FrameHeader, bytes]:
        """As it was asked for; as it is, said once, where that is not possible here."""
        try:
            return encode_frame(picture.header, picture.pixels, variant.request)
        except (MissingExtraError, LinkError) as error:
            topic = variant.request.topic
            if topic not in self._unable:
                self._unable.add(topic)
                _log.warning("%s of %s is sent as it is: %s", topic, self._name, error)
            return picture.header, picture.pixels.tobytes()
