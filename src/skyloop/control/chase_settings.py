"""Goals, gains and limits of :class:`skyloop.control.chase_law.ChaseLaw`, and its phases."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import StrEnum

from skyloop.control.limiting import lowered
from skyloop.errors import UsageError
from skyloop.messages import Value


class FollowMode(StrEnum):
    """How to follow a target."""

    FOLLOW = "follow"  #: keep a distance, and a side if one is given
    ORBIT = "orbit"  #: circle it, even while it moves
    LOOK = "look"  #: stay in place and turn to it


class TargetPhase(StrEnum):
    """The phases of a pursuit."""

    LOOKING = "looking for the target"  #: not seen yet: turning on the spot
    RANGING = "range not yet known: turns only"  #: seen, but perhaps much nearer than it seems
    FOLLOWING = "following"
    ORBITING = "orbiting"
    WATCHING = "looking at it"
    PREDICTING = "hidden: following its predicted motion"
    HOVERING = "lost: hovering where it went out of sight"
    SEARCHING = "lost: looking around"
    GIVEN_UP = "lost for too long: given up"


LOSSES = frozenset({TargetPhase.PREDICTING, TargetPhase.HOVERING, TargetPhase.SEARCHING, TargetPhase.GIVEN_UP})


@dataclass(frozen=True, slots=True)
class ChaseSettings:
    """Goal, gains and limits of :class:`ChaseLaw`.

    Attributes:
        distance_m: Horizontal, from the vehicle's centre to the target's.
        nearest_m: Never fly nearer, and back off from a target that comes nearer.
        clear_m: The same for others that the detector sees.
        bearing_rad: Side of the target to stay on, as seen from it, counter-clockwise from its direction of motion: 0
            is ahead of it, π behind, π/2 on its left. None: whichever side the vehicle is on.
        orbit_m_s: Speed around the target, counter-clockwise from above if positive.
        leash_m: Farthest horizontal distance from the start; at the leash the vehicle only turns, whoever approaches.
            None: no leash. Uses the vehicle's position, or, while unknown, its integrated velocity, which drifts.
        height_m: Above the ground; None: the height at the start.
        lowest_m: Above the ground.
        highest_m: Above the ground.
        parallax_m: How far to rise (or sink, if rising is not possible) and come back in order to learn the range of a
            target that may not stand on the ground. None: wait for the range without such moves.
        steep_rad: Largest elevation of the target's middle, up or down, at which the vehicle keeps its height.
        lead_s: Delay from deciding a command until it takes effect: delays of commands and feedback together.
        response_s: Time to reach a commanded velocity; the target's velocity is predicted this far ahead.
        range_gain: [1/s]
        velocity_gain: Acceleration per unit of velocity error [1/s].
        yaw_gain: [1/s]
        height_gain: [1/s]
        round_gain: How fast to move around to ``bearing_rad`` [1/s].
        speed_m_s: Greatest horizontal speed. The proxy's ``limits.speed`` applies as well.
        climb_m_s: Greatest vertical speed.
        turn_rad_s: Greatest yaw rate.
        acceleration_m_s2: Horizontal limit of the set-point; harder acceleration tilts the camera off the target.
        react_s: The vehicle's worst-case reaction time; limits the speed towards the target to one it can stop from.
        brake_m_s2: Deceleration assumed for that stop.
        tilt_rad: Greatest tilt of a vehicle flown by attitude.
        tilt_gain: Acceleration per unit of velocity error of such a vehicle [1/s].
        lean_rad: Greatest lean that the model expects of a vehicle flown by velocity.
        seen_s: How long after the last sighting the target counts as seen.
        predict_s: How long to follow the hidden target's predicted motion, slowing down.
        hover_s: How long to hover after that, looking to both sides of the target's predicted position.
        give_up_s: How long after the last sighting to give up.
        search_rad_s: Yaw rate of the search.
        sweep_rad: How far to look past the target's predicted position while hovering.

    Raises:
        UsageError: A number is out of its range, or ``distance_m`` is not above ``nearest_m``.
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
        """Return these settings within the limits of a drone, so that the law expects nothing beyond them.

        Args:
            limits: ``limits.speed``, ``limits.climb``, ``limits.yaw_rate``, ``limits.altitude`` and ``limits.tilt``, as
                in ``drone.config``; a missing one limits nothing.
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
