"""The base class for controllers, and the loop that calls its callbacks."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any, Final, Literal

from skyloop.clock import NS_PER_S, nanoseconds
from skyloop.errors import AuthorityError, ClosedError, UsageError
from skyloop.extend import Known, commands, inbox, let_go
from skyloop.messages import EventKind, Failsafe, LinkState
from skyloop.messages.command import SET_POINTS

if TYPE_CHECKING:
    from skyloop.client import AuthorityStatus, Drone, Frame
    from skyloop.client.results import Result
    from skyloop.client.telemetry import Mailboxes
    from skyloop.messages import Event, Feedback

Reason = Literal["time", "until", "stopped", "closed"]
_POLL_S = 0.1  # interval at which ``until`` is evaluated while no samples arrive
_SAMPLES: Final = ("on_feedback", "on_frame", "on_result")
_CALLBACKS: Final = (*_SAMPLES, "on_authority", "on_reload")


@dataclass(frozen=True, slots=True)
class RunSummary:
    """Counts from one call of :meth:`Controller.run`, and the reason why it ended."""

    frames: int  #: number of ``on_frame`` calls
    feedback: int  #: number of ``on_feedback`` calls
    frames_dropped: int  #: frames replaced by newer ones while a callback was running
    feedback_dropped: int
    overruns: int  #: number of callbacks during which at least one sample was dropped
    seconds: float
    reason: Reason  #: why the run ended
    results: int = 0  #: number of ``on_result`` calls
    results_dropped: int = 0  #: results replaced by newer ones while a callback was running
    results_expired: int = 0  #: number of results older than ``result_max_age_s`` when taken from the queue
    notes: tuple[str, ...] = ()  #: descriptions of likely mistakes: a forgotten take-off, a misspelt callback, …

    def __str__(self) -> str:
        results = ""
        if self.results or self.results_dropped or self.results_expired:
            results = f"{self.results} results ({self.results_dropped} dropped, {self.results_expired} too old), "
        counts = (
            f"{self.seconds:.1f} s until {self.reason}: {self.frames} frames ({self.frames_dropped} dropped), "
            f"{self.feedback} feedback samples ({self.feedback_dropped} dropped), "
            f"{results}{self.overruns} overrun{'' if self.overruns == 1 else 's'}"
        )
        return "\n".join((counts, *(f"note: {note}" for note in self.notes)))


class Controller:
    """The base class for an application's control loop.

    Override one or more of :meth:`on_feedback`, :meth:`on_frame` and :meth:`on_result`, then call :meth:`run`.
    Callbacks run one at a time on the thread that called :meth:`run` and always get the newest sample: one that arrives
    while a callback is running replaces any sample already waiting.

    Attributes:
        camera: Camera for :meth:`on_frame`; None for the vehicle's first camera.
        processors: Processors for :meth:`on_result`; None for all.
        result_max_age_s: Maximum age of results; older ones are skipped. None disables the check.
        drone: The drone to fly.
    """

    camera: str | None = None
    processors: tuple[str, ...] | None = None
    result_max_age_s: float | None = 1.0

    def __init__(self, drone: Drone) -> None:
        """Store the drone; callbacks start with :meth:`run`."""
        self.drone = drone
        self._stopped = threading.Event()
        self._ended = False  # whether the controller has ended permanently
        self._inbox: Mailboxes | None = None
        self._checks: _Checks | None = None  # checks for the latest run

    # Callbacks to override ------------------------------------------------------------------------------------------

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
            result: The result; ``result.age_s`` is the time since its frame was captured.
        """

    def on_authority(self, status: AuthorityStatus) -> None:
        """Handle the loss or return of authority.

        Called once when a command fails because another client took over, and once more, before the next callback, when
        this client holds authority again.
        """

    def on_reload(self, before: Controller) -> None:
        """Take over the state of the controller that this one replaces in flight.

        Called once before the first sample when ``skyloop fly --reload`` reloads a saved file. Copy the previous
        controller's state here, for example ``self.target = before.target``.

        Args:
            before: The controller that ran until now.
        """

    # Methods to call ----------------------------------------------------------------------------------------------

    def stop(self) -> None:
        """End :meth:`run` after the current callback. Can be called from any thread."""
        self._stopped.set()
        inbox = self._inbox
        if inbox is not None:
            inbox.notifier.notify()

    def _is_overruled(self, feedback: Feedback) -> bool:
        """Return whether set-points are ignored because another client, controller or failsafe controls the vehicle."""
        return self.drone.authority.state != "held" or bool(feedback.others) or feedback.failsafe is not Failsafe.NONE

    def _end(self) -> None:
        """Stop permanently: a later :meth:`run` returns at once."""
        self._ended = True
        self.stop()

    def run(self, seconds: float | None = None, until: Callable[[], bool] | None = None) -> RunSummary:
        """Call the callbacks until time is up, ``until()`` is true, :meth:`stop` is called or the drone closes.

        After an exception in a callback, Ctrl-C or ``sys.exit()``, an airborne vehicle flown by this client hovers, and
        the exception propagates. If another client takes over, the resulting :class:`AuthorityError` does not end the
        run: instead, :meth:`on_authority` is called. Once a ready-made controller has finished, it does not fly again:
        further runs end at once.

        Args:
            seconds: How long to run, 0 or more; None for no limit.
            until: Function called before each round of callbacks, and every 0.1 s while no samples arrive.

        Returns:
            Counts of calls and drops, the reason why the run ended, and likely mistakes.

        Raises:
            UsageError: ``seconds`` is negative or NaN.
            UnknownNameError: The vehicle has no such camera.
            UnsupportedError: The vehicle has no camera, but :meth:`on_frame` is overridden.
        """
        if seconds is not None and not seconds >= 0.0:
            raise UsageError(f"seconds is {seconds!r} and must be 0 or more")
        own = type(self)
        wants_frames = own.on_frame is not Controller.on_frame
        wants_results = own.on_result is not Controller.on_result
        wants_feedback = own.on_feedback is not Controller.on_feedback or not (wants_frames or wants_results)
        mailboxes = inbox(
            self.drone,
            feedback=wants_feedback,
            frames=wants_frames,
            camera=self.camera,
            results=wants_results,
            processors=self.processors,
            max_age_s=self.result_max_age_s,
        )
        if not self._ended:
            self._stopped.clear()
        checks = self._checks = _Checks(self)
        try:
            with mailboxes:
                self._inbox = mailboxes
                return _Run(self, mailboxes, self._stopped, checks).go(seconds, until)
        except BaseException as error:
            let_go(self.drone, f"{type(self).__name__} ended by {type(error).__name__}")
            raise
        finally:
            self._inbox = None


