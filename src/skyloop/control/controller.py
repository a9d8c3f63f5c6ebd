"""The base class of controllers, and the loop that runs one."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from skyloop.clock import NS_PER_S, nanoseconds
from skyloop.errors import AuthorityError, SkyloopError, UsageError
from skyloop.messages import LinkState

if TYPE_CHECKING:
    from skyloop.client import AuthorityStatus, Drone, Frame
    from skyloop.client.inbox import Inbox
    from skyloop.client.results import Result
    from skyloop.messages import Feedback

Reason = Literal["time", "until", "stopped", "closed"]
_LOOK_S = 0.1  #: how often ``until`` is asked while nothing comes


@dataclass(frozen=True, slots=True)
class RunSummary:
    """How a run went."""

    frames: int  #: calls of ``on_frame``
    feedback: int  #: calls of ``on_feedback``
    frames_dropped: int  #: frames that newer ones replaced while a callback was running
    feedback_dropped: int
    overruns: int  #: callbacks that took so long that something was dropped meanwhile
    seconds: float
    reason: Reason  #: why it ended
    results: int = 0  #: calls of ``on_result``
    results_dropped: int = 0  #: results that newer ones replaced
    results_expired: int = 0  #: results that were older than ``result_max_age_s`` when their turn came

    def __str__(self) -> str:
        return (
            f"{self.seconds:.1f} s until {self.reason}: {self.frames} frames ({self.frames_dropped} dropped), "
            f"{self.feedback} feedback samples ({self.feedback_dropped} dropped), "
            f"{self._results()}{self.overruns} overruns"
        )

    def _results(self) -> str:
        if not (self.results or self.results_dropped or self.results_expired):
            return ""
        return f"{self.results} results ({self.results_dropped} dropped, {self.results_expired} too old), "


class Controller:
    """Write ``on_feedback``, ``on_frame`` or ``on_result``, or several, and call :meth:`run`.

    Each is called with the newest sample, one call at a time, on the thread that called :meth:`run`; what comes while
    a call is running is replaced by what is newer. ``camera`` names whose frames come; None: the vehicle's first.
    ``processors`` names whose results come, None: everybody's; older ones than ``result_max_age_s`` are left out.
    """

    camera: str | None = None
    processors: tuple[str, ...] | None = None
    result_max_age_s: float | None = 1.0

    def __init__(self, drone: Drone) -> None:
        self.drone = drone
        self._stopped = threading.Event()
        self._inbox: Inbox | None = None

    # To be written by the user ---------------------------------------------------------------------------------

    def on_feedback(self, feedback: Feedback) -> None:
        """Called with the newest feedback."""

    def on_frame(self, frame: Frame) -> None:
        """Called with the newest frame: BGR, shape (height, width, 3), uint8, read-only."""

    def on_result(self, result: Result) -> None:
        """Called with the newest result of each processor; ``result.age_s`` is the time since its frame's capture."""

    def on_authority(self, status: AuthorityStatus) -> None:
        """Called once when a command failed because somebody else took over, and once when it is given back."""

    def on_reload(self, before: Controller) -> None:
        """Called once before the first sample, when this one takes the place of ``before`` in flight because its file
        was saved (``skyloop fly --reload``): take over here what the older one knows, ``self.target = before.target``.
        """

    # To be called ----------------------------------------------------------------------------------------------

    def stop(self) -> None:
        """End :meth:`run` after the call that is under way. Any thread."""
        self._stopped.set()
        inbox = self._inbox
        if inbox is not None:
            inbox.bell.ring()

    def run(self, seconds: float | None = None, until: Callable[[], bool] | None = None) -> RunSummary:
        """Call the callbacks for ``seconds``, or until ``until()`` is true, :meth:`stop` or the drone's end.

        An exception in a callback makes an airborne vehicle hover and comes out here. Only an
        :class:`AuthorityError` because somebody else took over does not: :meth:`on_authority` is told, and it goes on.
        """
        if seconds is not None and not seconds >= 0.0:
            raise UsageError(f"seconds is {seconds!r} and must be 0 or more")
        own = type(self)
        wants_frames = own.on_frame is not Controller.on_frame
        wants_results = own.on_result is not Controller.on_result
        wants_feedback = own.on_feedback is not Controller.on_feedback or not (wants_frames or wants_results)
        inbox = self.drone.inbox(
            feedback=wants_feedback,
            frames=wants_frames,
            camera=self.camera,
            results=wants_results,
            processors=self.processors,
            max_age_s=self.result_max_age_s,
        )
        self._stopped.clear()
        try:
            with inbox:
                self._inbox = inbox
                return _Run(self, inbox, self._stopped).go(seconds, until)
        finally:
            self._inbox = None


