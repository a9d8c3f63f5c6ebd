"""Keep frames while a person draws a box, and track the box's content from that frame on; each uses its own thread.

Frames arrive on a listener's thread. The follower (:class:`skyloop.control.target_follower.TargetFollower`) is called
on one other thread only. It first catches up frame by frame, and then always processes the newest frame. A set-point is
computed after each frame, and at least every :data:`PERIOD_S`.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Protocol

import numpy as np

from skyloop.client.frame import ReceivedFrame, compressed
from skyloop.clock import Clock, monotonic_ns, nanoseconds, seconds
from skyloop.control.target_follower import detections_of
from skyloop.errors import DecodeError, MissingExtraError, RefusedError, SkyloopError, UsageError
from skyloop.estimation import assignment
from skyloop.messages import Text
from skyloop.vision import LongTermTracker

if TYPE_CHECKING:
    from skyloop.client import Drone, Frame, Listener, Result
    from skyloop.control.target_follower import FollowStatus
    from skyloop.messages import AnyAction, Feedback
    from skyloop.messages.relayed import Shape
    from skyloop.vision import Detection

KEPT_S: Final = 3.0  #: a box drawn on a picture older than this is refused and must be drawn again
KEPT_BYTES: Final = 64 * 1024 * 1024  #: maximum total size of the kept frames
#: While catching up, a tracker uses the newest frame that is at most this much later than the previous one.
STRIDE_S: Final = 0.07

_KEPT_NS: Final = nanoseconds(KEPT_S)
_STRIDE_NS: Final = nanoseconds(STRIDE_S)
PERIOD_S: Final = 0.05  #: interval between set-points if there is no new frame
SOURCE: Final = "follow"  #: source name of the drawings


class KeptFrames:
    """Frames as JPEGs, ordered by capture time: only the newest :data:`KEPT_S` or ``most_bytes`` are kept."""

    def __init__(self, most_bytes: int = KEPT_BYTES) -> None:
        self.bytes = 0  #: total size of the kept frames
        self._most_bytes = most_bytes
        self._frames: deque[ReceivedFrame] = deque()

    def __len__(self) -> int:
        return len(self._frames)

    def add(self, arrival: ReceivedFrame) -> None:
        """Add a frame. If it is no newer than the last one (the proxy restarted), discard the frames kept so far."""
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
        self._frames.clear()
        self.bytes = 0

    def find(self, captured_ns: int) -> ReceivedFrame:
        """Return the frame with this capture time; raise ``RefusedError``, which says why, if it was not kept."""
        for arrival in self._frames:
            if arrival.header.captured_ns == captured_ns:
                return arrival
        if not self._frames:
            raise RefusedError("no frame has arrived yet: draw the box again")
        oldest_ns, newest_ns = (self._frames[place].header.captured_ns for place in (0, -1))
        if oldest_ns < captured_ns < newest_ns:
            raise RefusedError("the frame under the box did not arrive here: draw the box again")
        if captured_ns > newest_ns:
            raise RefusedError("the frame under the box is newer than any that arrived here: draw it again")
        raise RefusedError(
            f"the picture was {seconds(newest_ns - captured_ns):.1f} s old when its box arrived, and only the last "
            f"{seconds(newest_ns - oldest_ns):.1f} s are kept: draw the box again"
        )

    def next_after(self, captured_ns: int) -> ReceivedFrame | None:
        """Return the next frame to track while catching up, or None if no frame is newer.

        This is the newest frame within :data:`STRIDE_S` after the last one or, if there is none, the first frame after
        it. ``captured_ns``: capture time of the last tracked frame.
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


_DEPTH: Final = 8  # number of queued frames; large enough that the frame shown on the page is not dropped
_SAMPLES: Final = 1024  # number of feedback samples kept for the frames
_RESULTS: Final = 16  # number of processor results kept


