"""The checks that a command passes before it reaches the vehicle. Pure: the time is an argument.

In this order: sequence, age, lease, finite numbers (these four, :meth:`CommandChecks.receive`, decide whether it is a
sign of life of the holder), then whether its intent is under way (:mod:`skyloop.proxy.core.intents`), the vehicle's
link, support, whose the flight is, the flight state, limits, safety box and zones (:meth:`CommandChecks.decide`). The
rules in words are in ``docs/proxy.md``.
"""

from __future__ import annotations

from enum import Enum, auto
from typing import Final, NamedTuple

from skyloop.clock import seconds
from skyloop.messages import (
    Action,
    AnyAction,
    Attitude,
    Command,
    Failsafe,
    Feedback,
    FlightState,
    Hover,
    Idle,
    Land,
    LinkState,
    Position,
    Refusal,
    ResetEmergency,
    ReturnToStart,
    Takeoff,
    Velocity,
)
from skyloop.messages.command import SET_POINTS
from skyloop.proxy.core.airspace import Airspace, Verdict
from skyloop.proxy.core.authority import Authority
from skyloop.proxy.core.failsafe import REASONS, FailsafeLadder
from skyloop.proxy.core.flight import Flight, Whose
from skyloop.proxy.core.intents import MAX_AHEAD_NS, Intent, Intents
from skyloop.proxy.core.returning import ReturnDecision, ReturnFlight, StartPoint
from skyloop.proxy.core.settings import Clamp, ReturnSettings

_HOVER_ACTION: Final = Hover()
_ON_THE_GROUND: Final = (FlightState.LANDED, FlightState.UNKNOWN)
_TAKING: Final = (Takeoff, Hover, Land)  #: newly asked for, they take a vehicle that others fly


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

    Args:
        authority: who holds the lease; :meth:`receive` notes when its holder's last command came.
        ladder: the failsafe ladder.
        flight: whose it is.
        supported: the actions that the vehicle or the software autopilot can do.
        why_not: why others are not supported, for people; may be empty.
        native: those that the vehicle itself takes.
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
        self.back: ReturnFlight | None = None  #: the flight back to the start; None: it was not asked for
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

    def explain(self, refusal: Refusal, command: Command, intents: Intents, now_ns: int) -> str:
        """Return why :meth:`receive` refused a command, for a person."""
        lease = self._authority.lease
        return explain(refusal, command, intents.seq, now_ns=now_ns, max_age_ns=self.max_age_ns, lease=lease)

    def decide(
        self,
        action: AnyAction,
        intent: Intent,
        state: FlightState,
        link: LinkState,
        feedback: Feedback | None,
        now_ns: int,
        *,
        new: bool,
        automatic: bool = False,
    ) -> Decision:
        """Decide what the vehicle does of a command whose intent is under way. Not for an emergency stop.

        Args:
            action: any action but :class:`Idle` and :class:`EmergencyStop`.
            intent: what it is asked for, or repeated, by.
            state: the flight state now.
            link: the state of the link to the vehicle.
            feedback: the newest sample, for altitude and position; None: none came yet.
            now_ns: the time now, on the proxy's clock [ns].
            new: whether the application newly asked for it; else the library repeats it, or asks for it by itself.
            automatic: whether the library asks for it by itself.
        """
        kind = type(action)
        policy = STATE_POLICIES[kind][state]
        if new and kind is ReturnToStart:
            self.back = None
        if automatic and (state is FlightState.LANDING or self._ladder.lands_on or self._ladder.step is Failsafe.LAND):
            policy = StatePolicy.HOLD  # it lands already, and no automatic hover breaks that off
        elif kind is Land and link is LinkState.LOST and policy is StatePolicy.HOLD:
            policy = StatePolicy.APPLY  # that it lands, or stands, was before: it may have heard something else since
        problem = self._problem(action, policy, state, link, new=new, automatic=automatic)
        if problem is not None:
            return Decision(None, *problem)
        is_set_point = kind in SET_POINTS
        if policy is StatePolicy.HOLD and is_set_point and self._ladder.step is Failsafe.LAND and not automatic:
            policy = StatePolicy.HOVER  # the ladder's landing, not a pilot's: a pilot who is back breaks it off
        if policy is StatePolicy.REFUSE:
            return Decision(None, Refusal.WRONG_STATE, explain_state(action, state))
        if policy is StatePolicy.HOLD:
            if type(action) is Position and (why := self.airspace.objection(action, feedback, now_ns)):
                return Decision(None, Refusal.OUT_OF_RANGE, why)  # which would be too late after the take-off
            return Decision()
        if type(action) is ReturnToStart and policy is not StatePolicy.HOVER:
            if self.back is None:
                self.begin_return(action)
            back = self.step_return(feedback, now_ns)
            if back.action is None:
                return Decision(_HOVER_ACTION, back.refusal, back.why)
            return Decision(back.action, clamps=back.clamps, enforced=back.enforced)
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

    def _is_judged(self, action: AnyAction, state: FlightState) -> bool:
        """Whether it matters where the vehicle is: a hover only in its place, a take-off only on the ground."""
        if type(action) is Hover:
            return Velocity in self._supported and state in (FlightState.HOVERING, FlightState.FLYING)
        return type(action) in SET_POINTS or (type(action) is Takeoff and state is FlightState.LANDED)

    def begin_return(self, action: ReturnToStart) -> None:
        """Begin a flight back to the start, in place of another one."""
        self.back = ReturnFlight(action, self.start.position, self.returns)

    def step_return(self, feedback: Feedback | None, now_ns: int) -> ReturnDecision:
        """Decide what the vehicle does now on its flight back to the start."""
        assert self.back is not None
        return self.back.step(self.airspace, feedback, now_ns)

    def why_no_return(self, feedback: Feedback | None, now_ns: int) -> str:
        """Return why the vehicle could not begin to return to its start now and land there; empty if it could."""
        flight = ReturnFlight(ReturnToStart(land=True), self.start.position, self.returns)
        decision = flight.step(self.airspace.apart(), feedback, now_ns)
        return decision.why if decision.action is None and decision.refusal is not None else ""

    def _problem(
        self,
        action: AnyAction,
        policy: StatePolicy,
        state: FlightState,
        link: LinkState,
        *,
        new: bool,
        automatic: bool,
    ) -> tuple[Refusal, str] | None:
        """What forbids a command of the holder, whatever the policy of the flight state is."""
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
        if self._ladder.lands_for_battery and (kind in SET_POINTS or (automatic and kind is not Land)):
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
