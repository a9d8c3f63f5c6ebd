"""Settings of the landing: gains, limits, heights, and when it aborts or gives up."""

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
_BELOW_CEILING_M = 0.2  # so far below the greatest altitude it searches: the proxy slows climbs down before it


@dataclass(frozen=True, slots=True)
class LandingSettings:
    """Gains, limits and heights of :class:`~skyloop.control.landing_law.LandingLaw`.

    Heights are of the feet over the marker unless stated otherwise.

    Raises:
        UsageError: A number is out of its range, or two contradict each other.
    """

    response: ResponseSettings = field(default_factory=ResponseSettings)  #: of the vehicle to velocity set-points
    position_gain: float = 12.0  #: acceleration by offset [1/s²]
    velocity_gain: float = 6.0  #: acceleration by error of velocity [1/s]
    climb_gain: float = 1.0  #: share of the climb's error that is asked for on top
    speed_m_s: float = 8.0  #: greatest, horizontally
    climb_m_s: float = 0.7  #: greatest, up and down
    acceleration_m_s2: float = 15.0  #: greatest change of the set-point, horizontally: for vehicles that answer faster
    climb_acceleration_m_s2: float = 2.0  #: and vertically
    closing_m_s: float = 1.5  #: greatest speed relative to the marker, on the way to it
    braking_m_s2: float = 1.0  #: by which it slows down to the marker's velocity on arrival
    known_m_s: float = 0.5  #: it follows the marker once its velocity is known so well (standard deviation)
    sight_m: float = 0.004  #: standard deviation of a sighting's position next to the camera
    sight_share: float = 0.004  #: and how much it grows with each metre of distance
    sight_s: float = 0.01  #: by how much the attitude may be late for the frame: the more it turns, the farther off

    descent_m_s: float = 0.45
    cone_m: float = 0.06  #: radius of the cone at the marker: outside of it, the vehicle does not descend
    cone: float = 0.2  #: how much wider it is for each metre of height
    view: float = 0.3  #: farther off than this share of its height, the vehicle climbs to keep the marker in view
    #: Below this it descends by the filter, whether it sees the marker or not, if it is over the marker's centre, as
    #: fast as the marker, and the marker has lately moved as was predicted ``foresight_s`` before.
    commit_m: float = 0.6
    commit_off_m: float = 0.08
    commit_m_s: float = 0.25
    commit_turn_rad_s: float = 1.2  #: what turns faster is waited for
    foresight_s: float = 0.7
    foreseen_m: float = 0.08
    final_descent_m_s: float = 0.65
    #: It aborts where it would touch farther off than this, or the marker is unseen for longer than ``blind_s``; when
    #: it is all but down, only where it would miss the platform.
    abort_off_m: float = 0.14
    blind_s: float = 1.3
    nearly_m: float = 0.1
    pad_m: float = 0.3  #: what touches so far from the marker's centre still stands safely on the platform
    touch_m: float = 0.03  #: so near it counts as touched
    feet_m: float = 0.06  #: below the body's centre

    #: It turns the image's longer side along the way of a marker that is faster than this, to see it for longer.
    turn_from_m_s: float = 0.8
    turn_rad_s: float = 0.8
    long_side_rad: float = math.pi / 2  #: of the image, from the vehicle's forward, counter-clockwise from above

    fresh_s: float = 0.35  #: since last seen: it flies on
    recovering_s: float = 4.0  #: so long it flies where the unseen marker must be; then it searches
    search_height_m: float = 2.6  #: above the ground; also where it is safe to hover
    search_speed_m_s: float = 1.0
    search_lane_m: float = 1.1  #: between the lanes of the spiral: what the camera sees from there, less a margin
    search_largest_m: float = 5.5  #: the spiral's longest leg
    ceiling_m: float = math.inf  #: greatest altitude above the ground
    wait_s: float = 0.0  #: before it starts on the spiral, it waits so long for the marker to pass by
    attempts: int = 8  #: it gives up after so many aborted touch-downs
    give_up_s: float = math.inf  #: it gives up when it has not landed so long after its start

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
        """Return these settings within the limits of a drone, so that it is asked for nothing that it may not do.

        Args:
            limits: ``limits.speed``, ``limits.climb``, ``limits.altitude`` and ``limits.tilt``, as in
                ``drone.config``; one that is missing limits nothing.

        Raises:
            UsageError: The drone may not fly high enough to search.
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
