"""The safety box and the no-fly zones: set-points that would leave the one or enter the others are shortened. Pure.

Every wall is a plane: those of the box, and before each zone the one through its nearest point, square to the line of
sight, behind which all of the zone lies because zones are convex. Towards a plane at distance ``d`` the vehicle may be
as fast as it can still be stopped: ``v·t + v²/(2·a) = d`` with the reaction time ``t``, the age of the position
included, and the deceleration ``a``. A velocity keeps what runs along the plane; a tilt is let through until the
vehicle is as fast as that, and then is turned into one that brakes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from skyloop.clock import NS_PER_S, seconds
from skyloop.errors import ParameterError
from skyloop.messages import AnyAction, Attitude, Feedback, Refusal, Value, Velocity
from skyloop.proxy.core.limits import Clamp
from skyloop.zones import BOX, ZONES, Box, Space, Vec3, Wall, Zone, parse_zones

GRAVITY_M_S2: Final = 9.80665
STALE_NS: Final = NS_PER_S // 2  #: a vehicle whose position is older has none
MARGIN_M: Final = 0.1  #: so far beyond a wall is taken for noise; farther is outside, where only coming back is allowed
BRAKE_GAIN: Final = 2.0  #: deceleration asked for per speed that is too much [1/s]
RETURN_M_S: Final = 0.5  #: at most so fast is it led back that is beyond a wall and asks to go farther

_PASSES: Final = 8  # of shortening by all walls in turn, before giving up on all but standing still


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


def safety_of(number: Callable[[str], float], space: Space) -> Safety | None:
    """What the parameters ask for; None if that is nothing."""
    if space.box is None and not space.zones:
        return None
    return Safety(space.box, space.zones, number("safety.deceleration"), number("safety.reaction_s"))


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
