"""Goals, gains, limits and phases of :class:`skyloop.control.chase_law.ChaseLaw`."""

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

    FOLLOW = "follow"  #: keep a distance and, if given, a side
    ORBIT = "orbit"  #: circle the target, even while it moves
    LOOK = "look"  #: stay in place and turn towards the target


class TargetPhase(StrEnum):
    """The phases of a pursuit."""

    LOOKING = "looking for the target"  #: target not seen yet: turning on the spot
    RANGING = "range not yet known: turns only"  #: target seen, but perhaps much closer than it seems
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
    """Goals, gains and limits of :class:`ChaseLaw`.

    Raises:
        UsageError: A number is out of its range, or ``distance_m`` is not greater than ``nearest_m``.
    """

    distance_m: float = 4.0  #: horizontal distance between the centres of the vehicle and the target
    nearest_m: float = 2.0  #: minimum distance to the target; the vehicle backs off from a target that comes closer
    clear_m: float = 1.5  #: minimum distance to other objects that the detector sees
    #: Side of the target to stay on, as an angle counter-clockwise from its direction of motion: 0 is in front of it, π
    #: behind it, π/2 on its left. None for the side that the vehicle is on.
    bearing_rad: float | None = None
    orbit_m_s: float = 0.8  #: speed around the target; positive for counter-clockwise as seen from above
    #: Maximum horizontal distance from the start; at the leash the vehicle only turns, whoever approaches. None for no
    #: leash. Uses the vehicle's position or, if unknown, its integrated velocity, which drifts.
    leash_m: float | None = None
    height_m: float | None = None  #: height above the ground; None for the height at the start
    lowest_m: float = 0.8  #: minimum height above the ground
    highest_m: float = 4.0  #: maximum height above the ground
    #: How far to rise (or sink, if it can't rise) and return in order to measure the range of a target that may not be
    #: on the ground. None waits for the range without moving.
    parallax_m: float | None = 0.4
    #: maximum elevation of the target's middle, up or down, at which the vehicle keeps its height
    steep_rad: float = 0.25
    lead_s: float = 0.12  #: total delay of commands and feedback, from the decision until a command takes effect
    response_s: float = 0.4  #: time to reach a commanded velocity, for which the target's velocity is predicted ahead
    range_gain: float = 1.0  #: [1/s]
    velocity_gain: float = 3.0  #: acceleration per unit of velocity error [1/s]
    yaw_gain: float = 2.2  #: [1/s]
    height_gain: float = 1.0  #: [1/s]
    round_gain: float = 1.2  #: gain of moving around to ``bearing_rad`` [1/s]
    #: Maximum horizontal speed. The proxy's ``limits.speed`` applies as well.
    speed_m_s: float = 4.0
    climb_m_s: float = 0.6  #: maximum vertical speed
    turn_rad_s: float = 1.8  #: maximum yaw rate
    #: limit of the horizontal set-point; more acceleration would tilt the camera off the target
    acceleration_m_s2: float = 3.0
    #: the vehicle's worst-case reaction time; limits the closing speed so that it can stop in time
    react_s: float = 0.5
    brake_m_s2: float = 1.5  #: deceleration assumed for that stop
    tilt_rad: float = 0.33  #: maximum tilt of a vehicle flown by attitude
    tilt_gain: float = 3.0  #: acceleration per unit of velocity error of a vehicle flown by attitude [1/s]
    lean_rad: float = 0.5  #: maximum lean that the model expects of a vehicle flown by velocity
    seen_s: float = 0.4  #: time after the last sighting for which the target still counts as seen
    predict_s: float = 2.0  #: time to follow a hidden target's predicted motion while slowing down
    hover_s: float = 4.0  #: time to hover after that, looking to either side of the target's predicted position
    give_up_s: float = 25.0  #: time after the last sighting at which to give up
    search_rad_s: float = 0.7  #: yaw rate during the search
    sweep_rad: float = 0.6  #: angle to look past the target's predicted position while hovering

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
        """Return these settings clamped to a drone's limits, so that the law never expects more than they allow.

        Args:
            limits: ``limits.speed``, ``limits.climb``, ``limits.yaw_rate``, ``limits.altitude`` and ``limits.tilt``, as
                in ``drone.config``; a missing one sets no limit.
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
