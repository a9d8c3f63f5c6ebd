"""The base class of controllers, and the loop that calls its callbacks."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from skyloop.clock import NS_PER_S, nanoseconds
from skyloop.errors import AuthorityError, ClosedError, UsageError
from skyloop.messages import Failsafe, LinkState

if TYPE_CHECKING:
    from skyloop.client import AuthorityStatus, Drone, Frame
    from skyloop.client.results import Result
    from skyloop.client.telemetry import Mailboxes
    from skyloop.messages import Feedback

Reason = Literal["time", "until", "stopped", "closed"]
_LOOK_S = 0.1  #: how often ``until`` is evaluated while no sample arrives


@dataclass(frozen=True, slots=True)
class RunSummary:
    """What :meth:`Controller.run` counted, and why it ended."""

    frames: int  #: calls of ``on_frame``
    feedback: int  #: calls of ``on_feedback``
    frames_dropped: int  #: frames that newer ones replaced while a callback was running
    feedback_dropped: int
    overruns: int  #: callbacks during which at least one sample was dropped
    seconds: float
    reason: Reason  #: why the run ended
    results: int = 0  #: calls of ``on_result``
    results_dropped: int = 0  #: results that newer ones replaced
    results_expired: int = 0  #: results that were older than ``result_max_age_s`` when they were taken from the queue

    def __str__(self) -> str:
        return (
            f"{self.seconds:.1f} s until {self.reason}: {self.frames} frames ({self.frames_dropped} dropped), "
            f"{self.feedback} feedback samples ({self.feedback_dropped} dropped), "
            f"{self._results()}{self.overruns} overrun{'' if self.overruns == 1 else 's'}"
        )

    def _results(self) -> str:
        if not (self.results or self.results_dropped or self.results_expired):
            return ""
        return f"{self.results} results ({self.results_dropped} dropped, {self.results_expired} too old), "


class Controller:
    """The base class of an application's control loop.

    Override one or several of :meth:`on_feedback`, :meth:`on_frame` and :meth:`on_result`, then call :meth:`run`. Each
    callback gets the newest sample, one call at a time, on the thread that called :meth:`run`; samples that arrive
    while a callback runs replace the older ones that are waiting.

    Attributes:
        camera: Whose frames :meth:`on_frame` gets; None is the vehicle's first camera.
        processors: Whose results :meth:`on_result` gets; None is all processors.
        result_max_age_s: Results older than this are left out; None leaves out none.
        drone: The drone that is flown.
    """

    camera: str | None = None
    processors: tuple[str, ...] | None = None
    result_max_age_s: float | None = 1.0

    def __init__(self, drone: Drone) -> None:
        """Store the drone; no callback is called before :meth:`run`."""
        self.drone = drone
        self._stopped = threading.Event()
        self._ended = False  # for good
        self._inbox: Mailboxes | None = None

    # To be overridden ------------------------------------------------------------------------------------------

    def on_feedback(self, feedback: Feedback) -> None:
        """Handle the newest feedback."""

    def on_frame(self, frame: Frame) -> None:
        """Handle the newest frame.

        Args:
            frame: BGR image, shape (height, width, 3), uint8, read-only.
        """

    def on_result(self, result: Result) -> None:
        """Handle the newest result of a processor.

        Args:
            result: ``result.age_s`` is the time since the capture of the frame that it was computed from.
        """

    def on_authority(self, status: AuthorityStatus) -> None:
        """Handle the loss or the return of authority.

        Called once when a command fails because another client took over, and once, before the next callback, when
        authority is held again.
        """

    def on_reload(self, before: Controller) -> None:
        """Take over the state of the controller that this one replaces in flight.

        Called once before the first sample, when ``skyloop fly --reload`` loads a saved file again. Copy here what the
        older controller knows, for example ``self.target = before.target``.

        Args:
            before: The controller that ran until now.
        """

    # To be called ----------------------------------------------------------------------------------------------

    def stop(self) -> None:
        """End :meth:`run` after the callback that is running. May be called from any thread."""
        self._stopped.set()
        inbox = self._inbox
        if inbox is not None:
            inbox.notifier.notify()

    def _is_overruled(self, feedback: Feedback) -> bool:
        """Whether set-points have no effect: another client, another controller or a failsafe has the vehicle."""
        return self.drone.authority.state != "held" or bool(feedback.others) or feedback.failsafe is not Failsafe.NONE

    def _end(self) -> None:
        """Stop for good: a later :meth:`run` returns at once."""
        self._ended = True
        self.stop()

    def run(self, seconds: float | None = None, until: Callable[[], bool] | None = None) -> RunSummary:
        """Call the callbacks until the time is over, ``until()`` is true, :meth:`stop` is called or the drone closes.

        An exception in a callback, Ctrl-C and ``sys.exit()`` make an airborne vehicle hover, if this client flies it,
        and are raised from here. An :class:`AuthorityError` because another client took over does not end the run:
        :meth:`on_authority` is called instead. A ready-made controller that has reached its end flies no second time:
        its next run returns at once.

        Args:
            seconds: How long to run, 0 or more; None sets no limit.
            until: Evaluated before each round of callbacks, and every 0.1 s while no sample arrives.

        Returns:
            What was called and dropped, and why the run ended.

        Raises:
            UsageError: ``seconds`` is negative or NaN.
        """
        if seconds is not None and not seconds >= 0.0:
            raise UsageError(f"seconds is {seconds!r} and must be 0 or more")
        own = type(self)
        wants_frames = own.on_frame is not Controller.on_frame
        wants_results = own.on_result is not Controller.on_result
        wants_feedback = own.on_feedback is not Controller.on_feedback or not (wants_frames or wants_results)
        inbox = self.drone._core.inbox(
            feedback=wants_feedback,
            frames=wants_frames,
            camera=self.camera,
            results=wants_results,
            processors=self.processors,
            max_age_s=self.result_max_age_s,
        )
        if not self._ended:
            self._stopped.clear()
        try:
            with inbox:
                self._inbox = inbox
                return _Run(self, inbox, self._stopped).go(seconds, until)
        except BaseException as error:
            self.drone._core.let_go(f"{type(self).__name__} ended by {type(error).__name__}")
            raise
        finally:
            self._inbox = None


class _Run:
    """One run of a controller."""

    def __init__(self, controller: Controller, inbox: Mailboxes, stopped: threading.Event) -> None:
        self._controller = controller
        self._drone = controller.drone
        self._inbox = inbox
        self._stopped = stopped
        self._frames = 0
        self._feedback = 0
        self._results = 0
        self._overruns = 0
        self._lost = False  # another client took over, and on_authority was called

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
            self._inbox.notifier.wait_for(lambda: self._inbox.waiting or self._stopped.is_set(), max(0.0, left_s))
            self._serve()
        return RunSummary(
            self._frames,
            self._feedback,
            self._inbox.frames.dropped,
            self._inbox.feedback.dropped,
            self._overruns,
            (self._inbox.clock() - started_ns) / NS_PER_S,
            reason,
            self._results,
            self._inbox.results.pushed_out,
            self._inbox.results.expired,
        )

    def _over(self, deadline_ns: int | None, until: Callable[[], bool] | None) -> Reason | None:
        if self._stopped.is_set():
            return "stopped"
        if self._drone._core.ending or self._ended():
            return "closed"
        if deadline_ns is not None and self._inbox.clock() >= deadline_ns:
            return "time"
        return "until" if until is not None and until() else None

    def _ended(self) -> bool:
        """Whether the vehicle closed its link on purpose, as a replay does, and all samples were handled."""
        return self._drone.link.vehicle is LinkState.CLOSED and not self._inbox.waiting

    def _serve(self) -> None:
        """Call one callback per kind of sample that waits; feedback first, so that frames meet the newer state."""
        feedback = self._inbox.feedback.take()
        if feedback is not None:
            self._feedback += 1
            self._call(self._controller.on_feedback, feedback)
        frame = None if self._stopped.is_set() else self._inbox.frame()
        if frame is not None:
            self._frames += 1
            self._call(self._controller.on_frame, frame)
        result = None if self._stopped.is_set() else self._inbox.results.take()
        if result is not None:
            self._results += 1
            self._call(self._controller.on_result, result)

    def _call(self, callback: Callable[[Any], None], sample: Any) -> None:
        dropped = self._dropped()
        if self._lost and self._drone.authority.state == "held":
            self._lost = False
            self._controller.on_authority(self._drone.authority)
        self._guarded(callback, sample)
        if self._dropped() > dropped:
            self._overruns += 1

    def _dropped(self) -> int:
        return self._inbox.frames.dropped + self._inbox.feedback.dropped + self._inbox.results.pushed_out

    def _guarded(self, callback: Callable[[Any], None], sample: Any) -> None:
        try:
            callback(sample)
        except ClosedError:
            if not self._drone._core.ending:
                raise
        except AuthorityError:
            status = self._drone.authority
            if status.state == "none":
                raise  # nobody took over: this application never acquired authority, or released it
            if not self._lost and status.state != "held":
                self._lost = True
                self._controller.on_authority(status)
