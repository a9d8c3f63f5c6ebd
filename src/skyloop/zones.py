"""Define the space in which a vehicle may fly: a room's walls, a safety box and upright no-fly zones. Pure.

The world axes are x east, y north, z up [m]. The proxy decides how a vehicle may move near these walls.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Final, NamedTuple

from skyloop.errors import ParameterError
from skyloop.messages import Refusal, Value

FAR_M: Final = 10_000.0  #: a wall of the safety box is ignored if it is at least this far away [m]
MAX_ZONES: Final = 32  #: maximum number of zones
#: Thinner zones are enlarged to this thickness [m] to keep an overshoot or a gust from carrying a vehicle across.
THINNEST_M: Final = 0.5
BOX: Final = "safety.box"  #: prefix of the parameters of the safety box
ZONES: Final = "safety.zones"
ROOM: Final = "safety.room"

MAX_NAME: Final = 24  #: maximum length of a zone's name [characters]
_SHAPES: Final = {"box": 6, "cylinder": 5}  # how many numbers define each shape
_NAME: Final = re.compile(rf"[^:;,\x00-\x1f\x7f]{{1,{MAX_NAME}}}")

Vec3 = tuple[float, float, float]


class Wall(NamedTuple):
    """A plane, given by a unit vector towards it (world axes) and the distance to it [m], negative beyond the plane."""

    normal: Vec3
    distance: float
    name: str  #: name of the parameter
    zone: str = ""  #: name of the zone, if any


@dataclass(frozen=True, slots=True)
class Box:
    """An upright box parallel to the world axes."""

    low: Vec3
    high: Vec3
    name: str = ""  #: name of the zone, if any

    def walls_inside(self, place: Vec3) -> Iterator[Wall]:
        """Yield the walls of a box that a vehicle must not leave."""
        for axis in range(3):
            for sign, distance in ((-1.0, place[axis] - self.low[axis]), (1.0, self.high[axis] - place[axis])):
                normal = [0.0, 0.0, 0.0]
                normal[axis] = sign
                yield Wall((normal[0], normal[1], normal[2]), distance, BOX)

    def wall_outside(self, place: Vec3) -> Wall:
        """Return the wall that a vehicle outside the box must not cross."""
        nearest = tuple(max(low, min(high, at)) for low, high, at in zip(self.low, self.high, place, strict=True))
        way = (nearest[0] - place[0], nearest[1] - place[1], nearest[2] - place[2])
        distance = math.hypot(*way)
        if distance > 0.0:
            return Wall((way[0] / distance, way[1] / distance, way[2] / distance), distance, ZONES, self.name)
        return max(
            (Wall((-n[0], -n[1], -n[2]), -d, ZONES, self.name) for n, d, *_ in self.walls_inside(place)),
            key=lambda wall: wall.distance,
        )

    def holds(self, place: Vec3) -> bool:
        """Return whether a position is inside the box or on its surface."""
        return all(low <= at <= high for low, high, at in zip(self.low, self.high, place, strict=True))

    def is_in_the_way(self, start: Vec3, end: Vec3) -> bool:
        """Return whether the straight line between two positions crosses the zone."""
        first, last = 0.0, 1.0
        for low, high, at, to in zip(self.low, self.high, start, end, strict=True):
            first, last = _within(low, high, at, to, first, last)
        return first <= last

    def thickened(self) -> Box:
        """Return a box with the same centre that is at least :data:`THINNEST_M` thick along each axis."""
        x, y, z = (_thickened(low, high) for low, high in zip(self.low, self.high, strict=True))
        low, high = (x[0], y[0], z[0]), (x[1], y[1], z[1])
        return self if (low, high) == (self.low, self.high) else replace(self, low=low, high=high)

    def __str__(self) -> str:
        return f"{_prefix(self.name)}box {_numbers(*self.low, *self.high)}"


@dataclass(frozen=True, slots=True)
class Cylinder:
    """An upright cylinder."""

    x: float
    y: float
    radius: float
    low: float
    high: float
    name: str = ""

    def wall_outside(self, place: Vec3) -> Wall:
        """Return the wall that a vehicle outside the cylinder must not cross."""
        east, north = self.x - place[0], self.y - place[1]
        off = math.hypot(east, north)
        aside = (east / off, north / off) if off > 0.0 else (1.0, 0.0)
        across, along = off - self.radius, max(self.low - place[2], place[2] - self.high)
        up = 1.0 if place[2] < (self.low + self.high) / 2 else -1.0
        if across > 0.0 and along > 0.0:
            distance = math.hypot(across, along)
            share = across / distance
            return Wall((aside[0] * share, aside[1] * share, up * along / distance), distance, ZONES, self.name)
        if across >= along:
            return Wall((aside[0], aside[1], 0.0), across, ZONES, self.name)
        return Wall((0.0, 0.0, up), along, ZONES, self.name)

    def holds(self, place: Vec3) -> bool:
        """Return whether a position is inside or on the surface."""
        return math.hypot(place[0] - self.x, place[1] - self.y) <= self.radius and self.low <= place[2] <= self.high

    def is_in_the_way(self, start: Vec3, end: Vec3) -> bool:
        """Return whether the straight line between two positions crosses the zone."""
        first, last = _within(self.low, self.high, start[2], end[2], 0.0, 1.0)
        if first > last:
            return False
        x, y, across, along = start[0] - self.x, start[1] - self.y, end[0] - start[0], end[1] - start[1]
        length = across * across + along * along
        nearest = 0.0 if length == 0.0 else -(x * across + y * along) / length  # nearest point on the infinite line
        share = max(first, min(last, nearest))
        return math.hypot(x + share * across, y + share * along) <= self.radius

    def thickened(self) -> Cylinder:
        """Return a cylinder with the same centre that is at least :data:`THINNEST_M` thick."""
        radius, (low, high) = max(self.radius, THINNEST_M / 2), _thickened(self.low, self.high)
        if (radius, low, high) == (self.radius, self.low, self.high):
            return self
        return replace(self, radius=radius, low=low, high=high)

    def __str__(self) -> str:
        return f"{_prefix(self.name)}cylinder {_numbers(self.x, self.y, self.radius, self.low, self.high)}"


Zone = Box | Cylinder


@dataclass(frozen=True, slots=True)
class Space:
    """The space in which a vehicle may fly."""

    room: Box | None = None  #: the room's walls, which the vehicle can't pass; None if unknown
    box: Box | None = None  #: safety box; None if there is none
    zones: tuple[Zone, ...] = ()  #: no-fly zones, exactly as given
    #: The enforced zones, enlarged to be at least :data:`THINNEST_M` thick.
    barriers: tuple[Zone, ...] = field(init=False, compare=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "barriers", tuple(zone.thickened() for zone in self.zones))

    @property
    def walled(self) -> bool:
        """Whether any walls limit set-points. The walls of the room never do."""
        return self.box is not None or bool(self.zones)

    @property
    def thin(self) -> tuple[Zone, ...]:
        """The zones that had to be enlarged, in their original form."""
        return tuple(zone for zone, kept in zip(self.zones, self.barriers, strict=True) if zone is not kept)

    def problem_at(self, place: Vec3) -> str:
        """Return why the vehicle may not fly to a position, and where it may, as readable text; empty if it may."""
        if self.room is not None and not self.room.holds(place):
            return f"the place is outside the room, {self.room} [m] ({ROOM})"
        if self.box is not None and not self.box.holds(place):
            return f"the place is outside the safety box, {self.box} [m] ({BOX})"
        for zone, kept in zip(self.zones, self.barriers, strict=True):
            if kept.holds(place):
                return f"the place is in a no-fly zone, {_shown(zone, kept)}: choose a place outside it"
        return ""

    def problem_between(self, start: Vec3, end: Vec3) -> str:
        """Return what blocks the straight line between two positions, as readable text; empty if nothing blocks it.

        A zone that contains the start is ignored, which lets a vehicle leave it.
        """
        for zone, kept in zip(self.zones, self.barriers, strict=True):
            if not kept.holds(start) and kept.is_in_the_way(start, end):
                return f"a no-fly zone blocks the straight line, {_shown(zone, kept)}: fly around it in several legs"
        return ""


def space_of(number: Callable[[str], float], text: Callable[[str], str]) -> Space:
    """Return the space in which a vehicle's parameters allow it to fly; the functions return their values by name.

    Raises :class:`ParameterError` if the zones can't be parsed.
    """
    low = (number(f"{BOX}.x_low"), number(f"{BOX}.y_low"), number(f"{BOX}.z_low"))
    high = (number(f"{BOX}.x_high"), number(f"{BOX}.y_high"), number(f"{BOX}.z_high"))
    is_box = max(low) > -FAR_M or min(high) < FAR_M
    return Space(_room(text(ROOM)), Box(low, high) if is_box else None, parse_zones(text(ZONES)))


def _room(text: str) -> Box | None:
    try:
        zones = parse_zones(text)
    except ParameterError:
        return None  # a driver uses this name for another purpose
    return zones[0] if len(zones) == 1 and isinstance(zones[0], Box) else None


def parse_zones(text: str) -> tuple[Zone, ...]:
    """Parse zones separated by semicolons. Raises :class:`ParameterError` if they are invalid or there are too many.

    A zone is ``box x y z x y z`` (two corners) or ``cylinder x y radius z_low z_high``, in world axes [m]. It may be
    preceded by a name and a colon: ``tree: cylinder 1 2 0.5 0 3``.
    """
    zones = [_parse_zone(part) for part in text.split(";") if part.strip()]
    if len(zones) > MAX_ZONES:
        raise _wrong(f"{len(zones)} zones were given, at most {MAX_ZONES} are allowed")
    return tuple(zones)


def _parse_zone(text: str) -> Zone:
    before, colon, after = text.partition(":")
    name = " ".join(before.split()) if colon else ""
    if colon and not _NAME.fullmatch(name):
        raise _wrong(f"a name must have 1 to {MAX_NAME} letters and no comma, colon or semicolon, got {name!r:.40}")
    shape, *words = re.split(r"[\s,]+", (after if colon else text).strip())
    if shape not in _SHAPES:
        raise _wrong(f"a zone must be a box or a cylinder, got {shape!r:.40}")
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        raise _wrong(f"{shape} must be followed by numbers, got {' '.join(words)!r:.60}") from None
    if len(numbers) != _SHAPES[shape] or not all(math.isfinite(number) for number in numbers):
        raise _wrong(f"a {shape} must have {_SHAPES[shape]} finite numbers, got {len(numbers)} in {text.strip()!r:.60}")
    if shape == "box":
        pairs = list(zip(numbers[:3], numbers[3:], strict=True))
        low, high = [min(pair) for pair in pairs], [max(pair) for pair in pairs]
        if any(a == b for a, b in pairs):
            raise _wrong(f"a box must have an extent along each axis: {text.strip()!r:.60}")
        return Box((low[0], low[1], low[2]), (high[0], high[1], high[2]), name)
    x, y, radius, bottom, top = numbers
    if radius <= 0.0 or bottom >= top:
        raise _wrong(f"a cylinder must have a radius above 0 and its low end below its high end: {text.strip()!r:.60}")
    return Cylinder(x, y, radius, bottom, top, name)


def check_written(name: str, value: Value, number: Callable[[str], float]) -> None:
    """Check a new value for a safety parameter against the others.

    Raises :class:`ParameterError` if opposite walls of the box are in the wrong order or the zones can't be parsed.
    """
    if name == ZONES:
        parse_zones(str(value))
    elif name.startswith(f"{BOX}.") and isinstance(value, float):
        end = "high" if name.endswith("low") else "low"
        other = number(f"{name.rpartition('_')[0]}_{end}")
        if not (value < other if end == "high" else value > other):
            word = "below" if end == "high" else "above"
            raise ParameterError(f"{name} must be {word} the box's other wall, {other:g} m", code=Refusal.OUT_OF_RANGE)


def _thickened(low: float, high: float) -> tuple[float, float]:
    more = (THINNEST_M - (high - low)) / 2
    return (low - more, high + more) if more > 0.0 else (low, high)


def _shown(zone: Zone, kept: Zone) -> str:
    thin = "" if zone is kept else f"; it is thin and enforced as if it were {THINNEST_M:g} m thick"
    return f"{zone} [m] ({ZONES}{thin})"


def _prefix(name: str) -> str:
    return f"{name}: " if name else ""


def _wrong(why: str) -> ParameterError:
    form = "box x y z x y z; tree: cylinder x y radius z_low z_high"
    return ParameterError(f"{ZONES}: {why}; for example {form!r} [m]", code=Refusal.OUT_OF_RANGE)


def _within(low: float, high: float, at: float, to: float, first: float, last: float) -> tuple[float, float]:
    """Return the part of the way from ``at`` to ``to`` between two walls, as fractions from ``first`` to ``last``.

    If there is none, the first fraction is greater than the second.
    """
    if at == to:
        return (first, last) if low <= at <= high else (1.0, 0.0)
    one, other = (low - at) / (to - at), (high - at) / (to - at)
    return max(first, min(one, other)), min(last, max(one, other))


def _numbers(*numbers: float) -> str:
    return " ".join(f"{number:g}" for number in numbers)
