"""What an application asked for, from its beginning to its one end. Pure: the time is an argument.

The library repeats each command many times a second. A repeat asks the intent: it is judged again while the intent is
under way, and never acts once it is over. :data:`skyloop.messages.command.ENDINGS` lists all that ends one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from skyloop.clock import nanoseconds
from skyloop.errors import shortened
from skyloop.messages import (
    AnyAction,
    Command,
    EmergencyStop,
    Fate,
    FlightState,
    Hover,
    Idle,
    Land,
    Outcome,
    Refusal,
    ResetEmergency,
    ReturnToStart,
    Takeoff,
)
from skyloop.messages.command import ENDINGS, MAX_OUTCOME_TEXT

MAX_AHEAD_NS: Final = nanoseconds(0.05)  #: how far ahead a command's time may lie: the error of the clocks' offset
TAKEOFF_NS: Final = nanoseconds(20.0)  #: a take-off that has not left the ground by then ends
#: A landing that withdrew a take-off is done when the vehicle stood for so long: an arming may have been on its way.
SETTLED_NS: Final = nanoseconds(1.0)
_UP: Final = (FlightState.HOVERING, FlightState.FLYING)
_SILENT: Final = (Fate.COMPLETED, Fate.WITHDRAWN)  #: nobody needs to be told that repeats of it do nothing
_LANDINGS: Final = (Land, ReturnToStart)
_PASSING: Final = (Refusal.DRIVER_FAILED, Refusal.VEHICLE_LINK_LOST)  #: what may be different with the next repeat


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

    def outcome(self, app_id: int, name: str) -> Outcome:
        """What feedback tells of it; ``name``: of the application."""
        fate = self.fate  # first, as another thread may end it now
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

    def receive(self, command: Command, state: FlightState, now_ns: int) -> tuple[Intent, bool]:
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
