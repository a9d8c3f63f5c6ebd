"""The safety box and the no-fly zones: set-points that would leave the one or enter the others are shortened. Pure.

Every wall is a plane: those of the box, and before each zone the one through its nearest point, square to the line of
sight, behind which all of the zone lies because zones are convex. Towards a plane at distance ``d`` the vehicle may be
as fast as it can still be stopped: ``v·t + v²/(2·a) = d`` with the reaction time ``t``, the age of the position
included, and the deceleration ``a``. A velocity keeps what runs along the plane; a tilt is let through until the
vehicle is as fast as that, and then is turned into one that brakes.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple

from skyloop.clock import NS_PER_S, seconds
from skyloop.errors import ParameterError
from skyloop.messages import AnyAction, Attitude, Feedback, Refusal, Value, Velocity
from skyloop.proxy.core.limits import Clamp

GRAVITY_M_S2: Final = 9.80665
STALE_NS: Final = NS_PER_S // 2  #: a vehicle whose position is older has none
MARGIN_M: Final = 0.1  #: so far beyond a wall is taken for noise; farther is outside, where only coming back is allowed
FAR_M: Final = 10_000.0  #: a wall of the box that far away is none
BRAKE_GAIN: Final = 2.0  #: deceleration asked for per speed that is too much [1/s]
RETURN_M_S: Final = 0.5  #: at most so fast is it led back that is beyond a wall and asks to go farther
MAX_ZONES: Final = 32
BOX: Final = "safety.box"
ZONES: Final = "safety.zones"

_PASSES: Final = 8  # of shortening by all walls in turn, before giving up on all but standing still
_SHAPES: Final = {"box": 6, "cylinder": 5}

Vec3 = tuple[float, float, float]


class Wall(NamedTuple):
    """A plane: the unit vector towards it, world axes, and how far it is [m]; below 0 the vehicle is beyond it."""

    normal: Vec3
    distance: float
    name: str  #: of the parameter


@dataclass(frozen=True, slots=True)
class Box:
    """An upright box along the world's axes."""

    low: Vec3
    high: Vec3

    def walls_inside(self, place: Vec3) -> Iterator[Wall]:
        """Those of a box that is to be kept in."""
        for axis in range(3):
            for sign, distance in ((-1.0, place[axis] - self.low[axis]), (1.0, self.high[axis] - place[axis])):
                normal = [0.0, 0.0, 0.0]
                normal[axis] = sign
                yield Wall((normal[0], normal[1], normal[2]), distance, BOX)

    def wall_outside(self, place: Vec3) -> Wall:
        """The one of a box that is to be kept out of."""
        nearest = tuple(max(low, min(high, at)) for low, high, at in zip(self.low, self.high, place, strict=True))
        way = (nearest[0] - place[0], nearest[1] - place[1], nearest[2] - place[2])
        distance = math.hypot(*way)
        if distance > 0.0:
            return Wall((way[0] / distance, way[1] / distance, way[2] / distance), distance, ZONES)
        return max(
            (Wall((-n[0], -n[1], -n[2]), -d, ZONES) for n, d, _ in self.walls_inside(place)),
            key=lambda wall: wall.distance,
        )

    def holds(self, place: Vec3) -> bool:
        """Whether a place is within it, or on its surface."""
        return all(low <= at <= high for low, high, at in zip(self.low, self.high, place, strict=True))

    def is_in_the_way(self, start: Vec3, end: Vec3) -> bool:
        """Whether the straight way between two places leads through it."""
        first, last = 0.0, 1.0
        for low, high, at, to in zip(self.low, self.high, start, end, strict=True):
            first, last = _within(low, high, at, to, first, last)
        return first <= last

    def __str__(self) -> str:
        return f"box {_numbers(*self.low, *self.high)}"


