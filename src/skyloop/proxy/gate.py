"""The checks that a command passes before it reaches the vehicle. Pure: the time is an argument.

In this order: sequence, age, lease, finite numbers (these four say whether the holder was *heard*), then freshness,
the vehicle's link, support, and the flight state. The rules in words are in ``docs/proxy.md``.
"""

from __future__ import annotations

from enum import Enum, auto
from typing import Final

from skyloop.clock import nanoseconds, seconds
from skyloop.messages import (
    Action,
    Attitude,
    Command,
    FlightState,
    Hover,
    Idle,
    Land,
    Refusal,
    ResetEmergency,
    Takeoff,
    Velocity,
)

MAX_AHEAD_S: Final = 0.05  #: how far in the future a command's time may lie: the error of the clocks' offset
_MAX_AHEAD_NS: Final = nanoseconds(MAX_AHEAD_S)


class Track:
    """What is remembered of one connection's commands."""

    __slots__ = ("floor", "intent", "seq")

    def __init__(self) -> None:
        self.seq = -1  #: of the newest command received
        self.intent = 0  #: highest received, refused commands included
        self.floor = -1  #: intents up to this one are from before something that ended them

    def receive(self, command: Command, now_ns: int, max_age_ns: int, lease: int, holds: bool) -> Refusal | None:
        """Check sequence, age, lease and numbers, and remember the sequence and the intent.

        ``lease`` is the one in force (0 for none), ``holds`` whether the sender holds it. None: the holder was heard.
        """
        if command.seq <= self.seq:
            return Refusal.OUT_OF_SEQUENCE
        self.seq = command.seq
        if command.intent > self.intent:
            self.intent = command.intent
        if not -_MAX_AHEAD_NS <= now_ns - command.sent_ns <= max_age_ns:
            return Refusal.STALE
        if command.lease != lease or not holds:
            named_one = command.lease not in (0, lease)
            return Refusal.FOREIGN_LEASE if named_one else Refusal.NO_AUTHORITY
        if not command.action.finite:
            return Refusal.NON_FINITE
        return None

    def fresh(self, command: Command) -> bool:
        """Whether the application asked for it after the last thing that ended older intents."""
        return command.intent > self.floor

    def end_intents(self) -> None:
        """Only what the application asks for from now on counts: a repeat of anything older is not fresh."""
        self.floor = self.intent


class Plan(Enum):
    """What to do with an action in a flight state."""

    APPLY = auto()
    HOLD = auto()  #: accepted, and nothing is done: it is so already, or a manoeuvre in progress goes on
    HOVER = auto()  #: a take-off of what flies already: hover
    REFUSE = auto()


def _row(**plans: Plan) -> dict[FlightState, Plan]:
    other = plans.pop("other")
    return {state: plans.get(state.value, other) for state in FlightState}


_APPLY, _HOLD, _HOVER, _REFUSE = Plan.APPLY, Plan.HOLD, Plan.HOVER, Plan.REFUSE
_SET_POINT: Final = _row(landed=_REFUSE, taking_off=_HOLD, landing=_HOLD, emergency=_REFUSE, other=_APPLY)

#: In a state that is not known everything is passed on: some vehicles never tell.
PLANS: Final[dict[type[Action], dict[FlightState, Plan]]] = {
    Idle: _row(other=_HOLD),
    Takeoff: _row(landed=_APPLY, unknown=_APPLY, taking_off=_HOLD, emergency=_REFUSE, other=_HOVER),
    Hover: _row(landed=_HOLD, emergency=_REFUSE, other=_APPLY),
    Land: _row(landed=_HOLD, landing=_HOLD, emergency=_REFUSE, other=_APPLY),
    ResetEmergency: _row(emergency=_APPLY, unknown=_APPLY, other=_REFUSE),
    Attitude: _SET_POINT,
    Velocity: _SET_POINT,
}


def explain(reason: Refusal, command: Command, track: Track, *, now_ns: int, max_age_ns: int, lease: int) -> str:
    """Why a command was refused by :meth:`Track.receive`, and what would be right, in words for a person."""
    if reason is Refusal.OUT_OF_SEQUENCE:
        return f"number {command.seq} is not newer than {track.seq}, the last one received"
    if reason is Refusal.STALE:
        age = seconds(now_ns - command.sent_ns)
        if age < 0:
            return f"it was sent {-age:.3f} s in the future, at most {MAX_AHEAD_S:g} s are allowed"
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
