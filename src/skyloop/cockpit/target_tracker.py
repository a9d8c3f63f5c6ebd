"""Tracks what is in a box from the frame on that it was drawn on, on threads of its own.

Frames arrive on a listener's thread (:mod:`skyloop.cockpit.frame_keeper`). The follower
(:class:`skyloop.control.target_follower.TargetFollower`) is called on one other thread alone: it catches up frame by
frame first, then takes the newest frame each time, and makes a set-point after each frame and at least every
:data:`PERIOD_S`.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Protocol

import numpy as np

from skyloop.clock import Clock, monotonic_ns, nanoseconds
from skyloop.cockpit.frame_keeper import KEPT_S
from skyloop.control.follow_target import detections_of
from skyloop.errors import DecodeError, MissingExtraError, SkyloopError, UsageError
from skyloop.estimation import assignment
from skyloop.messages import Text
from skyloop.vision import LongTermTracker

if TYPE_CHECKING:
    from skyloop.client import Drone, Frame
    from skyloop.client.frame import Arrival
    from skyloop.cockpit.frame_keeper import FrameKeeper
    from skyloop.control.target_follower import FollowStatus
    from skyloop.messages import AnyAction, Feedback
    from skyloop.messages.relayed import Shape
    from skyloop.vision import Detection

PERIOD_S: Final = 0.05  #: between two set-points without a new frame
SOURCE: Final = "follow"  #: of what is drawn


def warm_up() -> None:
    """Track once, in noise: what that imports takes the interpreter from everybody who flies by this cockpit.

    SciPy, which matches detections, needs it for half a second on an idle computer and for seconds on a busy one. So
    this runs as the cockpit starts, on a thread other than the event loop's, and not when a first target is marked.
    """
    noise = np.random.default_rng(1).integers(0, 255, (96, 96, 3), np.uint8)
    with suppress(MissingExtraError):  # who marks a target is told
        tracker = LongTermTracker()
        tracker.start(noise, (32.0, 32.0, 24.0, 32.0))
        tracker.update(noise)
        assignment("following a target", "vision")


class Follower(Protocol):
    """As much of :class:`skyloop.control.target_follower.TargetFollower` as is used; called from one thread."""

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
    """What became of one step.

    Attributes:
        status: Of the follower; None before its first frame.
        caught_up: It has tracked up to the newest frame.
        action: The set-point for now; None if none is wanted, and while it catches up.
        over: The follower has given up.
        size: Width and height of the frames [px].
        frame_ns: When a frame was tracked last, on this process's clock.
        frame_age_s: Age of that frame when it was tracked [s].
        problem: What went wrong in the follower, which is not called again; empty: nothing.
    """

    status: FollowStatus | None
    caught_up: bool
    action: AnyAction | None
    over: bool
    size: tuple[int, int]
    frame_ns: int
    frame_age_s: float
    problem: str = ""


class TargetTracker:
    """Calls a follower with frames and feedback on a thread of its own, and reports each step.

    Args:
        drone: By which drawings are published; may be an observer's.
        keeper: Keeps the frames; closed with this.
        begin: The frame that the box was drawn on.
        make: Makes the follower; called on the thread.
        report: Called after each step, on the thread.
        clock: This process's monotonic clock [ns].
    """

    def __init__(
        self,
        drone: Drone,
        keeper: FrameKeeper,
        begin: Arrival,
        make: Callable[[], Follower],
        report: Callable[[TrackReport], None],
        clock: Clock = monotonic_ns,
    ) -> None:
        self.steers = False  #: set-points are wanted
        self.mode = ""  #: applied with the next step; empty: as it was made
        self.settings: Any = None  #: the same; None: as it was made
        self._applied: tuple[str, Any] = ("", None)
        self._drone = drone
        self._keeper = keeper
        self._begin: Arrival | None = begin
        self._make = make
        self._report = report
        self._clock = clock
        self._closed = False
        self._seen_ns = 0  # capture of the frame that was tracked last
        self._frame_ns = clock()
        self._frame_age_s = 0.0
        self._size = (begin.header.width, begin.header.height)
        self._thread = threading.Thread(target=self._run, name="skyloop-follow", daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def close(self) -> None:
        """End the thread, without waiting for it."""
        self._closed = True
        self._keeper.close()

    def join(self, timeout_s: float) -> None:
        """Wait until the thread, which was started, has ended."""
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
        except Exception as error:  # noqa: BLE001  (whatever is wrong in it, the vehicle hovers and the page is told)
            self._fail(follower, f"tracking failed: {type(error).__name__}: {error}")
        finally:
            self._keeper.close()

    def _catch_up(self, follower: Follower) -> None:
        """Track in the kept frames, from the one of the box on, for :data:`KEPT_S` at most: then in the newest."""
        until_ns = self._clock() + nanoseconds(KEPT_S)
        arrival: Arrival | None
        arrival, self._begin = self._begin, None
        while arrival is not None and not self._closed and self._clock() < until_ns:
            frame = arrival.frame()
            self._feed(follower, frame.captured_ns)
            self._look(follower, frame)
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
            with suppress(DecodeError, MissingExtraError):  # as if no program had sent any
                if isinstance(value := result.value, dict) and "detections" in value:
                    follower.detected(detections_of(value), result.captured_ns)
        if frame is not None:
            self._look(follower, frame)
        # A law that flies nothing would count on motion that does not come.
        action = follower.step(self._clock() + self._drone.clock_offset_ns) if self.steers else None
        self._report(self._made(follower, action))

    def _feed(self, follower: Follower, until_ns: int | None) -> None:
        for sample in self._keeper.feedback(until_ns):
            follower.feedback(sample)

    def _look(self, follower: Follower, frame: Frame) -> None:
        shapes = follower.look(frame)
        if not self.steers:  # the law's state would be drawn, too
            shapes = [one for one in shapes if not isinstance(one, Text)]
        self._seen_ns = frame.captured_ns
        self._frame_ns = self._clock()
        self._frame_age_s = frame.age_s
        self._size = frame.shape[1], frame.shape[0]
        with suppress(UsageError):  # what can't be drawn is no reason to end a flight
            self._drone.annotate(frame, shapes, source=SOURCE)

    def _made(self, follower: Follower, action: AnyAction | None, *, caught_up: bool = True) -> TrackReport:
        frame = self._size, self._frame_ns, self._frame_age_s
        return TrackReport(follower.status, caught_up, action, follower.over, *frame)

    def _fail(self, follower: Follower | None, problem: str) -> None:
        status: FollowStatus | None = None
        with suppress(Exception):  # it has failed already
            status = None if follower is None else follower.status
        self._report(TrackReport(status, True, None, True, self._size, self._frame_ns, self._frame_age_s, problem))
