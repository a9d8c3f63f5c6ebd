"""Pilot a vehicle for an application: wait for commands to complete, give up control, and end the flight."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import Final, Literal

from skyloop.child_process import leave_to_parent
from skyloop.client.actions import OUTDONE, OVERRULED
from skyloop.client.commands import LANDING, CommandSender, GivenUpError, cancelled
from skyloop.client.connection import ProxyConnection
from skyloop.client.telemetry import ClientState
from skyloop.errors import AuthorityError, ClosedError, NoAnswerError, RefusedError, SkyloopError, UnsupportedError
from skyloop.messages import (
    AnyAction,
    EmergencyStop,
    EventKind,
    Failsafe,
    Fate,
    Feedback,
    FlightState,
    Hover,
    Idle,
    Land,
    LinkState,
    Outcome,
    Refusal,
    ResetEmergency,
    ReturnPhase,
    Severity,
    Takeoff,
)
from skyloop.messages.command import ENDINGS, SET_POINTS

OnExit = Literal["land", "hover"]
STOP_S: Final = 2.0  #: how long closing waits for the vehicle to confirm an emergency stop [s]
LANDING_S: Final = 20.0  #: how long to wait for a landing [s]
OTHERS_S: Final = 1.0  #: time for feedback to tell which application took a vehicle whose landing was refused [s]
RETURN_S: Final = 180.0  #: how long to wait for a return flight that the proxy started [s]
AGAIN_NS: Final = 500_000_000  #: interval between attempts at a take-off that is not possible yet [ns]
#: If the proxy reports no outcome, feedback that arrives sooner than this after a command may predate the command [ns].
_STALE_NS: Final = 100_000_000
_NOT_YET: Final = (Refusal.DRIVER_FAILED, Refusal.VEHICLE_LINK_LOST)  #: reasons after which a take-off is retried
_ENDED_IN: Final = (FlightState.LANDED, FlightState.EMERGENCY)
_SINKING: Final = (*_ENDED_IN, FlightState.LANDING)
_log = logging.getLogger("skyloop")


class Piloting:
    """Pilots the vehicle for one application until the end of the flight. Thread-safe."""

    def __init__(
        self,
        connection: ProxyConnection,
        state: ClientState,
        commands: CommandSender,
        on_exit: OnExit,
        close: Callable[[], None],
    ) -> None:
        """Prepare to fly; ``close`` ends the connection after the flight has ended."""
        self.commands = commands
        self._connection = connection
        self._state = state
        self._on_exit = on_exit
        self._close = close
        self._end = threading.Lock()  # ensures that only one caller ends the flight
        leave_to_parent(self)

    @property
    def closed(self) -> bool:
        """Whether the drone has been closed or belongs to the parent process."""
        return self._connection.why_closed != ""

    @property
    def ending(self) -> bool:
        """Whether the end of the flight has begun, or the drone is closed."""
        return self.closed or self.commands.barred

    def forked(self) -> None:
        """Leave the vehicle and the connection to the parent process; called in a child of ``os.fork``."""
        if not self.closed:
            self._connection.forked()

    def complete(
        self,
        action: AnyAction,
        is_done: Callable[[Feedback], bool],
        wait: bool,
        timeout_s: float,
        *,
        automatic: bool = False,
    ) -> None:
        """Send the command and, with ``wait``, wait until feedback confirms its completion; see :meth:`Drone.land`.

        Call :meth:`let_go` if a take-off does not complete in time, and if the caller stops waiting for anything but a
        landing, for example after Ctrl-C.
        """
        if not wait:
            self.commands.command(action, now=True)
            return
        if type(action) is not Land:  # a landing is always commanded, because nothing is safer
            self._connection.check_may_wait()
        deadline_s = time.monotonic() + timeout_s
        waiting = None
        try:
            waiting = ActionWait(action, is_done, self.commands, self._state, self._connection, automatic=automatic)
            self._connection.check_may_wait()
            waiting.wait(timeout_s, deadline_s)
        except SkyloopError as error:
            if isinstance(error, NoAnswerError) and type(action) is Takeoff:
                self.let_go("it did not take off in time")
            raise
        except BaseException as error:
            unasked = isinstance(error, GivenUpError) and (waiting is None or waiting.outdone)
            if type(action) is not Land and not unasked:
                self.let_go(f"the call no longer waits for {action.name}")
            raise

    def report(self, where: str, error: Exception | SystemExit) -> None:
        """Emit an event for an exception in an application's callback; ``sys.exit()`` also ends the flight."""
        text = f"{where} raised {type(error).__name__}: {error}"
        self._state.emit(EventKind.CALLBACK_ERROR, text, Severity.ERROR, where=where)
        if isinstance(error, SystemExit) and not self.ending:
            self.commands.bar()
            try:  # not a daemon: the interpreter must wait for the landing
                threading.Thread(target=self.end_flight, name="skyloop-end").start()
            except RuntimeError:  # no thread can be started, and this thread must not wait
                self.let_go(f"{where} ended the program", land=True)

    def let_go(self, reason: str, *, land: bool = False) -> bool:
        """Hover or land by the library's own decision; no other method does this.

        Because the library decides this, not a person, the vehicle is left alone if others are flying it, if it is
        landing or returning, or if this application has landed or stopped it. The proxy applies the same rule. A
        take-off without visible effect is cancelled. With ``land``, the vehicle lands instead of hovering. Returns
        whether anything was sent.
        """
        commands, feedback, kind = self.commands, self._state.newest, type(self.commands.newest)
        if self.closed or kind in LANDING or (kind is Hover and not land):
            return False
        leave = feedback is None or feedback.others or _returns(feedback)
        if land or (kind is Takeoff and feedback is not None and feedback.state is FlightState.LANDED):
            action: AnyAction = Idle() if leave else Land()
        else:
            action = Idle() if leave or (feedback is not None and feedback.state in _SINKING) else Hover()
        try:
            if commands.status.state != "held":
                commands.drop()
                return False
            sent = commands.command(action, automatic=True)
        except SkyloopError:
            return False
        if type(action) is not Idle:
            _log.info("%s: %s, because %s", self._state.name, action.name, reason)
        return sent

    def end_flight(self, report: Callable[[str], object] = lambda _: None) -> SkyloopError | None:
        """End the flight: land or hover (see ``on_exit``) if this application flies the vehicle, then close.

        Once this starts, commands from the application's other threads raise :class:`ClosedError`; only an emergency
        stop is still sent. Waits until the vehicle has landed. A second call waits for the first. Idempotent.
        ``report`` is called with a message for each step. Returns the error, or None.
        """
        if self.closed:  # also in a forked child, where another thread may have held the locks
            return None
        self.commands.bar()
        with self._end:
            try:
                land = self._on_exit == "land"
                return None if self.closed else self.bring_down("its flight ends", report, land=land)
            finally:
                self._close()

    def bring_down(
        self, reason: str, report: Callable[[str], object] = lambda _: None, *, land: bool = True
    ) -> SkyloopError | None:
        """If this application flies the vehicle, land it and wait, or let go of it if ``land`` is False.

        ``report`` and the result are those of :meth:`end_flight`; ``reason`` is for the log.
        """
        self.finish_stop()
        feedback = self._state.newest
        if not self._flies():
            if feedback is not None and feedback.state.airborne and (whose := self._others_hands()):
                if land and feedback.others and feedback.state not in _SINKING:  # it may have been ours until just now
                    _log.warning("%s: %s: leaving it in the air, not landing it", self._state.name, whose)
                report(f"{whose}: leaving the drone to it")
            return None
        try:
            if not land:
                self.let_go(reason)
            elif feedback is not None and _returns(feedback):
                report("it is returning to its start to land")
                self._connection.check_may_wait()
                if not self._state.notifier.wait_for(lambda: self._is_down() or cancelled.get()(), RETURN_S):
                    return NoAnswerError(f"the vehicle has not returned and landed within {RETURN_S:g} s")
            else:
                report("landing")
                self.complete(Land(), lambda newest: newest.state in _ENDED_IN, True, LANDING_S, automatic=True)
        except RefusedError as error:
            if not self._state.notifier.wait_for(lambda: self._others_hands() != "", OTHERS_S):
                return error
            report(f"{self._others_hands()}: leaving the drone to it")
        except SkyloopError as error:
            return error
        return None

    def finish_stop(self) -> None:
        """Wait up to 2 s for the vehicle to confirm an emergency stop, because closing ends the stop."""
        if self._connection.connected and not self._connection.receiving:
            self._state.notifier.wait_for(lambda: not self.commands.schedule.stopping, STOP_S)

    def _is_down(self) -> bool:
        newest = self._state.newest
        return self.closed or newest is None or newest.state in _ENDED_IN

    def _others_hands(self) -> str:
        """Return who has taken the vehicle from this application, as readable text; empty if nobody has."""
        status, newest = self.commands.status, self._state.newest
        if status.state in ("queued", "preempted"):
            return f"{status.holder or 'another application'} took over"
        return "" if newest is None else newest.others or ""

    def _flies(self) -> bool:
        """Return whether this application is flying the vehicle or has just commanded a take-off."""
        newest = self._state.newest
        if self._state.status.vehicle is LinkState.CLOSED:
            return False  # a recording that has ended has no vehicle that could land
        airborne = newest is not None and newest.state.airborne
        if newest is not None and newest.others:
            return False  # others are also flying the vehicle; this application must not land or stop it
        return self.commands.status.state == "held" and (airborne or self.commands.wants_flight)


