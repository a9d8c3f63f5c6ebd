"""Track each of an application's intents from start to end, and check each command. Pure.

The library repeats each command many times a second. A repeat refers to its intent. It is checked again during the
intent, and has no effect afterwards. :data:`skyloop.messages.command.ENDINGS` lists everything that ends an intent.

The checks come in this order: sequence, age, lease and finite numbers (:meth:`CommandChecks.receive`; these four decide
whether a command is a sign of life of the holder); then whether its intent is in progress, the vehicle link, support,
whose flight it is, the flight state, limits, safety box and zones (:meth:`CommandChecks.decide`). ``docs/proxy.md``
describes the rules.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto
from typing import Final, NamedTuple

from skyloop.clock import nanoseconds, seconds
from skyloop.errors import shortened
from skyloop.messages import (
    Action,
    AnyAction,
    Attitude,
    Command,
    EmergencyStop,
    Failsafe,
    Fate,
    Feedback,
    FlightState,
    Hover,
    Idle,
    Land,
    LinkState,
    Outcome,
    Position,
    Refusal,
    ResetEmergency,
    ReturnToStart,
    Takeoff,
    Velocity,
)
from skyloop.messages.command import ENDINGS, MAX_OUTCOME_TEXT, SET_POINTS
from skyloop.proxy.core.airspace import Airspace, Clamp, Verdict
from skyloop.proxy.core.authority import Authority
from skyloop.proxy.core.autopilot import ReturnDecision, ReturnFlight, ReturnSettings, StartPoint
from skyloop.proxy.core.failsafe import REASONS, FailsafeLadder
from skyloop.proxy.core.flight import Flight, Snapshot, Whose

MAX_AHEAD_NS: Final = nanoseconds(0.05)  #: how far in the future a command's time may be: the clock offset has errors
TAKEOFF_NS: Final = nanoseconds(20.0)  #: a take-off that has not left the ground after this time is withdrawn
#: A landing that withdrew a take-off is complete after this time on the ground, in case arming was in progress.
SETTLED_NS: Final = nanoseconds(1.0)
_UP: Final = (FlightState.HOVERING, FlightState.FLYING)
_SILENT: Final = (Fate.COMPLETED, Fate.WITHDRAWN)  #: fates of intents whose repeats are refused without explanation
_LANDINGS: Final = (Land, ReturnToStart)
_PASSING: Final = (Refusal.DRIVER_FAILED, Refusal.VEHICLE_LINK_LOST)  #: the next repeat after one of these may succeed

_HOVER_ACTION: Final = Hover()
_ON_THE_GROUND: Final = (FlightState.LANDED, FlightState.UNKNOWN)
_TAKING: Final = (Takeoff, Hover, Land)  #: actions that take over a vehicle flown by others if they are new requests


@dataclass(slots=True)
class Intent:
    """One request from an application."""

    number: int
    action: AnyAction
    asked_ns: int
    state: FlightState  #: the vehicle's state when the intent was requested or last observed
    fate: Fate = Fate.UNDER_WAY
    begun: bool = False  #: whether the vehicle has started to execute the intent
    automatic: bool = False  #: whether the library itself requested the intent
    withdrew: bool = False  #: whether the intent ended a take-off that had not left the ground
    reason: Refusal | None = None
    text: str = ""

    @property
    def over(self) -> bool:
        """Whether this intent has ended. Repeats of an ended intent have no effect."""
        return self.fate is not Fate.UNDER_WAY

    def end(self, fate: Fate, text: str = "", reason: Refusal | None = None) -> None:
        """End the intent unless it has already ended. ``text`` and ``reason`` answer its repeats."""
        if self.fate is Fate.UNDER_WAY:
            silent = fate in _SILENT
            self.reason = None if silent else reason or Refusal.NOT_FRESH
            self.text = "" if silent else text or f"{ENDINGS[fate]}: send a new command"
            self.fate = fate  # set last, because other threads read it without a lock

    def refuse(self, reason: Refusal, why: str) -> None:
        """End the intent with a refusal.

        Hovers and landings stay in progress if only the driver failed or the link is lost, as nothing is safer. So do
        all resets, because the emergency may not be known yet. All count as refused until a repeat is executed.
        """
        kind = type(self.action)
        self.reason, self.text = reason, why
        if not (kind is ResetEmergency or (kind in (Hover, Land) and reason in _PASSING)):
            self.end(Fate.REFUSED, why, reason)

    def observe(self, state: FlightState, now_ns: int, shown_ns: int | None = None) -> None:
        """End or complete the intent according to the vehicle's state at ``shown_ns`` (None: now)."""
        before = self.state
        if state is not FlightState.UNKNOWN:  # an unknown state does not replace a known one
            self.state = state
        if self.fate is not Fate.UNDER_WAY:
            return
        kind = type(self.action)
        if state is FlightState.LANDED:
            if kind is Land:
                # The vehicle having been on the ground before the request proves nothing: it may be in the air by now.
                shown = shown_ns is None or shown_ns >= self.asked_ns
                if shown and (not self.withdrew or now_ns - self.asked_ns >= SETTLED_NS):
                    self.end(Fate.COMPLETED)
            elif before.airborne:
                self.end(Fate.COMPLETED if kind is ReturnToStart else Fate.LANDED)
        elif state is FlightState.LANDING:
            if before is not state and kind not in _LANDINGS:
                self.end(Fate.LANDED)
        elif state is FlightState.EMERGENCY:
            if before is not state and kind is not ResetEmergency:
                self.end(Fate.EMERGENCY)
        elif kind is Takeoff and state in _UP and (self.begun or before.airborne):
            self.end(Fate.COMPLETED)
        if kind is Takeoff and not self.state.airborne and now_ns - self.asked_ns >= TAKEOFF_NS:
            self.end(Fate.TIMED_OUT)
        if kind is ResetEmergency and self.begun and state is not FlightState.EMERGENCY:
            self.end(Fate.COMPLETED)

    def outcome(self, app_id: int, name: str, state: FlightState) -> Outcome:
        """Return the intent's outcome for the feedback, given the application's name and the vehicle's state in it.

        A take-off that has only just left the ground has no outcome yet: others may have taken over during the climb.
        """
        fate = self.fate  # read this first, because another thread may end the intent now
        if fate is Fate.UNDER_WAY and state in _UP and self.begun and type(self.action) is Takeoff:
            return Outcome()
        if not self.text:
            return Outcome(app_id, max(0, self.number), fate)
        text = shortened(f"{name}: {self.action.name} refused: {self.text}", MAX_OUTCOME_TEXT)
        return Outcome(app_id, self.number, fate, self.reason, text)


