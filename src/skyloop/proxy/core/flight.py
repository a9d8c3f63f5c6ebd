"""Track one flight: whether the vehicle flies, whose flight it is, and how certain that is. Pure: time is an argument.

The proxy steers only for a new intent of an application, or to end a flight that the proxy itself started. Arming,
flying, mode changes and landings by others are observed, reported, and left alone. A flight is over when the vehicle
reports that it is, never just because time has passed. ``docs/proxy.md`` describes the rules.
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

#: If a requested take-off has no visible effect after this time, no flight is attributed to it. Drivers give up sooner.
CLAIM_NS: Final = nanoseconds(15.0)
#: If the vehicle takes off although the take-off was cancelled, it does so within this time.
CALLED_OFF_NS: Final = nanoseconds(3.0)
#: A flight is over after this time on the ground. Shorter bounces and brief false reports therefore don't end a flight.
STANDING_NS: Final = nanoseconds(1.0)
#: How long a flight that can't be observed still counts as this proxy's. After that, it may be a different flight.
BELIEF_NS: Final = nanoseconds(60.0)
STALE_NS: Final = NS_PER_S // 2  #: age from which feedback is ignored
AIRBORNE_ALTITUDE: Final = 0.3  #: a vehicle that reports no state counts as flying if first seen above this height [m]
STALL_ALTITUDE: Final = 0.5  #: below this altitude, a descent without progress has reached the ground [m]
STALL_NS: Final = NS_PER_S  #: time without progress after which a descent has stalled
STALL_HEADWAY: Final = 0.02  #: smallest decrease in altitude that counts as progress [m]
BLIND_NS: Final = 15 * NS_PER_S  #: after this time, the result of a landing without sensor data is unknown

_GROUNDED: Final = (FlightState.LANDED, FlightState.EMERGENCY)
_AIRBORNE: Final = frozenset(state for state in FlightState if state.airborne)
_MANOEUVRES: Final = (FlightState.TAKING_OFF, FlightState.LANDING)
_FLYING: Final = (Takeoff, Hover, Attitude, Velocity, Position)


class Whose(Enum):
    """Who started the flight, or has taken it over."""

    NOBODYS = auto()  #: as far as is known, the vehicle is not flying
    OURS = auto()  #: an application of this proxy, or the proxy itself while it ends that application's flight
    OTHERS = auto()  #: a remote control, a ground station or another program


class Changed(NamedTuple):
    """The flight has changed hands. ``why`` is the text to publish; it is empty if the change was already published."""

    whose: Whose
    why: str = ""


class Snapshot(NamedTuple):
    """The known state of the vehicle for one decision. The snapshot is read once and passed on."""

    now_ns: int
    state: FlightState
    feedback: Feedback | None  #: the newest sample; None if there is none yet
    link: LinkState
    link_up: bool


class Flight:
    """The known state of one vehicle's flight. If the flight is ``shared``, others may fly the vehicle as well.

    :meth:`state` and :meth:`flies` acquire no lock and change nothing, so any thread may call them. Everything else is
    called under the command handler's lock. A vehicle steered in software without ``native`` take-off and landing has
    no concept of a flight: its flight state is derived from commands and observations.
    """

    def __init__(self, native: frozenset[str] = frozenset(), *, shared: bool = True) -> None:
        self._shared = shared
        self._has_no_notion = bool(native & {"attitude", "velocity"}) and not native & {"takeoff", "land"}
        self.whose = Whose.NOBODYS
        self.left_to = ""  #: what others made the vehicle do, as the driver reports it
        self._believed_until_ns: int | None = None  # until then, a flight that is found counts as an earlier run's
        self._claimed_until_ns: int | None = None  # deadline for a requested take-off to have a visible effect
        self._grounded_ns: int | None = None  # start of the current period of time on the ground
        self._steered = False  # whether the vehicle is steered in software, with the task in :attr:`_state`
        self._state = FlightState.LANDED  # the steered task, or the state of a vehicle without a concept of flight
        self._begun_ns = 0  # time at which the steered task began
        self._was_up = False  # whether the vehicle has reported being in the air while it was steered
        self._landed_ns: int | None = None  # time at which the vehicle first reported being landed while steered
        self._seen = False  # whether an altitude has been received
        self._lowest, self._lowest_ns = math.inf, 0
        self._blind_ns: int | None = None  # time at which a landing lost its sensor data
        self._sent_up = False  # whether the newest action makes the vehicle fly
        self._seen_up = False  # whether the vehicle has been seen in the air and, since then, not on the ground

    # Whether it flies -------------------------------------------------------------------------------------------

    def state(self, reported: FlightState) -> FlightState:
        """Return the flight state, given the state reported by the driver. Thread-safe."""
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
        """Return whether the vehicle flies, or may be flying, in a state returned by :meth:`state`. Thread-safe.

        In an unknown state, the vehicle counts as flying if it was seen flying or has been commanded to fly.
        """
        return state in _AIRBORNE or (state is FlightState.UNKNOWN and (self._seen_up or self._sent_up))

    def may_begin(self, now_ns: int) -> bool:
        """Return whether a take-off has had no visible effect yet. A vehicle on the ground may then be about to fly."""
        return self._claimed_until_ns is not None and now_ns < self._claimed_until_ns

    # Whose flight it is ------------------------------------------------------------------------------------------

    @property
    def ours(self) -> bool:
        """Whether the proxy may make the vehicle hover, land or stop on its own initiative."""
        return self.whose is Whose.OURS

    @property
    def others(self) -> str:
        """Readable reason why the vehicle is left alone; empty if no one else is flying it."""
        if self.whose is not Whose.OTHERS:
            return ""
        if self.left_to:
            return f"the vehicle is in {self.left_to}, which was not chosen here"
        return "the vehicle is flown by others"

    @property
    def awaited(self) -> bool:
        """Whether a flight from an earlier run may still be discovered."""
        return self._believed_until_ns is not None

    def began_before(self, until_ns: int) -> None:
        """Assume that a vehicle found in the air before this time is on a flight from an earlier run."""
        self._believed_until_ns = until_ns

    def claim(self, now_ns: int) -> None:
        """Record that a take-off was requested, so that the resulting flight counts as the proxy's."""
        self._claimed_until_ns = now_ns + CLAIM_NS
        if self.whose is Whose.NOBODYS:
            self.whose = Whose.OURS

    def call_off(self, now_ns: int) -> None:
        """Record that a take-off was cancelled before it had a visible effect."""
        if self._claimed_until_ns is not None:
            self._claimed_until_ns = min(self._claimed_until_ns, now_ns + CALLED_OFF_NS)

    def take(self) -> None:
        """Record that an application's new intent was executed. From now on, the flight belongs to the proxy."""
        self.whose, self.left_to = Whose.OURS, ""

    def forget(self) -> bool:
        """Assume from now on that the vehicle may be on someone else's flight; return whether others can fly it."""
        if self.ours and self._shared:
            self.whose = Whose.NOBODYS
        return self._shared

    def slept(self, ns: int) -> None:
        """Allow for the time that the computer slept without its clock running: a different flight may be under way."""
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

        ``left_to``: what others have made the vehicle do since the proxy last steered it, according to the driver.
        ``feedback``: the newest sample, if it is fresh and the link is up; otherwise None.
        """
        if self._has_no_notion and not self._steered and feedback is not None:
            self._observe_unsteered(reported, left_to, feedback.altitude_m)
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
                self._claimed_until_ns = None  # the take-off is visible
            if left_to:
                self.whose, self.left_to = Whose.OTHERS, left_to
            elif flies and self.whose is Whose.NOBODYS:
                self.whose = Whose.OURS if self.awaited or not self._shared else Whose.OTHERS
            if flies:
                self._believed_until_ns = None
        return None if self.whose is before else Changed(self.whose, self._change_text(before))

    def _observe_unsteered(self, reported: FlightState, left_to: str, altitude: float | None) -> None:
        """Observe a vehicle without a concept of flight while it is not being steered."""
        begins_high = not self._seen and (altitude or 0.0) > AIRBORNE_ALTITUDE
        if reported is FlightState.LANDED:
            if not left_to and self._state is not FlightState.EMERGENCY:  # otherwise a pilot bypasses the driver
                self._state = FlightState.LANDED
        elif reported is FlightState.UNKNOWN and begins_high and self._state is FlightState.LANDED:
            self._state = FlightState.FLYING  # the proxy may have restarted during the flight
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

    def _change_text(self, before: Whose) -> str:
        if before is not Whose.NOBODYS or self.left_to or not self._shared:
            return ""  # the driver has reported who took over, the flight has ended, or no one else can fly the vehicle
        if self.whose is Whose.OURS:
            return "the vehicle is on a flight that this proxy started before its restart"
        return "the vehicle is flown by others: it is left alone until an application takes off, hovers or lands it"

    # Commands ------------------------------------------------------------------------------------------------------

    def sent(self, action: Action) -> None:
        """Record the action that was applied."""
        self._sent_up = isinstance(action, _FLYING)
        if isinstance(action, EmergencyStop):
            self._seen_up = False

    def steer(self, state: FlightState, now_ns: int) -> None:
        """Record that the software autopilot is starting the task that this state stands for."""
        if not self._steered:
            self._was_up, self._landed_ns = False, None
        self._steered, self._state, self._begun_ns = True, state, now_ns
        self._start_descent(now_ns)

    def let_go(self, action_name: str) -> None:
        """Record that the vehicle itself is now executing an action."""
        self._steered = False
        if action_name == "emergency_stop":
            self._state = FlightState.EMERGENCY
        elif action_name == "reset_emergency":
            self._state = FlightState.LANDED
        elif self._state not in _GROUNDED:
            self._state = FlightState.HOVERING if action_name == "hover" else FlightState.FLYING

    def refused(self, reported: FlightState) -> bool:
        """Handle a refusal by the vehicle. Return whether the refusal ends a take-off from the ground."""
        if not (self._steered and self._state is FlightState.TAKING_OFF and reported is FlightState.LANDED):
            return False
        self._steered, self._state = False, FlightState.LANDED
        return True

    def lifted(self, reported: FlightState) -> bool:
        """Return whether the vehicle has left the ground in a take-off, or never reports that it has."""
        return not self._has_no_notion or self._was_up or reported is not FlightState.LANDED

    def has_ended(self, reported: FlightState, now_ns: int, feedback: Feedback | None) -> bool:
        """Return whether the steered task has ended on the ground, in which case the vehicle is no longer steered.

        If the vehicle reports its state, that report takes precedence. Otherwise, a descent has reached the ground when
        the altimeter reads a low altitude and shows no progress. A landing with neither report nor altimeter continues
        for :data:`BLIND_NS`, and its result is unknown. ``feedback``: as in :meth:`observe`.
        """
        landing = self._state is FlightState.LANDING
        if feedback is None:
            self._start_descent(now_ns)
            return False
        if reported is FlightState.LANDED:
            self._landed_ns = now_ns if self._landed_ns is None else self._landed_ns
            # The vehicle may be about to take off, so reports from before the command prove nothing.
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
