"""Routes, stored in ``NAME.route.json``, with a speed, heading and actions for each waypoint, and preflight checks.

World axes are x east, y north, z up [m]; yaw is counter-clockwise from x [rad]. The file format is described in
``docs/routes.md``. The checks cover legs, heights, speeds, battery and start.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import msgspec

from skyloop import files
from skyloop.control.waypoint import Waypoint, lacking
from skyloop.errors import LinkError, NoAnswerError, UsageError
from skyloop.messages import Feedback, Value, Vector
from skyloop.zones import BOX, FAR_M, Space, space_of

if TYPE_CHECKING:
    from skyloop.client import Drone

ENDING: Final = ".route.json"
VERSION: Final = 1  #: version of the file format
LARGEST_FILE: Final = 65_536  #: maximum size of a route file [bytes]
MOST_WAYPOINTS: Final = 200  #: maximum number of waypoints in a route

Metres = Annotated[float, msgspec.Meta(ge=-10_000.0, le=10_000.0)]
Angle = Annotated[float, msgspec.Meta(ge=-7.0, le=7.0)]  # a little more than a full turn either way [rad]
Speed = Annotated[float, msgspec.Meta(ge=0.05, le=30.0)]
Seconds = Annotated[float, msgspec.Meta(ge=0.0, le=3600.0)]
Name = Annotated[str, msgspec.Meta(max_length=64)]
Point = tuple[Metres, Metres]
SETTLE_S: Final = 1.0  #: additional time per leg for accelerating and stopping
LOOK_S: Final = 3.0  #: estimated duration of a look action
PHOTO_S: Final = 1.0  #: estimated duration of a photo
DESCENT_M_S: Final = 0.4  #: landing speed assumed for the estimate
SLACK_M: Final = 0.15  #: tolerance of the checks, the same as in the proxy


class _Part(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Base class for the parts of a route."""

    def __post_init__(self) -> None:
        for name in self.__struct_fields__:
            value = getattr(self, name)
            numbers = value if isinstance(value, tuple) else (value,)
            if any(isinstance(number, float) and not math.isfinite(number) for number in numbers):
                raise UsageError(f"{name} is {value} and must be finite")


class Look(_Part, frozen=True, tag_field="do", tag="look"):
    """Turn to a given yaw, or towards a point (x, y)."""

    yaw: Angle | None = None
    at: Point | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.yaw is None) == (self.at is None):
            raise UsageError("look needs either a yaw or a point to look at: give one of yaw and at")


class Wait(_Part, frozen=True, tag_field="do", tag="wait"):
    """Stay at the waypoint for some time [s]."""

    seconds: Seconds


class Photo(_Part, frozen=True, tag_field="do", tag="photo"):
    """Save a frame from a camera, by default the vehicle's first camera."""

    camera: Name | None = None


Action = Look | Wait | Photo


class RouteWaypoint(_Part, frozen=True):
    """A waypoint of a route."""

    x: Metres  #: east [m]
    y: Metres  #: north [m]
    z: Metres  #: up [m]
    speed: Speed | None = None  #: maximum speed to this waypoint [m/s]; None for the route's speed
    yaw: Angle | None = None  #: yaw to turn to before arrival [rad]; None to keep the current yaw
    look_at: Point | None = None  #: point (x, y) [m] to face, as an alternative to a fixed yaw
    actions: Annotated[tuple[Action, ...], msgspec.Meta(max_length=16)] = ()  #: actions to perform, in order

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.yaw is not None and self.look_at is not None:
            raise UsageError("a waypoint takes a yaw or a point to look at, not both")

    @property
    def position(self) -> Vector:
        """The position (x, y, z) [m]."""
        return self.x, self.y, self.z

    @property
    def goal(self) -> Waypoint:
        """The position and yaw to fly to."""
        return Waypoint(self.x, self.y, self.z, self.yaw if self.look_at is None else self.yaw_to(self.look_at))

    def yaw_to(self, point: Point) -> float:
        """Return the yaw [rad] for facing a point from this waypoint."""
        return math.atan2(point[1] - self.y, point[0] - self.x)


class Route(_Part, frozen=True, kw_only=True):
    """A route.

    Raises:
        UsageError: A number is not finite, or there are no waypoints.
    """

    #: waypoints in flight order
    waypoints: Annotated[tuple[RouteWaypoint, ...], msgspec.Meta(min_length=1, max_length=MOST_WAYPOINTS)]
    name: Name = ""  #: human-readable name
    speed: Speed = 0.5  #: maximum speed to waypoints that don't set their own [m/s]
    #: what to do after the last waypoint: ``hover``, ``land`` or ``return`` (fly back to the start of the route at the
    #: last waypoint's height and land there)
    end: Literal["hover", "land", "return"] = "hover"
    version: Literal[1] = VERSION

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.waypoints:
            raise UsageError("a route needs at least one waypoint")

    def speed_to(self, index: int) -> float:
        """Return the maximum speed to a waypoint [m/s]; an index past the last waypoint means the return flight."""
        own = self.waypoints[index].speed if index < len(self.waypoints) else None
        return self.speed if own is None else own

    def to_json(self) -> bytes:
        """Return the contents of the route's file."""
        plain: dict[str, Any] = {"version": self.version, **msgspec.to_builtins(self)}
        return msgspec.json.format(msgspec.json.encode(plain), indent=1) + b"\n"


def parse_route(content: bytes | str) -> Route:
    """Read a route from the contents of a file; if it is not a route, UsageError says where and why."""
    try:
        return checked(msgspec.json.decode(content, type=Route))
    except (msgspec.MsgspecError, UnicodeError, RecursionError) as error:
        raise UsageError(f"not a route: {error}") from None