NO_INTENT: Final = Intent(-1, Idle(), 0, FlightState.UNKNOWN, Fate.COMPLETED)


class Intents:
    """The requests of one connection: their sequence numbers, and the newest intent."""

    __slots__ = ("_ended", "_floor", "_received", "newest", "seq")

    def __init__(self) -> None:
        self.seq = -1  #: sequence number of the newest command received
        self.newest = NO_INTENT
        self._received = 0  # highest intent received, including refused commands
        self._floor = -1  # an event ended the intents up to this number
        self._ended = Fate.AUTHORITY  # fate of the intents that this event ends

    def check(self, command: Command, now_ns: int, max_age_ns: int, lease: int, holds: bool) -> Refusal | None:
        """Check a command's sequence, age, lease and numbers, and remember its sequence.

        ``lease``: the lease in force (0 if there is none). ``holds``: whether the sender holds it. Returns None if the
        command counts as a sign of life.
        """
        if command.seq <= self.seq:
            return Refusal.OUT_OF_SEQUENCE
        self.seq = command.seq
        if command.intent > self._received:
            self._received = command.intent
        if not -MAX_AHEAD_NS <= now_ns - command.sent_ns <= max_age_ns:
            return Refusal.STALE
        if command.lease != lease or not holds:
            named_one = command.lease not in (0, lease)
            return Refusal.FOREIGN_LEASE if named_one else Refusal.NO_AUTHORITY
        if not command.action.finite:
            return Refusal.NON_FINITE
        return None

    def intent_of(self, command: Command, state: FlightState, now_ns: int) -> tuple[Intent, bool]:
        """Return the intent of a command that passed :meth:`check`, and whether the command is a new request."""
        newest, number = self.newest, command.intent
        if number == newest.number:
            return newest, False
        if number <= newest.number or number <= self._floor:
            older = Intent(number, command.action, now_ns, state)
            older.end(self._ended if number <= self._floor else Fate.REPLACED)
            return older, False
        newest.end(Fate.WITHDRAWN if type(command.action) is Idle else Fate.REPLACED)
        self.newest = newest = Intent(number, command.action, now_ns, state, automatic=command.automatic)
        return newest, True

    @property
    def lands(self) -> bool:
        """Whether a requested landing in place is in progress."""
        return type(self.newest.action) is Land and not self.newest.over

    def stop(self, command: Command) -> None:
        """Handle an emergency stop. The stop is executed regardless of its sequence number, and ends all requests."""
        assert type(command.action) is EmergencyStop
        self.seq, self._received = max(self.seq, command.seq), max(self._received, command.intent)
        self.end(Fate.EMERGENCY)

    def end(self, fate: Fate, text: str = "", reason: Refusal | None = None) -> None:
        """End all requests received so far, including those that have not passed the checks."""
        self.newest.end(fate, text, reason)
        self._floor, self._ended = self._received, fate


