"""Back to where the vehicle took off: which place that is, and the flight there. Pure: the time is an argument.

The flight is a series of places to fly to, each judged as ``go_to`` is (:mod:`skyloop.proxy.core.airspace`): straight
up to a safe height, straight over the start, and there a landing or a hover. The rules in words are in
``docs/proxy.md``.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

from skyloop.clock import NS_PER_S, seconds
from skyloop.messages import Feedback, FlightState, Land, Position, Refusal, ReturnPhase, ReturnToStart
from skyloop.proxy.core.airspace import STALE_NS, Airspace
from skyloop.proxy.core.flight import STANDING_NS
from skyloop.proxy.core.settings import Clamp, ReturnSettings
from skyloop.zones import Space, Vec3

NEAR_M: Final = 0.3  #: so near, and at rest, it is there
CLOSE_M: Final = 1.0  #: so near is near enough where it comes no nearer
AT_REST_M_S: Final = 0.3
HEADWAY_M: Final = 0.2  #: a way that does not become shorter by this ...
STALL_NS: Final = 10 * NS_PER_S  #: ... within this time leads nowhere
#: How long a failsafe bears with what is against a return before it lands where the vehicle is.
PATIENCE_NS: Final = NS_PER_S
CLEARANCE_M: Final = 0.3  #: kept to the ceiling of the room and to the upper wall of the safety box
_GROUNDED: Final = (FlightState.LANDED, FlightState.EMERGENCY)


class StartPoint:
    """Where the vehicle left the ground last, in world axes."""

    def __init__(self) -> None:
        self.position: Vec3 | None = None  #: [m]; None: not known
        self._state = FlightState.UNKNOWN
        self._standing_ns: int | None = None  # since when it stands; None: it does not
        self._flew = False  # it was seen in the air
        self._open = False  # it is just taking off, and its position is still awaited

    def observe(self, state: FlightState, feedback: Feedback | None, now_ns: int) -> None:
        """Observe the vehicle; a moment of "landed" in the air does not move the start."""
        before, self._state = self._state, state
        if state in _GROUNDED:
            if self._standing_ns is None:
                self._standing_ns = now_ns
            return
        if not state.airborne:
            return
        taking_off = state is FlightState.TAKING_OFF
        since_ns, self._standing_ns = self._standing_ns, None
        flew, self._flew = self._flew, True
        stood = since_ns is not None and (now_ns - since_ns >= STANDING_NS or not flew)
        if stood or (taking_off and not before.airborne):
            self.position, self._open = None, True
        stands = before in _GROUNDED
        if not (stands or taking_off):
            self._open = False
        elif self._open and feedback is not None and feedback.position_m is not None:
            x, y, z = feedback.position_m
            if now_ns - feedback.captured_ns <= STALE_NS:
                self.position, self._open = (x, y, z if stands else z - (feedback.altitude_m or 0.0)), False


class ReturnDecision(NamedTuple):
    """What the vehicle does next on its way back."""

    action: Position | Land | None = None  #: None: it must stop
    clamps: tuple[Clamp, ...] = ()
    refusal: Refusal | None = None  #: None without an action: it goes on as soon as a young position comes
    why: str = ""  #: of the refusal, for a person
    lasting: bool = False  #: waiting for a young position does not help
    enforced: bool | None = None  #: whether the safety box and zones could be; None: there are none, or no place


class ReturnFlight:
    """One flight back to the start point; ``settings`` hold where the action leaves something open."""

    def __init__(self, action: ReturnToStart, start: Vec3 | None, settings: ReturnSettings) -> None:
        self.phase = ReturnPhase.NONE
        self._action = action
        self._start = start
        self._height = settings.height if action.height is None else action.height
        self._speed = settings.speed
        self._land = settings.land if action.land is None else action.land
        self._target: Vec3 = (0.0, 0.0, 0.0)
        self._flown: Vec3 = (0.0, 0.0, 0.0)  # the target, lowered where the ceiling is lower now
        self._over: Vec3 = (0.0, 0.0, 0.0)  # the place above the start
        self._left_m, self._left_ns = math.inf, 0  # the shortest way that was left, and since when it is
        self._stepped_ns = 0

    def step(self, airspace: Airspace, feedback: Feedback | None, now_ns: int) -> ReturnDecision:
        """Decide what the vehicle does now."""
        begins = self.phase is ReturnPhase.NONE
        if self.phase is not ReturnPhase.LANDING:
            airspace.observe(feedback)
            problem = self._plan(airspace, feedback, now_ns)
            if problem is not None:
                self.phase = ReturnPhase.NONE  # all of it is checked again before it goes on
                return problem
        if self.phase is ReturnPhase.LANDING:
            return ReturnDecision(Land())
        place = airspace.judge(Position(*self._target, None, self._speed), feedback, now_ns, planned=True)
        if isinstance(place.action, Position):
            self._flown = place.action.place
            return ReturnDecision(place.action, place.clamps, enforced=place.enforced)
        if begins:
            self.phase = ReturnPhase.NONE
        return ReturnDecision(None, place.clamps, place.refusal, place.why)

    def _plan(self, airspace: Airspace, feedback: Feedback | None, now_ns: int) -> ReturnDecision | None:
        """Begin, or go on to the next part of the way; return what is against it."""
        if self._action.problem:
            return ReturnDecision(None, (), Refusal.OUT_OF_RANGE, self._action.problem, True)
        if feedback is None or feedback.position_m is None or now_ns - feedback.captured_ns > STALE_NS:
            return None  # which is the same for every place
        if self.phase is not ReturnPhase.NONE:
            problem = self._go_on(feedback, feedback.position_m, now_ns)
            return ReturnDecision(None, (), Refusal.WRONG_STATE, problem, True) if problem else None
        if self._start is None:
            why = "where it took off is not known: fly it to a place, or land it here"
            return ReturnDecision(None, (), Refusal.WRONG_STATE, why, True)
        problem = self._begin(self._start, airspace, feedback, feedback.position_m)
        return ReturnDecision(None, (), Refusal.OUT_OF_RANGE, problem, True) if problem else None

    def _begin(self, start: Vec3, airspace: Airspace, feedback: Feedback, at: Vec3) -> str:
        """Plan the whole way; return what is in it, for a person."""
        space = airspace.settings.space
        top = max(at[2], start[2] + self._height) if math.dist(at[:2], start[:2]) >= CLOSE_M else at[2]
        top = min(top, airspace.ceiling(feedback))
        for walls in (space.room, space.box):
            if walls is not None:
                top = min(top, max(walls.high[2] - CLEARANCE_M, walls.low[2]))
        above, over = (at[0], at[1], top), (start[0], start[1], top)
        # From outside of the box, or in a zone, it does not climb first: the straight way leads back inside.
        climbs = top - at[2] > NEAR_M and not space.problem_at(above)
        problem = space.problem_at(over) or space.problem_between(above if climbs else at, over)
        if not problem and climbs:
            problem = space.problem_between(at, above)
        if not problem and self._land:
            below = Space(zones=space.zones)  # the box may end above the ground
            problem = below.problem_between(over, start)
        if problem:
            return problem
        self.phase = ReturnPhase.CLIMBING if climbs else ReturnPhase.FLYING
        self._over, self._left_m = over, math.inf
        self._target = self._flown = above if climbs else over
        return ""

    def _go_on(self, feedback: Feedback, at: Vec3, now_ns: int) -> str:
        """Begin the next part of the way where the present one is over; return what is against it, for a person."""
        left_m = math.dist(at, self._flown)
        paused, self._stepped_ns = now_ns - self._stepped_ns > NS_PER_S, now_ns
        if paused or left_m < self._left_m - HEADWAY_M:
            self._left_m, self._left_ns = left_m, now_ns
        stalled = now_ns - self._left_ns >= STALL_NS
        if self.phase is ReturnPhase.CLIMBING:
            if at[2] >= self._target[2] - NEAR_M or (stalled and left_m <= CLOSE_M):
                self.phase, self._left_m = ReturnPhase.FLYING, math.inf
                self._target = self._flown = self._over  # the straight way there is judged with it
                return ""
        elif self.phase is ReturnPhase.FLYING:
            slow = feedback.velocity_m_s is None or math.hypot(*feedback.velocity_m_s) <= AT_REST_M_S
            if (left_m <= NEAR_M and slow) or (stalled and left_m <= CLOSE_M):
                self.phase = ReturnPhase.LANDING if self._land else ReturnPhase.ARRIVED
        else:
            return ""
        if stalled and left_m > CLOSE_M:
            return f"it came no nearer to its start for {seconds(STALL_NS):g} s, and {left_m:.1f} m are left"
        return ""