def load_route(path: str | Path) -> Route:
    """Read a route file.

    Raises:
        FileFormatError: The file can't be read.
        UsageError: The file is not a route; the message says where and why.
    """
    content = files.read_text(path, "the route", LARGEST_FILE)
    try:
        return parse_route(content)
    except UsageError as error:
        raise UsageError(f"{path}: {error}") from None


def save_route(route: Route, path: str | Path) -> None:
    """Write a route file, replacing an existing one.

    Raises:
        UsageError: The file can't be written, or a number in the route is out of range.
    """
    files.write(files.expand(path), checked(route).to_json())


def checked(route: Route) -> Route:
    """Return the route after checking that all numbers are in range, even if a program built the route."""
    try:
        return msgspec.convert(msgspec.to_builtins(route), Route)
    except msgspec.ValidationError as error:
        raise UsageError(f"not a route: {error}") from None


@dataclass(frozen=True, slots=True)
class Conditions:
    """The conditions against which a route is checked."""

    space: Space = field(default_factory=Space)  #: where flying is allowed
    #: start of the route [m]: the vehicle's position or, before take-off, a point above it; None if unknown
    start: Vector | None = None
    problem: str = ""  #: why the vehicle can't be flown by position; empty if it can
    ground_m: float | None = None  #: height of the ground in world axes; None if unknown
    battery: float | None = None  #: current battery charge, 0 to 1; None if unknown
    speed_m_s: float = 2.0  #: maximum horizontal speed
    climb_m_s: float = 1.0  #: maximum speed up or down
    altitude_m: float = 5.0  #: maximum height above the ground
    battery_warn: float = 0.2  #: battery charge below which the vehicle warns
    battery_land: float = 0.1  #: battery charge below which the vehicle lands
    flight_time_s: float = 600.0  #: flight time with a full battery


class Finding(msgspec.Struct, frozen=True):
    """A problem with a route, or a warning about it."""

    waypoint: int | None  #: number of the waypoint, or of the leg's end point, from 1; None for the whole route
    severity: Literal["error", "warning"]
    reason: str


class RouteCheck(msgspec.Struct, frozen=True):
    """Findings about a route, with estimates for the flight."""

    findings: tuple[Finding, ...]
    length_m: float
    seconds: float
    battery_left: float | None  #: battery charge at the end, 0 to 1; None if the current charge is unknown

    @property
    def ok(self) -> bool:
        """Whether no errors were found."""
        return all(one.severity != "error" for one in self.findings)


def conditions_of(feedback: Feedback | None, parameters: Mapping[str, Value]) -> Conditions:
    """Read the conditions from a vehicle's newest feedback and its parameters."""
    usual = {f"{BOX}.{axis}_{end}": far for axis in "xyz" for end, far in (("low", -FAR_M), ("high", FAR_M))}

    def number(name: str, default: float = 0.0) -> float:
        value = parameters.get(name, usual.get(name, default))
        return float(value) if isinstance(value, int | float) and math.isfinite(value) else default

    def text(name: str) -> str:
        value = parameters.get(name, "")
        return value if isinstance(value, str) else ""

    problem = "no feedback from the vehicle yet" if feedback is None else lacking(feedback)
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


def check_for(drone: Drone, route: Route, *, wait_s: float = 2.0) -> RouteCheck:
    """Check a route against a drone's newest feedback and parameters; observers may do so, too.

    Waits for the proxy's answer, and up to ``wait_s`` for the first position.
    """
    feedback = None
    with suppress(LinkError):  # missing feedback becomes a finding
        if wait_s > 0.0:
            with suppress(NoAnswerError):
                drone.wait(lambda newest: newest.position_m is not None, wait_s)
        feedback = drone.feedback()
    values = {parameter.name: parameter.value for parameter in drone.config.parameters()}
    return check_route(route, conditions_of(feedback, values))


def check_route(route: Route, conditions: Conditions) -> RouteCheck:
    """Check each waypoint, each leg and the route as a whole.

    The estimated duration is the sum of the time for each leg at its speed, :data:`SETTLE_S` per leg for starting and
    stopping, all actions and the final descent. The battery is assumed to drain evenly over ``flight_time_s``.
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
            warning(number, f"{back}{speed:g} m/s is more than limits.speed allows: flown at {c.speed_m_s:g} m/s")
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
        warning(None, "the battery's charge is unknown: can't check whether it lasts")
    elif left < c.battery_land:
        minutes = f"{seconds / 60:.1f} minutes of the {c.flight_time_s / 60:g} of a full battery (battery.flight_time)"
        error(None, f"the battery falls below {c.battery_land:.0%} and the vehicle lands: the route takes {minutes}")
    elif left < c.battery_warn:
        warning(None, f"the battery ends up at about {left:.0%}, below {c.battery_warn:.0%} (battery.warn)")
    return RouteCheck(tuple(found), length_m, seconds, None if left is None else max(0.0, left))


def _height_problem(place: Vector, c: Conditions) -> str:
    """Return a description of the problem with a point's height; empty if there is none."""
    ground = c.ground_m
    if ground is None:
        return ""
    if place[2] < ground - SLACK_M:
        return f"z is {place[2]:g} m, below the ground at {ground:.2f} m"
    if place[2] > ground + c.altitude_m + SLACK_M:
        return f"z is {place[2]:g} m and must be at most {ground + c.altitude_m:.2f} m (limits.altitude)"
    return ""


def _leg_s(at: Vector, to: Vector, speed: float, climb: float) -> float:
    """Return the duration of a leg [s]."""
    away = math.dist(at, to)
    return SETTLE_S + max(away / speed, abs(to[2] - at[2]) / climb) if away > 0.01 else 0.0