class StatePolicy(Enum):
    """How to handle an action in a given flight state."""

    APPLY = auto()
    HOLD = auto()  #: accept the action without effect, because the state has been reached or a manoeuvre continues
    HOVER = auto()  #: if a take-off is requested in flight, hover instead
    REFUSE = auto()


def _row(**policies: StatePolicy) -> dict[FlightState, StatePolicy]:
    other = policies.pop("other")
    return {state: policies.get(state.value, other) for state in FlightState}


_APPLY, _HOLD, _HOVER, _REFUSE = StatePolicy.APPLY, StatePolicy.HOLD, StatePolicy.HOVER, StatePolicy.REFUSE
_SET_POINT: Final = _row(landed=_REFUSE, taking_off=_HOLD, landing=_HOLD, emergency=_REFUSE, other=_APPLY)

#: In an unknown state, all actions are passed on, because some vehicles never report their state.
STATE_POLICIES: Final[dict[type[Action], dict[FlightState, StatePolicy]]] = {
    Idle: _row(other=_HOLD),
    Takeoff: _row(landed=_APPLY, unknown=_APPLY, taking_off=_HOLD, emergency=_REFUSE, other=_HOVER),
    Hover: _row(landed=_HOLD, emergency=_REFUSE, other=_APPLY),
    Land: _row(landed=_HOLD, landing=_HOLD, emergency=_REFUSE, other=_APPLY),
    ResetEmergency: _row(emergency=_APPLY, unknown=_APPLY, other=_REFUSE),
    Attitude: _SET_POINT,
    Velocity: _SET_POINT,
    Position: _SET_POINT,
    ReturnToStart: _SET_POINT,
}


class Decision(NamedTuple):
    """The decision on a command that passed the first checks."""

    action: AnyAction | None = None  #: the vehicle's new action (a substitute if the command was refused), or None
    refusal: Refusal | None = None
    why: str = ""  #: readable reason for the refusal
    takes_off: bool = False
    clamps: tuple[Clamp, ...] = ()  #: the limits that reduced it
    enforced: bool | None = None  #: whether box and zones could be enforced; None if there are none, or no set-point


