"""Prepare an application's actions: check their numbers, schedule them, and decide when they are complete. Pure.

The newest set-point wins: it is sent at once and then repeated at a steady rate with absolute deadlines, unless a newer
one follows within one and a quarter periods. Without a set-point, ``Idle`` is repeated. It renews the lease without
changing what the vehicle does. A set-point from before a lost link, a lost authority or a failsafe is never resent.
"""

from __future__ import annotations

import math
import numbers
from typing import Final, NamedTuple

from skyloop.clock import nanoseconds
from skyloop.errors import RefusedError, UsageError
from skyloop.messages import (
    ACTION_NAMES,
    AnyAction,
    Attitude,
    EmergencyStop,
    Failsafe,
    Fate,
    Feedback,
    FlightState,
    Hover,
    Idle,
    Land,
    Outcome,
    Position,
    Refusal,
    ResetEmergency,
    ReturnPhase,
    ReturnToStart,
    Takeoff,
    Velocity,
)
from skyloop.messages.command import ENDINGS, SET_POINTS
from skyloop.messages.feedback import is_on_earth
from skyloop.messages.geometry import wrap_angle

AT_REST_M_S: Final = 0.3  #: a vehicle at its target has arrived once it is slower than this
_ACTIONS: Final = frozenset(ACTION_NAMES)
_OLD_PLACE_S: Final = 2.0  #: maximum age of feedback used to convert a geographic position
OVERRULED: Final = (Fate.FAILSAFE, Fate.LINK, Fate.AUTHORITY)  #: not refusals: the application may request it again
OUTDONE: Final = (Fate.REPLACED, Fate.WITHDRAWN)  #: outcomes of actions that the application ended itself
_IDLE: Final = Idle()
_HOVER: Final = Hover()
#: States that complete an action if the proxy reports no outcome. A completed action is no longer sent.
_DONE_IN: Final[dict[type[AnyAction], frozenset[FlightState]]] = {
    Takeoff: frozenset({FlightState.HOVERING, FlightState.FLYING}),
    Land: frozenset({FlightState.LANDED}),
    EmergencyStop: frozenset({FlightState.EMERGENCY}),
    ReturnToStart: frozenset({FlightState.LANDED}),
    ResetEmergency: frozenset(FlightState) - {FlightState.EMERGENCY},
}
#: Minimum time for which these actions are repeated, because the last known state may be older than the command.
_AT_LEAST_NS: Final[dict[type[AnyAction], int]] = {
    Takeoff: nanoseconds(0.3),
    Land: nanoseconds(0.3),
    ReturnToStart: nanoseconds(0.3),
    EmergencyStop: nanoseconds(0.1),
    ResetEmergency: nanoseconds(0.1),
}
#: Maximum time for which these actions are repeated; others have no limit of their own.
_AT_MOST_NS: Final[dict[type[AnyAction], int]] = {
    Takeoff: nanoseconds(21.0),  # the proxy gives up after 20 s and reports whether the take-off may be requested again
    Land: nanoseconds(60.0),  # counted from the last time the proxy reports it in progress
    EmergencyStop: nanoseconds(8.0),  # the driver continues for 10 s; a late repeat must not count as a second press
    ResetEmergency: nanoseconds(2.0),
}
_MIN_INTERVAL_NS: Final = nanoseconds(0.005)  #: minimum time between two new set-points, not counting repeats
_KEEP_NS: Final = nanoseconds(0.5)  #: a set-point that could not be sent is sent later unless it is older than this
_UNSENT_STOP_NS: Final = nanoseconds(2.0)  #: a stop that can't be sent within this time is abandoned
_STOP_PERIOD_NS: Final = nanoseconds(0.05)  #: interval between repeats of a stop, whatever the rate of other commands


def checked(action: AnyAction) -> AnyAction:
    """Return ``action`` if an application may command it; raise :class:`UsageError` otherwise."""
    if type(action) not in _ACTIONS:
        raise UsageError(f"a command must be one of {', '.join(sorted(ACTION_NAMES.values()))}, not {action!r}")
    try:
        finite, problem = action.finite, action.problem
    except OverflowError:
        raise UsageError(f"{action.name} has a number that is too large") from None
    except TypeError as error:
        raise UsageError(f"{action!r} has a value that is not a number: {error}") from None
    if not finite:
        raise UsageError(f"{action!r} has a number that is NaN or infinite")
    if problem:
        raise UsageError(f"{action.name}: {problem}")
    return action


