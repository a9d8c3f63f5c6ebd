"""Actions of an application: checks of what they are asked with, and the wait until one is done."""

from __future__ import annotations

import math
import numbers
import time
from collections.abc import Callable
from typing import Final

from skyloop.client.commands import CommandSender, GivenUpError, cancelled
from skyloop.client.connection import ProxyConnection
from skyloop.client.telemetry import ClientState
from skyloop.errors import (
    AuthorityError,
    ClosedError,
    NoAnswerError,
    RefusedError,
    UnsupportedError,
    UsageError,
)
from skyloop.messages import (
    ACTION_NAMES,
    AnyAction,
    EmergencyStop,
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
    ReturnPhase,
    ReturnToStart,
    Takeoff,
)
from skyloop.messages.command import ENDINGS, SET_POINTS
from skyloop.messages.feedback import is_on_earth
from skyloop.messages.geometry import wrap_angle

AT_REST_M_S: Final = 0.3  #: a vehicle that is slower than this at its place has arrived
#: Where the proxy does not tell: feedback received sooner after a command may be older than it.
_STALE_NS: Final = 100_000_000
_ACTIONS: Final = frozenset(ACTION_NAMES)
_OLD_PLACE_S: Final = 2.0  #: older, a place on the earth is not converted by it
AGAIN_NS: Final = 500_000_000  #: between a take-off that is not possible yet and the next attempt
_NOT_YET: Final = (Refusal.DRIVER_FAILED, Refusal.VEHICLE_LINK_LOST)
OVERRULED: Final = (Fate.FAILSAFE, Fate.LINK, Fate.AUTHORITY)  #: not refused: it may be asked for again
OUTDONE: Final = (Fate.REPLACED, Fate.WITHDRAWN)  #: by the application itself


def checked(action: AnyAction) -> AnyAction:
    """Return ``action`` if it can be commanded.

    Raises:
        UsageError: If it is no action, or has a number that is not finite or makes no sense.
    """
    if type(action) not in _ACTIONS:
        raise UsageError(f"a command is one of {', '.join(sorted(ACTION_NAMES.values()))}, not {action!r}")
    try:
        finite, problem = action.finite, action.problem
    except OverflowError:
        raise UsageError(f"{action.name} has a number that is too large") from None
    except TypeError as error:
        raise UsageError(f"{action!r} has something that is no number: {error}") from None
    if not finite:
        raise UsageError(f"{action!r} has a number that is NaN or infinite")
    if problem:
        raise UsageError(f"{action.name}: {problem}")
    return action


def position_action(x: object, y: object, z: object, yaw: object = None, speed: object = None) -> Position:
    """Return the action that flies to a place.

    Args:
        x: East [m].
        y: North [m].
        z: Up [m].
        yaw: Counter-clockwise from x [rad]; None: keep the present one.
        speed: Greatest one [m/s]; None: as fast as the limits allow.

    Raises:
        UsageError: If something is no number, not finite, or makes no sense.
    """
    place = Position(
        number("x", x),
        number("y", y),
        number("z", z),
        None if yaw is None else number("yaw", yaw),
        None if speed is None else number("speed", speed),
    )
    checked(place)
    return place


def return_action(height_m: object, land: object) -> ReturnToStart:
    """Return the action that flies back to the start.

    Args:
        height_m: Above the start, at least, on the way [m]; None: the proxy's parameter.
        land: Whether to land there; None: the proxy's parameter.

    Raises:
        UsageError: If something is no number or no bool, or makes no sense.
    """
    if not (land is None or isinstance(land, bool)):
        raise UsageError(f"land is {land!r:.60} and must be True, False or None (as return.land says)")
    back = ReturnToStart(None if height_m is None else number("height_m", height_m), land)
    checked(back)
    return back


def in_world_axes(
    local: tuple[object, object, object],
    earth: tuple[object, object, object],
    newest: Feedback | None,
    age_s: float,
) -> tuple[object, object, object]:
    """Return x, y, z of a place that is given in either way.

    Args:
        local: x, y, z in world axes [m], or three times None.
        earth: Latitude and longitude [°] and altitude above mean sea level [m], or three times None; None for the
            altitude alone: the present height.
        newest: The newest feedback.
        age_s: Its age [s].

    Raises:
        UsageError: If both ways or neither are given, or something is no number or not on the earth.
        RefusedError: If the vehicle's place on the earth is not known.
    """
    if all(one is None for one in earth):
        if any(one is None for one in local):
            raise UsageError("go_to needs x, y and z, or latitude_deg and longitude_deg with or without altitude_m")
        return local
    if any(one is not None for one in local):
        raise UsageError("go_to takes x, y, z or latitude_deg, longitude_deg, altitude_m, not some of both")
    latitude_deg, longitude_deg = number("latitude_deg", earth[0]), number("longitude_deg", earth[1])
    if not is_on_earth(latitude_deg, longitude_deg):
        raise UsageError(
            f"latitude_deg is {latitude_deg:g} and longitude_deg {longitude_deg:g}: they must be within 89.9 and 180"
        )
    origin = None if newest is None else newest.origin
    if newest is None or origin is None or newest.position_m is None or age_s > _OLD_PLACE_S:
        raise RefusedError(
            "position: the vehicle does not report its place on the earth (it needs a 3-D fix by satellites, and a "
            "driver that passes it on): fly it by x, y, z",
            code=Refusal.WRONG_STATE,
        )
    z = newest.position_m[2] if earth[2] is None else number("altitude_m", earth[2]) - origin.altitude_m
    x, y, _ = origin.position_of(latitude_deg, longitude_deg, origin.altitude_m)
    return x, y, z


