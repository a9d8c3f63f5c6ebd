"""The newest frame of a camera, made a JPEG once for all pages that show it. On the event loop."""

from __future__ import annotations

import asyncio
import os
import struct
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import msgspec

from skyloop.clock import Clock, monotonic_ns, seconds
from skyloop.cockpit.broadcast import Cancellable, Wake, call_soon
from skyloop.messages import CameraInfo

if TYPE_CHECKING:
    from skyloop.client import Drone, Frame
    from skyloop.client.channels import Listener

JPEG_QUALITY = 80

_LENGTH: Final = struct.Struct(">I")
_encode = msgspec.json.Encoder().encode
NICENESS: Final = 10  #: of the thread that encodes


def _give_way() -> None:
    if sys.platform == "linux":  # elsewhere it is the whole process that has a priority
        os.nice(NICENESS)


#: One thread for all cameras: encoding for many pages must not take the cores that fly. The event loop keeps the
#: priority it was started with: a person's sticks and stop pass through it, and must not starve beside a browser.
_ENCODER: Final = ThreadPoolExecutor(1, "jpeg", initializer=_give_way)


@dataclass(frozen=True, slots=True)
class NumberedFrame:
    """One frame on its way to pages; ``serial`` counts the frames of this process, across restarts of the proxy."""

    serial: int
    frame: Frame


class CameraFeed:
    """The newest frame of one camera, encoded at most once for all pages, and only while a page wants it.

    Args:
        drone: The drone.
        camera: The camera's name.
        clock: The monotonic clock [ns].
    """

    def __init__(self, drone: Drone, camera: str, clock: Clock = monotonic_ns) -> None:
        self.camera = camera
        self.newest: NumberedFrame | None = None
        self.encoded = 0  #: frames that were made a JPEG
        self._drone = drone
        self._clock = clock
        self._since_ns = 0  # since when a page wants frames
        self._listener: Cancellable | None = None
        self._wakes: set[Wake] = set()
        self._serial = 0
        self._jpeg: tuple[int, asyncio.Future[bytes]] | None = None

    @property
    def wanted(self) -> bool:
        """Whether a page watches it."""
        return bool(self._wakes)

    def subscribe(self, wake: Wake) -> None:
        """Call ``wake`` on the loop for each newer frame; the first subscriber subscribes to the camera."""
        self._wakes.add(wake)
        if self._listener is None:
            loop = asyncio.get_running_loop()
            self._since_ns = self._clock()
            self._listener = self._drone.on_frame(lambda frame: call_soon(loop, self._put, frame), camera=self.camera)
        elif self.newest is not None:
            wake()

    def unsubscribe(self, wake: Wake) -> None:
        """Call ``wake`` no longer; after the last one the camera is no longer subscribed to."""
        self._wakes.discard(wake)
        if not self._wakes and self._listener is not None:
            self._listener.cancel()
            self._listener = self.newest = self._jpeg = None

    @property
    def age_s(self) -> float | None:
        """Age of the newest frame [s], or how long one was waited for in vain.

        None while no page wants any, and before the first that ever came: a vehicle may take seconds to send it.
        """
        if self._listener is None or not self._serial:
            return None
        return seconds(self._clock() - self._since_ns) if self.newest is None else self.newest.frame.age_s

    async def jpeg(self, picture: NumberedFrame) -> bytes:
        """Return the picture as a JPEG file; it is encoded once for all pages, on a thread."""
        if self._jpeg is None or self._jpeg[0] != picture.serial:
            loop = asyncio.get_running_loop()
            self._jpeg = picture.serial, loop.run_in_executor(_ENCODER, to_jpeg, picture.frame)
            self.encoded += 1
        return await asyncio.shield(self._jpeg[1])

    def close(self) -> None:
        """Unsubscribe from the camera."""
        if self._listener is not None:
            self._listener.cancel()
            self._listener = None

    def _put(self, frame: Frame) -> None:
        if self._listener is None:  # cancelled while this was on its way
            return
        self._serial += 1
        self.newest = NumberedFrame(self._serial, frame)
        for wake in self._wakes:
            wake()