def position_action(x: object, y: object, z: object, yaw: object = None, speed: object = None) -> Position:
    """Return the action that flies to a target: x east, y north, z up [m], yaw from x [rad], maximum speed [m/s].

    If ``yaw`` is None, the current yaw is kept; if ``speed`` is None, only the limits apply. Raises :class:`UsageError`
    for values that are not numbers, not finite, or make no sense.
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
    """Return the action that flies back to the start; for values that are None, the proxy uses its parameters.

    Raises :class:`UsageError` if a value is not a number or bool, or makes no sense.
    """
    if not (land is None or isinstance(land, bool)):
        raise UsageError(f"land is {land!r:.60} and must be True, False or None (the parameter return.land)")
    back = ReturnToStart(None if height_m is None else number("height_m", height_m), land)
    checked(back)
    return back


def in_world_axes(
    local: tuple[object, object, object], earth: tuple[object, object, object], newest: Feedback | None, age_s: float
) -> tuple[object, object, object]:
    """Return x, y, z [m] of a target given as either ``local`` or ``earth``; the other argument contains only None.

    ``local``: x, y, z in world axes [m]. ``earth``: latitude and longitude [°], and altitude above mean sea level [m];
    an altitude of None means the current height. Raises :class:`UsageError` if both forms or neither are given, or if a
    value is invalid. Raises :class:`RefusedError` if the vehicle's geographic position is unknown.
    """
    if all(one is None for one in earth):
        if any(one is None for one in local):
            raise UsageError("go_to needs x, y and z, or latitude_deg and longitude_deg with or without altitude_m")
        return local
    if any(one is not None for one in local):
        raise UsageError("go_to takes x, y, z or latitude_deg, longitude_deg, altitude_m, but not both")
    latitude_deg, longitude_deg = number("latitude_deg", earth[0]), number("longitude_deg", earth[1])
    if not is_on_earth(latitude_deg, longitude_deg):
        raise UsageError(
            f"latitude_deg is {latitude_deg:g} and longitude_deg {longitude_deg:g}: they must be within ±89.9 and ±180"
        )
    origin = None if newest is None else newest.origin
    if newest is None or origin is None or newest.position_m is None or age_s > _OLD_PLACE_S:
        raise RefusedError(
            "position: the vehicle does not report its geographic position (this needs a 3-D satellite fix and a "
            "driver that reports it): use x, y, z",
            code=Refusal.WRONG_STATE,
        )
    z = newest.position_m[2] if earth[2] is None else number("altitude_m", earth[2]) - origin.altitude_m
    x, y, _ = origin.position_of(latitude_deg, longitude_deg, origin.altitude_m)
    return x, y, z


def above_zero(name: str, value: object) -> float:
    """Return an argument as a finite float above zero; raise :class:`UsageError` otherwise."""
    found = number(name, value)
    if not found > 0.0:
        raise UsageError(f"{name} is {found:g} and must be more than 0")
    return found


def number(name: str, value: object) -> float:
    """Return an argument as a finite float; raise :class:`UsageError` otherwise."""
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
    """Return whether a vehicle is in the air at a target, and nearly at rest.

    The yaw is checked if the target has one. A vehicle that doesn't report its state is assumed to be in the air, and
    one that doesn't report its velocity to be at rest.
    """
    if feedback.position_m is None or math.dist(feedback.position_m, target.place) > tolerance_m:
        return False
    yaw = feedback.yaw_rad
    if target.yaw is not None and (yaw is None or abs(wrap_angle(target.yaw - yaw)) > tolerance_rad):
        return False
    flies = feedback.state.airborne or feedback.state is FlightState.UNKNOWN
    return flies and (feedback.velocity_m_s is None or math.hypot(*feedback.velocity_m_s) <= AT_REST_M_S)


class ReturnWatch:
    """Decides whether a return flight is over. Call it with each new sample of feedback."""

    def __init__(self) -> None:
        """Prepare the watch; call this before the command is sent."""
        self._began = False

    def __call__(self, feedback: Feedback) -> bool:
        """Return whether the vehicle has started returning and has since landed or is hovering above its start."""
        phase = feedback.return_phase
        self._began |= phase is not ReturnPhase.NONE
        return self._began and (phase is ReturnPhase.ARRIVED or feedback.state is FlightState.LANDED)


class Unsent(NamedTuple):
    """A one-off request that could not be sent because the transport had no room."""

    action: AnyAction
    intent: int
    since_ns: int
    automatic: bool = False


class CommandSchedule:
    """Stores the newest set-point of an application and decides when to send it. Times are on this process's clock."""

    def __init__(self, *, rate_hz: float = 32.0, stall_s: float = 1.0) -> None:
        """Start without a set-point. Raises :class:`UsageError` unless ``rate_hz`` is 1 to 200 and ``stall_s`` above 0.

        If the application makes no call for ``stall_s``, a velocity or attitude decays to hover; ``math.inf`` disables
        this. Flights to a target and return flights do not decay, because the vehicle stops at the end of them.
        """
        if not 1.0 <= rate_hz <= 200.0:
            raise UsageError(f"rate_hz is {rate_hz!r} and must be from 1 to 200 commands a second")
        if not stall_s > 0.0:
            raise UsageError(f"stall_s is {stall_s!r} and must be more than 0 s (math.inf: never)")
        self._period_ns = nanoseconds(1.0 / rate_hz)
        self._stall_ns = None if stall_s == float("inf") else nanoseconds(stall_s)
        self.action: AnyAction = _IDLE
        self.intent = 0  #: number of the newest intent
        self.automatic = False  #: whether the newest set-point is the library's own
        self.over: Outcome | None = None  #: how the newest intent ended; None while it has not
        self.owed: Unsent | None = None  #: a one-off request that could not be sent yet
        self.latest: dict[type[AnyAction], int] = {}  #: number of the newest intent of each kind
        self._asked_ns = 0
        # Repeats must not delay an application that commands at about the same rate. Therefore the first repeat waits a
        # quarter period longer, and only the application's own commands delay the next command.
        self._first_ns = self._period_ns * 5 // 4
        self._new_sent_ns = -_MIN_INTERVAL_NS  # time at which the newest intent was first sent
        self._sent_intent = 0
        self.due_ns = 0  #: time at which :meth:`next` will have something to send
        self._failsafe = Failsafe.NONE
        self._reset_asked_ns: int | None = None  # time of a reset requested while a stop was active

    def ask(self, action: AnyAction, now_ns: int, *, automatic: bool = False) -> int:
        """Make ``action`` the set-point and return the number of this intent; :meth:`may_ask` must have allowed it.

        ``automatic``: whether the library, rather than the application, requests the action.
        """
        resets = isinstance(action, ResetEmergency)
        self._reset_asked_ns = now_ns if resets and self.stopping else None
        if self._reset_asked_ns is not None:
            return self.intent  # observe() requests the reset once the vehicle reports the stop
        stops = type(action) is Hover and type(self.action) is not Hover
        self.action, self.over = action, None
        self.intent += 1
        self.latest[type(action)] = self.intent
        self.automatic = automatic
        self._asked_ns = now_ns
        if stops or type(action) in _DONE_IN:  # these are rare and important, so send them at once
            self.due_ns = now_ns
        else:
            self.due_ns = max(now_ns, self._new_sent_ns + _MIN_INTERVAL_NS)
        return self.intent

    @property
    def stopping(self) -> bool:
        """Whether an emergency stop is in progress; only another stop may replace it (see :meth:`may_ask`)."""
        return isinstance(self.action, EmergencyStop)

    def may_ask(self, action: AnyAction) -> bool:
        """Return whether the application may command this now.

        An emergency stop is repeated until the vehicle confirms it, or for 8 s. Until then, this application sends
        nothing else; otherwise, after a single lost packet, held sticks would end the stop. ``Idle`` withdraws a stop
        that was never sent. A reset is sent once the vehicle has reported the stop, unless the report takes too long.
        """
        if type(self.action) is not EmergencyStop or isinstance(action, EmergencyStop | ResetEmergency):
            return True
        return isinstance(action, Idle) and self.intent != self._sent_intent

    @property
    def open_ns(self) -> int:
        """Earliest time at which a new set-point can be sent without delay [ns]."""
        return self._new_sent_ns + _MIN_INTERVAL_NS

    def next(self, now_ns: int) -> AnyAction | None:
        """Return the action to send now under the current :attr:`intent`; None if nothing is due yet."""
        if now_ns < self.due_ns:
            return None
        kind, since_ns, is_sent = type(self.action), now_ns - self._asked_ns, self.intent == self._sent_intent
        longest_ns = _UNSENT_STOP_NS if kind is EmergencyStop and not is_sent else _AT_MOST_NS.get(kind)
        if (kind is Velocity or kind is Attitude) and self._stall_ns is not None and since_ns >= self._stall_ns:
            self.action, self.automatic = _HOVER, True
        elif longest_ns is not None and since_ns > longest_ns:
            self.action, self.owed = _IDLE, None
        period_ns, first_ns = self._period_ns, self._first_ns
        if self.action is not _IDLE and kind is EmergencyStop:
            period_ns, first_ns = min(period_ns, _STOP_PERIOD_NS), min(first_ns, _STOP_PERIOD_NS)
        if not is_sent:
            self._sent_intent, self._new_sent_ns = self.intent, now_ns
            self.due_ns = now_ns + first_ns
            return self.action
        # The next deadline follows from the last one rather than from now, which keeps the rate steady. A deadline
        # missed by more than a period is skipped.
        self.due_ns += period_ns
        if self.due_ns <= now_ns:
            self.due_ns = now_ns + period_ns
        return self.action

    def not_sent(self, action: AnyAction, now_ns: int) -> None:
        """Record that the action from :meth:`next` was not sent; a one-off action remains :attr:`owed`."""
        if isinstance(action, EmergencyStop):
            if self._new_sent_ns == now_ns:  # first attempt: the action may still be withdrawn, and is soon abandoned
                self._sent_intent = -1
        elif not _is_periodic(action):
            self.owed = Unsent(action, self.intent, now_ns, self.automatic)

    def first(self, action: AnyAction, now_ns: int) -> Unsent | None:
        """Return :attr:`owed` if it must be sent before ``action``, because ``action`` neither repeats nor revokes it.

        One-off actions revoke it; actions requested by the library itself revoke everything except a landing.
        """
        owed = self.owed
        if owed is None or owed.intent == self.intent or now_ns - owed.since_ns > _KEEP_NS:
            return None
        if self.automatic and type(owed.action) is not Land:
            return None
        return owed if _is_periodic(action) else None

    def decayed(self, before: AnyAction) -> bool:
        """Return whether the set-point ``before`` has decayed to hover because the application made no calls."""
        return self.action is _HOVER and before is not _HOVER

    def observe(self, feedback: Feedback, now_ns: int, app_id: int = 0) -> None:
        """End the set-point if the proxy reports that its intent has ended, or that a failsafe has overruled it."""
        kind, outcome = type(self.action), feedback.outcome
        done_in = _DONE_IN.get(kind)
        if outcome is not None and (outcome.app_id, outcome.intent) == (app_id, self.intent):
            if outcome.over:
                self._end(outcome)
            elif kind is Land and feedback.state is not FlightState.UNKNOWN:
                self._asked_ns = now_ns  # the proxy continues the landing for as long as it takes
        if done_in is None:
            if feedback.state is FlightState.EMERGENCY:
                self.clear(Fate.EMERGENCY)
        elif (
            (outcome is None or kind is EmergencyStop)  # older proxies report no outcome; any pilot may trigger a stop
            and feedback.state in done_in
            and now_ns - self._asked_ns >= _AT_LEAST_NS[kind]
        ):
            self.action, reset_ns = _IDLE, self._reset_asked_ns
            if reset_ns is not None and now_ns - reset_ns <= _AT_MOST_NS[ResetEmergency]:
                self.ask(ResetEmergency(), now_ns)
        if feedback.failsafe is not self._failsafe:
            self._failsafe = feedback.failsafe
            if feedback.failsafe is not Failsafe.NONE:
                self.clear(Fate.FAILSAFE)

    def clear(self, fate: Fate) -> None:
        """Drop the set-point, and record ``fate`` as the reason. An emergency stop is kept."""
        self._end(Outcome(0, self.intent, fate, Refusal.NOT_FRESH, ENDINGS[fate]))
        self.owed = None

    def _end(self, outcome: Outcome) -> None:
        if self.over is None:
            self.over = outcome
        if type(self.action) is not EmergencyStop:
            self.action = _IDLE

    def resume(self, now_ns: int, connected_ns: int = 0) -> None:
        """Resume sending on the connection made at ``connected_ns``, but drop a set-point that is too old."""
        if now_ns - self._asked_ns > _KEEP_NS:  # if it was requested on this connection, only the lease was missing
            self.clear(Fate.LINK if self._asked_ns < connected_ns else Fate.AUTHORITY)
        self._failsafe = Failsafe.NONE
        self.due_ns = now_ns

    @property
    def wants_flight(self) -> bool:
        """Whether the newest set-point keeps the vehicle in the air or brings it there."""
        return isinstance(self.action, Takeoff | Hover | Velocity | Attitude | Position | ReturnToStart)


def _is_periodic(action: AnyAction) -> bool:
    return type(action) is Idle or isinstance(action, SET_POINTS)
