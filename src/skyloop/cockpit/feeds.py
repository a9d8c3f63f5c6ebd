"""From the client's threads to the event loop: the newest frame, the newest drawing of each source, the last events.

Everything here but the callbacks given to the drone runs on the event loop.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from skyloop.messages import Annotation, Event

if TYPE_CHECKING:
    from skyloop.client import Drone, Frame

JPEG_QUALITY = 80
KEPT_EVENTS = 256

Wake = Callable[[], None]


class _Cancellable(Protocol):
    """What registering with a drone gives back."""

    def cancel(self) -> None: ...


@dataclass(frozen=True, slots=True)
class Picture:
    """One frame on its way to pages. ``serial`` counts what this process saw, across restarts of the proxy."""

    serial: int
    frame: Frame


class CameraFeed:
    """The newest frame of one camera, encoded at most once for all pages, and only while a page wants it."""

    def __init__(self, drone: Drone, camera: str) -> None:
        self.camera = camera
        self.newest: Picture | None = None
        self._drone = drone
        self._processor: _Cancellable | None = None
        self._wakes: set[Wake] = set()
        self._serial = 0
        self._encoded: tuple[int, asyncio.Future[bytes]] | None = None
        # One thread: encoding for many pages must not take the cores that fly.
        self._pool = ThreadPoolExecutor(1, thread_name_prefix=f"jpeg-{camera}")

    def join(self, wake: Wake) -> None:
        """A page wants frames: ``wake`` is called on the loop when there is a newer one."""
        self._wakes.add(wake)
        if self._processor is None:
            loop = asyncio.get_running_loop()
            self._processor = self._drone.add_processor(
                lambda frame: _call_soon(loop, self._put, frame), camera=self.camera, name="cockpit"
            )
        elif self.newest is not None:
            wake()

    def leave(self, wake: Wake) -> None:
        """A page went away; after the last one the camera is no longer subscribed."""
        self._wakes.discard(wake)
        if not self._wakes and self._processor is not None:
            self._processor.cancel()
            self._processor = self.newest = self._encoded = None

    async def jpeg(self, picture: Picture) -> bytes:
        """The picture as a JPEG file; the same work is done once for all pages."""
        if self._encoded is None or self._encoded[0] != picture.serial:
            loop = asyncio.get_running_loop()
            self._encoded = picture.serial, loop.run_in_executor(self._pool, to_jpeg, picture.frame)
        return await asyncio.shield(self._encoded[1])

    def close(self) -> None:
        if self._processor is not None:
            self._processor.cancel()
            self._processor = None
        self._pool.shutdown(wait=False, cancel_futures=True)

    def _put(self, frame: Frame) -> None:
        if self._processor is None:  # cancelled while this was on its way
            return
        self._serial += 1
        self.newest = Picture(self._serial, frame)
        for wake in self._wakes:
            wake()


class NewsFeed:
    """The drone's annotations and events. Events are numbered here, as those that the client makes have no number."""

    def __init__(self, drone: Drone) -> None:
        self.drawings: dict[tuple[str, str], Annotation] = {}  #: newest, by camera and source
        self.events: deque[tuple[int, Event]] = deque(enumerate(drone.recent_events(), 1), maxlen=KEPT_EVENTS)
        self._next = len(self.events) + 1
        self._wakes: set[Wake] = set()
        loop = asyncio.get_running_loop()
        self._listeners: list[_Cancellable] = [
            drone.on_annotation(lambda annotation: _call_soon(loop, self._draw, annotation)),
            drone.on_event(lambda event: _call_soon(loop, self._tell, event)),
        ]

    def join(self, wake: Wake) -> None:
        """``wake`` is called on the loop when there is a newer drawing."""
        self._wakes.add(wake)

    def leave(self, wake: Wake) -> None:
        self._wakes.discard(wake)

    def events_after(self, number: int) -> list[tuple[int, Event]]:
        """Events with greater numbers, oldest first, with their numbers."""
        return [(n, event) for n, event in self.events if n > number]

    def close(self) -> None:
        for listener in self._listeners:
            listener.cancel()

    def _draw(self, annotation: Annotation) -> None:
        self.drawings[annotation.camera, annotation.source] = annotation
        for wake in self._wakes:
            wake()

    def _tell(self, event: Event) -> None:
        self.events.append((self._next, event))
        self._next += 1


def to_jpeg(frame: Frame) -> bytes:
    """A frame (BGR) as a JPEG file."""
    import cv2

    done, data = cv2.imencode(".jpg", frame.image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise ValueError(f"frame {frame.seq} of {frame.camera} could not be made a JPEG")
    return bytes(data.data)


def _call_soon(loop: asyncio.AbstractEventLoop, function: Callable[..., None], *arguments: Any) -> None:
    """From any thread. A loop that has just been closed has no pages left to tell."""
    if not loop.is_closed():
        loop.call_soon_threadsafe(function, *arguments)