class CommandChecks:
    """Decides how to handle the commands for one vehicle.

    ``supported``: the actions of the vehicle and the software autopilot. ``native``: the actions of the vehicle itself.
    ``why_not``: readable reasons why other actions are not available.
    """

    def __init__(
        self,
        authority: Authority,
        ladder: FailsafeLadder,
        flight: Flight,
        *,
        supported: frozenset[type[Action]],
        why_not: str,
        native: frozenset[type[Action]],
    ) -> None:
        self.airspace = Airspace()
        self.returns = ReturnSettings()
        self.start = StartPoint()
        self.way_back: ReturnFlight | None = None  #: the return in progress; None if none was requested
        self.max_age_ns = 0
        self._authority = authority
        self._ladder = ladder
        self._flight = flight
        self._supported = supported
        self._why_not = why_not
        #: Actions that a person may command while nothing is received from the vehicle. The vehicle may still receive
        #: our commands. Without us, only the emergency stop could bring it down.
        self._unheard = native & {Hover, Land}

    def receive(self, command: Command, intents: Intents, app_id: int, now_ns: int) -> Refusal | None:
        """Check sequence, age, lease and numbers. Returns None if the command passes, which renews the lease."""
        authority = self._authority
        holder = authority.holder
        holds = holder is not None and holder.app_id == app_id
        refusal = intents.check(command, now_ns, self.max_age_ns, authority.lease, holds)
        if refusal is None:
            authority.last_command_ns = now_ns
        return refusal

    def decide(
        self, action: AnyAction, intent: Intent, seen: Snapshot, *, new: bool, automatic: bool = False
    ) -> Decision:
        """Decide on a command whose intent is in progress. The command must not be an emergency stop or idle.

        ``new``: whether this is a new request, and neither a repeat nor one that the library makes (``automatic``).
        """
        now_ns, state, feedback, link, _ = seen
        kind = type(action)
        policy = STATE_POLICIES[kind][state]
        if new and kind is ReturnToStart:
            self.way_back = None
        if automatic and (state is FlightState.LANDING or self.keeps_failsafe(kind, seen, automatic=True)):
            policy = StatePolicy.HOLD  # an automatic hover does not abort a landing
        elif kind is Land and link is LinkState.LOST and policy is StatePolicy.HOLD:
            policy = StatePolicy.APPLY  # the state is outdated: the vehicle may have received other commands since then
        problem = self._problem(action, policy, seen, new=new, automatic=automatic)
        if problem is not None:
            return Decision(None, *problem)
        is_set_point = kind in SET_POINTS
        lands = policy is StatePolicy.HOLD and self._ladder.step is Failsafe.LAND
        if lands and is_set_point and not self.keeps_failsafe(kind, seen, automatic=automatic):
            policy = StatePolicy.HOVER  # a returning pilot aborts the ladder's landing, but not a pilot's landing
        if policy is StatePolicy.REFUSE:
            return Decision(None, Refusal.WRONG_STATE, explain_state(action, state))
        if policy is StatePolicy.HOLD:
            if type(action) is Position and (why := self.airspace.objection(action, feedback, now_ns)):
                return Decision(None, Refusal.OUT_OF_RANGE, why)  # after taking off, it would be too late
            return Decision()
        if type(action) is ReturnToStart and policy is not StatePolicy.HOVER:
            if self.way_back is None:
                self.begin_return(action)
            step = self.step_return(feedback, now_ns)
            if step.action is None:
                return Decision(_HOVER_ACTION, step.refusal, step.why)
            return Decision(step.action, clamps=step.clamps, enforced=step.enforced)
        action = _HOVER_ACTION if policy is StatePolicy.HOVER else action
        if self._is_judged(action, state):
            verdict = self.airspace.judge(action, feedback, now_ns, new=not intent.begun)
            if verdict.action is None:  # the previous target isn't wanted any more, either
                instead = _HOVER_ACTION if is_set_point and Hover in self._supported else None
                return Decision(instead, verdict.refusal, verdict.why)  # without a refusal, it waits for a position
        else:
            verdict = Verdict(action)
        takes_off = kind is Takeoff and policy is StatePolicy.APPLY
        return Decision(verdict.action, None, "", takes_off, verdict.clamps, verdict.enforced)

    def keeps_failsafe(self, kind: type[Action], seen: Snapshot, *, automatic: bool) -> bool:
        """Return whether the ladder's task continues, rather than ends, when the holder's command is executed."""
        ladder = self._ladder
        if automatic:
            return ladder.continues_landing or ladder.step is Failsafe.LAND
        if kind is Land:
            return ladder.continues_landing
        return kind is Hover and ladder.step is Failsafe.HOVER and not (ladder.given_up or seen.link_up)

    def _is_judged(self, action: AnyAction, state: FlightState) -> bool:
        """Return whether the position matters. It does for hovers in flight and for take-offs from the ground."""
        if type(action) is Hover and self._flight.whose is not Whose.OTHERS:  # a descent would not take over control
            return Velocity in self._supported and state in (FlightState.HOVERING, FlightState.FLYING)
        return type(action) in SET_POINTS or (type(action) is Takeoff and state is FlightState.LANDED)

    def begin_return(self, action: ReturnToStart) -> None:
        """Start a return, replacing any return in progress."""
        self.way_back = ReturnFlight(action, self.start.position, self.returns)

    def step_return(self, feedback: Feedback | None, now_ns: int) -> ReturnDecision:
        """Decide on the next step of the return."""
        assert self.way_back is not None
        return self.way_back.step(self.airspace, feedback, now_ns)

    def why_no_return(self, feedback: Feedback | None, now_ns: int) -> str:
        """Return why the vehicle can't start a return flight that ends in a landing now; empty if it can."""
        flight = ReturnFlight(ReturnToStart(land=True), self.start.position, self.returns)
        decision = flight.step(self.airspace.copy(), feedback, now_ns)
        return decision.why if decision.action is None and decision.refusal is not None else ""

    def _problem(
        self, action: AnyAction, policy: StatePolicy, seen: Snapshot, *, new: bool, automatic: bool
    ) -> tuple[Refusal, str] | None:
        """Return the reason that forbids a command from the holder, regardless of the policy for the flight state."""
        state, link = seen.state, seen.link
        kind = type(action)
        unheard = link is LinkState.LOST and kind in self._unheard and not automatic
        if link is not LinkState.UP and link is not LinkState.DEGRADED and not unheard:
            return Refusal.VEHICLE_LINK_LOST, f"the link to the vehicle is {link.value}"
        if kind not in self._supported:
            why = self._why_not or "neither the vehicle nor the software autopilot can do it"
            return Refusal.UNSUPPORTED, f"{action.name} is not possible: {why}"
        if self._flight.whose is Whose.OTHERS:
            others = self._flight.others
            if kind in SET_POINTS:
                return Refusal.WRONG_STATE, f"{others}: hover, take off or land first to take it over"
            if not new and (automatic or policy is not StatePolicy.HOLD) and kind in _TAKING:
                what = "an automatic command" if automatic else "a repeated command"
                return Refusal.WRONG_STATE, f"{others}, and {what} does not take it back: send a new one"
        if self._ladder.barred and kind is not Land:
            return Refusal.WRONG_STATE, f"only landing is possible: {REASONS[self._ladder.barred]}"
        unasked = automatic and kind is not Land
        if self._ladder.step is Failsafe.LAND and self._ladder.lands_for_battery and (unasked or kind in SET_POINTS):
            what = "returns to its start" if self._ladder.returning else "lands"
            return Refusal.WRONG_STATE, f"it {what}, because the battery is low: hover or land first to take it over"
        if self._ladder.battery_low and kind is Takeoff and state in _ON_THE_GROUND:
            why = "the battery is low, and it would return at once (battery.return): charge it"
            return Refusal.WRONG_STATE, f"{action.name} is not possible: {why}"
        if policy is StatePolicy.HOVER and Hover not in self._supported:
            return Refusal.UNSUPPORTED, f"{action.name} is not possible while {state.value}"
        return None


