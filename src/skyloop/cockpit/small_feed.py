"""The newest frame of one camera, small, for pages that show many cameras at once.

The drone's own thread scales and encodes at most :data:`FPS` frames a second; the event loop takes what is there when
it wants to send something, and is woken by none of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from skyloop.clock import Clock, monotonic_ns, seconds
from skyloop.cockpit.camera_feed import to_jpeg
from skyloop.messages import CameraInfo

if TYPE_CHECKING:
    from skyloop.client import Drone, Frame
    from skyloop.client.channels import Listener

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