def above_zero(name: str, value: object) -> float:
    """Return ``value`` as a finite float above zero.

    Args:
        name: Name of the argument, for the error.
        value: What was given.

    Raises:
        UsageError: If it is no such number.
    """
    found = number(name, value)
    if not found > 0.0:
        raise UsageError(f"{name} is {found:g} and must be more than 0")
    return found


def number(name: str, value: object) -> float:
    """Return ``value`` as a finite float.

    Args:
        name: Name of the argument, for the error.
        value: What was given.

    Raises:
        UsageError: If it is no real number, or not finite.
    """
    if type(value) is not float and (isinstance(value, bool) or not isinstance(value, numbers.Real)):
        raise UsageError(f"{name} is {value!r:.60} and must be a number")
    try:
        number = float(value)
    except OverflowError:
        raise UsageError(f"{name} is too large for a number") from None
    if not math.isfinite(number):
        raise UsageError(f"{name} is {number} and must be finite")
    return number


def is_there(target: Position, feedback: Feedback, tolerance_m: float, tolerance_rad: float) -> bool:
    """Return whether a vehicle is in the air at a place, and nearly at rest.

    Args:
        target: The place.
        feedback: The vehicle's; without a velocity it counts as at rest.
        tolerance_m: How far from it is near enough [m].
        tolerance_rad: The same of its yaw, if it has one [rad].
    """
    if feedback.position_m is None or math.dist(feedback.position_m, target.place) > tolerance_m:
        return False
    yaw = feedback.yaw_rad
    if target.yaw is not None and (yaw is None or abs(wrap_angle(target.yaw - yaw)) > tolerance_rad):
        return False
    flies = feedback.state.airborne or feedback.state is FlightState.UNKNOWN
    return flies and (feedback.velocity_m_s is None or math.hypot(*feedback.velocity_m_s) <= AT_REST_M_S)


class ReturnWatch:
    """Whether a return is over; called with each newest feedback."""

    def __init__(self) -> None:
        """Begin before it is commanded."""
        self._began = False

    def __call__(self, feedback: Feedback) -> bool:
        """Return whether the vehicle was on its way back, and has landed since or stays above its start."""
        phase = feedback.return_phase
        self._began |= phase is not ReturnPhase.NONE
        return self._began and (phase is ReturnPhase.ARRIVED or feedback.state is FlightState.LANDED)


