"""The software autopilot: take-off, hover, land, velocity and position for vehicles that lack these actions. Pure.

The autopilot also handles the return to the take-off position, for all vehicles. A return is a series of targets, each
judged as for ``go_to`` (:mod:`skyloop.proxy.core.airspace`): straight up to a safe height, straight to a point above
the start, and a landing or hover there. The caller steps both. ``docs/proxy.md`` describes the rules of the return.

A vehicle that supports velocities gets velocities; one that supports only attitude with climb rate gets the output of
a velocity loop (proportional and integral, the usual cascade for small multirotors: e.g. R. Mahony, V. Kumar, P. Corke,
"Multirotor Aerial Vehicles", IEEE Robotics & Automation Magazine 19(3), 2012). Signs follow REP 103. To accelerate
forward, the nose goes down (positive pitch). To accelerate left, the left side goes down (negative roll).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, auto
from typing import Final, NamedTuple

from skyloop.clock import NS_PER_S, seconds
from skyloop.messages import (
    Attitude,
    Feedback,
    FlightState,
    Hover,
    Land,
    Position,
    Refusal,
    ReturnPhase,
    ReturnToStart,
    Takeoff,
    Velocity,
)
from skyloop.messages.geometry import clamped, wrap_angle
from skyloop.proxy.core.airspace import Airspace, Clamp
from skyloop.proxy.core.flight import STALE_NS, STANDING_NS, Flight
from skyloop.zones import Space, Vec3

PERIOD_S: Final = 0.02  #: step period that the autopilot is designed for
ALTITUDE_GAIN: Final = 1.0  #: climb rate per metre of altitude error [1/s]
POSITION_GAIN: Final = 0.6  #: speed per metre of position error [1/s]
POSITION_SPEED: Final = 0.5  #: maximum speed for holding a position [m/s]
GO_GAIN: Final = 0.9  #: speed for each metre that remains to the target [1/s]
GO_SPEED: Final = 1.0  #: maximum speed on the way to a target, if the target gives none [m/s]
GO_DECELERATION: Final = 0.6  #: deceleration towards the target [m/s²]
TURN_GAIN: Final = 1.5  #: yaw rate per radian that remains to turn [1/s]
TURN_RATE: Final = 1.2  #: maximum yaw rate if the set-point gives none [rad/s]
SETTLED_SPEED: Final = 0.2  #: speed below which a hover holds its position [m/s]
ARRIVED: Final = 0.1  #: a take-off ends at this distance below its altitude [m]
LONGEST_RISE: Final = 2.0  #: a take-off ends after this multiple of its nominal duration, ...
LONGEST_RISE_S: Final = 2.0  #: ... plus this [s]

# Return flight:
NEAR_M: Final = 0.3  #: a vehicle that is this close and at rest has arrived
CLOSE_M: Final = 1.0  #: a vehicle that is this close and gets no closer has arrived
AT_REST_M_S: Final = 0.3  #: maximum speed of a vehicle that counts as at rest
HEADWAY_M: Final = 0.2  #: a leg has stalled if the remaining distance does not decrease by this …
STALL_NS: Final = 10 * NS_PER_S  #: … within this time
#: If a return is not possible, how long a failsafe waits for that to change before it lands the vehicle in place.
PATIENCE_NS: Final = NS_PER_S
CLEARANCE_M: Final = 0.3  #: distance to keep from the ceiling of the room and the top of the safety box
_GROUNDED: Final = (FlightState.LANDED, FlightState.EMERGENCY)

SOFTWARE: Final = frozenset({"takeoff", "hover", "land", "velocity", "position", "return_to_start"})


def software_actions(native: frozenset[str]) -> frozenset[str]:
    """Return the actions that the autopilot adds to a vehicle's native actions."""
    if not native & {"attitude", "velocity"}:
        return frozenset()
    return SOFTWARE - native


@dataclass(frozen=True, slots=True)
class AutopilotSettings:
    """The autopilot's tuning. Altitude [m], speeds [m/s], ``tilt`` [rad], and gains [rad per m/s] and [rad per m]."""

    takeoff_altitude: float = 1.0
    climb: float = 0.5
    descent: float = 0.4
    velocity_p: float = 0.15
    velocity_i: float = 0.05
    tilt: float = 0.35


