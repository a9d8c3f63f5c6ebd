"""Settings of the landing law: gains, limits, heights, and when to abort or give up."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from skyloop.control.limiting import lowered
from skyloop.control.response import ResponseSettings
from skyloop.errors import UsageError
from skyloop.messages import Value

_MAY_BE_0 = frozenset({"wait_s", "climb_gain", "sight_s"})
_MAY_BE_INFINITE = frozenset({"give_up_s", "ceiling_m"})
_BELOW_CEILING_M = 0.2  # margin of the search height below the maximum altitude, near which the proxy slows climbs


@dataclass(frozen=True, slots=True)
class LandingSettings:
    """Gains, limits and heights of :class:`~skyloop.control.landing_law.LandingLaw`.

    Heights are those of the feet above the marker unless stated otherwise.
    """

    response: ResponseSettings = field(default_factory=ResponseSettings)  #: response to velocity set-points
    position_gain: float = 12.0  #: acceleration per offset [1/s²]
    velocity_gain: float = 6.0  #: acceleration per velocity error [1/s]
    climb_gain: float = 1.0  #: fraction of the climb rate's error added to the set-point
    speed_m_s: float = 8.0  #: maximum horizontal speed
    climb_m_s: float = 0.7  #: maximum vertical speed
    acceleration_m_s2: float = 15.0  #: limit of the set-point's horizontal change, for vehicles that respond faster
    climb_acceleration_m_s2: float = 2.0  #: limit of the set-point's vertical change
    closing_m_s: float = 1.5  #: maximum speed relative to the marker on the way to it
    braking_m_s2: float = 1.0  #: deceleration to the marker's velocity when arriving
    known_m_s: float = 0.5  #: standard deviation of the marker's velocity below which to follow the marker
    sight_m: float = 0.004  #: standard deviation of a sighting's position close to the camera
    sight_share: float = 0.004  #: growth of that deviation per metre of distance
    sight_s: float = 0.01  #: possible delay between attitude and frame, whose errors grow with the turn rate

    descent_m_s: float = 0.45
    cone_m: float = 0.06  #: radius, at the marker, of the cone within which the vehicle descends
    cone: float = 0.2  #: growth of the cone's radius per metre of height
    view: float = 0.3  #: offset as a fraction of the height beyond which the vehicle climbs to see the marker
    #: Below this height the vehicle descends by the filter, with or without sight of the marker, if it is over the
    #: marker's centre, matches its speed, and the marker's motion agrees with that predicted ``foresight_s`` earlier.
    commit_m: float = 0.6
    commit_off_m: float = 0.08
    commit_m_s: float = 0.25
    commit_turn_rad_s: float = 1.2  #: maximum turn rate of the marker: the vehicle waits while it turns faster
    foresight_s: float = 0.7
    foreseen_m: float = 0.08
    final_descent_m_s: float = 0.65
    #: Abort a touch-down that would miss by more than this, or if the marker is out of sight for over ``blind_s``. Just
    #: above the marker (``nearly_m``), abort only if the touch-down would miss the platform.
    abort_off_m: float = 0.14
    blind_s: float = 1.3
    nearly_m: float = 0.1
    pad_m: float = 0.3  #: distance from the marker's centre at which a touch-down is still safely on the platform
    touch_m: float = 0.03  #: height below which the vehicle counts as touched down
    feet_m: float = 0.06  #: distance of the feet below the body's centre

    #: Align the image's longer side with the motion of a marker faster than this, to see it for longer.
    turn_from_m_s: float = 0.8
    turn_rad_s: float = 0.8
    long_side_rad: float = math.pi / 2  #: angle of the image's longer side from forward, counter-clockwise from above

    fresh_s: float = 0.35  #: time to continue without a sighting
    recovering_s: float = 4.0  #: time to follow an unseen marker's predicted position before searching
    search_height_m: float = 2.6  #: height above the ground for searching, and the safe height to hover at
    search_speed_m_s: float = 1.0
    search_lane_m: float = 1.1  #: distance between the spiral's lanes: the camera's view minus a margin
    search_largest_m: float = 5.5  #: the spiral's longest leg
    ceiling_m: float = math.inf  #: maximum altitude above the ground
    wait_s: float = 0.0  #: time to wait for the marker to pass before starting the spiral
    attempts: int = 8  #: number of aborted touch-downs after which to give up
    give_up_s: float = math.inf  #: time after the start at which to give up

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if name == "response":
                continue
            if name == "attempts":
                if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                    raise UsageError(f"attempts is {value!r} and must be a whole number of at least 1")
            elif name in _MAY_BE_0 and value == 0.0:
                continue
            elif not (0.0 < value < math.inf or (name in _MAY_BE_INFINITE and value == math.inf)):
                raise UsageError(f"{name} is {value!r} and must be a finite number above 0")
        for less, more in (("touch_m", "nearly_m"), ("nearly_m", "commit_m"), ("commit_m", "search_height_m")):
            if getattr(self, less) >= getattr(self, more):
                raise UsageError(f"{less} is {getattr(self, less):g} and must be below {more}, {getattr(self, more):g}")

    def within(self, limits: Mapping[str, Value]) -> LandingSettings:
        """Return these settings clamped to a drone's ``limits.…``, so that no set-point exceeds them.

        A missing limit sets none. UsageError if they don't allow the height needed for the search.
        """
        climb = lowered(self.climb_m_s, limits, "limits.climb")
        return replace(
            self,
            response=replace(self.response, tilt_rad=lowered(self.response.tilt_rad, limits, "limits.tilt")),
            speed_m_s=lowered(self.speed_m_s, limits, "limits.speed"),
            climb_m_s=climb,
            descent_m_s=min(self.descent_m_s, climb),
            final_descent_m_s=min(self.final_descent_m_s, climb),
            ceiling_m=lowered(self.ceiling_m, limits, "limits.altitude"),
            search_height_m=lowered(self.search_height_m, limits, "limits.altitude", _BELOW_CEILING_M),
        )
