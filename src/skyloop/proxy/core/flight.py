"""One flight: whether the vehicle flies, whose flight that is, and how sure both are. Pure: the time is an argument.

The proxy steers only for an application's own, new intent, or to end a flight that it began itself. What others arm,
fly, switch or land is observed, reported, and left alone. A flight is over when the vehicle shows it, and not by time
alone. The rules in words are in ``docs/proxy.md``.
"""

from __future__ import annotations

import math
from enum import Enum, auto
from typing import Final, NamedTuple

from skyloop.clock import NS_PER_S, nanoseconds
from skyloop.messages import (
    Action,
    Attitude,
    EmergencyStop,
    Feedback,
    FlightState,
    Hover,
    LinkState,
    Position,
    Takeoff,
    Velocity,
)

#: A take-off that was asked for so long ago and does not show is none of ours any more: drivers give one up sooner.
CLAIM_NS: Final = nanoseconds(15.0)
#: One that was called off shows within this time if the vehicle rises all the same.
CALLED_OFF_NS: Final = nanoseconds(3.0)
#: A flight is over when the vehicle stood for so long: one that bounces, or reports so for a moment, still flies.
STANDING_NS: Final = nanoseconds(1.0)
#: How long it is believed without being observed that a flight is this proxy's: then it may be another one.
BELIEF_NS: Final = nanoseconds(60.0)
STALE_NS: Final = NS_PER_S // 2  #: older feedback shows nothing
AIRBORNE_ALTITUDE: Final = 0.3  #: a vehicle first seen above it that reports no state is taken to be flying [m]
STALL_ALTITUDE: Final = 0.5  #: below it a descent that makes no headway has met the ground [m]
STALL_NS: Final = NS_PER_S
STALL_HEADWAY: Final = 0.02  #: [m]
BLIND_NS: Final = 15 * NS_PER_S  #: of a landing that nothing shows, nobody can say by then what became of it

_GROUNDED: Final = (FlightState.LANDED, FlightState.EMERGENCY)
_AIRBORNE: Final = frozenset(state for state in FlightState if state.airborne)
_MANOEUVRES: Final = (FlightState.TAKING_OFF, FlightState.LANDING)
_FLYING: Final = (Takeoff, Hover, Attitude, Velocity, Position)


class Whose(Enum):
    """Who began the flight, or steers since."""

    NOBODYS = auto()  #: the vehicle does not fly, as far as is known
    OURS = auto()  #: an application of this proxy does, or this proxy ends what one began
    OTHERS = auto()  #: somebody else does: a remote control, a ground station, another program


class Changed(NamedTuple):
    """The flight is somebody else's now. ``why``: to be published, empty where it is already."""

    whose: Whose
    why: str = ""


class Snapshot(NamedTuple):
    """What is known of the vehicle where something is decided: read once, and passed on."""

    now_ns: int
    state: FlightState
    feedback: Feedback | None  #: the newest sample; None: none came yet
    link: LinkState
    link_up: bool


