"""What an application asked for, from its beginning to its one end, and the checks that each command passes. Pure.

The library repeats each command many times a second. A repeat asks the intent: it is judged again while the intent is
under way, and never acts once it is over. :data:`skyloop.messages.command.ENDINGS` lists all that ends one.

The checks come in this order: sequence, age, lease, finite numbers (these four, :meth:`CommandChecks.receive`, decide
whether it is a sign of life of the holder), then whether its intent is under way, the vehicle's link, support, whose
the flight is, the flight state, limits, safety box and zones (:meth:`CommandChecks.decide`). The rules in words are in
``docs/proxy.md``.
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
from skyloop.proxy.core.airspace import Airspace, Verdict
from skyloop.proxy.core.authority import Authority
from skyloop.proxy.core.autopilot import ReturnDecision, ReturnFlight, StartPoint
from skyloop.proxy.core.failsafe import REASONS, FailsafeLadder
from skyloop.proxy.core.flight import Flight, Snapshot, Whose
from skyloop.proxy.core.settings import Clamp, ReturnSettings

MAX_AHEAD_NS: Final = nanoseconds(0.05)  #: how far ahead a command's time may lie: the error of the clocks' offset
TAKEOFF_NS: Final = nanoseconds(20.0)  #: a take-off that has not left the ground by then ends, and is withdrawn
#: A landing that withdrew a take-off is done when the vehicle stood for so long: an arming may have been on its way.
SETTLED_NS: Final = nanoseconds(1.0)
_UP: Final = (FlightState.HOVERING, FlightState.FLYING)
_SILENT: Final = (Fate.COMPLETED, Fate.WITHDRAWN)  #: nobody needs to be told that repeats of it do nothing
_LANDINGS: Final = (Land, ReturnToStart)
_PASSING: Final = (Refusal.DRIVER_FAILED, Refusal.VEHICLE_LINK_LOST)  #: what may be different with the next repeat

_HOVER_ACTION: Final = Hover()
_ON_THE_GROUND: Final = (FlightState.LANDED, FlightState.UNKNOWN)
_TAKING: Final = (Takeoff, Hover, Land)  #: newly asked for, they take a vehicle that others fly


@dataclass(slots=True)
class Intent:
    """One thing that an application asked for."""

    number: int
    action: AnyAction
    asked_ns: int
    state: FlightState  #: the vehicle's, when it was asked for or looked at last
    fate: Fate = Fate.UNDER_WAY
    begun: bool = False  #: the vehicle was made to do it
    automatic: bool = False  #: the library asked for it by itself
    withdrew: bool = False  #: it ended a take-off that had not left the ground
    reason: Refusal | None = None
    text: str = ""

    @property
    def over(self) -> bool:
        """Whether it ended; then no repeat acts."""
        return self.fate is not Fate.UNDER_WAY

    def end(self, fate: Fate, text: str = "", reason: Refusal | None = None) -> None:
        """End it, unless it is over already. ``text`` and ``reason``: what its repeats are answered with."""
        if self.fate is Fate.UNDER_WAY:
            silent = fate in _SILENT
            self.reason = None if silent else reason or Refusal.NOT_FRESH
            self.text = "" if silent else text or f"{ENDINGS[fate]}: send a new command"
            self.fate = fate  # last, as other threads read it

    def refuse(self, reason: Refusal, why: str) -> None:
        """End it because it was refused.

        A hover and a landing go on where only the driver failed or the link is lost, as nothing is safer; a reset does
        in any case, as the emergency may not be known yet. They are told to be refused until a repeat is carried out.
        """
        kind = type(self.action)
        self.reason, self.text = reason, why
        if not (kind is ResetEmergency or (kind in (Hover, Land) and reason in _PASSING)):
            self.end(Fate.REFUSED, why, reason)

    def observe(self, state: FlightState, now_ns: int, shown_ns: int | None = None) -> None:
        """End or complete it by what the vehicle does; ``shown_ns``: when that was so, None for now."""
        before = self.state
        if state is not FlightState.UNKNOWN:  # what was known before that still counts
            self.state = state
        if self.fate is not Fate.UNDER_WAY:
            return
        kind = type(self.action)
        if state is FlightState.LANDED:
            if kind is Land:
                # That it stood before it was asked for proves nothing: it may be in the air by now.
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
        """What feedback tells of it; ``name``: of the application, ``state``: the vehicle's in that feedback.

        Nothing of a take-off that has just come to be in the air: others may have taken the vehicle on its way up.
        """
        fate = self.fate  # first, as another thread may end it now
        if fate is Fate.UNDER_WAY and state in _UP and self.begun and type(self.action) is Takeoff:
            return Outcome()
        if not self.text:
            return Outcome(app_id, max(0, self.number), fate)
        text = shortened(f"{name}: {self.action.name} refused: {self.text}", MAX_OUTCOME_TEXT)
        return Outcome(app_id, self.number, fate, self.reason, text)


NO_INTENT: Final = Intent(-1, Idle(), 0, FlightState.UNKNOWN, Fate.COMPLETED)


class Intents:
    """What one connection asked for: its sequence numbers, and its newest intent."""

    __slots__ = ("_ended", "_floor", "_received", "newest", "seq")

    def __init__(self) -> None:
        self.seq = -1  #: of the newest command received
        self.newest = NO_INTENT
        self._received = 0  # the highest number, refused commands included
        self._floor = -1  # intents up to this one are from before something that ended them,
        self._ended = Fate.AUTHORITY  # which was this

    def check(self, command: Command, now_ns: int, max_age_ns: int, lease: int, holds: bool) -> Refusal | None:
        """Check sequence, age, lease and numbers, and remember the sequence.

        ``lease`` is the one in force (0 for none), ``holds`` whether the sender holds it. None: it is a sign of life.
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
        """Return the intent of a command that :meth:`check` let through, and whether it is newly asked for."""
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
        """Whether a landing where the vehicle is was asked for, and is under way."""
        return type(self.newest.action) is Land and not self.newest.over

    def stop(self, command: Command) -> None:
        """Take an emergency stop, which is carried out whatever its sequence: all that was asked for ends."""
        assert type(command.action) is EmergencyStop
        self.seq, self._received = max(self.seq, command.seq), max(self._received, command.intent)
        self.end(Fate.EMERGENCY)

    def end(self, fate: Fate, text: str = "", reason: Refusal | None = None) -> None:
        """End all that was received until now, also what has not passed the checks yet."""
        self.newest.end(fate, text, reason)
        self._floor, self._ended = self._received, fate