class FrameKeeper:
    """Keeps one camera's frames, together with feedback and detections, until :meth:`close` is called.

    ``drone``: provides the frames; may be connected as an observer. ``first``: called once with the capture time of the
    first stored frame [ns], on the listener's thread.
    """

    def __init__(self, drone: Drone, camera: str, first: Callable[[int], None] = lambda _: None) -> None:
        self.camera = camera
        self.keeps = True  #: whether to keep older frames in addition to the newest
        self._first: Callable[[int], None] | None = first
        self._kept = KeptFrames()
        self._newest: Frame | None = None
        self._samples: deque[Feedback] = deque(maxlen=_SAMPLES)
        self._results: deque[Result] = deque(maxlen=_RESULTS)
        self._news = threading.Condition()  # guards the private fields
        self._closed = False
        self._listeners: list[Listener[Any]] = [
            drone.on_feedback(self._on_feedback, inline=True),
            drone.on_result(self._on_result, inline=True),
            drone.on_frame(self._on_frame, camera=camera, depth=_DEPTH),
        ]

    def find(self, captured_ns: int) -> ReceivedFrame:
        """Return the frame with this capture time; raise :class:`RefusedError` if it was not kept."""
        with self._news:
            return self._kept.find(captured_ns)

    def catch_up(self, captured_ns: int) -> ReceivedFrame | None:
        """Return the next frame to track while catching up, or None if there is no newer frame."""
        with self._news:
            return self._kept.next_after(captured_ns)

    def newest(self, captured_ns: int, timeout_s: float) -> Frame | None:
        """Wait for a frame other than the one with this capture time; return the newest frame, or None on time-out."""
        with self._news:
            self._kept.clear()
            self._news.wait_for(lambda: self._closed or self._is_news(captured_ns), timeout_s)
            frame, self._newest = self._newest, None  # a reference to the frame would occupy the proxy's memory
            return frame if frame is not None and frame.captured_ns != captured_ns else None

    def feedback(self, until_ns: int | None) -> list[Feedback]:
        """Return and remove the feedback up to a capture time [ns], or all feedback if the time is None."""
        taken = []
        with self._news:
            while self._samples and (until_ns is None or self._samples[0].captured_ns <= until_ns):
                taken.append(self._samples.popleft())
        return taken

    def results(self) -> list[Result]:
        """Return and remove the results of processors."""
        with self._news:
            taken = list(self._results)
            self._results.clear()
            return taken

    def close(self) -> None:
        """Unregister from the drone without waiting, and wake waiting threads."""
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
            if self._closed or not self._samples:  # the vehicle's state at the time the frame was captured is unknown
                return
            if kept is not None and self.keeps:
                self._kept.add(kept)
            self._newest = frame
            self._news.notify_all()
            first, self._first = self._first, None
        if first is not None:
            first(frame.captured_ns)


def warm_up() -> None:
    """Run a tracker once on a noise image, so that imports, which hold the GIL, do not stall flights later.

    SciPy, which matches detections, takes half a second to import on an idle computer and several seconds on a busy
    one. This function therefore runs when the cockpit starts, on a thread other than that of the event loop, rather
    than when the first target is marked.
    """
    noise = np.random.default_rng(1).integers(0, 255, (96, 96, 3), np.uint8)
    with suppress(MissingExtraError):  # the error will be reported when a target is marked
        tracker = LongTermTracker()
        tracker.start(noise, (32.0, 32.0, 24.0, 32.0))
        tracker.update(noise)
        assignment("following a target", "vision")


class Follower(Protocol):
    """The part of :class:`skyloop.control.target_follower.TargetFollower` used here; called on one thread."""

    mode: Any
    settings: Any

    def feedback(self, feedback: Feedback) -> None: ...
    def look(self, frame: Frame) -> Sequence[Shape]: ...
    def detected(self, detections: Sequence[Detection], captured_ns: int) -> None: ...
    def step(self, now_ns: int) -> AnyAction: ...
    @property
    def status(self) -> FollowStatus: ...
    @property
    def over(self) -> bool: ...


@dataclass(frozen=True, slots=True)
class TrackReport:
    """The result of one step."""

    status: FollowStatus | None  #: the follower's status; None before its first frame
    caught_up: bool  #: whether the tracker has processed the newest frame
    action: AnyAction | None  #: current set-point; None while catching up or if no set-point is needed
    over: bool  #: whether the follower has given up
    size: tuple[int, int]  #: width and height of the frames [px]
    frame_ns: int  #: time at which the last frame was tracked, on this process's clock
    frame_age_s: float  #: age of the last frame when it was tracked [s]
    problem: str = ""  #: the follower's error, after which the follower is not called again; empty if there is none