class _Run:
    """One run of a controller."""

    def __init__(self, controller: Controller, inbox: Inbox, stopped: threading.Event) -> None:
        self._controller = controller
        self._drone = controller.drone
        self._inbox = inbox
        self._stopped = stopped
        self._frames = 0
        self._feedback = 0
        self._results = 0
        self._overruns = 0
        self._lost = False  # somebody took over, and the controller was told

    def go(self, seconds: float | None, until: Callable[[], bool] | None) -> RunSummary:
        started_ns = self._inbox.clock()
        deadline_ns = None if seconds is None else started_ns + nanoseconds(seconds)
        while True:
            reason = self._over(deadline_ns, until)
            if reason is not None:
                break
            left_s = _LOOK_S
            if deadline_ns is not None:
                left_s = min(left_s, (deadline_ns - self._inbox.clock()) / NS_PER_S)
            self._inbox.bell.wait_for(lambda: self._inbox.waiting or self._stopped.is_set(), max(0.0, left_s))
            self._serve()
        return RunSummary(
            self._frames,
            self._feedback,
            self._inbox.frames_dropped,
            self._inbox.feedback_dropped,
            self._overruns,
            (self._inbox.clock() - started_ns) / NS_PER_S,
            reason,
            self._results,
            self._inbox.results_dropped,
            self._inbox.results_expired,
        )

    def _over(self, deadline_ns: int | None, until: Callable[[], bool] | None) -> Reason | None:
        if self._stopped.is_set():
            return "stopped"
        if self._drone.closed or self._ended():
            return "closed"
        if deadline_ns is not None and self._inbox.clock() >= deadline_ns:
            return "time"
        return "until" if until is not None and until() else None

    def _ended(self) -> bool:
        """Whether the vehicle ended on purpose, as a recording does, and all that came before that was served."""
        return self._drone.link.vehicle is LinkState.CLOSED and not self._inbox.waiting

    def _serve(self) -> None:
        """One call for each kind of sample that came; feedback first, so that frames meet the newer state."""
        feedback = self._inbox.feedback()
        if feedback is not None:
            self._feedback += 1
            self._call(self._controller.on_feedback, feedback)
        frame = None if self._stopped.is_set() else self._inbox.frame()
        if frame is not None:
            self._frames += 1
            self._call(self._controller.on_frame, frame)
        result = None if self._stopped.is_set() else self._inbox.result()
        if result is not None:
            self._results += 1
            self._call(self._controller.on_result, result)

    def _call(self, callback: Callable[[Any], None], sample: Any) -> None:
        dropped = self._dropped()
        try:
            if self._lost and self._drone.authority.state == "held":
                self._lost = False
                self._controller.on_authority(self._drone.authority)
            self._guarded(callback, sample)
        except BaseException:
            self._hover()
            raise
        if self._dropped() > dropped:
            self._overruns += 1

    def _dropped(self) -> int:
        return self._inbox.frames_dropped + self._inbox.feedback_dropped + self._inbox.results_dropped

    def _guarded(self, callback: Callable[[Any], None], sample: Any) -> None:
        try:
            callback(sample)
        except AuthorityError:
            status = self._drone.authority
            if status.state == "none":
                raise  # nobody took over: it was never asked for, or given back by this application
            if not self._lost and status.state != "held":
                self._lost = True
                self._controller.on_authority(status)

    def _hover(self) -> None:
        """Leave the vehicle in a safe state if it is in our hands and in the air."""
        with contextlib.suppress(SkyloopError):
            if self._drone.authority.state == "held" and self._drone.feedback().state.airborne:
                self._drone.hover()