class ActionWait:
    """One commanded action, and the wait for feedback that shows that it is done."""

    def __init__(
        self,
        action: AnyAction,
        is_done: Callable[[Feedback], bool],
        commands: CommandSender,
        state: ClientState,
        connection: ProxyConnection,
        *,
        automatic: bool = False,
    ) -> None:
        """Send the action.

        Args:
            action: The action.
            is_done: Whether feedback that is newer than the action shows it.
            commands: Sends it, now and where it is commanded again, under a new number, and tells what became of it.
            state: Newest feedback.
            connection: State of the link.
            automatic: The library asks by itself, which takes no vehicle from others, also at the end of the flight.

        Raises:
            SkyloopError: As :meth:`CommandSender.ask`.
        """
        self._action = action
        self._is_done = is_done
        self._automatic = automatic
        self._commands = commands
        self._state = state
        self._connection = connection
        self._problem: Exception | None = None
        self._why = ""  # it was not done yet, for people
        self._why_link: LinkState | None = None  # the vehicle's link at that time, of which it may speak
        self._flew = False  # it was in the air meanwhile
        self._refused, self._refused_ns = 0, 0  # the newest intent of ours that was not possible yet, and since when
        self._asked_ns = state.scheduler.clock()
        # The call may take the vehicle from the pilot who has it now, or when it can first be sent.
        self._others, self._may_be_sent = self._others_now, commands.may_ask
        self._intent = commands.ask(action, automatic=automatic)

    @property
    def outdone(self) -> bool:
        """Whether the application asked for something else since, which a set-point behind a take-off is not."""
        commands = self._commands
        behind = type(self._action) is Takeoff and isinstance(commands.newest, SET_POINTS)
        return commands.intent != self._intent and not behind

    def wait(self, timeout_s: float, deadline_s: float) -> None:
        """Wait until the action is done.

        Args:
            timeout_s: What the caller gave [s], for the error.
            deadline_s: Until when, on ``time.monotonic``.

        Raises:
            NoAnswerError: If it is not done in time.
            ClosedError: If the drone is closed.
            AuthorityError: If another application takes over.
            UnsupportedError: If the vehicle does not support it.
            RefusedError: If the proxy refuses it in the present state, or something ends it.
        """
        if not self._state.notifier.wait_for(self._over, deadline_s - time.monotonic()):
            raise NoAnswerError(self._not_reached(timeout_s))
        if self._problem is not None:
            raise self._problem

    def _over(self) -> bool:
        """Whether it is done, or waiting longer can't help."""
        if type(self._action) is Land and self._done():  # whoever landed it
            return True
        self._problem = self._why_not()
        return self._problem is not None or self._done()

    def _done(self) -> bool:
        """Whether feedback from after it shows that it is done."""
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
            return outcome.over  # it stood already: a take-off may have been on its way
        return True

    def _why_not(self) -> Exception | None:
        """Why waiting longer can't help; None if it can. Asks again for what may be possible then."""
        name = self._action.name
        if self._commands.why_closed or (self._commands.barred and not self._automatic):
            return ClosedError(f"this drone was closed while {name} was under way")
        if cancelled.get()():
            return GivenUpError()
        status = self._commands.status
        if status.state in ("queued", "preempted"):
            return AuthorityError(f"{name}: {status.holder or 'another application'} took over the authority")
        told = self._commands.told
        if told is not None and told.intent == self._intent and told.fate not in OUTDONE:
            self._note(told.text)  # nothing any more, once a repeat is carried out
            if not told.over:  # carried out: whoever has the vehicle from now on took it since
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
                f"{name} was ended on the way, by a failsafe or a lost link: send the command again", code="not_fresh"
            )
        return _refused(outcome)

    def _why_no_takeoff(self, outcome: Outcome) -> Exception | None:
        if outcome.reason in _NOT_YET or outcome.fate is Fate.TIMED_OUT:
            now_ns, newest = self._state.scheduler.clock(), self._state.newest
            if self._refused != self._intent:
                self._refused, self._refused_ns = self._intent, now_ns
            # Its withdrawal shows as a landing at first, which would end another take-off.
            # One that still wakes up is asked again when it is awake: until then it can only refuse.
            stands = newest is not None and not newest.state.airborne and not newest.waking_up
            if stands and now_ns - self._refused_ns >= AGAIN_NS and self._commands.may_ask:
                self._again()
            return None
        if outcome.fate in OUTDONE:
            if self._called_off():
                return _replaced(self._action)
            return None  # what has begun ends by itself
        if outcome.fate in OVERRULED:
            newest = self._state.newest
            rose = newest is not None and newest.state.airborne and newest.state is not FlightState.LANDING
            if rose or not self._commands.may_ask:  # what rose by then hovers in the end, and it is done
                return None
            text = f"takeoff was ended on the way, as {ENDINGS[outcome.fate]}: take off again"
            return RefusedError(text, code=Refusal.NOT_FRESH)
        return _refused(outcome)

    def _called_off(self) -> bool:
        """Whether the application asked for something since that ends a take-off, or did before it had begun."""
        commands, newest = self._commands, self._state.newest
        if commands.latest(Land, EmergencyStop, ResetEmergency) > self._intent:
            return True
        # A hover and idle end one that does not show yet: where the proxy had them and it still stands, it is over.
        stayed, told = commands.latest(Hover, Idle), commands.told
        stands = newest is not None and newest.state is FlightState.LANDED
        return stands and self._intent < stayed and told is not None and told.intent >= stayed

    def _why_no_landing(self, outcome: Outcome) -> Exception | None:
        """Old set-points are not sent again by themselves, but the caller still waits for this landing."""
        if outcome.fate in OVERRULED:
            if self._commands.may_ask:
                # The caller still asks for it, but a pilot who took the vehicle by hand since then keeps it. While the
                # application's own link is lost, nothing shows that.
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
        state = "in a state that is not known" if newest is None else newest.state.value
        text = f"{self._action.name} was not completed within {timeout_s:g} s: the vehicle is {state}"
        if connection.state.value not in ("up", "degraded"):
            return f"{text}, and the link is {connection.state.value} ({connection.reason})"
        if newest is not None and newest.vehicle_link not in (LinkState.UP, LinkState.DEGRADED):
            return f"{text}, and its own link is {newest.vehicle_link.value} ({newest.link_reason})"
        if newest is not None and newest.waking_up:
            return f"{text}; it is {newest.link_reason}"
        return f"{text}; {self._why}" if self._why and self._why_link is self._vehicle_link else text

    def _note(self, why: str) -> None:
        if self._why != why:
            self._why, self._why_link = why, self._vehicle_link

    @property
    def _vehicle_link(self) -> LinkState | None:
        return None if self._state.newest is None else self._state.newest.vehicle_link


def _replaced(action: AnyAction) -> RefusedError:
    return RefusedError(f"{action.name} was ended on the way: another command took its place", code="replaced")


def _refused(outcome: Outcome) -> RefusedError:
    return RefusedError(outcome.text, code=str(outcome.reason))