@dataclass(frozen=True, slots=True)
class Cylinder:
    """An upright cylinder."""

    x: float
    y: float
    radius: float
    low: float
    high: float

    def wall_outside(self, place: Vec3) -> Wall:
        """The one of a cylinder that is to be kept out of."""
        east, north = self.x - place[0], self.y - place[1]
        off = math.hypot(east, north)
        aside = (east / off, north / off) if off > 0.0 else (1.0, 0.0)
        across, along = off - self.radius, max(self.low - place[2], place[2] - self.high)
        up = 1.0 if place[2] < (self.low + self.high) / 2 else -1.0
        if across > 0.0 and along > 0.0:
            distance = math.hypot(across, along)
            share = across / distance
            return Wall((aside[0] * share, aside[1] * share, up * along / distance), distance, ZONES)
        if across >= along:
            return Wall((aside[0], aside[1], 0.0), across, ZONES)
        return Wall((0.0, 0.0, up), along, ZONES)

    def holds(self, place: Vec3) -> bool:
        """Whether a place is within it, or on its surface."""
        return math.hypot(place[0] - self.x, place[1] - self.y) <= self.radius and self.low <= place[2] <= self.high

    def is_in_the_way(self, start: Vec3, end: Vec3) -> bool:
        """Whether the straight way between two places leads through it."""
        first, last = _within(self.low, self.high, start[2], end[2], 0.0, 1.0)
        if first > last:
            return False
        x, y, across, along = start[0] - self.x, start[1] - self.y, end[0] - start[0], end[1] - start[1]
        length = across * across + along * along
        nearest = 0.0 if length == 0.0 else -(x * across + y * along) / length  # of the whole line, as a share of it
        share = max(first, min(last, nearest))
        return math.hypot(x + share * across, y + share * along) <= self.radius

    def __str__(self) -> str:
        return f"cylinder {_numbers(self.x, self.y, self.radius, self.low, self.high)}"


Zone = Box | Cylinder


