"""Plays a recording into a sink, by its own stamps."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import monotonic_ns, nanoseconds, seconds
from skyloop.drivers.base import Sink
from skyloop.drivers.live_frames import CheckedRelay, StreamRelay
from skyloop.errors import SkyloopError
from skyloop.messages import EventKind, Feedback, Intrinsics, LinkState, Severity, Value
from skyloop.vehicles.video.sources import DecodedImage, Source

FEEDBACK_NS: Final = 50_000_000
POLL_S: Final = 0.02
BEHIND_NS: Final = 250_000_000  #: further behind than this, a schedule restarts instead of rushing to catch up
GAP_S: Final = 2.0  #: a longer step between two stamps, or one backwards, is a cut in the recording


class FilePacer:
    """Maps a recording's own time stamps to the times at which its pictures are shown.

    Times never go backwards. A stamp that jumps (a cut, a clock that was set) counts as one usual period.

    Args:
        speed: Seconds of the recording in a second.
        period_s: The usual step between two stamps.
    """

    def __init__(self, speed: float, period_s: float) -> None:
        self._speed = speed
        self._period_s = period_s
        self._stamp_s: float | None = None
        self._due_ns = 0

    def due_ns(self, stamp_s: float, now_ns: int) -> int:
        """Return when to show the image of this stamp; ``now_ns`` is when it was ready."""
        if self._stamp_s is None:
            self._due_ns = now_ns
        else:
            step_s = stamp_s - self._stamp_s
            if not 0.0 <= step_s <= GAP_S:
                step_s = self._period_s
            self._due_ns += nanoseconds(step_s / self._speed)
            if now_ns - self._due_ns > BEHIND_NS:
                self._due_ns = now_ns
        self._stamp_s = stamp_s
        return self._due_ns


class CameraPublisher:
    """Publishes images and feedback of one camera to a sink, and waits between them.

    Args:
        sink: The proxy's.
        camera: Its name.
        intrinsics: Returns those for a width and height.
        stop: Set when the driver is closed.
    """

    def __init__(
        self, sink: Sink, camera: str, intrinsics: Callable[[int, int], Intrinsics | None], stop: threading.Event
    ) -> None:
        self.sink = sink
        self.shown = 0
        self.loops = 0
        self.damaged = 0
        self._camera = camera
        self._intrinsics = intrinsics
        self.stop = stop
        self._position_s = 0.0
        self._feedback_ns = 0
        relay = StreamRelay(sink, lambda _camera, width, height: intrinsics(width, height))
        self._relay = CheckedRelay(relay, sink, camera, "recording")

    @property
    def wanted(self) -> bool:
        """Whether somebody wants the decoded images."""
        return self.sink.wants(self._camera)

    @property
    def wanted_encoded(self) -> bool:
        """Whether somebody wants the images as they were encoded."""
        return self._relay.wanted

    def wait_until(self, due_ns: int) -> bool:
        """Wait, and publish feedback meanwhile. Return False if the driver is being closed."""
        while not self.stop.is_set():
            now_ns = monotonic_ns()
            self.publish_state(now_ns)
            if now_ns >= due_ns:
                return True
            self.stop.wait(seconds(min(due_ns, self._feedback_ns) - now_ns))
        return False

    def publish_state(self, now_ns: int, *, at_once: bool = False) -> None:
        """Publish feedback, if it is due: where the recording is, and nothing else, as nothing flies."""
        if now_ns < self._feedback_ns and not at_once:
            return
        self._feedback_ns = now_ns + FEEDBACK_NS
        native: dict[str, Value] = {
            "video.position_s": self._position_s,
            "video.frames": self.shown,
            "video.loops": self.loops,
            "video.damaged": self.damaged,
        }
        self.sink.feedback(Feedback(captured_ns=now_ns, native=native))

    def show(self, image: DecodedImage, due_ns: int) -> bool:
        """Convert an image now and publish it when it is due, as captured then.

        Args:
            image: The image.
            due_ns: When to publish it.

        Returns:
            False if the driver is being closed.
        """
        pixels = _bgr(image) if self.wanted else None
        if not self.wait_until(due_ns):
            return False
        self.shown += 1
        self._position_s = image.stamp_s
        if image.coded is not None:
            self._relay.take(image.coded, image.reason, due_ns, number=image.number, connection=self.loops)
        if pixels is not None:
            height, width = pixels.shape[:2]
            self.sink.frame(
                self._camera,
                pixels,
                due_ns,
                width=width,
                height=height,
                intrinsics=self._intrinsics(width, height),
            )
        return not self.stop.is_set()


class FilePlayer:
    """Plays a recording once, or with ``loop`` again and again.

    Args:
        publisher: Publishes the images.
        open_source: Opens the recording for another pass.
        loop: Whether it starts over at the end.
        speed: Seconds of the recording in a second.
    """

    def __init__(
        self, publisher: CameraPublisher, open_source: Callable[[], Source], *, loop: bool, speed: float
    ) -> None:
        self._publisher = publisher
        self._open = open_source
        self._loop = loop
        self._speed = speed

    def run(self, source: Source, *, wait: bool) -> None:
        """Play until the end, or until the driver is closed, and close the source.

        Args:
            source: The first pass over the recording.
            wait: Whether to wait until somebody wants the images.
        """
        publisher = self._publisher
        publisher.sink.link(LinkState.UP)
        while wait and not (publisher.wanted or publisher.wanted_encoded):
            if not publisher.wait_until(monotonic_ns() + nanoseconds(POLL_S)):
                break
        while True:
            try:
                again = self._pass(source)
            finally:
                source.close()
            if not again:
                return
            publisher.loops += 1
            try:
                source = self._open()
            except SkyloopError as error:
                publisher.sink.link(LinkState.LOST, f"cannot start over: {error}")
                return

    def _pass(self, source: Source) -> bool:
        """Play once through. Return whether to play again."""
        publisher = self._publisher
        pacer = FilePacer(self._speed, 1.0 / source.fps)
        before = publisher.shown
        for image in source.images():
            due_ns = pacer.due_ns(image.stamp_s, monotonic_ns())
            if not publisher.show(image, due_ns):
                return False
        if not publisher.wait_until(monotonic_ns() + nanoseconds(1.0 / source.fps / self._speed)):
            return False
        if source.damaged:
            publisher.damaged += source.damaged
            text = f"{source.damaged} pieces of the recording are damaged and were left out"
            publisher.sink.event(EventKind.VEHICLE_MESSAGE, text, Severity.WARNING, damaged=source.damaged)
        publisher.publish_state(monotonic_ns(), at_once=True)
        if publisher.shown == before:
            publisher.sink.link(LinkState.LOST, "no picture of the recording can be decoded")
            return False
        if not self._loop:
            publisher.sink.link(LinkState.CLOSED, f"end of the recording after {publisher.shown} frames")
        return self._loop


def _bgr(image: DecodedImage) -> NDArray[np.uint8]:
    """Shape (h, w, 3), C-contiguous."""
    return np.ascontiguousarray(np.rot90(image.frame.to_ndarray(format="bgr24"), image.turns), dtype=np.uint8)
