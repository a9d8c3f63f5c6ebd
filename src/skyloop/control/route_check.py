"""What speaks against a route, before it is flown: legs, heights, speeds, battery, the start. Pure."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Literal

import msgspec

from skyloop.control.route import Look, Photo, Route, Wait
from skyloop.control.waypoint import lacking
from skyloop.messages import Feedback, Value, Vector
from skyloop.zones import BOX, FAR_M, Space, space_of

SETTLE_S: Final = 1.0  #: what a leg takes longer than at its full speed: to get under way and to come to rest
LOOK_S: Final = 3.0
PHOTO_S: Final = 1.0
DESCENT_M_S: Final = 0.4
SLACK_M: Final = 0.15  #: as that of the proxy


@dataclass(frozen=True, slots=True)
class Conditions:
    """What a route is checked against.

    Attributes:
        space: Where the vehicle may fly.
        start: Where the route begins [m]: the vehicle's position, or above it where it takes off first; None: unknown.
        problem: Why the vehicle can't be flown by position; empty if it can.
        ground_m: Height of the ground in world axes; None: unknown.
        battery: Charge now, 0 to 1; None: unknown.
        speed_m_s: Greatest horizontal speed.
        climb_m_s: Greatest speed up or down.
        altitude_m: Greatest height above the ground.
        battery_warn: Charge below which the vehicle warns.
        battery_land: Charge below which the vehicle lands.
        flight_time_s: How long a full battery lasts.
    """

    space: Space = field(default_factory=Space)
    start: Vector | None = None
    problem: str = ""
    ground_m: float | None = None
    battery: float | None = None
    speed_m_s: float = 2.0
    climb_m_s: float = 1.0
    altitude_m: float = 5.0
    battery_warn: float = 0.2
    battery_land: float = 0.1
    flight_time_s: float = 600.0


class Finding(msgspec.Struct, frozen=True):
    """Something that speaks against a route, or that one should know."""

    waypoint: int | None  #: from 1 on; None: of the whole route. A problem of a leg has the number of its end
    severity: Literal["error", "warning"]
    reason: str


class RouteCheck(msgspec.Struct, frozen=True):
    """What was found, and an estimate of the flight."""

    findings: tuple[Finding, ...]
    length_m: float
    seconds: float
    battery_left: float | None  #: charge at the end, 0 to 1; None where it is not known now

    @property
    def ok(self) -> bool:
        """Whether nothing forbids the flight."""
        return all(one.severity != "error" for one in self.findings)


def conditions_of(feedback: Feedback | None, parameters: Mapping[str, Value]) -> Conditions:
    """Return what a vehicle's newest feedback and its parameters say.

    Raises:
        ParameterError: The no-fly zones can't be read.
    """
    usual = {f"{BOX}.{axis}_{end}": far for axis in "xyz" for end, far in (("low", -FAR_M), ("high", FAR_M))}

    def number(name: str, default: float = 0.0) -> float:
        value = parameters.get(name, usual.get(name, default))
        return float(value) if isinstance(value, int | float) and math.isfinite(value) else default

    def text(name: str) -> str:
        value = parameters.get(name, "")
        return value if isinstance(value, str) else ""

    problem = "nothing is known of the vehicle yet" if feedback is None else lacking(feedback)
    start, ground = None, None
    if feedback is not None and feedback.position_m is not None:
        x, y, z = start = feedback.position_m
        ground = None if feedback.altitude_m is None else z - feedback.altitude_m
        if not feedback.state.airborne:
            rise = number("limits.takeoff_altitude", number("autopilot.takeoff_altitude", 1.0))
            start = (x, y, z + rise)
    return Conditions(
        space_of(number, text),
        start,
        problem,
        ground,
        None if feedback is None else feedback.battery,
        number("limits.speed", 2.0),
        number("limits.climb", 1.0),
        number("limits.altitude", 5.0),
        number("battery.warn", 0.2),
        number("battery.land", 0.1),
        number("battery.flight_time", 600.0),
    )


def check_route(route: Route, conditions: Conditions) -> RouteCheck:
    """Check each waypoint, each leg, and the whole.

    The estimate: each leg at its speed, :data:`SETTLE_S` more for starting and stopping, the actions' times, and the
    battery in proportion to the time, by ``flight_time_s``.

    Args:
        route: The route.
        conditions: The vehicle, its limits and where it may fly.
    """
    found: list[Finding] = []

    def error(number: int | None, reason: str) -> None:
        found.append(Finding(number, "error", reason))

    def warning(number: int | None, reason: str) -> None:
        found.append(Finding(number, "warning", reason))

    c, length_m, seconds = conditions, 0.0, 0.0
    if c.problem:
        error(None, c.problem)
    places: list[Vector] = [one.position for one in route.waypoints]
    if route.end == "return" and c.start is not None:
        places.append((c.start[0], c.start[1], places[-1][2]))
    at = c.start
    for index, place in enumerate(places):
        number = min(index + 1, len(route.waypoints))
        back = "on the way back, " if index == len(route.waypoints) else ""
        problem = c.space.problem_at(place) or _height_problem(place, c)
        if not problem and at is not None:
            problem = c.space.problem_between(at, place)
        if problem:
            error(number, back + problem)
        speed = route.speed_to(index)
        if speed > c.speed_m_s:
            warning(number, f"{back}{speed:g} m/s is asked for, and at most {c.speed_m_s:g} m/s flown (limits.speed)")
        if at is not None:
            length_m += math.dist(at, place)
            seconds += _leg_s(at, place, min(speed, c.speed_m_s), c.climb_m_s)
        if index < len(route.waypoints):
            seconds += sum(
                one.seconds if isinstance(one, Wait) else LOOK_S if isinstance(one, Look) else PHOTO_S
                for one in route.waypoints[index].actions
                if isinstance(one, Wait | Look | Photo)
            )
        at = place
    if route.end != "hover":
        seconds += max(0.0, places[-1][2] - (c.ground_m or 0.0)) / DESCENT_M_S
    left = None if c.battery is None else c.battery - seconds / c.flight_time_s
    if left is None:
        warning(None, "the battery's charge is not known: it is not checked whether it lasts")
    elif left < c.battery_land:
        minutes = f"{seconds / 60:.1f} minutes of the {c.flight_time_s / 60:g} of a full battery (battery.flight_time)"
        error(None, f"the battery ends below {c.battery_land:.0%}, where the vehicle lands: the route takes {minutes}")
    elif left < c.battery_warn:
        warning(None, f"the battery ends at about {left:.0%}, below {c.battery_warn:.0%} (battery.warn)")
    return RouteCheck(tuple(found), length_m, seconds, None if left is None else max(0.0, left))


def _height_problem(place: Vector, c: Conditions) -> str:
    """Return what is wrong with a place's height; empty if nothing is."""
    ground = c.ground_m
    if ground is None:
        return ""
    if place[2] < ground - SLACK_M:
        return f"z is {place[2]:g} m, below the ground at {ground:.2f} m"
    if place[2] > ground + c.altitude_m + SLACK_M:
        return f"z is {place[2]:g} m, and at most {ground + c.altitude_m:.2f} m is allowed (limits.altitude)"
    return ""


def _leg_s(at: Vector, to: Vector, speed: float, climb: float) -> float:
    """Return how long a leg takes [s]."""
    away = math.dist(at, to)
    return SETTLE_S + max(away / speed, abs(to[2] - at[2]) / climb) if away > 0.01 else 0.0