@dataclass(frozen=True, slots=True)
class Safety:
    """The walls in force."""

    box: Box | None
    zones: tuple[Zone, ...] = ()
    deceleration: float = 1.0  #: at which the vehicle can be relied on to stop [m/s²]
    reaction_s: float = 0.3  #: until it begins to

    def clamp(
        self, action: AnyAction, feedback: Feedback | None, now_ns: int
    ) -> tuple[AnyAction, tuple[Clamp, ...], bool]:
        """Return the nearest set-point that keeps within the box and out of the zones.

        Args:
            action: what is asked for.
            feedback: the newest sample.
            now_ns: the time now, on the clock of ``feedback.captured_ns`` [ns].

        Returns:
            The set-point, what was in the way, and whether the position is known; if not, the set-point is unchanged.
        """
        if feedback is None or feedback.position_m is None or feedback.yaw_rad is None:
            return action, (), False
        if now_ns - feedback.captured_ns > STALE_NS:
            return action, (), False
        late_s = self.reaction_s + max(0.0, seconds(now_ns - feedback.captured_ns))
        walls = [] if self.box is None else list(self.box.walls_inside(feedback.position_m))
        walls += [zone.wall_outside(feedback.position_m) for zone in self.zones]
        turn = (math.cos(feedback.yaw_rad), math.sin(feedback.yaw_rad))
        now = None if feedback.velocity_m_s is None else _to_world(feedback.velocity_m_s, turn)
        if isinstance(action, Velocity):
            return *self._velocity(action, walls, turn, now, late_s), True
        if isinstance(action, Attitude):
            return *self._attitude(action, walls, turn, now or (0.0, 0.0, 0.0), late_s), True
        return action, (), True

    def problem_at(self, place: Vec3) -> str:
        """Return why a place can't be flown to, and what can, in words for a person; empty if it can."""
        if self.box is not None and not self.box.holds(place):
            return f"the place is outside of the safety box, {self.box} [m] ({BOX})"
        for zone in self.zones:
            if zone.holds(place):
                return f"the place is in a no-fly zone, {zone} [m] ({ZONES}): choose a place outside of it"
        return ""

    def problem_between(self, start: Vec3, end: Vec3) -> str:
        """Return what is in the straight way between two places, in words for a person; empty if nothing is.

        A zone that the way begins in may be left.
        """
        for zone in self.zones:
            if not zone.holds(start) and zone.is_in_the_way(start, end):
                return f"a no-fly zone is in the straight way there, {zone} [m] ({ZONES}): fly round it, place by place"
        return ""

    def allowed_speed(self, distance: float, late_s: float) -> float:
        """The greatest speed towards a wall so far away [m/s]; 0 beyond it."""
        lost = self.deceleration * late_s
        return math.sqrt(lost * lost + 2 * self.deceleration * distance) - lost if distance > 0.0 else 0.0

    def _velocity(
        self, action: Velocity, walls: list[Wall], turn: tuple[float, float], now: Vec3 | None, late_s: float
    ) -> tuple[AnyAction, tuple[Clamp, ...]]:
        asked = _to_world((action.forward, action.left, action.up), turn)
        wanted, clamps = asked, dict[str, Clamp]()
        beyond = [(_dot(asked, wall.normal), wall) for wall in walls if wall.distance < -MARGIN_M]
        if beyond and any(asked) and (max(beyond)[0] > 0.0 or min(beyond)[0] >= 0.0):
            name = beyond[0][1].name
            clamps[name] = Clamp(name, math.hypot(*asked), 0.0)
            wanted = (0.0, 0.0, 0.0)
        for _ in range(_PASSES):
            before = wanted
            for wall in walls:
                most = self.allowed_speed(wall.distance, late_s) + min(0.0, max(-RETURN_M_S, wall.distance))
                if now is not None and (excess := _dot(now, wall.normal) - most) > 0.0:
                    most -= min(1.0, BRAKE_GAIN / 4 * excess)
                if _dot(asked, wall.normal) <= 0.0:
                    most = max(0.0, most)  # who does not ask to go there is not pushed away
                towards = _dot(wanted, wall.normal)
                if towards > most + 1e-9:
                    wanted = _add(wanted, wall.normal, most - towards)
                    first = clamps.get(wall.name)
                    clamps[wall.name] = Clamp(wall.name, towards if first is None else first.asked, most)
            if math.dist(wanted, before) < 1e-6:
                break
        else:
            wanted = (0.0, 0.0, 0.0)  # between walls that contradict one another
        if not clamps:
            return action, ()
        forward, left = _to_body(wanted[0], wanted[1], turn)
        return Velocity(forward, left, wanted[2], action.yaw_rate), tuple(clamps.values())

    def _attitude(
        self, action: Attitude, walls: list[Wall], turn: tuple[float, float], now: Vec3, late_s: float
    ) -> tuple[AnyAction, tuple[Clamp, ...]]:
        """Pitch forward accelerates forward, roll to the right to the right, both by g·tan."""
        ahead, aside = GRAVITY_M_S2 * math.tan(action.pitch), -GRAVITY_M_S2 * math.tan(action.roll)
        east, north, climb = _to_world((ahead, aside, action.climb), turn)
        clamps: dict[str, Clamp] = {}
        for wall in walls:
            x, y, z = wall.normal
            most = self.allowed_speed(wall.distance, late_s)
            across = math.hypot(x, y)
            if across > 0.3:
                x, y = x / across, y / across
                pull = x * east + y * north
                outside = wall.distance < -MARGIN_M
                excess = now[0] * x + now[1] * y - most
                brake = -self.deceleration / 2 if outside else -min(self.deceleration, BRAKE_GAIN * max(0.0, excess))
                if pull > brake and (excess >= 0.0 or outside):
                    east, north = east + (brake - pull) * x, north + (brake - pull) * y
                    clamps[wall.name] = Clamp(wall.name, pull, brake)
            if abs(z) > 0.3 and climb * z > most:
                clamps[wall.name] = Clamp(wall.name, climb * z, most)
                climb = most / z
        if not clamps:
            return action, ()
        ahead, aside = _to_body(east, north, turn)
        pitch, roll = math.atan(ahead / GRAVITY_M_S2), -math.atan(aside / GRAVITY_M_S2)
        return Attitude(roll, pitch, climb, action.yaw_rate), tuple(clamps.values())


def safety_of(number: Callable[[str], float], zones: str) -> Safety | None:
    """What the parameters ask for; None if that is nothing."""
    low = (number(f"{BOX}.x_low"), number(f"{BOX}.y_low"), number(f"{BOX}.z_low"))
    high = (number(f"{BOX}.x_high"), number(f"{BOX}.y_high"), number(f"{BOX}.z_high"))
    is_box = max(low) > -FAR_M or min(high) < FAR_M
    found = parse_zones(zones)
    if not is_box and not found:
        return None
    return Safety(Box(low, high) if is_box else None, found, number("safety.deceleration"), number("safety.reaction_s"))