class Flight:
    """What is known of one vehicle's flight.

    :meth:`state` and :meth:`flies` take no lock and change nothing: any thread may ask. All else is called under the
    command handler's lock.

    Args:
        native: The actions that the vehicle itself takes. One that is steered from here and takes neither take-off nor
            landing has no notion of a flight: what it is told to do, and what it shows, is its flight state.
        shared: Whether somebody else may fly it besides; else a flight is never others'.
    """

    def __init__(self, native: frozenset[str] = frozenset(), *, shared: bool = True) -> None:
        self._shared = shared
        self._has_no_notion = bool(native & {"attitude", "velocity"}) and not native & {"takeoff", "land"}
        self.whose = Whose.NOBODYS
        self.left_to = ""  #: what others made of it, in the driver's word
        self._believed_until_ns: int | None = None  # what is found in the air until then was begun by an earlier run
        self._claimed_until_ns: int | None = None  # a take-off was asked for, and shows until then
        self._grounded_ns: int | None = None  # since when it stands
        self._steered = False  # in software, at what :attr:`_state` says
        self._state = FlightState.LANDED  # of a vehicle without a notion, or of what is steered
        self._begun_ns = 0  # when what is steered began
        self._was_up = False  # the vehicle reported to be in the air since it is steered
        self._landed_ns: int | None = None  # since when it reports to stand meanwhile
        self._seen = False  # an altitude was
        self._lowest, self._lowest_ns = math.inf, 0
        self._blind_ns: int | None = None  # since when a landing goes by nothing
        self._sent_up = False  # the newest action is one of the air
        self._seen_up = False  # it was seen in the air, and not on the ground since

    # Does it fly? ------------------------------------------------------------------------------------------------

    def state(self, reported: FlightState) -> FlightState:
        """Return the flight state, given the one that the driver reported. Any thread."""
        state = self._state
        if reported is FlightState.EMERGENCY:
            return reported
        if self._steered:
            if state is FlightState.LANDING and reported is FlightState.LANDED and not self._has_no_notion:
                return reported
            if self._has_no_notion or state in _MANOEUVRES:
                return state
            return state if reported is FlightState.FLYING and state is FlightState.HOVERING else reported
        if not self._has_no_notion or (reported in _AIRBORNE and state not in _AIRBORNE):
            return reported
        return state

    def flies(self, state: FlightState) -> bool:
        """Return whether it flies, or may, in a state of :meth:`state`. Any thread.

        A vehicle of which nothing is known flies if it was seen to, or from the first command to do so.
        """
        return state in _AIRBORNE or (state is FlightState.UNKNOWN and (self._seen_up or self._sent_up))

    def may_begin(self, now_ns: int) -> bool:
        """Return whether a take-off was asked for that does not show yet: what stands may be about to fly."""
        return self._claimed_until_ns is not None and now_ns < self._claimed_until_ns

    # Whose is it? ------------------------------------------------------------------------------------------------

    @property
    def ours(self) -> bool:
        """Whether the proxy may hold, land or stop the vehicle by itself."""
        return self.whose is Whose.OURS

    @property
    def others(self) -> str:
        """Why the vehicle is left alone, for a person; empty where it is not somebody else's."""
        if self.whose is not Whose.OTHERS:
            return ""
        if self.left_to:
            return f"the vehicle is in {self.left_to}, which was not chosen here"
        return "the vehicle is flown by others"

    @property
    def awaited(self) -> bool:
        """Whether a flight that an earlier run began is still looked for."""
        return self._believed_until_ns is not None

    def began_before(self, until_ns: int) -> None:
        """Take a vehicle that is found in the air until then to be on a flight that an earlier run began."""
        self._believed_until_ns = until_ns

    def claim(self, now_ns: int) -> None:
        """Note that a take-off is asked for: the flight that comes of it is ours."""
        self._claimed_until_ns = now_ns + CLAIM_NS
        if self.whose is Whose.NOBODYS:
            self.whose = Whose.OURS

    def call_off(self, now_ns: int) -> None:
        """Note that a take-off which does not show yet is called off."""
        if self._claimed_until_ns is not None:
            self._claimed_until_ns = min(self._claimed_until_ns, now_ns + CALLED_OFF_NS)

    def take(self) -> None:
        """Note that an application's new intent was carried out: whatever flies is ours from here on."""
        self.whose, self.left_to = Whose.OURS, ""

    def forget(self) -> bool:
        """Note that what is found in the air from now on may be another flight; return whether it may."""
        if self.ours and self._shared:
            self.whose = Whose.NOBODYS
        return self._shared

    def slept(self, ns: int) -> None:
        """Note that the computer slept for so long, which its clock does not count: it may be another flight by now."""
        if self._believed_until_ns is not None:
            self._believed_until_ns -= ns
        if self._claimed_until_ns is not None:
            self._claimed_until_ns -= ns
        if ns >= BELIEF_NS:
            self.forget()

    def observe(
        self, reported: FlightState, left_to: str, now_ns: int, feedback: Feedback | None = None
    ) -> Changed | None:
        """Observe the vehicle.

        ``left_to``: what others chose since we steered last, as the driver observes it. ``feedback``: the newest
        sample, where the link is up and it is young; None: nothing is shown now.
        """
        if self._has_no_notion and not self._steered and feedback is not None:
            self._look(reported, left_to, feedback.altitude_m)
        state, before = self.state(reported), self.whose
        flies = self.flies(state)
        if self._believed_until_ns is not None and now_ns >= self._believed_until_ns:
            self._believed_until_ns = None
        if state in _GROUNDED:
            self._stands(now_ns)
        else:
            self._grounded_ns = None
            if state in _AIRBORNE:
                self._seen_up = True
            if flies:
                self._claimed_until_ns = None  # the take-off shows
            if left_to:
                self.whose, self.left_to = Whose.OTHERS, left_to
            elif flies and self.whose is Whose.NOBODYS:
                self.whose = Whose.OURS if self.awaited or not self._shared else Whose.OTHERS
            if flies:
                self._believed_until_ns = None
        return None if self.whose is before else Changed(self.whose, self._words(before))

    def _look(self, reported: FlightState, left_to: str, altitude: float | None) -> None:
        """What a vehicle without a notion shows while nothing is steered."""
        begins_high = not self._seen and (altitude or 0.0) > AIRBORNE_ALTITUDE
        if reported is FlightState.LANDED:
            if not left_to and self._state is not FlightState.EMERGENCY:  # else a pilot flies it, past its driver
                self._state = FlightState.LANDED
        elif reported is FlightState.UNKNOWN and begins_high and self._state is FlightState.LANDED:
            self._state = FlightState.FLYING  # the proxy may have been restarted under it
        self._seen = self._seen or altitude is not None

    def _stands(self, now_ns: int) -> None:
        if self._grounded_ns is None:
            self._grounded_ns = now_ns
        standing = now_ns - self._grounded_ns >= STANDING_NS
        if standing:
            self._believed_until_ns = None
        if not self.may_begin(now_ns) and (standing or not self.ours):
            self.whose, self.left_to, self._claimed_until_ns = Whose.NOBODYS, "", None
            self._seen_up = self._sent_up = False

    def _words(self, before: Whose) -> str:
        if before is not Whose.NOBODYS or self.left_to or not self._shared:
            return ""  # the driver reported who took it, or the flight is over, or it can't be anybody else's
        if self.whose is Whose.OURS:
            return "the vehicle is on a flight that this proxy began before it was restarted"
        return "the vehicle is flown by others: it is left alone until an application takes off, hovers or lands it"

    # What it is told to do ---------------------------------------------------------------------------------------

    def sent(self, action: Action) -> None:
        """Note what was applied."""
        self._sent_up = isinstance(action, _FLYING)
        if isinstance(action, EmergencyStop):
            self._seen_up = False

    def steer(self, state: FlightState, now_ns: int) -> None:
        """Note that the software autopilot begins with what is this state."""
        if not self._steered:
            self._was_up, self._landed_ns = False, None
        self._steered, self._state, self._begun_ns = True, state, now_ns
        self._start_descent(now_ns)

    def let_go(self, action_name: str) -> None:
        """Note that the vehicle itself does something now."""
        self._steered = False
        if action_name == "emergency_stop":
            self._state = FlightState.EMERGENCY
        elif action_name == "reset_emergency":
            self._state = FlightState.LANDED
        elif self._state not in _GROUNDED:
            self._state = FlightState.HOVERING if action_name == "hover" else FlightState.FLYING

    def refused(self, reported: FlightState) -> bool:
        """Note that the vehicle refused what it was sent; return whether that ends a take-off from where it stands."""
        if not (self._steered and self._state is FlightState.TAKING_OFF and reported is FlightState.LANDED):
            return False
        self._steered, self._state = False, FlightState.LANDED
        return True

    def lifted(self, reported: FlightState) -> bool:
        """Return whether it has left the ground in a take-off, or does not report that."""
        return not self._has_no_notion or self._was_up or reported is not FlightState.LANDED

    def has_ended(self, reported: FlightState, now_ns: int, feedback: Feedback | None) -> bool:
        """Return whether what is steered has come to its end on the ground; it is steered no longer then.

        What the vehicle reports counts where it reports anything. Else a descent has met the ground where the
        altimeter, near it, shows no headway. A landing without either goes on for :data:`BLIND_NS`, and nothing is
        known then. ``feedback``: as in :meth:`observe`.
        """
        landing = self._state is FlightState.LANDING
        if feedback is None:
            self._start_descent(now_ns)
            return False
        if reported is FlightState.LANDED:
            self._landed_ns = now_ns if self._landed_ns is None else self._landed_ns
            # It may be about to rise: what it reported before it was told to do this proves nothing.
            since_ns = self._begun_ns if self._state in _MANOEUVRES else self._landed_ns
            patience_ns = CLAIM_NS if self._state is FlightState.TAKING_OFF else STANDING_NS
            ended = now_ns - since_ns >= (0 if self._was_up else patience_ns)
            ended = ended if self._has_no_notion else landing
        else:
            self._landed_ns = None
            self._was_up = self._was_up or reported.airborne
            ended = landing and not reported.airborne and self._is_down(feedback.altitude_m, now_ns)
        if ended:
            self._steered, self._state = False, FlightState.LANDED
        elif landing and self._blind_ns is not None and now_ns - self._blind_ns >= BLIND_NS:
            self._steered, self._state = False, FlightState.UNKNOWN
            return True
        return ended

    def _is_down(self, altitude: float | None, now_ns: int) -> bool:
        if altitude is None:
            self._blind_ns = now_ns if self._blind_ns is None else self._blind_ns
            return False
        self._blind_ns = None
        if altitude < self._lowest - STALL_HEADWAY:
            self._lowest, self._lowest_ns = altitude, now_ns
        return altitude < STALL_ALTITUDE and now_ns - self._lowest_ns >= STALL_NS

    def _start_descent(self, now_ns: int) -> None:
        self._lowest, self._lowest_ns, self._blind_ns = math.inf, now_ns, None
