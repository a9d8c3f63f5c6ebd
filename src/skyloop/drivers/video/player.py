"""Plays a source into a sink: recordings by their own stamps, devices as fast as they come."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import monotonic_ns, nanoseconds, seconds
from skyloop.drivers.base import Sink
from skyloop.drivers.video.pacing import FilePacer, LiveClock
from skyloop.drivers.video.sources import Picture, Source
from skyloop.errors import SkyloopError
from skyloop.messages import EventKind, Feedback, Intrinsics, LinkState, Severity, Value
from skyloop.wire.ardrone.pave import PaveFrame

FEEDBACK_NS: Final = 50_000_000
POLL_S: Final = 0.02
RETRY_S: Final = 1.0
LATE_NS: Final = 100_000_000  #: a live picture older than this is passed over for a newer one


class Screen:
    """Puts pictures and feedback of one camera into a sink, and waits between them."""

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
        self._streaming = False  # pictures are handed on as they came

    @property
    def wanted(self) -> bool:
        return self.sink.wants(self._camera)

    @property
    def recorded(self) -> bool:
        """Whether somebody wants the pictures as they come."""
        return self.sink.wants_stream(self._camera)

    def wait_until(self, due_ns: int) -> bool:
        """Wait, with feedback meanwhile. False if the driver is being closed."""
        while not self.stop.is_set():
            now_ns = monotonic_ns()
            self.tell_state(now_ns)
            if now_ns >= due_ns:
                return True
            self.stop.wait(seconds(min(due_ns, self._feedback_ns) - now_ns))
        return False

    def tell_state(self, now_ns: int, *, at_once: bool = False) -> None:
        """Feedback, if it is time for it. A thing that can't fly knows nothing but its place in the recording."""
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

    def show(self, picture: Picture, due_ns: int | None, captured_ns: int) -> bool:
        """Convert now, hand over when it is due. False if the driver is being closed."""
        pixels = _bgr(picture) if self.wanted else None
        if due_ns is not None and not self.wait_until(due_ns):
            return False
        self.shown += 1
        self._position_s = picture.stamp_s
        if picture.coded is not None:
            self._hand_on(picture.coded, captured_ns)
        if pixels is not None:
            height, width = pixels.shape[:2]
            self.sink.frame(
                self._camera,
                pixels,
                captured_ns,
                width=width,
                height=height,
                intrinsics=self._intrinsics(width, height),
            )
        return not self.stop.is_set()

    def _hand_on(self, coded: PaveFrame, captured_ns: int) -> None:
        """As it came. Each that was decoded builds on the one decoded before it, or is a key."""
        self._streaming = self.recorded and (self._streaming or coded.is_key)
        if self._streaming:
            self.sink.stream(
                self._camera,
                coded.payload,
                captured_ns,
                width=coded.width,
                height=coded.height,
                key=coded.is_key,
                intrinsics=self._intrinsics(coded.width, coded.height),
            )


class FilePlayer:
    """Plays a recording once, or with ``loop`` again and again."""

    def __init__(self, screen: Screen, open_source: Callable[[], Source], *, loop: bool, speed: float) -> None:
        self._screen = screen
        self._open = open_source
        self._loop = loop
        self._speed = speed

    def run(self, source: Source, *, wait: bool) -> None:
        """Until the end or until the driver is closed. ``wait``: start when somebody looks. Closes the source."""
        screen = self._screen
        screen.sink.link(LinkState.UP)
        while wait and not (screen.wanted or screen.recorded):
            if not screen.wait_until(monotonic_ns() + nanoseconds(POLL_S)):
                break
        while True:
            try:
                again = self._pass(source)
            finally:
                source.close()
            if not again:
                return
            screen.loops += 1
            try:
                source = self._open()
            except SkyloopError as error:
                screen.sink.link(LinkState.LOST, f"cannot start over: {error}")
                return

    def _pass(self, source: Source) -> bool:
        """One time through. False if there shall be no other."""
        screen = self._screen
        pacer = FilePacer(self._speed, 1.0 / source.fps)
        before = screen.shown
        for picture in source.pictures():
            due_ns = pacer.due_ns(picture.stamp_s, monotonic_ns())
            if not screen.show(picture, due_ns, due_ns):
                return False
        if not screen.wait_until(monotonic_ns() + nanoseconds(1.0 / source.fps / self._speed)):
            return False
        if source.damaged:
            screen.damaged += source.damaged
            text = f"{source.damaged} pieces of the recording are damaged and were left out"
            screen.sink.event(EventKind.VEHICLE_MESSAGE, text, Severity.WARNING, damaged=source.damaged)
        screen.tell_state(monotonic_ns(), at_once=True)
        if screen.shown == before:
            screen.sink.link(LinkState.LOST, "no picture of the recording can be decoded")
            return False
        if not self._loop:
            screen.sink.link(LinkState.CLOSED, f"end of the recording after {screen.shown} pictures")
        return self._loop


class LivePlayer:
    """Shows a device's newest picture, and tries for ever to open a device that is not there."""

    def __init__(self, screen: Screen, open_source: Callable[[], Source], retry_s: float = RETRY_S) -> None:
        self._screen = screen
        self._open = open_source
        self._retry_s = retry_s

    def run(self) -> None:
        """Until the driver is closed."""
        screen = self._screen
        told = ""
        while not screen.stop.is_set():
            try:
                source = self._open()
            except SkyloopError as error:
                reason = str(error)
            else:
                told = ""
                try:
                    if not screen.stop.is_set():  # opening may take longer than the driver was open
                        screen.sink.link(LinkState.UP)
                        self._play(source)
                    reason = "the device ended its stream"
                except SkyloopError as error:
                    reason = str(error)
                finally:
                    source.close()
            if screen.stop.is_set():
                return
            if reason != told:
                screen.sink.link(LinkState.LOST, reason)
                told = reason
            screen.stop.wait(self._retry_s)

    def _play(self, source: Source) -> None:
        clock = LiveClock()

        def late(stamp_s: float) -> bool:
            now_ns = monotonic_ns()
            return now_ns - clock.captured_ns(stamp_s, now_ns) > LATE_NS

        for picture in source.pictures(late):
            now_ns = monotonic_ns()
            self._screen.tell_state(now_ns)
            if not self._screen.show(picture, None, clock.captured_ns(picture.stamp_s, now_ns)):
                return


def _bgr(picture: Picture) -> NDArray[np.uint8]:
    """Shape (h, w, 3), C-contiguous."""
    return np.ascontiguousarray(picture.image.to_ndarray(format="bgr24"), dtype=np.uint8)