class StatePolicy(Enum):
    """What becomes of an action in a flight state."""

    APPLY = auto()
    HOLD = auto()  #: accepted, and nothing is done: it is so already, or a manoeuvre in progress goes on
    HOVER = auto()  #: a take-off of what flies already: hover
    REFUSE = auto()


def _row(**policies: StatePolicy) -> dict[FlightState, StatePolicy]:
    other = policies.pop("other")
    return {state: policies.get(state.value, other) for state in FlightState}


_APPLY, _HOLD, _HOVER, _REFUSE = StatePolicy.APPLY, StatePolicy.HOLD, StatePolicy.HOVER, StatePolicy.REFUSE
_SET_POINT: Final = _row(landed=_REFUSE, taking_off=_HOLD, landing=_HOLD, emergency=_REFUSE, other=_APPLY)

#: In a state that is not known everything is passed on: some vehicles never report it.
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
    """What becomes of a command that the first checks let through."""

    action: AnyAction | None = None  #: what the vehicle must do; None: nothing new. Of a refused one: instead of it
    refusal: Refusal | None = None
    why: str = ""  #: of the refusal, for a person
    takes_off: bool = False
    clamps: tuple[Clamp, ...] = ()  #: the limits that shortened it
    enforced: bool | None = None  #: whether the safety box and zones could be; None: there are none, or no set-point