def misspelt(own: type[Controller]) -> Iterator[str]:
    """Describe methods whose names look like misspelt callbacks, and controllers without a callback."""
    theirs = [
        kind for kind in own.__mro__ if issubclass(kind, Controller) and not kind.__module__.startswith("skyloop.")
    ]
    if not theirs:
        return
    missing = {name.replace("_", ""): name for name in _CALLBACKS if getattr(own, name) is getattr(Controller, name)}
    similar = False
    for kind in theirs:
        for name, value in vars(kind).items():
            if not callable(value) or name.startswith("_") or name in _CALLBACKS:
                continue
            for match in get_close_matches(name.lower().replace("_", ""), missing, 1, 0.85):
                similar = True
                yield f"{own.__name__}.{name} is never called: did you mean {missing[match]}?"
    if not similar and all(getattr(own, name) is getattr(Controller, name) for name in _SAMPLES):
        yield f"{own.__name__} has none of {', '.join(_SAMPLES)}: nothing was called"


class _Checks:
    """The checks of a run for beginners' mistakes."""

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self.known, self._commands = Known(controller.drone), commands(controller.drone)
        self._first_intent = self._commands.intent
        self._last_event = next(reversed(controller.drone.recent_events()), None)
        self._flew = self._steered = False

    def update(self) -> None:
        """Record whether the vehicle is airborne and receives set-points; called throughout the run."""
        newest = self.known.newest
        self._flew = self._flew or (newest is not None and newest.state.airborne)
        if not self._steered and self._commands.intent > self._first_intent:
            self._steered = isinstance(self._commands.newest, SET_POINTS)

    def notes(self) -> Iterator[str]:
        """Yield descriptions of the mistakes found."""
        yield from misspelt(type(self._controller))
        if self._steered and not self._flew:
            yield "the drone never took off, so its set-points had no effect: call drone.takeoff() first"
        for found in self._detectors():
            if note := found():
                yield note
        limited = [event for event in self._events() if event.kind is EventKind.COMMAND_CLAMPED]
        for limit, times in Counter(event.data.get("limit") for event in limited).items():
            last = next(event.data for event in reversed(limited) if event.data.get("limit") == limit)
            asked, applied = last.get("asked"), last.get("applied")
            often = "" if times == 1 else f" {times} times"
            if isinstance(asked, float) and isinstance(applied, float):
                yield f"{limit} limited set-points{often}: {applied:.3g} instead of {asked:.3g}"

    def _detectors(self) -> Iterator[Callable[[], str]]:
        """Yield functions that explain why detectors of the controller, its class or its file have found nothing."""
        own = type(self._controller)
        places = [vars(self._controller), *map(vars, own.__mro__), getattr(own.on_frame, "__globals__", {})]
        found = {id(value): value for place in places for value in list(place.values()) if not isinstance(value, type)}
        for value in found.values():
            if callable(why := getattr(type(value), "why_nothing", None)):
                yield why.__get__(value)

    def _events(self) -> list[Event]:
        """Return the events about this application since the start of the run."""
        events = self._controller.drone.recent_events()
        if self._last_event in events:
            del events[: events.index(self._last_event) + 1]
        return [event for event in events if event.app == self.known.app]