@dataclass(frozen=True, slots=True)
class ReturnSettings:
    """The settings of a return."""

    height: float = 2.0  #: minimum height above the start on the way [m]
    speed: float = 1.0  #: maximum speed on the way back [m/s]
    land: bool = True  #: whether to land at the end rather than hover


class AutopilotMode(Enum):
    """The autopilot's current task."""

    OFF = auto()
    TAKEOFF = auto()
    HOVER = auto()
    LAND = auto()
    VELOCITY = auto()
    POSITION = auto()


_STATES: Final = {
    AutopilotMode.TAKEOFF: FlightState.TAKING_OFF,
    AutopilotMode.HOVER: FlightState.HOVERING,
    AutopilotMode.LAND: FlightState.LANDING,
    AutopilotMode.VELOCITY: FlightState.FLYING,
    AutopilotMode.POSITION: FlightState.FLYING,
}


class SoftwareAutopilot:
    """Flies one vehicle in software. ``flight`` is informed of the current task and decides when the task has ended."""

    def __init__(
        self, native: frozenset[str], settings: AutopilotSettings | None = None, flight: Flight | None = None
    ) -> None:
        self.flight = flight or Flight(native)
        self.settings = settings or AutopilotSettings()
        self.mode = AutopilotMode.OFF
        self.drifts = False  #: whether the vehicle is held level, but not braked, because its velocity is unknown
        #: Returns the permitted velocity for a desired one, given fresh feedback. Not called during a landing.
        self.guard: Callable[[Velocity, Feedback, int], Velocity] = lambda wanted, _feedback, _now_ns: wanted
        self._takes_velocity = "velocity" in native
        self._target: Velocity | Position = Velocity()
        self._integral = (0.0, 0.0)  # integrals in the forward and left directions [rad]
        self._stepped_ns: int | None = None
        self._lifted_ns: int | None = None  # time at which the take-off left the ground
        self._from_height: float | None = None  # height at that time, according to the position [m]
        self._altitudes: set[float] = set()  # lowest and highest readings since then [m]
        self._hold_altitude: float | None = None
        self._hold_position: tuple[float, float] | None = None
        self._hold_yaw: float | None = None

    def start(
        self, action: Takeoff | Hover | Land | Velocity | Position, now_ns: int, feedback: Feedback | None
    ) -> None:
        """Start a task. :meth:`step` continues it. Repeating the current task changes nothing."""
        mode = _MODES[type(action)]
        if isinstance(action, Velocity | Position):
            if isinstance(self._target, Position) and self._target.yaw is not None:
                self._hold_yaw = None  # from now on, hold the current yaw instead of the earlier one
            self._target = action
        if mode is self.mode:
            return
        if self.mode is AutopilotMode.OFF:
            self._integral, self._stepped_ns = (0.0, 0.0), None
        self.mode = mode
        self.flight.steer(_STATES[mode], now_ns)
        self._hold_position = self._hold_yaw = self._lifted_ns = None
        self._hold_altitude = feedback.altitude_m if feedback is not None else None

    def stop(self, action_name: str) -> None:
        """Stop steering, because the vehicle itself is now executing an action."""
        self.mode = AutopilotMode.OFF
        self.flight.let_go(action_name)

    def brake(self) -> None:
        """Stop moving, because the vehicle failed to execute the action that was supposed to replace this task."""
        if isinstance(self._target, Position) and self._target.yaw is not None:
            self._hold_yaw = None  # hold the current yaw, as in ``start``
        self._target = Velocity()

    def refused(self, reported: FlightState) -> None:
        """Handle the vehicle's refusal of a set-point. If it ``reported`` being landed, a take-off is over."""
        if self.flight.refused(reported):
            self.mode = AutopilotMode.OFF

    def step(
        self, now_ns: int, feedback: Feedback | None, reported: FlightState = FlightState.UNKNOWN
    ) -> Attitude | Velocity | None:
        """Return the set-point to send now; None while the autopilot is off. Call every :data:`PERIOD_S`.

        ``reported``: the flight state reported by the driver, which may differ from the state in ``feedback``.
        """
        if self.mode is AutopilotMode.OFF:
            return None
        known = feedback if feedback is not None and now_ns - feedback.captured_ns <= STALE_NS else None
        wanted = self._wanted(now_ns, known, reported)
        if self.flight.has_ended(reported, now_ns, known):  # the last set-point stays in force
            wanted = wanted if self.mode is AutopilotMode.LAND else Velocity()
            self.mode = AutopilotMode.OFF
        elif known is not None and self.mode is not AutopilotMode.LAND:
            wanted = self.guard(wanted, known, now_ns)
        # Limited, so that one step after a pause does not fill the integral.
        dt = PERIOD_S if self._stepped_ns is None else min(0.1, seconds(now_ns - self._stepped_ns))
        self._stepped_ns = now_ns
        if self._takes_velocity:
            return wanted
        roll, pitch = self._tilt(wanted, known, dt)
        return Attitude(roll, pitch, wanted.up, wanted.yaw_rate)

    def _wanted(self, now_ns: int, known: Feedback | None, reported: FlightState) -> Velocity:
        if self.mode is AutopilotMode.TAKEOFF:
            return self._rise(now_ns, known, self.flight.lifted(reported))
        if self.mode is AutopilotMode.LAND:
            return Velocity(up=-self.settings.descent)
        if self.mode is AutopilotMode.HOVER:
            return self._hold(known)
        if isinstance(self._target, Position):
            return self._go(self._target, known)
        return self._target

    def _rise(self, now_ns: int, known: Feedback | None, lifted: bool) -> Velocity:
        """Climb until the altimeter (if there is none, the position or the time) indicates enough height."""
        settings = self.settings
        altitude = known.altitude_m if known is not None else None
        height = known.position_m[2] if known is not None and known.position_m is not None else None
        if self._lifted_ns is None and lifted:
            self._lifted_ns, self._from_height, self._altitudes = now_ns, height, set()
        if self._lifted_ns is None:
            return Velocity(up=settings.climb)
        if altitude is not None:
            read = self._altitudes | {altitude}
            self._altitudes = {min(read), max(read)}
        rising_s, needed_s = seconds(now_ns - self._lifted_ns), settings.takeoff_altitude / settings.climb
        there = altitude is not None and altitude >= settings.takeoff_altitude - ARRIVED
        if height is not None and self._from_height is not None:
            arrived = there or height - self._from_height >= settings.takeoff_altitude
        else:
            arrived = there or (altitude is None and rising_s >= needed_s)
        if not arrived and rising_s < LONGEST_RISE * needed_s + LONGEST_RISE_S:
            return Velocity(up=settings.climb)
        # A stuck altimeter always reports the same altitude. If the readings change but stay low until time is up, they
        # are correct: the motors turn without lifting the vehicle, as with a real Betaflight on a slow computer.
        if not arrived and len(self._altitudes) > 1 and max(self._altitudes) < settings.takeoff_altitude / 2:
            self.mode = AutopilotMode.LAND
            self.flight.steer(FlightState.LANDING, now_ns)
            return Velocity(up=-settings.descent)
        self.mode = AutopilotMode.HOVER
        self.flight.steer(FlightState.HOVERING, now_ns)
        self._hold_altitude = settings.takeoff_altitude if there else altitude
        return Velocity()

    def _hold(self, known: Feedback | None) -> Velocity:
        if known is None:  # the vehicle may be anywhere when it is next received, and will then hold that position
            self._hold_altitude = self._hold_position = None
            return Velocity()
        altitude, up = known.altitude_m, 0.0
        if altitude is not None:
            if self._hold_altitude is None:
                self._hold_altitude = altitude
            up = clamped((self._hold_altitude - altitude) * ALTITUDE_GAIN, self.settings.climb)
        if known.position_m is None or known.yaw_rad is None:
            return Velocity(up=up)
        x, y, _ = known.position_m
        if self._hold_position is None:
            if known.velocity_m_s is None or math.hypot(*known.velocity_m_s[:2]) > SETTLED_SPEED:
                return Velocity(up=up)
            self._hold_position = (x, y)
        east, north = (self._hold_position[0] - x) * POSITION_GAIN, (self._hold_position[1] - y) * POSITION_GAIN
        cos, sin = math.cos(known.yaw_rad), math.sin(known.yaw_rad)
        forward, left = _shorten(cos * east + sin * north, cos * north - sin * east, POSITION_SPEED)
        return Velocity(forward, left, up)

    def _go(self, target: Position, known: Feedback | None) -> Velocity:
        """Fly straight to a target, slower when close to it. Stop while the position or yaw is unknown."""
        if known is None or known.position_m is None or known.yaw_rad is None:
            return Velocity()
        if self._hold_yaw is None:
            self._hold_yaw = known.yaw_rad
        east, north, up = (to - at for to, at in zip(target.place, known.position_m, strict=True))
        away = math.hypot(east, north, up)
        most = GO_SPEED if target.speed is None else target.speed
        speed = min(GO_GAIN * away, most, math.sqrt(2.0 * GO_DECELERATION * away))
        share = speed / away if away > 1e-9 else 0.0
        cos, sin = math.cos(known.yaw_rad), math.sin(known.yaw_rad)
        turn = wrap_angle((self._hold_yaw if target.yaw is None else target.yaw) - known.yaw_rad)
        return Velocity(
            forward=share * (cos * east + sin * north),
            left=share * (cos * north - sin * east),
            up=share * up,
            yaw_rate=clamped(TURN_GAIN * turn, TURN_RATE if target.turn_rate is None else target.turn_rate),
        )

    def _tilt(self, wanted: Velocity, known: Feedback | None, dt: float) -> tuple[float, float]:
        """Return the roll and pitch [rad] for reaching a velocity; both are 0 while the velocity is unknown."""
        self.drifts = known is None or known.velocity_m_s is None
        if known is None or known.velocity_m_s is None:
            return 0.0, 0.0
        settings = self.settings
        forward_error, left_error = wanted.forward - known.velocity_m_s[0], wanted.left - known.velocity_m_s[1]
        integral = _shorten(
            self._integral[0] + settings.velocity_i * forward_error * dt,
            self._integral[1] + settings.velocity_i * left_error * dt,
            settings.tilt,
        )
        forward = settings.velocity_p * forward_error + integral[0]
        left = settings.velocity_p * left_error + integral[1]
        if math.hypot(forward, left) <= settings.tilt:  # otherwise the integral would wind up
            self._integral = integral
        else:
            forward, left = _shorten(forward, left, settings.tilt)
        return -left, forward