def explain(reason: Refusal, command: Command, newest_seq: int, *, now_ns: int, max_age_ns: int, lease: int) -> str:
    """Return readable text about why :meth:`Intents.check` refused a command, and what would be right."""
    if reason is Refusal.OUT_OF_SEQUENCE:
        return f"number {command.seq} is not newer than {newest_seq}, the last one received"
    if reason is Refusal.STALE:
        age = seconds(now_ns - command.sent_ns)
        if age < 0:
            return f"it was sent {-age:.3f} s in the future, over the limit of {seconds(MAX_AHEAD_NS):g} s"
        return f"it is {age:.3f} s old, over the limit of {seconds(max_age_ns):g} s (command.max_age_s)"
    if reason is Refusal.FOREIGN_LEASE:
        force = f"lease {lease} is in force" if lease else "no lease is in force"
        return f"it was sent under lease {command.lease}, and {force}"
    if reason is Refusal.NO_AUTHORITY:
        return "the sender does not hold the authority: request it first"
    return f"{command.action.name} has a number that is NaN or infinite"


def explain_state(action: Action, state: FlightState) -> str:
    """Return why an action is refused in a flight state."""
    if state is FlightState.EMERGENCY:
        return f"{action.name} is not possible in an emergency: reset it first"
    if isinstance(action, ResetEmergency):
        return f"there is no emergency to reset: the vehicle is {state.value}"
    return f"{action.name} is not possible while {state.value}: take off first"