class CommandChecks:
    """Decides what becomes of the commands for one vehicle.

    ``supported``: the actions that the vehicle or the software autopilot can do; ``native``: those that the vehicle
    itself takes; ``why_not``: why others are not, for people.
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
        self.way_back: ReturnFlight | None = None  #: the flight back to the start; None: it was not asked for
        self.max_age_ns = 0
        self._authority = authority
        self._ladder = ladder
        self._flight = flight
        self._supported = supported
        self._why_not = why_not
        #: What a person may ask of a vehicle that is not heard, which may hear us all the same: without it only the
        #: emergency stop would be left to bring it down.
        self._unheard = native & {Hover, Land}

    def receive(self, command: Command, intents: Intents, app_id: int, now_ns: int) -> Refusal | None:
        """Check sequence, age, lease and numbers. None: they passed, which keeps the holder's lease."""
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
        """Decide what the vehicle does of a command whose intent is under way. Not for an emergency stop or idle.

        ``new``: the application newly asked for it; else the library repeats it, or asks for it by itself
        (``automatic``).
        """
        now_ns, state, feedback, link, _ = seen
        kind = type(action)
        policy = STATE_POLICIES[kind][state]
        if new and kind is ReturnToStart:
            self.way_back = None
        if automatic and (state is FlightState.LANDING or self.goes_on(kind, seen, automatic=True)):
            policy = StatePolicy.HOLD  # it lands already, and no automatic hover breaks that off
        elif kind is Land and link is LinkState.LOST and policy is StatePolicy.HOLD:
            policy = StatePolicy.APPLY  # that it lands, or stands, was before: it may have heard something else since
        problem = self._problem(action, policy, seen, new=new, automatic=automatic)
        if problem is not None:
            return Decision(None, *problem)
        is_set_point = kind in SET_POINTS
        lands = policy is StatePolicy.HOLD and self._ladder.step is Failsafe.LAND
        if lands and is_set_point and not self.goes_on(kind, seen, automatic=automatic):
            policy = StatePolicy.HOVER  # the ladder's landing, not a pilot's: a pilot who is back breaks it off
        if policy is StatePolicy.REFUSE:
            return Decision(None, Refusal.WRONG_STATE, explain_state(action, state))
        if policy is StatePolicy.HOLD:
            if type(action) is Position and (why := self.airspace.objection(action, feedback, now_ns)):
                return Decision(None, Refusal.OUT_OF_RANGE, why)  # which would be too late after the take-off
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
            if verdict.action is None:  # what was flown before is not wanted any more either
                instead = _HOVER_ACTION if is_set_point and Hover in self._supported else None
                return Decision(instead, verdict.refusal, verdict.why)  # without a refusal: until it is known again
        else:
            verdict = Verdict(action)
        takes_off = kind is Takeoff and policy is StatePolicy.APPLY
        return Decision(verdict.action, None, "", takes_off, verdict.clamps, verdict.enforced)

    def goes_on(self, kind: type[Action], seen: Snapshot, *, automatic: bool) -> bool:
        """Whether what the ladder does goes on beside a command of the holder that is carried out, or ends with it."""
        ladder = self._ladder
        if automatic:
            return ladder.lands_on or ladder.step is Failsafe.LAND
        if kind is Land:
            return ladder.lands_on
        return kind is Hover and ladder.step is Failsafe.HOVER and not (ladder.given_up or seen.link_up)

    def _is_judged(self, action: AnyAction, state: FlightState) -> bool:
        """Whether it matters where the vehicle is: a hover only in its place, a take-off only on the ground."""
        if type(action) is Hover and self._flight.whose is not Whose.OTHERS:  # a descent takes it from nobody
            return Velocity in self._supported and state in (FlightState.HOVERING, FlightState.FLYING)
        return type(action) in SET_POINTS or (type(action) is Takeoff and state is FlightState.LANDED)

    def begin_return(self, action: ReturnToStart) -> None:
        """Begin a flight back to the start, in place of another one."""
        self.way_back = ReturnFlight(action, self.start.position, self.returns)

    def step_return(self, feedback: Feedback | None, now_ns: int) -> ReturnDecision:
        """Decide what the vehicle does now on its flight back to the start."""
        assert self.way_back is not None
        return self.way_back.step(self.airspace, feedback, now_ns)

    def why_no_return(self, feedback: Feedback | None, now_ns: int) -> str:
        """Return why the vehicle could not begin to return to its start now and land there; empty if it could."""
        flight = ReturnFlight(ReturnToStart(land=True), self.start.position, self.returns)
        decision = flight.step(self.airspace.apart(), feedback, now_ns)
        return decision.why if decision.action is None and decision.refusal is not None else ""

    def _problem(
        self, action: AnyAction, policy: StatePolicy, seen: Snapshot, *, new: bool, automatic: bool
    ) -> tuple[Refusal, str] | None:
        """What forbids a command of the holder, whatever the policy of the flight state is."""
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
                what = "what the library does by itself" if automatic else "a repeated command"
                return Refusal.WRONG_STATE, f"{others}, and {what} does not take it back: send a new one"
        if self._ladder.barred and kind is not Land:
            return Refusal.WRONG_STATE, f"only landing is possible: {REASONS[self._ladder.barred]}"
        by_itself = automatic and kind is not Land
        if self._ladder.step is Failsafe.LAND and self._ladder.lands_for_battery and (by_itself or kind in SET_POINTS):
            what = "returns to its start" if self._ladder.returning else "lands"
            return Refusal.WRONG_STATE, f"it {what}, because the battery is low: hover or land first to take it over"
        if self._ladder.battery_low and kind is Takeoff and state in _ON_THE_GROUND:
            why = "the battery is low, and it would return at once (battery.return): charge it"
            return Refusal.WRONG_STATE, f"{action.name} is not possible: {why}"
        if policy is StatePolicy.HOVER and Hover not in self._supported:
            return Refusal.UNSUPPORTED, f"{action.name} is not possible while {state.value}"
        return None


def explain(reason: Refusal, command: Command, newest_seq: int, *, now_ns: int, max_age_ns: int, lease: int) -> str:
    """Why a command was refused by :meth:`Intents.check`, and what would be right, in words for a person."""
    if reason is Refusal.OUT_OF_SEQUENCE:
        return f"number {command.seq} is not newer than {newest_seq}, the last one received"
    if reason is Refusal.STALE:
        age = seconds(now_ns - command.sent_ns)
        if age < 0:
            return f"it was sent {-age:.3f} s in the future, at most {seconds(MAX_AHEAD_NS):g} s are allowed"
        return f"it is {age:.3f} s old, at most {seconds(max_age_ns):g} s are allowed (command.max_age_s)"
    if reason is Refusal.FOREIGN_LEASE:
        force = f"lease {lease} is in force" if lease else "no lease is in force"
        return f"it was sent under lease {command.lease}, and {force}"
    if reason is Refusal.NO_AUTHORITY:
        return "the sender does not hold the authority: request it first"
    return f"{command.action.name} has a number that is NaN or infinite"


def explain_state(action: Action, state: FlightState) -> str:
    """Why an action is refused in a flight state."""
    if state is FlightState.EMERGENCY:
        return f"{action.name} is not possible in an emergency: reset it first"
    if isinstance(action, ResetEmergency):
        return f"there is no emergency to reset: the vehicle is {state.value}"
    return f"{action.name} is not possible while {state.value}: take off first"
