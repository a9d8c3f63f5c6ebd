"""From the client's threads to the event loop: the newest frame, the newest drawing of each source, the last events,
what applications log and what is commanded.

Everything here but the callbacks given to the drone runs on the event loop.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from skyloop.clock import Clock, monotonic_ns, seconds
from skyloop.messages import Annotation, Applied, Event, LogEntry
from skyloop.messages.log import MOCAP as SERIES

if TYPE_CHECKING:
    from skyloop.client import Drone, Frame

JPEG_QUALITY = 80
KEPT_EVENTS = 256
MAX_SERIES = 256  #: logged numbers that are shown of one drone
WAYPOINTS = "waypoints"  #: name under which a controller logs where it flies to
MOCAP_S = 0.5  #: a pose of motion capture that is older is not shown

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

    def __init__(self, drone: Drone, camera: str, clock: Clock = monotonic_ns) -> None:
        self.camera = camera
        self.newest: Picture | None = None
        self.encoded = 0  #: frames that were made a JPEG
        self._drone = drone
        self._clock = clock
        self._since_ns = 0  # since when a page wants frames
        self._processor: _Cancellable | None = None
        self._wakes: set[Wake] = set()
        self._serial = 0
        self._jpeg: tuple[int, asyncio.Future[bytes]] | None = None
        # One thread: encoding for many pages must not take the cores that fly.
        self._pool = ThreadPoolExecutor(1, thread_name_prefix=f"jpeg-{camera}")

    @property
    def wanted(self) -> bool:
        """Whether a page watches it."""
        return bool(self._wakes)

    def join(self, wake: Wake) -> None:
        """A page wants frames: ``wake`` is called on the loop when there is a newer one."""
        self._wakes.add(wake)
        if self._processor is None:
            loop = asyncio.get_running_loop()
            self._since_ns = self._clock()
            self._processor = self._drone.add_processor(
                lambda frame: call_soon(loop, self._put, frame), camera=self.camera, name="cockpit"
            )
        elif self.newest is not None:
            wake()

    def leave(self, wake: Wake) -> None:
        """A page went away; after the last one the camera is no longer subscribed."""
        self._wakes.discard(wake)
        if not self._wakes and self._processor is not None:
            self._processor.cancel()
            self._processor = self.newest = self._jpeg = None

    @property
    def age_s(self) -> float | None:
        """Age of the newest frame, or how long one was waited for in vain; None while no page wants any [s]."""
        if self._processor is None:
            return None
        return seconds(self._clock() - self._since_ns) if self.newest is None else self.newest.frame.age_s

    async def jpeg(self, picture: Picture) -> bytes:
        """The picture as a JPEG file; the same work is done once for all pages."""
        if self._jpeg is None or self._jpeg[0] != picture.serial:
            loop = asyncio.get_running_loop()
            self._jpeg = picture.serial, loop.run_in_executor(self._pool, to_jpeg, picture.frame)
            self.encoded += 1
        return await asyncio.shield(self._jpeg[1])

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
            drone.on_annotation(lambda annotation: call_soon(loop, self._draw, annotation)),
            drone.on_event(lambda event: call_soon(loop, self._tell, event)),
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


class Listening:
    """What applications log and what was applied last; heard only while somebody wants it, as it costs the proxy
    something. The values are replaced as a whole, by the receiving thread."""

    #: A number that was logged longer ago is no longer shown.
    KEPT_S = 10.0

    def __init__(self, drone: Drone, clock: Clock = monotonic_ns) -> None:
        self.applied: Applied | None = None
        self._drone = drone
        self._clock = clock
        self._numbers: dict[str, tuple[int, float]] = {}  # when it came, and the value
        self._waypoints: tuple[int, tuple[tuple[float, ...], ...]] | None = None
        self._mocap: tuple[int, tuple[float, ...]] | None = None
        self._listeners: list[_Cancellable] = []

    def want(self, wanted: bool) -> None:
        """Begin to listen, or end it."""
        if wanted and not self._listeners:
            self._listeners = [
                self._drone.on_command(self._command, inline=True),
                self._drone.on_log(self._log, inline=True),
            ]
        elif not wanted:
            for listener in self._listeners:
                listener.cancel()
            self._listeners = []
            self._numbers, self._waypoints, self._mocap, self.applied = {}, None, None, None

    def numbers(self) -> dict[str, float]:
        """The newest value of each series that was logged lately."""
        oldest_ns = self._clock() - round(self.KEPT_S * 1e9)
        return {name: value for name, (at_ns, value) in list(self._numbers.items()) if at_ns >= oldest_ns}

    def waypoints(self) -> tuple[tuple[float, ...], ...]:
        """What was logged lately as an array named ``waypoints``: a row each of x, y, z [m] and perhaps yaw [rad]."""
        told = self._waypoints
        return told[1] if told is not None and seconds(self._clock() - told[0]) <= self.KEPT_S else ()

    def mocap(self) -> tuple[float, ...] | None:
        """Where motion capture sees it now: x, y, z [m], quaternion x, y, z, w; None if it does not."""
        told = self._mocap
        return told[1] if told is not None and seconds(self._clock() - told[0]) <= MOCAP_S else None

    def _command(self, applied: Applied) -> None:
        self.applied = applied

    def _log(self, entry: LogEntry) -> None:
        if entry.number is not None:
            if entry.name in self._numbers or len(self._numbers) < MAX_SERIES:
                self._numbers[entry.name] = self._clock(), entry.number
        elif entry.values is not None and entry.name == SERIES and len(entry.values) >= 7:
            self._mocap = self._clock(), entry.values
        elif (
            entry.values is not None and entry.name == WAYPOINTS and len(entry.shape) == 2 and entry.shape[1] in (3, 4)
        ):
            rows, columns = entry.shape
            values = entry.values
            places = tuple(values[row * columns : (row + 1) * columns] for row in range(rows))
            self._waypoints = self._clock(), places


def to_jpeg(frame: Frame) -> bytes:
    """A frame (BGR) as a JPEG file."""
    import cv2

    done, data = cv2.imencode(".jpg", frame.image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise ValueError(f"frame {frame.seq} of {frame.camera} could not be made a JPEG")
    return bytes(data.data)


def call_soon(loop: asyncio.AbstractEventLoop, function: Callable[..., None], *arguments: Any) -> None:
    """From any thread. A loop that has just been closed has no pages left to tell."""
    if not loop.is_closed():
        loop.call_soon_threadsafe(function, *arguments)
