"""Routes: waypoints with a speed, a heading and actions, in files ``NAME.route.json``.

World axes are x east, y north, z up [m]; yaw is counter-clockwise from x [rad]. ``docs/routes.md`` describes the file.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import msgspec

from skyloop import files
from skyloop.control.waypoint import Waypoint
from skyloop.errors import UsageError
from skyloop.messages import Vector

ENDING: Final = ".route.json"
VERSION: Final = 1
LARGEST_FILE: Final = 65_536  #: bytes
MOST_WAYPOINTS: Final = 200

Metres = Annotated[float, msgspec.Meta(ge=-10_000.0, le=10_000.0)]
Angle = Annotated[float, msgspec.Meta(ge=-7.0, le=7.0)]
Speed = Annotated[float, msgspec.Meta(ge=0.05, le=30.0)]
Seconds = Annotated[float, msgspec.Meta(ge=0.0, le=3600.0)]
Name = Annotated[str, msgspec.Meta(max_length=64)]
Point = tuple[Metres, Metres]


class _Part(msgspec.Struct, frozen=True, forbid_unknown_fields=True, omit_defaults=True):
    """Base of the parts of a route."""

    def __post_init__(self) -> None:
        for name in self.__struct_fields__:
            value = getattr(self, name)
            numbers = value if isinstance(value, tuple) else (value,)
            if any(isinstance(number, float) and not math.isfinite(number) for number in numbers):
                raise UsageError(f"{name} is {value} and must be finite")


class Look(_Part, frozen=True, tag_field="do", tag="look"):
    """Turn to a yaw, or towards a point (x, y)."""

    yaw: Angle | None = None
    at: Point | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.yaw is None) == (self.at is None):
            raise UsageError("look needs a yaw, or a point to look at: give one of yaw and at")


class Wait(_Part, frozen=True, tag_field="do", tag="wait"):
    """Stay at the waypoint [s]."""

    seconds: Seconds


class Photo(_Part, frozen=True, tag_field="do", tag="photo"):
    """Save a frame; None is the vehicle's first camera."""

    camera: Name | None = None


Action = Look | Wait | Photo


class RouteWaypoint(_Part, frozen=True):
    """One waypoint.

    Attributes:
        x: East [m].
        y: North [m].
        z: Up [m].
        speed: Greatest on the way there [m/s]; None: the route's.
        yaw: Turned to on the way there [rad]; None: the present one is kept.
        look_at: In place of a yaw, the point (x, y) that it looks at [m].
        actions: What is done there, in this order.
    """

    x: Metres
    y: Metres
    z: Metres
    speed: Speed | None = None
    yaw: Angle | None = None
    look_at: Point | None = None
    actions: Annotated[tuple[Action, ...], msgspec.Meta(max_length=16)] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.yaw is not None and self.look_at is not None:
            raise UsageError("a waypoint has a yaw or a point to look at, not both")

    @property
    def position(self) -> Vector:
        """Return (x, y, z) [m]."""
        return self.x, self.y, self.z

    @property
    def goal(self) -> Waypoint:
        """Return where to fly, with the yaw there."""
        return Waypoint(self.x, self.y, self.z, self.yaw if self.look_at is None else self.yaw_to(self.look_at))

    def yaw_to(self, point: Point) -> float:
        """Return the yaw that looks from here to a point [rad]."""
        return math.atan2(point[1] - self.y, point[0] - self.x)


class Route(_Part, frozen=True, kw_only=True):
    """A route.

    Attributes:
        waypoints: In the order in which they are flown to.
        name: For people.
        speed: Greatest between waypoints that have none of their own [m/s].
        end: What is done after the last one: ``hover``, ``land``, or ``return``: fly back to where the route began, at
            the last waypoint's height, and land.
        version: Of the file's format.

    Raises:
        UsageError: A number is not finite, or there is no waypoint.
    """

    waypoints: Annotated[tuple[RouteWaypoint, ...], msgspec.Meta(min_length=1, max_length=MOST_WAYPOINTS)]
    name: Name = ""
    speed: Speed = 0.5
    end: Literal["hover", "land", "return"] = "hover"
    version: Literal[1] = VERSION

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.waypoints:
            raise UsageError("a route has at least one waypoint")

    def speed_to(self, index: int) -> float:
        """Return the greatest speed on the way to a waypoint [m/s]; beyond the last one, on the way back."""
        own = self.waypoints[index].speed if index < len(self.waypoints) else None
        return self.speed if own is None else own

    def to_json(self) -> bytes:
        """Return the file's content."""
        plain: dict[str, Any] = {"version": self.version, **msgspec.to_builtins(self)}
        return msgspec.json.format(msgspec.json.encode(plain), indent=1) + b"\n"


def parse_route(content: bytes | str) -> Route:
    """Read a route from the content of its file.

    Raises:
        UsageError: It is none; the message says where and why.
    """
    try:
        return checked(msgspec.json.decode(content, type=Route))
    except (msgspec.MsgspecError, UnicodeError, RecursionError) as error:
        raise UsageError(f"not a route: {error}") from None


def load_route(path: str | Path) -> Route:
    """Read a route's file.

    Raises:
        FileFormatError: It can't be read.
        UsageError: It is no route; the message says where and why.
    """
    content = files.read_text(path, "the route", LARGEST_FILE)
    try:
        return parse_route(content)
    except UsageError as error:
        raise UsageError(f"{path}: {error}") from None


def save_route(route: Route, path: str | Path) -> None:
    """Write a route's file; one that is there is replaced.

    Raises:
        UsageError: It can't be written, or a number of the route is out of its range.
    """
    files.write(files.expand(path), checked(route).to_json())


def checked(route: Route) -> Route:
    """Return the route, with every number within its range.

    Raises:
        UsageError: One is not; a route that a program made is checked only here.
    """
    try:
        return msgspec.convert(msgspec.to_builtins(route), Route)
    except msgspec.ValidationError as error:
        raise UsageError(f"not a route: {error}") from None
