"""One form of a camera's H.264, for all pages that show it in this form: relayed as it comes, encoded nowhere here.

The drone's own thread keeps the newest pictures; pages take theirs on the event loop. A picture builds on the one
before, so a page gets all of them in order, or goes on with a key picture.
"""

from __future__ import annotations

import asyncio
import threading
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from skyloop.client.monitoring import ChannelCounter, ChannelStats
from skyloop.clock import Clock, monotonic_ns, seconds
from skyloop.cockpit.broadcast import Wake, call_soon
from skyloop.extend import stream_channel
from skyloop.messages import CameraInfo, EncodedFrame

if TYPE_CHECKING:
    from skyloop.client import Drone
    from skyloop.client.video import StreamChannel

KEPT: Final = 16  #: newest pictures of a form; who is further behind goes on with a key picture
SCALES: Final = (0.25, 0.375, 0.5, 0.75, 1.0)  #: of pictures in panes, so that like panes share a form
RATES: Final = (60, 100, 150, 220, 330, 500, 750, 1100, 1700, 2500, 3700, 5500, 8000)  #: [kbit/s], for the same reason
BITS: Final = 0.12  #: for a pixel of a picture that moves
_FPS: Final = 30.0  # of a camera that doesn't say


@dataclass(frozen=True, slots=True)
class Form:
    """How a camera's pictures are encoded. Neither rate nor subscriber: as the vehicle itself does it.

    ``kbit_s``: at this rate, once for all who want the same. ``subscriber``: for this one alone, at the rate and size
    that the path to it carries.
    """

    kbit_s: int | None = None
    scale: float = 1.0
    max_fps: float | None = None
    subscriber: str = ""

    @property
    def kind(self) -> str:
        """Whose it is: ``vehicle``, ``shared`` or ``own``."""
        if self.subscriber:
            return "own"
        return "vehicle" if self.kbit_s is None else "shared"


def form_for(camera: CameraInfo, width: int, max_fps: float | None = None) -> Form:
    """Choose the form that all panes of about the same size share.

    Args:
        camera: The camera.
        width: Of the pane [device pixels]; 0: the picture's full size.
        max_fps: Most pictures a second; None: all.
    """
    scale = 1.0
    if 0 < width < camera.width:
        scale = next(step for step in SCALES if step * camera.width >= width)
    if camera.stream == "h264" and scale == 1.0 and max_fps is None:
        return Form()
    fps = camera.fps if camera.fps > 0.0 else _FPS
    fps = fps if max_fps is None else min(fps, max_fps)
    good_kbit_s = camera.width * camera.height * scale**2 * fps * BITS / 1000
    return Form(next((rate for rate in RATES if rate >= good_kbit_s), RATES[-1]), scale, max_fps)


@dataclass(frozen=True, slots=True)
class NumberedPicture:
    """A picture on its way to pages; ``serial`` grows by one where it follows the one before, across restarts of it."""

    serial: int
    picture: EncodedFrame


class EncodedFeed:
    """The newest pictures of one form, while a page wants them. Made and used on the event loop.

    Args:
        drone: The drone.
        camera: The camera's name.
        form: How it is encoded.
        clock: The monotonic clock [ns].
    """

    encoded = 0  #: frames that were encoded here: none

    def __init__(self, drone: Drone, camera: str, form: Form, clock: Clock = monotonic_ns) -> None:
        self.camera = camera
        self.form = form
        self._counter = ChannelCounter()
        self._drone = drone
        self._clock = clock
        self._came_ns = 0  # when the newest picture came
        self._channel: StreamChannel | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._serial = 0
        self._lock = threading.Lock()  # guards the following
        self._wakes: dict[object, Wake | None] = {}  # by page
        self._pictures: deque[NumberedPicture] = deque(maxlen=KEPT)

    @property
    def wanted(self) -> bool:
        """Whether a page shows it."""
        return bool(self._wakes)

    @property
    def age_s(self) -> float | None:
        """Age of the newest picture [s].

        None while no page shows it, before the first, and where it waits for the one page that it is for: that tells
        nothing about the camera.
        """
        with self._lock:
            newest = self._pictures[-1] if self._pictures else None
        if newest is None or not self.wanted or self.form.subscriber:
            return None
        return seconds(self._clock() + self._drone.clock_offset_ns - newest.picture.captured_ns)

    @property
    def silent_s(self) -> float:
        """For how long no picture has come [s]; 0 where that may be as the one page that it is for takes none."""
        with self._lock:
            silent = self.wanted and not (self._pictures and self.form.subscriber)
            return seconds(self._clock() - self._came_ns) if silent else 0.0

    def stats(self) -> ChannelStats:
        """Return how its pictures come, as for a channel of the drone."""
        return self._counter.stats(self._clock())

    def subscribe(self, page: object, wake: Wake | None) -> None:
        """Show it on one more page; the first subscribes to the stream, whose first picture is a key.

        Args:
            page: Which one.
            wake: Called on the event loop for each picture; None: the page looks by itself.

        Raises:
            SkyloopError: The drone was closed, or has no such camera any more.
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
            channel.add(self._put, _none_dropped)
            self._channel = channel
        with self._lock:
            self._wakes[page] = wake

    def unsubscribe(self, page: object) -> None:
        """Show it on one page less; after the last one the stream is no longer subscribed to."""
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

    def after(self, serial: int, *, follows: bool) -> tuple[list[NumberedPicture], int]:
        """Return the pictures that a page is to get next, in order, and how many it misses before them.

        Args:
            serial: The picture that it was sent last; 0: none yet.
            follows: Whether it can decode the one after that; else it goes on with a key picture.
        """
        with self._lock:
            newer = [one for one in self._pictures if one.serial > serial]
        for first in range(len(newer) - 1, 0, -1):
            if newer[first].picture.key:  # nothing before it is of use any more
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
        """Ask the proxy for a key picture; at most some times a second."""
        if self._channel is not None:
            self._channel.report(0, wants_key=True)

    def acknowledge(self, seq: int) -> None:
        """Tell the proxy what the page has, where the rate follows that."""
        if self._channel is not None and self.form.subscriber:
            self._channel.report(seq)

    def _put(self, picture: EncodedFrame) -> None:
        """Keep a picture, on the drone's receiving thread."""
        with self._lock:
            last = self._pictures[-1].picture.seq if self._pictures else 0
            self._serial += 1 if picture.seq == last + 1 else 2
            self._pictures.append(NumberedPicture(self._serial, picture))
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


def _none_dropped() -> int:
    return 0