def to_jpeg(frame: Frame, quality: int = JPEG_QUALITY) -> bytes:
    """Encode a frame (BGR) as a JPEG file.

    Args:
        frame: The frame.
        quality: 1 to 100.

    Raises:
        ValueError: OpenCV could not.
    """
    import cv2

    done, data = cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, quality])
    if not done:
        raise ValueError(f"frame {frame.seq} of {frame.camera} could not be made a JPEG")
    return bytes(data.data)


def pack(head: dict[str, Any], *jpegs: bytes) -> bytes:
    """Return a binary message: length of the head (4 bytes, big-endian), the head as JSON, the JPEG files."""
    text = _encode(head)
    return b"".join((_LENGTH.pack(len(text)), text, *jpegs))


FPS: Final = 12.0  #: frames of each camera in a second, at most
WIDTHS: Final = (160, 240, 320, 480)  #: of frames [pixels]; what a page wishes is rounded up to one of them
QUALITY: Final = 70  #: of the JPEG files


@dataclass(frozen=True, slots=True)
class SmallFrame:
    """A frame as a JPEG file; ``serial`` counts those of one feed."""

    serial: int
    jpeg: bytes
    seq: int
    captured_ns: int  #: on the proxy's clock
    width: int
    height: int


class SmallFeed:
    """The newest frame of one camera in one size, as a JPEG file, while a page shows it. Used on the event loop.

    Args:
        drone: The drone.
        camera: The camera.
        width: The width to scale down to [pixels]; a smaller frame stays as it is.
        clock: The monotonic clock [ns].
    """

    def __init__(self, drone: Drone, camera: CameraInfo, width: int, clock: Clock = monotonic_ns) -> None:
        self.camera = camera.name
        self.newest: SmallFrame | None = None  #: replaced as a whole, by the drone's receiving thread
        self.encoded = 0  #: frames that were made a JPEG
        self._drone = drone
        self._scale = min(1.0, width / camera.width) if camera.width > 0 else 1.0
        self._clock = clock
        self._since_ns = 0
        self._pages = 0
        self._listener: Listener[Any] | None = None

    @property
    def wanted(self) -> bool:
        """Whether a page shows it."""
        return self._pages > 0

    @property
    def age_s(self) -> float | None:
        """Age of the newest frame [s], or how long one was waited for in vain.

        None while no page shows it, and before the first that ever came: a vehicle may take seconds to send it.
        """
        if not self.wanted or not self.encoded:
            return None
        newest, now_ns = self.newest, self._clock()
        if newest is None:
            return seconds(now_ns - self._since_ns)
        return seconds(now_ns + self._drone.clock_offset_ns - newest.captured_ns)

    def subscribe(self) -> None:
        """Show it on one more page; the first subscribes to the camera.

        Raises:
            SkyloopError: The drone was closed, or has no such camera any more.
        """
        if self._listener is None:
            self._since_ns = self._clock()
            # Inline: a thread of its own for each camera would be woken for each frame, and do no more than this.
            self._listener = self._drone.on_frame(
                self._put, camera=self.camera, inline=True, encoding="jpeg", max_fps=FPS, scale=self._scale
            )
        self._pages += 1

    def unsubscribe(self) -> None:
        """Show it on one page less; after the last the camera is no longer subscribed to."""
        self._pages -= 1
        if self._pages == 0:
            self.close()

    def close(self) -> None:
        """Unsubscribe from the camera. Idempotent."""
        if self._listener is not None:
            self._listener.cancel()
            self._listener = self.newest = None

    def _put(self, frame: Frame) -> None:
        """Encode a frame and keep it, on the drone's receiving thread."""
        jpeg = to_jpeg(frame, QUALITY)
        self.encoded += 1
        height, width = frame.shape[:2]
        self.newest = SmallFrame(self.encoded, jpeg, frame.seq, frame.captured_ns, width, height)


def rounded_width(wish: int) -> int:
    """Return the smallest of :data:`WIDTHS` that is not below ``wish`` [pixels]; the largest if all are."""
    return next((width for width in WIDTHS if width >= wish), WIDTHS[-1])
