"""What :class:`skyloop.control.chase_law.ChaseLaw` is to do, its gains and limits, and the phases in which it is."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import StrEnum

from skyloop.control.limiting import lowered
from skyloop.errors import UsageError
from skyloop.messages import Value


class FollowMode(StrEnum):
    """What to do about a target."""

    FOLLOW = "follow"  #: keep a distance, and a side if one was given
    ORBIT = "orbit"  #: circle it, also while it moves
    LOOK = "look"  #: turn to it, and stay


class TargetPhase(StrEnum):
    """What becomes of it."""

    LOOKING = "looking for the target"  #: it was not seen yet: turning on the spot
    RANGING = "range not yet known: turns only"  #: seen, but perhaps far nearer than it seems
    FOLLOWING = "following"
    ORBITING = "orbiting"
    WATCHING = "looking at it"
    PREDICTING = "hidden: on by its last motion"
    HOVERING = "lost: hovering where it went out of sight"
    SEARCHING = "lost: looking around"
    GIVEN_UP = "lost for too long: given up"


LOSSES = frozenset({TargetPhase.PREDICTING, TargetPhase.HOVERING, TargetPhase.SEARCHING, TargetPhase.GIVEN_UP})


@dataclass(frozen=True, slots=True)
class ChaseSettings:
    """Goal, gains and limits of :class:`ChaseLaw`.

    Attributes:
        distance_m: Horizontal, from the vehicle's centre to the target's.
        nearest_m: It never flies nearer, and backs off from a target that comes nearer.
        clear_m: The same for others that the detector sees.
        bearing_rad: Where to be as seen from the target, counter-clockwise from the direction in which it moves: 0 is
            ahead of it, π behind, π/2 on its left. None: on whichever side it is.
        orbit_m_s: Speed round the target, counter-clockwise from above if above 0.
        leash_m: Farthest horizontal distance from where it began; it stays there, turning, whoever comes near. None: no
            leash. By the vehicle's position; while that is not known, by its velocity, whose error adds up.
        height_m: Above the ground; None: the height at the start.
        lowest_m: Above the ground.
        highest_m: Above the ground.
        parallax_m: How far it rises, or sinks where it may not, and comes back, to learn the range of what may not
            stand on the ground. None: it only waits, for what else moves it.
        steep_rad: Farthest elevation of the target's middle, up or down, at which the height is kept.
        lead_s: From a command's decision to its taking hold: delays of commands and feedback together.
        response_s: From a velocity's set-point to that velocity: the target's acceleration is fed forward by as much.
        range_gain: [1/s]
        velocity_gain: How hard it takes up a velocity [1/s].
        yaw_gain: [1/s]
        height_gain: [1/s]
        round_gain: How fast to come round to the side [1/s].
        speed_m_s: Greatest, horizontally. The proxy's ``limits.speed`` holds as well.
        climb_m_s: Greatest, up and down.
        turn_rad_s: Greatest.
        acceleration_m_s2: Of the set-point, horizontally: a harder one tilts the camera off the target.
        react_s: How late the vehicle answers, at worst: it flies no faster towards the target than it can stop.
        brake_m_s2: How hard it brakes then.
        tilt_rad: Greatest, of a vehicle that is flown by attitude.
        tilt_gain: Acceleration per velocity's error of such a vehicle [1/s].
        lean_rad: Greatest lean of a vehicle that is flown by velocity: what it is counted on for.
        seen_s: Since last seen, up to which the target counts as seen.
        predict_s: How long it flies on by the target's last motion, ever slower.
        hover_s: How long it hovers after that, looking to both sides of where the target should be.
        give_up_s: Since last seen, after which it gives up.
        search_rad_s: Yaw rate of the search.
        sweep_rad: How far past where the target should be it looks while it hovers.

    Raises:
        UsageError: A number is out of its range, or the distance is not beyond the nearest one.
    """

    distance_m: float = 4.0
    nearest_m: float = 2.0
    clear_m: float = 1.5
    bearing_rad: float | None = None
    orbit_m_s: float = 0.8
    leash_m: float | None = None
    height_m: float | None = None
    lowest_m: float = 0.8
    highest_m: float = 4.0
    parallax_m: float | None = 0.4
    steep_rad: float = 0.25
    lead_s: float = 0.12
    response_s: float = 0.4
    range_gain: float = 1.0
    velocity_gain: float = 3.0
    yaw_gain: float = 2.2
    height_gain: float = 1.0
    round_gain: float = 1.2
    speed_m_s: float = 4.0
    climb_m_s: float = 0.6
    turn_rad_s: float = 1.8
    acceleration_m_s2: float = 3.0
    react_s: float = 0.5
    brake_m_s2: float = 1.5
    tilt_rad: float = 0.33
    tilt_gain: float = 3.0
    lean_rad: float = 0.5
    seen_s: float = 0.4
    predict_s: float = 2.0
    hover_s: float = 4.0
    give_up_s: float = 25.0
    search_rad_s: float = 0.7
    sweep_rad: float = 0.6

    def __post_init__(self) -> None:
        free = {"bearing_rad", "orbit_m_s", "leash_m", "height_m", "parallax_m"}
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if value is None and name in free:
                continue
            if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
                raise UsageError(f"{name} is {value!r} and must be a finite number")
            if value <= 0.0 and name not in {"bearing_rad", "orbit_m_s", "velocity_gain"}:
                raise UsageError(f"{name} is {value!r} and must be above 0")
        if self.distance_m <= self.nearest_m:
            raise UsageError(
                f"distance_m is {self.distance_m:g} and must be above nearest_m, which is {self.nearest_m:g}"
            )
        if self.lowest_m > self.highest_m:
            raise UsageError(f"lowest_m is {self.lowest_m:g} and must be at most highest_m, {self.highest_m:g}")

    def within(self, limits: Mapping[str, Value]) -> ChaseSettings:
        """Return these settings within the limits of a drone, so that nothing is counted on that it will not do.

        Args:
            limits: ``limits.speed``, ``limits.climb``, ``limits.yaw_rate``, ``limits.altitude`` and ``limits.tilt``, as
                in ``drone.config``; one that is missing limits nothing.
        """
        highest = lowered(self.highest_m, limits, "limits.altitude")
        return replace(
            self,
            speed_m_s=lowered(self.speed_m_s, limits, "limits.speed"),
            climb_m_s=lowered(self.climb_m_s, limits, "limits.climb"),
            turn_rad_s=lowered(self.turn_rad_s, limits, "limits.yaw_rate"),
            highest_m=highest,
            lowest_m=min(self.lowest_m, highest),
            tilt_rad=lowered(self.tilt_rad, limits, "limits.tilt"),
            lean_rad=lowered(self.lean_rad, limits, "limits.tilt"),
        )