class _Run:
    """One run of a controller."""

    def __init__(self, controller: Controller, inbox: Mailboxes, stopped: threading.Event, checks: _Checks) -> None:
        self._controller = controller
        self._drone = controller.drone
        self._inbox = inbox
        self._stopped = stopped
        self._checks = checks
        self._frames = 0
        self._feedback = 0
        self._results = 0
        self._overruns = 0
        self._lost = False  # whether another client has taken over and on_authority has been called

    def go(self, seconds: float | None, until: Callable[[], bool] | None) -> RunSummary:
        started_ns = self._inbox.clock()
        deadline_ns = None if seconds is None else started_ns + nanoseconds(seconds)
        while True:
            reason = self._over(deadline_ns, until)
            if reason is not None:
                break
            left_s = _POLL_S
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
            tuple(self._checks.notes()),
        )

    def _over(self, deadline_ns: int | None, until: Callable[[], bool] | None) -> Reason | None:
        self._checks.update()
        if self._stopped.is_set():
            return "stopped"
        if self._checks.known.is_ending or self._ended():
            return "closed"
        if deadline_ns is not None and self._inbox.clock() >= deadline_ns:
            return "time"
        return "until" if until is not None and until() else None

    def _ended(self) -> bool:
        """Return whether the vehicle closed its link on purpose, as replays do, and all samples have been handled."""
        return self._drone.link.vehicle is LinkState.CLOSED and not self._inbox.waiting

    def _serve(self) -> None:
        """Call one callback for each kind of waiting sample, feedback first so that frames see the latest state."""
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
            if not self._checks.known.is_ending:
                raise
        except AuthorityError:
            status = self._drone.authority
            if status.state == "none":
                raise  # not a takeover: this application never acquired authority or has released it
            if not self._lost and status.state != "held":
                self._lost = True
                self._controller.on_authority(status)