class TargetTracker:
    """Calls a follower with frames and feedback on a separate thread and reports each step.

    ``drone``: publishes the drawings; may be connected as an observer. ``keeper``: keeps the frames; closed with this
    object. ``make``: creates the follower; called on the thread. ``report``: called after each step, on the thread.
    """

    def __init__(
        self,
        drone: Drone,
        keeper: FrameKeeper,
        begin: ReceivedFrame,
        make: Callable[[], Follower],
        report: Callable[[TrackReport], None],
        clock: Clock = monotonic_ns,
    ) -> None:
        self.steers = False  #: whether to compute set-points
        self.mode = ""  #: mode to apply in the next step; empty for no change
        self.settings: Any = None  #: settings to apply in the next step; None for no change
        self._applied: tuple[str, Any] = ("", None)
        self._drone = drone
        self._keeper = keeper
        self._begin: ReceivedFrame | None = begin
        self._make = make
        self._report = report
        self._clock = clock
        self._closed = False
        self._seen_ns = 0  # capture time of the last tracked frame
        self._frame_ns = clock()
        self._frame_age_s = 0.0
        self._size = (begin.header.width, begin.header.height)
        self._thread = threading.Thread(target=self._run, name="skyloop-follow", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        """Stop the thread without waiting for it."""
        self._closed = True
        self._keeper.close()

    def join(self, timeout_s: float) -> None:
        self._thread.join(timeout_s)

    # On the thread ---------------------------------------------------------------------------------------------

    def _run(self) -> None:
        follower: Follower | None = None
        try:
            follower = self._make()
            self._catch_up(follower)
            while not self._closed:
                frame = self._keeper.newest(self._seen_ns, PERIOD_S)
                self._step(follower, frame)
                del frame
        except SkyloopError as error:
            self._fail(follower, str(error))
        except Exception as error:  # noqa: BLE001  (on any failure, the vehicle hovers and the page shows why)
            self._fail(follower, f"tracking failed: {type(error).__name__}: {error}")
        finally:
            self._keeper.close()

    def _catch_up(self, follower: Follower) -> None:
        """Track from the box's frame through the kept frames, for at most :data:`KEPT_S`."""
        until_ns = self._clock() + nanoseconds(KEPT_S)
        arrival: ReceivedFrame | None
        arrival, self._begin = self._begin, None
        while arrival is not None and not self._closed and self._clock() < until_ns:
            frame = arrival.frame()
            self._feed(follower, frame.captured_ns)
            self._track(follower, frame)
            self._report(self._made(follower, None, caught_up=False))
            arrival = self._keeper.catch_up(self._seen_ns)
        self._keeper.keeps = False

    def _step(self, follower: Follower, frame: Frame | None) -> None:
        if (wanted := (self.mode, self.settings)) != self._applied:
            self._applied = mode, settings = wanted
            if mode:
                follower.mode = mode
            if settings is not None:
                follower.settings = settings
        self._feed(follower, None)
        for result in self._keeper.results():
            with suppress(DecodeError, MissingExtraError):  # proceed as if no program had sent any detections
                if isinstance(value := result.value, dict) and "detections" in value:
                    follower.detected(detections_of(value), result.captured_ns)
        if frame is not None:
            self._track(follower, frame)
        # A control law that isn't flying the vehicle would expect motion that never happens.
        action = follower.step(self._clock() + self._drone.clock_offset_ns) if self.steers else None
        self._report(self._made(follower, action))

    def _feed(self, follower: Follower, until_ns: int | None) -> None:
        for sample in self._keeper.feedback(until_ns):
            follower.feedback(sample)

    def _track(self, follower: Follower, frame: Frame) -> None:
        shapes = follower.look(frame)
        if not self.steers:  # the drawing would include the state of the control law
            shapes = [one for one in shapes if not isinstance(one, Text)]
        self._seen_ns = frame.captured_ns
        self._frame_ns = self._clock()
        self._frame_age_s = frame.age_s
        self._size = frame.shape[1], frame.shape[0]
        with suppress(UsageError):  # a failed drawing must not end a flight
            self._drone.annotate(frame, shapes, source=SOURCE)

    def _made(self, follower: Follower, action: AnyAction | None, *, caught_up: bool = True) -> TrackReport:
        frame = self._size, self._frame_ns, self._frame_age_s
        return TrackReport(follower.status, caught_up, action, follower.over, *frame)

    def _fail(self, follower: Follower | None, problem: str) -> None:
        status: FollowStatus | None = None
        with suppress(Exception):  # it has already failed
            status = None if follower is None else follower.status
        self._report(TrackReport(status, True, None, True, self._size, self._frame_ns, self._frame_age_s, problem))
