"""Actions of an application: checks of what they are asked with, and of whether one is done. Pure."""

from __future__ import annotations

import math
import numbers
from typing import Final

from skyloop.errors import (
    RefusedError,
    UsageError,
)
from skyloop.messages import (
    ACTION_NAMES,
    AnyAction,
    Fate,
    Feedback,
    FlightState,
    Position,
    Refusal,
    ReturnPhase,
    ReturnToStart,
)
from skyloop.messages.feedback import is_on_earth
from skyloop.messages.geometry import wrap_angle

AT_REST_M_S: Final = 0.3  #: a vehicle that is slower than this at its place has arrived
_ACTIONS: Final = frozenset(ACTION_NAMES)
_OLD_PLACE_S: Final = 2.0  #: older, a place on the earth is not converted by it
OVERRULED: Final = (Fate.FAILSAFE, Fate.LINK, Fate.AUTHORITY)  #: not refused: it may be asked for again
OUTDONE: Final = (Fate.REPLACED, Fate.WITHDRAWN)  #: by the application itself


def checked(action: AnyAction) -> AnyAction:
    """Return ``action`` if it can be commanded, else raise :class:`UsageError`."""
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
    """Return the action that flies to a place: x east, y north, z up [m], yaw from x [rad], greatest speed [m/s].

    None keeps the present yaw, and is as fast as the limits allow. Raises :class:`UsageError` for what is no number,
    not finite, or makes no sense.
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
    """Return the action that flies back to the start; None: as the proxy's parameters say.

    Raises :class:`UsageError` if something is no number or no bool, or makes no sense.
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
    """Return x, y, z [m] of a place that is given in either way; the values of the other one are None.

    Args:
        local: x, y, z in world axes [m].
        earth: Latitude and longitude [°], altitude above mean sea level [m] or None: the present height.
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
    """Return the value of an argument as a finite float above zero, else raise :class:`UsageError`."""
    found = number(name, value)
    if not found > 0.0:
        raise UsageError(f"{name} is {found:g} and must be more than 0")
    return found


def number(name: str, value: object) -> float:
    """Return the value of an argument as a finite float, else raise :class:`UsageError`."""
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

    The yaw matters where the place has one; a vehicle that tells no velocity counts as at rest.
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