_MODES: Final = {
    Takeoff: AutopilotMode.TAKEOFF,
    Hover: AutopilotMode.HOVER,
    Land: AutopilotMode.LAND,
    Velocity: AutopilotMode.VELOCITY,
    Position: AutopilotMode.POSITION,
}


def _shorten(x: float, y: float, most: float) -> tuple[float, float]:
    length = math.hypot(x, y)
    return (x, y) if length <= most else (x / length * most, y / length * most)


# Return to the start ----------------------------------------------------------------------------------------


class StartPoint:
    """Stores the position where the vehicle last left the ground, in world axes."""

    def __init__(self) -> None:
        self.position: Vec3 | None = None  #: the position [m]; None if it is unknown
        self._state = FlightState.UNKNOWN
        self._standing_ns: int | None = None  # start of the current period of time on the ground; None in the air
        self._flew = False  # whether the vehicle has been seen in the air
        self._open = False  # whether the vehicle is taking off and its position is still unknown

    def observe(self, state: FlightState, feedback: Feedback | None, now_ns: int) -> None:
        """Observe the vehicle. If it briefly reports "landed" while in the air, the start does not change."""
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
    """The decision on the next step of a return."""

    action: Position | Land | None = None  #: the vehicle's next action; None if it must stop
    clamps: tuple[Clamp, ...] = ()
    refusal: Refusal | None = None  #: also None (like ``action``) if the return is only waiting for a fresh position
    why: str = ""  #: readable reason for the refusal
    lasting: bool = False  #: whether it is pointless to wait for a fresh position
    enforced: bool | None = None  #: whether box and zones were enforced; None if none are set or there is no target