def check_written(name: str, value: Value, number: Callable[[str], float]) -> None:
    """Check a value of a safety parameter against the others.

    Raises:
        ParameterError: a wall of the box beyond the opposite one, or no list of zones.
    """
    if name == ZONES:
        parse_zones(str(value))
    elif name.startswith(f"{BOX}.") and isinstance(value, float):
        end = "high" if name.endswith("low") else "low"
        other = number(f"{name.rpartition('_')[0]}_{end}")
        if not (value < other if end == "high" else value > other):
            word = "below" if end == "high" else "above"
            raise ParameterError(f"{name} must be {word} the box's other wall, {other:g} m", code=Refusal.OUT_OF_RANGE)


def parse_zones(text: str) -> tuple[Zone, ...]:
    """Read zones as they are written, with semicolons between them.

    Args:
        text: ``box x y z x y z`` (two corners) or ``cylinder x y radius z_low z_high``, world axes [m].

    Raises:
        ParameterError: it can't be read, or there are too many.
    """
    zones = [_parse_zone(part) for part in text.split(";") if part.strip()]
    if len(zones) > MAX_ZONES:
        raise _wrong(f"{len(zones)} zones are given, at most {MAX_ZONES} are possible")
    return tuple(zones)


def _parse_zone(text: str) -> Zone:
    shape, *words = re.split(r"[\s,]+", text.strip())
    if shape not in _SHAPES:
        raise _wrong(f"a zone is a box or a cylinder, not {shape!r:.40}")
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        raise _wrong(f"what follows {shape} must be numbers, not {' '.join(words)!r:.60}") from None
    if len(numbers) != _SHAPES[shape] or not all(math.isfinite(number) for number in numbers):
        raise _wrong(f"a {shape} has {_SHAPES[shape]} finite numbers, not {len(numbers)} as in {text.strip()!r:.60}")
    if shape == "box":
        pairs = list(zip(numbers[:3], numbers[3:], strict=True))
        low, high = [min(pair) for pair in pairs], [max(pair) for pair in pairs]
        if any(a == b for a, b in pairs):
            raise _wrong(f"a box must have an extent along each axis: {text.strip()!r:.60}")
        return Box((low[0], low[1], low[2]), (high[0], high[1], high[2]))
    x, y, radius, bottom, top = numbers
    if radius <= 0.0 or bottom >= top:
        raise _wrong(f"a cylinder has a radius above 0 and its low end below its high one: {text.strip()!r:.60}")
    return Cylinder(x, y, radius, bottom, top)


def _wrong(why: str) -> ParameterError:
    form = "box x y z x y z; cylinder x y radius z_low z_high"
    return ParameterError(f"{ZONES}: {why}; it looks like {form!r} [m]", code=Refusal.OUT_OF_RANGE)


def _within(low: float, high: float, at: float, to: float, first: float, last: float) -> tuple[float, float]:
    """The part of a way from ``at`` to ``to``, of that between the shares ``first`` and ``last``, between two walls."""
    if at == to:
        return (first, last) if low <= at <= high else (1.0, 0.0)
    one, other = (low - at) / (to - at), (high - at) / (to - at)
    return max(first, min(one, other)), min(last, max(one, other))


def _numbers(*numbers: float) -> str:
    return " ".join(f"{number:g}" for number in numbers)


def _dot(a: Vec3, b: Vec3) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _add(a: Vec3, b: Vec3, share: float) -> Vec3:
    return a[0] + share * b[0], a[1] + share * b[1], a[2] + share * b[2]


def _to_world(body: Vec3, turn: tuple[float, float]) -> Vec3:
    """Levelled body axes to world axes; ``turn`` holds cosine and sine of the yaw."""
    c, s = turn
    return c * body[0] - s * body[1], s * body[0] + c * body[1], body[2]


def _to_body(east: float, north: float, turn: tuple[float, float]) -> tuple[float, float]:
    c, s = turn
    return c * east + s * north, c * north - s * east
