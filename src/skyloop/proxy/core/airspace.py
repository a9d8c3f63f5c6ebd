"""Decide where a vehicle may fly, and how fast: judge each set-point, position, hover, take-off and step. Pure.

Every wall is a plane: those of the safety box and, for each no-fly zone, the plane through its nearest point that is
perpendicular to the line from the vehicle to that point. Zones are convex, so the whole zone is behind that plane.
Inside a zone, the plane through which the vehicle entered stays in force and leads it back to the side that it came
from. At distance ``d`` from a plane, the vehicle may approach only as fast as it can stop: ``v·t + v²/(2·a) = d``, with
the reaction time ``t`` (plus the age of the position) and the deceleration ``a``. A velocity keeps its part parallel to
the plane. An attitude passes unchanged until the vehicle reaches that speed. Then a braking attitude replaces it.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from skyloop.clock import NS_PER_S, seconds
from skyloop.messages import AnyAction, Attitude, Feedback, Hover, Position, Refusal, Takeoff, Velocity
from skyloop.messages.feedback import NO_POSITION, POSITION_SOURCES
from skyloop.proxy.core.flight import STALE_NS
from skyloop.zones import Space, Vec3, Wall, Zone

GRAVITY_M_S2: Final = 9.80665  #: standard gravity
LOST_NS: Final = 2 * NS_PER_S  #: if the newest position is older than this, targets are refused instead of held back
BLIND_M: Final = 0.5  #: maximum distance flown towards a target between walls without a new measured position
#: A position counts as having jumped if it changes by more than this, and by more than the vehicle could have flown.
JUMP_M: Final = 1.0
MARGIN_M: Final = 0.1  #: distance beyond a wall that counts as noise; further out, the vehicle may only move back
BRAKE_GAIN: Final = 2.0  #: requested deceleration for each unit of excess speed [1/s]
RETURN_M_S: Final = 0.5  #: maximum speed for bringing back a vehicle whose set-point leads further past a wall
HOVER_SLACK_M: Final = 0.3  #: a vehicle that hovers further than this above ``limits.altitude`` is lowered
SINK_M_S: Final = 0.2  #: minimum speed at which it is lowered
TAKEOFF_M: Final = 1.0  #: minimum height assumed for a take-off
LIFTED_M: Final = 0.3  #: a zone lower than this does not prevent a take-off: it may be the table that the vehicle is on

_FAST_M_S: Final = 10.0  # assumed maximum speed of a vehicle that does not report its velocity
_BLIND_S: Final = 0.1  # age of a position that the reaction time already allows for
_OLD_S: Final = 1.0  # maximum age of a position that is taken into account, because the vehicle may be at rest
_AT_REST_M_S: Final = 0.05  # below this speed, vehicles may report the same position repeatedly
_GROUND_NS: Final = NS_PER_S // 2  # the ground is the median over this time, so that a single wrong value has no effect
_NO_WAY_M: Final = 0.05  # this close to the target, there is no meaningful direction to apply limits to
_PASSES: Final = 8  # maximum number of passes in which all walls in turn reduce a velocity before a stop is required

#: Permitted climb rate for each metre below ``limits.altitude`` [1/s]. This limit slows the vehicle down as it
#: approaches that altitude. Above the limit, the vehicle sinks at the same rate per metre.
ALTITUDE_GAIN: Final = 1.0
#: Altitudes that exceed ``limits.altitude`` by no more than this count as altimeter noise [m].
SLACK_M: Final = 0.15


@dataclass(frozen=True, slots=True)
class Clamp:
    """A limit that reduced a set-point. For tilt and speed, the two numbers are the lengths of the vectors."""

    limit: str  #: name of the parameter
    asked: float
    applied: float
    zone: str = ""  #: name of the no-fly zone, if there is one


@dataclass(frozen=True, slots=True)
class Limits:
    """The limits in force."""

    tilt: float = 0.35  #: maximum tilt from the vertical, with roll and pitch combined [rad]
    climb: float = 1.0  #: maximum speed up or down [m/s]
    yaw_rate: float = 1.75  #: maximum yaw rate [rad/s]
    speed: float = 2.0  #: maximum horizontal speed [m/s]
    altitude: float = 5.0  #: maximum height above ground [m]

    def clamp(self, action: Attitude | Velocity, altitude: float | None) -> tuple[AnyAction, tuple[Clamp, ...]]:
        """Return the nearest set-point within the limits, and the limits that were applied.

        Tilt and horizontal speed are reduced without a change of direction. ``altitude`` is given [m] if it is known.
        """
        if type(action) is Velocity:
            x, y, up, yaw_rate, longest = action.forward, action.left, action.up, action.yaw_rate, self.speed
        else:
            assert isinstance(action, Attitude)
            x, y, up, yaw_rate, longest = action.roll, action.pitch, action.climb, action.yaw_rate, self.tilt
        highest = self.climb
        if altitude is not None:  # above the limit, ``room`` is negative and the vehicle descends
            room = self.altitude - altitude
            highest = max(-self.climb, min(highest, room * ALTITUDE_GAIN)) if not -SLACK_M <= room <= 0.0 else 0.0
        if (
            x * x + y * y <= longest * longest
            and -self.climb <= up <= highest
            and -self.yaw_rate <= yaw_rate <= self.yaw_rate
        ):
            return action, ()
        clamps: list[Clamp] = []
        length = math.hypot(x, y)
        if length > longest:
            clamps.append(Clamp("limits.speed" if type(action) is Velocity else "limits.tilt", length, longest))
            x, y = x / length * longest, y / length * longest
        allowed_up = max(-self.climb, min(highest, up))
        if allowed_up != up:
            near_the_top = up > highest and highest < self.climb
            clamps.append(Clamp("limits.altitude" if near_the_top else "limits.climb", up, allowed_up))
        allowed_yaw_rate = max(-self.yaw_rate, min(self.yaw_rate, yaw_rate))
        if allowed_yaw_rate != yaw_rate:
            clamps.append(Clamp("limits.yaw_rate", yaw_rate, allowed_yaw_rate))
        return type(action)(x, y, allowed_up, allowed_yaw_rate), tuple(clamps)


@dataclass(frozen=True, slots=True)
class AirspaceSettings:
    """Parameters for where the vehicle may fly, and how fast."""

    limits: Limits = field(default_factory=Limits)
    space: Space = field(default_factory=Space)
    deceleration: float = 1.0  #: deceleration that the vehicle can reliably achieve [m/s²]
    reaction_s: float = 0.3  #: delay before the vehicle starts to brake


class Verdict(NamedTuple):
    """The decision on a request."""

    action: AnyAction | None = None  #: the permitted action; None if the vehicle must stop, or stay on the ground
    clamps: tuple[Clamp, ...] = ()  #: the limits that were applied
    refusal: Refusal | None = None  #: also None (like ``action``) while the request only waits for a fresh position
    why: str = ""  #: readable reason for the refusal
    enforced: bool | None = None  #: whether safety box and zones could be enforced; None if there are none


class Airspace:
    """Judges the actions that are requested of one vehicle, based on the vehicle's position."""

    def __init__(self, settings: AirspaceSettings | None = None) -> None:
        self.settings = settings or AirspaceSettings()
        self.jumped_m = 0.0  #: size of a recent jump of the position; whoever handles it resets this
        self._way: tuple[Vec3, Space] | None = None  # the permitted target, and the space when it was permitted
        self._sinks = self._blocked = False  # whether the vehicle is sinking to the ceiling, and whether it is blocked
        self._newest: Feedback | None = None
        self._at_ns = 0  # capture time of the newest position; repeated positions do not count
        self._moves = False  # whether the vehicle's last permitted set-point makes it move
        self._sides: dict[Zone, tuple[Vec3, float]] = {}  # by zone: the plane nearest the vehicle when last outside
        self._ground: deque[tuple[int, float]] = deque()  # times, and heights of the ground in world axes [m]

    def judge(
        self, action: AnyAction, feedback: Feedback | None, now_ns: int, *, new: bool = False, planned: bool = False
    ) -> Verdict:
        """Judge a new or repeated request with finite numbers. ``now_ns`` is on the clock of ``feedback.captured_ns``.

        Unless the request is ``new``, a permitted target stays permitted: the steps avoid an obstacle that drift puts
        in the way, and a lower ceiling lowers the target. ``planned``: whether the target is part of a route that was
        checked as a whole. Such a target may be lowered from the start.
        """
        self.observe(feedback)
        if isinstance(action, Position):
            if new:
                self._way = None
            return self._place(action, feedback, now_ns, planned)
        self._way = None
        if isinstance(action, Velocity | Attitude):
            return self._set_point(action, feedback, now_ns)
        self._moves = False
        if isinstance(action, Hover):
            return self._hover(feedback, now_ns)
        if isinstance(action, Takeoff):
            return self._takeoff(action, feedback, now_ns)
        return Verdict(action)

    def step(self, action: Velocity | Attitude, feedback: Feedback | None, now_ns: int) -> Verdict:
        """Reduce a set-point, or a step towards a target, to what the limits and walls allow."""
        self.observe(feedback)
        return self._set_point(action, feedback, now_ns)

    def _set_point(self, action: Velocity | Attitude, feedback: Feedback | None, now_ns: int) -> Verdict:
        allowed, clamps = self.settings.limits.clamp(action, feedback.altitude_m if feedback is not None else None)
        enforced = None
        if self.settings.space.walled:
            allowed, walls, enforced = self.between_walls(allowed, feedback, now_ns)
            clamps += walls
            self._moves = any(getattr(allowed, name) for name in allowed.__struct_fields__[:3])
        return Verdict(allowed, clamps, enforced=enforced)

    def objection(self, action: Position, feedback: Feedback | None, now_ns: int) -> str:
        """Return readable text about what is wrong with a target itself; empty if it is valid."""
        self.observe(feedback)
        if action.problem or feedback is None or feedback.position_m is None or not self._young(feedback, now_ns):
            return action.problem
        ground, space = self._ground_below(feedback), self.settings.space
        return self._too_high(action.z, ground) or space.problem_at(action.place) or _too_low(action.z, ground)

    def ceiling_problem(self, altitude: float, feedback: Feedback | None) -> str:
        """Return why ``limits.altitude`` must not be this low now; some vehicles descend to it automatically."""
        self.observe(feedback)
        if feedback is None or feedback.position_m is None or (ground := self._ground_below(feedback)) is None:
            return ""
        x, y, z = at = feedback.position_m
        below, zones = (x, y, ground + altitude), Space(zones=self.settings.space.zones)
        problem = "" if below[2] >= z else zones.problem_at(below) or zones.problem_between(at, below)
        return f"the vehicle would have to sink to {altitude:g} m, and {problem}" if problem else ""

    def copy(self) -> Airspace:
        """Return a copy with the same observations, for checking hypothetical requests."""
        other = Airspace(self.settings)
        other._newest, other._at_ns, other._moves = self._newest, self._at_ns, self._moves
        other._sides, other._ground = dict(self._sides), self._ground.copy()
        return other

    def observe(self, feedback: Feedback | None) -> None:
        """Update what is known about the vehicle's position: its age, its side of each zone, and the ground below it.

        ``jumped_m`` is set if the position has changed by more than the vehicle could have flown in that time.
        """
        before, at = self._newest, None if feedback is None else feedback.position_m
        if feedback is None or at is None or feedback is before:
            return
        if before is None or abs(feedback.captured_ns - before.captured_ns) > NS_PER_S:
            self._sides.clear()
            self._ground.clear()
        else:
            self._notice_jump(before, feedback, math.dist(at, before.position_m or at))
        rests = not self._moves and _speed(feedback) <= _AT_REST_M_S
        if before is None or at != before.position_m or rests:
            self._at_ns = feedback.captured_ns
        self._newest = feedback
        for zone in self.settings.space.barriers:
            wall = zone.wall_outside(at)
            if wall.distance > 0.0:
                self._sides[zone] = wall.normal, _dot(wall.normal, at) + wall.distance
        if feedback.altitude_m is not None:
            ground = self._ground
            ground.append((feedback.captured_ns, at[2] - feedback.altitude_m))
            while feedback.captured_ns - ground[0][0] > _GROUND_NS:
                ground.popleft()

    def _notice_jump(self, before: Feedback, feedback: Feedback, moved_m: float) -> None:
        limits = self.settings.limits
        reported = _FAST_M_S if feedback.velocity_m_s is None else max(_speed(before), _speed(feedback))
        fastest = max(math.hypot(limits.speed, limits.climb), reported)
        if moved_m > JUMP_M + fastest * max(0.0, seconds(feedback.captured_ns - self._at_ns)):
            self.jumped_m = moved_m
            self._sides.clear()
            self._ground.clear()

    def allowed_speed(self, distance: float, late_s: float) -> float:
        """Return the maximum speed towards a wall at this distance [m/s]; 0 beyond the wall."""
        deceleration = self.settings.deceleration
        # The positive root of ``v·t + v²/(2·a) = d``.
        lost = deceleration * late_s
        return math.sqrt(lost * lost + 2 * deceleration * distance) - lost if distance > 0.0 else 0.0

    def between_walls(
        self, action: AnyAction, feedback: Feedback | None, now_ns: int
    ) -> tuple[AnyAction, tuple[Clamp, ...], bool]:
        """Return the nearest set-point that the walls allow, the limits applied, and whether the position is known.

        If the position is unknown, the set-point is unchanged.
        """
        if feedback is None or feedback.position_m is None or feedback.yaw_rad is None:
            return action, (), False
        self.observe(feedback)
        if now_ns - feedback.captured_ns > STALE_NS:
            return action, (), False
        age_s, speed = self._age_s(feedback, now_ns), _speed(feedback)
        late_s = self.settings.reaction_s + min(age_s, _OLD_S)
        walls = self._walls(feedback.position_m)
        turn = (math.cos(feedback.yaw_rad), math.sin(feedback.yaw_rad))
        now = None if feedback.velocity_m_s is None else _to_world(feedback.velocity_m_s, turn)
        if now is not None and age_s > _BLIND_S and speed > _AT_REST_M_S:  # the vehicle has moved since then
            walls = [wall._replace(distance=wall.distance - age_s * max(0.0, _dot(now, wall.normal))) for wall in walls]
        if isinstance(action, Velocity):
            return *self._velocity(action, walls, turn, now, late_s), True
        if isinstance(action, Attitude):
            return *self._attitude(action, walls, turn, now or (0.0, 0.0, 0.0), late_s), True
        return action, (), True

    def _walls(self, at: Vec3) -> list[Wall]:
        space = self.settings.space
        walls = [] if space.box is None else list(space.box.walls_inside(at))
        for zone in space.barriers:
            wall = zone.wall_outside(at)
            # Inside a zone, the nearest plane could be on the far side. Keep the plane from before the vehicle entered.
            if wall.distance <= 0.0 and (side := self._sides.get(zone)) is not None:
                normal, offset = side
                wall = wall._replace(normal=normal, distance=offset - _dot(normal, at))
            walls.append(wall)
        return walls

    def _velocity(
        self, action: Velocity, walls: list[Wall], turn: tuple[float, float], now: Vec3 | None, late_s: float
    ) -> tuple[AnyAction, tuple[Clamp, ...]]:
        asked = _to_world((action.forward, action.left, action.up), turn)
        wanted, clamps = asked, dict[str, Clamp]()
        beyond = [(_dot(asked, wall.normal), wall) for wall in walls if wall.distance < -MARGIN_M]
        # Beyond walls, stop unless the velocity leads back through at least one wall and no further beyond any other.
        if beyond and any(asked) and (max(beyond)[0] > 0.0 or min(beyond)[0] >= 0.0):
            wall = beyond[0][1]
            clamps[wall.name] = Clamp(wall.name, math.hypot(*asked), 0.0, wall.zone)
            wanted = (0.0, 0.0, 0.0)
        for _ in range(_PASSES):
            before = wanted
            for wall in walls:
                most = self.allowed_speed(wall.distance, late_s) + min(0.0, max(-RETURN_M_S, wall.distance))
                if now is not None and (excess := _dot(now, wall.normal) - most) > 0.0:
                    most -= min(1.0, BRAKE_GAIN / 4 * excess)
                if _dot(asked, wall.normal) <= 0.0:
                    most = max(0.0, most)  # a vehicle is pushed back only if its set-point leads towards the wall
                towards = _dot(wanted, wall.normal)
                if towards > most + 1e-9:
                    wanted = _add(wanted, wall.normal, most - towards)
                    first = clamps.get(wall.name)
                    clamps[wall.name] = Clamp(wall.name, towards if first is None else first.asked, most, wall.zone)
            if math.dist(wanted, before) < 1e-6:
                break
        else:
            wanted = (0.0, 0.0, 0.0)  # the walls contradict each other
        if not clamps:
            return action, ()
        forward, left = _to_body(wanted[0], wanted[1], turn)
        return Velocity(forward, left, wanted[2], action.yaw_rate), tuple(clamps.values())

    def _attitude(
        self, action: Attitude, walls: list[Wall], turn: tuple[float, float], now: Vec3, late_s: float
    ) -> tuple[AnyAction, tuple[Clamp, ...]]:
        """Reduce an attitude. Pitching forward accelerates forward, rolling right to the right, both by g·tan."""
        ahead, aside = GRAVITY_M_S2 * math.tan(action.pitch), -GRAVITY_M_S2 * math.tan(action.roll)
        east, north, climb = _to_world((ahead, aside, action.climb), turn)
        clamps: dict[str, Clamp] = {}
        deceleration = self.settings.deceleration
        unseen_s = late_s - self.settings.reaction_s  # time during which the vehicle may have accelerated
        gaining_s = unseen_s if unseen_s > _BLIND_S else 0.0
        for wall in walls:
            x, y, z = wall.normal
            most = self.allowed_speed(wall.distance, late_s)
            across = math.hypot(x, y)
            if across > 0.3:  # a wall that is nearly level limits only the climb rate, below
                x, y = x / across, y / across
                pull = x * east + y * north
                outside = wall.distance < -MARGIN_M
                excess = now[0] * x + now[1] * y + gaining_s * max(0.0, pull) - most
                brake = -min(deceleration, max(deceleration / 2 if outside else 0.0, BRAKE_GAIN * excess))
                if pull > brake and (excess >= 0.0 or outside):
                    east, north = east + (brake - pull) * x, north + (brake - pull) * y
                    clamps[wall.name] = Clamp(wall.name, pull, brake, wall.zone)
            if abs(z) > 0.3 and climb * z > most:
                clamps[wall.name] = Clamp(wall.name, climb * z, most, wall.zone)
                climb = most / z
        if not clamps:
            return action, ()
        ahead, aside = _to_body(east, north, turn)
        pitch, roll = math.atan(ahead / GRAVITY_M_S2), -math.atan(aside / GRAVITY_M_S2)
        return Attitude(roll, pitch, climb, action.yaw_rate), tuple(clamps.values())

    def _place(self, action: Position, feedback: Feedback | None, now_ns: int, planned: bool) -> Verdict:
        limits, space = self.settings.limits, self.settings.space
        before, self._way = self._way, None
        if action.problem:
            return _out_of_range(action.problem)
        unknown = _why_unknown(feedback, now_ns)
        if unknown or feedback is None or feedback.position_m is None:
            return Verdict(None, (), Refusal.WRONG_STATE, unknown)
        if not self._young(feedback, now_ns):
            self._way = before
            return Verdict()
        at, (x, y, z) = feedback.position_m, action.place
        goes_on = before is not None and before[0] == action.place
        ground = self._ground_below(feedback)
        clamps: list[Clamp] = []
        allowed = goes_on or planned
        if problem := self._too_high(z, ground):
            if not allowed or ground is None:
                return _out_of_range(problem)
            z = ground + limits.altitude
            clamps.append(Clamp("limits.altitude", action.z, z))
        place = (x, y, z)
        checked = before == (action.place, space) and z == action.z
        problem = space.problem_at(place) or ("" if checked else space.problem_between(at, place))
        if problem := problem or ("" if allowed else _too_low(z, ground)):
            return _out_of_range(problem)
        self._way = action.place, space
        speed, limit = _fastest(at, place, limits)
        # The limit is reported only once, because the direction changes near the target.
        if not goes_on and action.speed is not None and action.speed > speed:
            clamps.append(Clamp(limit, action.speed, speed))
        if action.turn_rate is not None and action.turn_rate > limits.yaw_rate:
            clamps.append(Clamp("limits.yaw_rate", action.turn_rate, limits.yaw_rate))
        turn_rate = min(limits.yaw_rate, action.turn_rate or math.inf)
        fitted = Position(x, y, z, action.yaw, min(speed, action.speed or math.inf), turn_rate)
        return Verdict(fitted, tuple(clamps), enforced=True if space.walled else None)

    def _hover(self, feedback: Feedback | None, now_ns: int) -> Verdict:
        """Hover. If the vehicle is above ``limits.altitude``, first descend unless something is in the way."""
        limits = self.settings.limits
        altitude = None if feedback is None else feedback.altitude_m
        above = 0.0 if altitude is None else altitude - limits.altitude
        self._sinks = above > (SLACK_M if self._sinks else HOVER_SLACK_M)
        if not self._sinks:
            self._blocked = False
            return Verdict(Hover())
        up = -min(limits.climb, max(SINK_M_S, above * ALTITUDE_GAIN))
        sink, walls, _, _, enforced = self._set_point(Velocity(up=up), feedback, now_ns)
        assert isinstance(sink, Velocity)
        self._blocked = bool(walls) and -sink.up < (2 * SINK_M_S if self._blocked else SINK_M_S)
        clamps = (Clamp("limits.altitude", 0.0, up), *walls)
        return Verdict(Hover() if self._blocked else sink, clamps, enforced=enforced)

    def _takeoff(self, action: Takeoff, feedback: Feedback | None, now_ns: int) -> Verdict:
        """Refuse a take-off that begins in a no-fly zone or leads into one."""
        if feedback is None or feedback.position_m is None or not self._young(feedback, now_ns):
            return Verdict(action)
        x, y, z = feedback.position_m
        zones, at, top = Space(zones=self.settings.space.zones), (x, y, z + LIFTED_M), (x, y, z + TAKEOFF_M)
        problem = zones.problem_at(at) or zones.problem_between(at, top)
        return _out_of_range(f"the take-off would enter it: {problem}") if problem else Verdict(action)

    def _ground_below(self, feedback: Feedback) -> float | None:
        """Return the recent median height of the ground below the vehicle, in world axes [m]; None if it is unknown."""
        if feedback.altitude_m is None or not self._ground:
            return None
        return sorted(height for _, height in self._ground)[len(self._ground) // 2]

    def ceiling(self, feedback: Feedback) -> float:
        """Return the maximum height at this point, in world axes [m]; infinite if the ground is unknown."""
        ground = self._ground_below(feedback)
        return math.inf if ground is None else ground + self.settings.limits.altitude

    def _too_high(self, z: float, ground: float | None) -> str:
        limit = self.settings.limits.altitude
        if ground is None or z - ground - limit <= SLACK_M:
            return ""
        return (
            f"z is {z:g} m and must be at most {ground + limit:.2f} m: {limit:g} m above the ground (limits.altitude)"
        )

    def _age_s(self, feedback: Feedback, now_ns: int) -> float:
        """Return the age of the newest position [s], even if that position is a repeat."""
        return max(0.0, seconds(now_ns - min(self._at_ns, feedback.captured_ns)))

    def _young(self, feedback: Feedback, now_ns: int) -> bool:
        """Return whether the newest position is fresh enough to fly to a target; between walls, speed counts, too."""
        if now_ns - feedback.captured_ns > STALE_NS:
            return False
        speed = _speed(feedback)
        blind = self.settings.space.walled and speed > _AT_REST_M_S
        return not blind or speed * self._age_s(feedback, now_ns) <= BLIND_M


def _speed(feedback: Feedback) -> float:
    """Return the reported speed [m/s]; 0 if none was reported."""
    return 0.0 if feedback.velocity_m_s is None else math.hypot(*feedback.velocity_m_s)


def _out_of_range(why: str) -> Verdict:
    return Verdict(None, (), Refusal.OUT_OF_RANGE, why)


def _too_low(z: float, ground: float | None) -> str:
    if ground is None or ground - z <= SLACK_M:
        return ""
    return f"z is {z:g} m, which is {ground - z:.2f} m below the ground under the vehicle: choose a target above it"


def _why_unknown(feedback: Feedback | None, now_ns: int) -> str:
    """Return why the vehicle can't fly to targets now, and what to do about it; empty if it can."""
    if feedback is None or feedback.position_m is None:
        return f"{NO_POSITION}: fly it by velocity, or {POSITION_SOURCES}"
    if feedback.yaw_rad is None:
        return "the vehicle does not report its yaw: fly it by velocity"
    age_ns = now_ns - feedback.captured_ns
    if age_ns > LOST_NS:
        return f"the vehicle's newest position is {seconds(age_ns):.1f} s old, over the limit of {seconds(LOST_NS):g} s"
    return ""


def _fastest(at: Vec3, place: Vec3, limits: Limits) -> tuple[float, str]:
    """Return the maximum speed along the line within the horizontal and vertical limits, and the limit that applies."""
    across, up = math.dist(at[:2], place[:2]), abs(place[2] - at[2])
    away = math.hypot(across, up)
    if away < _NO_WAY_M:
        return (limits.speed, "limits.speed") if limits.speed <= limits.climb else (limits.climb, "limits.climb")
    by_speed = limits.speed * away / across if across > 0.0 else math.inf
    by_climb = limits.climb * away / up if up > 0.0 else math.inf
    return (by_speed, "limits.speed") if by_speed <= by_climb else (by_climb, "limits.climb")


def _dot(a: Vec3, b: Vec3) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _add(a: Vec3, b: Vec3, share: float) -> Vec3:
    return a[0] + share * b[0], a[1] + share * b[1], a[2] + share * b[2]


def _to_world(body: Vec3, turn: tuple[float, float]) -> Vec3:
    """Rotate from levelled body axes to world axes; ``turn`` holds the cosine and sine of the yaw."""
    c, s = turn
    return c * body[0] - s * body[1], s * body[0] + c * body[1], body[2]


def _to_body(east: float, north: float, turn: tuple[float, float]) -> tuple[float, float]:
    c, s = turn
    return c * east + s * north, c * north - s * east
