"""Keeps the frames of one camera while a person draws a box, and gives them to who tracks what is in it."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

from skyloop.client.frame import Arrival, compressed
from skyloop.clock import nanoseconds, seconds
from skyloop.errors import RefusedError

if TYPE_CHECKING:
    from skyloop.client import Drone, Frame, Listener, Result
    from skyloop.client.frame import Arrival
    from skyloop.messages import Feedback

KEPT_S: Final = 3.0  #: a picture that is older when its box comes is drawn again
KEPT_BYTES: Final = 64 * 1024 * 1024
#: While a tracker catches up it takes the newest frame that is no further than this from the one before.
STRIDE_S: Final = 0.07

_KEPT_NS: Final = nanoseconds(KEPT_S)
_STRIDE_NS: Final = nanoseconds(STRIDE_S)


class KeptFrames:
    """Frames as JPEGs, ordered by capture, the newest :data:`KEPT_S` or :data:`KEPT_BYTES` of them."""

    def __init__(self, most_bytes: int = KEPT_BYTES) -> None:
        """Keep nothing yet; at most ``most_bytes``."""
        self.bytes = 0  #: of all that are kept
        self._most_bytes = most_bytes
        self._frames: deque[Arrival] = deque()

    def __len__(self) -> int:
        return len(self._frames)

    def add(self, arrival: Arrival) -> None:
        """Add a frame; one captured before the newest (a restarted proxy's) ends what was kept."""
        if self._frames and arrival.header.captured_ns <= self._frames[-1].header.captured_ns:
            self.clear()
        self._frames.append(arrival)
        self.bytes += arrival.header.size
        oldest_ns = arrival.header.captured_ns - _KEPT_NS
        while self._frames[0].header.captured_ns < oldest_ns or (
            self.bytes > self._most_bytes and len(self._frames) > 1
        ):
            self.bytes -= self._frames.popleft().header.size

    def clear(self) -> None:
        """Keep nothing of what came so far."""
        self._frames.clear()
        self.bytes = 0

    def find(self, captured_ns: int) -> Arrival:
        """Return the frame of that capture.

        Args:
            captured_ns: On the proxy's clock.

        Raises:
            RefusedError: It is not kept; the message says why.
        """
        for arrival in self._frames:
            if arrival.header.captured_ns == captured_ns:
                return arrival
        if not self._frames:
            raise RefusedError("there is no frame yet to begin on: draw the box again")
        oldest_ns, newest_ns = (self._frames[place].header.captured_ns for place in (0, -1))
        if oldest_ns < captured_ns < newest_ns:
            raise RefusedError("the frame that the box was drawn on did not arrive here: draw the box again")
        if captured_ns > newest_ns:
            raise RefusedError("the frame that the box was drawn on is newer than any that arrived here: draw it again")
        raise RefusedError(
            f"the picture was {seconds(newest_ns - captured_ns):.1f} s old when its box came, and the last "
            f"{seconds(newest_ns - oldest_ns):.1f} s are kept: draw the box again"
        )

    def next_after(self, captured_ns: int) -> Arrival | None:
        """Return the frame to track in next while catching up; None if there is none newer.

        It is the newest one that is at most :data:`STRIDE_S` after the last, or else the first one after it.

        Args:
            captured_ns: Capture of the last one.
        """
        best = None
        for arrival in self._frames:
            at_ns = arrival.header.captured_ns
            if at_ns <= captured_ns:
                continue
            if best is not None and at_ns > captured_ns + _STRIDE_NS:
                break
            best = arrival
        return best


_DEPTH: Final = 8  # frames that wait while others are made JPEGs: the one that was on the page must not be dropped
_SAMPLES: Final = 1024  # of feedback, for the frames that are kept
_RESULTS: Final = 16  # of processors


class FrameKeeper:
    """Keeps frames of one camera, with feedback and detections, from when it is made until :meth:`close`.

    Args:
        drone: Whose frames; may be an observer's.
        camera: The camera's name.
        first: Called once with the capture of the first frame that is kept [ns], on the listener's thread.
    """

    def __init__(self, drone: Drone, camera: str, first: Callable[[int], None] = lambda _: None) -> None:
        self.camera = camera
        self.keeps = True  #: older frames than the newest, too
        self._first: Callable[[int], None] | None = first
        self._kept = KeptFrames()
        self._newest: Frame | None = None
        self._samples: deque[Feedback] = deque(maxlen=_SAMPLES)
        self._results: deque[Result] = deque(maxlen=_RESULTS)
        self._news = threading.Condition()  # guards all above
        self._closed = False
        self._listeners: list[Listener[Any]] = [
            drone.on_feedback(self._on_feedback, inline=True),
            drone.on_result(self._on_result, inline=True),
            drone.on_frame(self._on_frame, camera=camera, depth=_DEPTH),
        ]

    def find(self, captured_ns: int) -> Arrival:
        """Return the frame of that capture; :class:`RefusedError` if it is not kept."""
        with self._news:
            return self._kept.find(captured_ns)

    def catch_up(self, captured_ns: int) -> Arrival | None:
        """Return the frame to track in next while catching up; None if there is none newer."""
        with self._news:
            return self._kept.next_after(captured_ns)

    def newest(self, captured_ns: int, timeout_s: float) -> Frame | None:
        """Return the newest frame, waiting for one that is not the one of that capture; None if none came in time."""
        with self._news:
            self._kept.clear()
            self._news.wait_for(lambda: self._closed or self._is_news(captured_ns), timeout_s)
            frame, self._newest = self._newest, None  # its memory is the proxy's
            return frame if frame is not None and frame.captured_ns != captured_ns else None

    def feedback(self, until_ns: int | None) -> list[Feedback]:
        """Take the feedback that came since the last call, up to a capture [ns]; None: all."""
        taken = []
        with self._news:
            while self._samples and (until_ns is None or self._samples[0].captured_ns <= until_ns):
                taken.append(self._samples.popleft())
        return taken

    def results(self) -> list[Result]:
        """Take the results of processors that came since the last call."""
        with self._news:
            taken = list(self._results)
            self._results.clear()
            return taken

    def close(self) -> None:
        """Unregister from the drone, without waiting, and wake who waits."""
        for listener in self._listeners:
            listener.cancel(wait=False)
        with self._news:
            self._closed = True
            self._kept.clear()
            self._newest = None
            self._news.notify_all()

    def _is_news(self, captured_ns: int) -> bool:
        return self._newest is not None and self._newest.captured_ns != captured_ns

    def _on_feedback(self, feedback: Feedback) -> None:
        with self._news:
            self._samples.append(feedback)

    def _on_result(self, result: Result) -> None:
        if result.camera == self.camera:
            with self._news:
                self._results.append(result)

    def _on_frame(self, frame: Frame) -> None:
        kept = compressed(frame) if self.keeps else None
        with self._news:
            if self._closed or not self._samples:  # nothing is known of the vehicle at its capture
                return
            if kept is not None and self.keeps:
                self._kept.add(kept)
            self._newest = frame
            self._news.notify_all()
            first, self._first = self._first, None
        if first is not None:
            first(frame.captured_ns)