class ActionWait:
    """Sends one action and waits for feedback that confirms its completion."""

    def __init__(
        self,
        action: AnyAction,
        is_done: Callable[[Feedback], bool],
        commands: CommandSender,
        state: ClientState,
        connection: ProxyConnection,
        *,
        automatic: bool,
    ) -> None:
        """Send the action with :meth:`CommandSender.ask`; ``is_done`` is called with the feedback that follows."""
        self._action = action
        self._is_done = is_done
        self._automatic = automatic
        self._commands = commands
        self._state = state
        self._connection = connection
        self._problem: Exception | None = None
        self._why = ""  # why the action was not complete yet, as text
        self._why_link: LinkState | None = None  # state of the vehicle's link at that time, which the text may mention
        self._flew = False  # whether the vehicle has been in the air since
        self._refused, self._refused_ns = 0, 0  # newest intent not possible yet, and when it was first refused
        self._asked_ns = state.scheduler.clock()
        # The call may take the vehicle only from whoever flies it now, or when the action can first be sent.
        self._others, self._may_be_sent = self._others_now, commands.may_ask
        self._intent = commands.ask(action, automatic=automatic)

    @property
    def outdone(self) -> bool:
        """Whether the application has since given a different command. A set-point after a take-off is ignored."""
        commands = self._commands
        behind = type(self._action) is Takeoff and isinstance(commands.newest, SET_POINTS)
        return commands.intent != self._intent and not behind

    def wait(self, timeout_s: float, deadline_s: float) -> None:
        """Wait for the action until ``deadline_s`` on ``time.monotonic``; error messages mention ``timeout_s``.

        Raises :class:`NoAnswerError` if it is not complete in time, or the error that explains why it can't complete.
        """
        if not self._state.notifier.wait_for(self._over, deadline_s - time.monotonic()):
            raise NoAnswerError(self._not_reached(timeout_s))
        if self._problem is not None:
            raise self._problem

    def _over(self) -> bool:
        """Return whether the action is complete or waiting any longer is pointless."""
        if type(self._action) is Land and self._done():  # regardless of who landed it
            return True
        self._problem = self._why_not()
        return self._problem is not None or self._done()

    def _done(self) -> bool:
        """Return whether newer feedback confirms that the action is complete."""
        newest = self._state.newest
        if newest is None:
            return False
        self._flew = self._flew or newest.state.airborne
        if not self._is_done(newest):
            return False
        outcome = newest.outcome
        if outcome is None:
            return self._state.received_ns - self._asked_ns > _STALE_NS
        if outcome.app_id != self._commands.app_id or outcome.intent < self._intent:
            return False
        if outcome.intent == self._intent and type(self._action) is Land and not self._flew:
            return outcome.over  # the vehicle is on the ground, but a take-off may still have been in transit
        return True

    def _why_not(self) -> Exception | None:
        """Return why waiting any longer is pointless; None if it is not. Repeats requests that may succeed later."""
        name = self._action.name
        if self._connection.why_closed or (self._commands.barred and not self._automatic):
            return ClosedError(f"this drone was closed during {name}")
        if cancelled.get()():
            return GivenUpError()
        status = self._commands.status
        if status.state in ("queued", "preempted"):
            return AuthorityError(f"{name}: {status.holder or 'another application'} took over the authority")
        newest = self._commands.newest_outcome
        if newest is not None and newest.intent == self._intent and newest.fate not in OUTDONE:
            self._note(newest.text)  # the text is cleared once the repeated request is executed
            if not newest.over:  # it was executed; whoever else flies the vehicle took it afterwards
                self._others, self._may_be_sent = None, True
        outcome = self._commands.outcome(self._intent)
        if outcome is None or not outcome.failed:
            return None
        if outcome.reason is Refusal.UNSUPPORTED:
            return UnsupportedError(outcome.text)
        if outcome.fate not in OUTDONE:
            self._note(outcome.text)
        if type(self._action) is Takeoff:
            return self._why_no_takeoff(outcome)
        if type(self._action) is Land:
            return self._why_no_landing(outcome)
        if outcome.fate in OUTDONE:
            return _replaced(self._action)
        if outcome.fate in OVERRULED:
            if not self._commands.may_ask:
                return None
            return RefusedError(
                f"{name} was ended by a failsafe or a lost link: send the command again", code="not_fresh"
            )
        return _refused(outcome)

    def _why_no_takeoff(self, outcome: Outcome) -> Exception | None:
        if outcome.reason in _NOT_YET or outcome.fate is Fate.TIMED_OUT:
            now_ns, newest = self._state.scheduler.clock(), self._state.newest
            if self._refused != self._intent:
                self._refused, self._refused_ns = self._intent, now_ns
            # A withdrawn take-off first appears as a landing, which would end another take-off. A vehicle that is still
            # starting up can only refuse the request, which is therefore repeated later.
            stands = newest is not None and not newest.state.airborne and not newest.waking_up
            if stands and now_ns - self._refused_ns >= AGAIN_NS and self._commands.may_ask:
                self._again()
            return None
        if outcome.fate in OUTDONE:
            if self._called_off():
                return _replaced(self._action)
            return None  # a take-off in progress always ends
        if outcome.fate in OVERRULED:
            newest = self._state.newest
            rose = newest is not None and newest.state.airborne and newest.state is not FlightState.LANDING
            if rose or not self._commands.may_ask:  # the vehicle has left the ground and will end up hovering
                return None
            text = f"takeoff was ended because {ENDINGS[outcome.fate]}: take off again"
            return RefusedError(text, code=Refusal.NOT_FRESH)
        return _refused(outcome)

    def _called_off(self) -> bool:
        """Return whether another command by the application cancels the take-off, whether or not it has started."""
        commands, newest = self._commands, self._state.newest
        if commands.latest(Land, EmergencyStop, ResetEmergency) > self._intent:
            return True
        # A hover or idle command cancels a take-off without visible effect: if the vehicle is still on the ground, the
        # take-off is over.
        stayed, outcome = commands.latest(Hover, Idle), commands.newest_outcome
        stands = newest is not None and newest.state is FlightState.LANDED
        return stands and self._intent < stayed and outcome is not None and outcome.intent >= stayed

    def _why_no_landing(self, outcome: Outcome) -> Exception | None:
        """Return why waiting is pointless. Old commands aren't resent, but the caller still waits for this landing."""
        if outcome.fate in OVERRULED:
            if self._commands.may_ask:
                # The caller still wants to land. However, if a pilot has since taken over by hand, that pilot keeps the
                # vehicle. While the application's own link is lost, it can't see a takeover.
                taken = self._may_be_sent and self._others_now not in (None, self._others)
                self._again(automatic=taken or outcome.fate not in (Fate.FAILSAFE, Fate.AUTHORITY))
            return None
        return None if outcome.fate in OUTDONE else _refused(outcome)

    def _again(self, *, automatic: bool = True) -> None:
        self._asked_ns = self._state.scheduler.clock()
        self._intent = self._commands.ask(self._action, automatic=automatic or self._automatic, again=self._intent)

    @property
    def _others_now(self) -> str | None:
        return None if self._state.newest is None else self._state.newest.others

    def _not_reached(self, timeout_s: float) -> str:
        newest, connection = self._state.newest, self._connection
        state = "in an unknown state" if newest is None else newest.state.value
        text = f"{self._action.name} was not completed within {timeout_s:g} s: the vehicle is {state}"
        if connection.state.value not in ("up", "degraded"):
            return f"{text}, and the link is {connection.state.value} ({connection.reason})"
        if newest is not None and newest.vehicle_link not in (LinkState.UP, LinkState.DEGRADED):
            return f"{text}, and its own link is {newest.vehicle_link.value} ({newest.link_reason})"
        if newest is not None and newest.waking_up:
            return f"{text}; it is {newest.link_reason}"
        if newest is not None and "replay.position_s" in (newest.native or {}):
            return f"{text}; a replay flies only when its recording does: begin there, with ?start=SECONDS"
        return f"{text}; {self._why}" if self._why and self._why_link is self._vehicle_link else text

    def _note(self, why: str) -> None:
        if self._why != why:
            self._why, self._why_link = why, self._vehicle_link

    @property
    def _vehicle_link(self) -> LinkState | None:
        return None if self._state.newest is None else self._state.newest.vehicle_link


def _replaced(action: AnyAction) -> RefusedError:
    return RefusedError(f"{action.name} was ended by another command", code="replaced")


def _refused(outcome: Outcome) -> RefusedError:
    return RefusedError(outcome.text, code=str(outcome.reason))


def _returns(feedback: Feedback) -> bool:
    """Return whether a failsafe is flying the vehicle back to its start."""
    return feedback.failsafe is Failsafe.LAND and feedback.return_phase is not ReturnPhase.NONE