class ReturnFlight:
    """One return flight to the start. The settings fill in what the action does not specify."""

    def __init__(self, action: ReturnToStart, start: Vec3 | None, settings: ReturnSettings) -> None:
        self.phase = ReturnPhase.NONE
        self._action = action
        self._start = start
        self._height = settings.height if action.height is None else action.height
        self._speed = settings.speed
        self._land = settings.land if action.land is None else action.land
        self._target: Vec3 = (0.0, 0.0, 0.0)
        self._flown: Vec3 = (0.0, 0.0, 0.0)  # the target, lowered if the ceiling is lower
        self._over: Vec3 = (0.0, 0.0, 0.0)  # the point directly above the start
        self._left_m, self._left_ns = math.inf, 0  # the shortest remaining distance so far, and when it was reached
        self._stepped_ns = 0

    def step(self, airspace: Airspace, feedback: Feedback | None, now_ns: int) -> ReturnDecision:
        """Decide the vehicle's next action."""
        begins = self.phase is ReturnPhase.NONE
        if self.phase is not ReturnPhase.LANDING:
            airspace.observe(feedback)
            problem = self._plan(airspace, feedback, now_ns)
            if problem is not None:
                self.phase = ReturnPhase.NONE  # everything is checked again before continuing
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
        """Start, or continue with the next leg; return the objection, if any."""
        if self._action.problem:
            return ReturnDecision(None, (), Refusal.OUT_OF_RANGE, self._action.problem, True)
        if feedback is None or feedback.position_m is None or now_ns - feedback.captured_ns > STALE_NS:
            return None  # the airspace refuses this, whatever the target
        if self.phase is not ReturnPhase.NONE:
            problem = self._go_on(feedback, feedback.position_m, now_ns)
            return ReturnDecision(None, (), Refusal.WRONG_STATE, problem, True) if problem else None
        if self._start is None:
            why = "the start is unknown: fly the vehicle to a position, or land it here"
            return ReturnDecision(None, (), Refusal.WRONG_STATE, why, True)
        problem = self._begin(self._start, airspace, feedback, feedback.position_m)
        return ReturnDecision(None, (), Refusal.OUT_OF_RANGE, problem, True) if problem else None

    def _begin(self, start: Vec3, airspace: Airspace, feedback: Feedback, at: Vec3) -> str:
        """Plan the whole return. Return what is in the way, as readable text."""
        space = airspace.settings.space
        top = max(at[2], start[2] + self._height) if math.dist(at[:2], start[:2]) >= CLOSE_M else at[2]
        top = min(top, airspace.ceiling(feedback))
        for walls in (space.room, space.box):
            if walls is not None:
                top = min(top, max(walls.high[2] - CLEARANCE_M, walls.low[2]))
        above, over = (at[0], at[1], top), (start[0], start[1], top)
        # Outside the box or inside a zone, the vehicle must not climb first: the straight line leads back.
        climbs = top - at[2] > NEAR_M and not space.problem_at(above)
        problem = space.problem_at(over) or space.problem_between(above if climbs else at, over)
        if not problem and climbs:
            problem = space.problem_between(at, above)
        if not problem and self._land:
            below = Space(zones=space.zones)  # the bottom of the box may be above the ground
            problem = below.problem_between(over, start)
        if problem:
            return problem
        self.phase = ReturnPhase.CLIMBING if climbs else ReturnPhase.FLYING
        self._over, self._left_m = over, math.inf
        self._target = self._flown = above if climbs else over
        return ""

    def _go_on(self, feedback: Feedback, at: Vec3, now_ns: int) -> str:
        """Start the next leg when the current leg is over. Return an objection, if there is one, as readable text."""
        left_m = math.dist(at, self._flown)
        paused, self._stepped_ns = now_ns - self._stepped_ns > NS_PER_S, now_ns
        if paused or left_m < self._left_m - HEADWAY_M:
            self._left_m, self._left_ns = left_m, now_ns
        stalled = now_ns - self._left_ns >= STALL_NS
        if self.phase is ReturnPhase.CLIMBING:
            if at[2] >= self._target[2] - NEAR_M or (stalled and left_m <= CLOSE_M):
                self.phase, self._left_m = ReturnPhase.FLYING, math.inf
                self._target = self._flown = self._over  # it is judged together with the straight line to the start
                return ""
        elif self.phase is ReturnPhase.FLYING:
            slow = feedback.velocity_m_s is None or math.hypot(*feedback.velocity_m_s) <= AT_REST_M_S
            if (left_m <= NEAR_M and slow) or (stalled and left_m <= CLOSE_M):
                self.phase = ReturnPhase.LANDING if self._land else ReturnPhase.ARRIVED
        else:
            return ""
        if stalled and left_m > CLOSE_M:
            return f"it has got no closer to its start for {seconds(STALL_NS):g} s, and {left_m:.1f} m remain"
        return ""
