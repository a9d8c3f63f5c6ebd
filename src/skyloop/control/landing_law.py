"""A control law for landing on a still or moving marker, based on sightings and feedback. Pure.

A filter for straight motion and steady turns (:mod:`.kalman`) tracks the marker in odometry axes. Using a prediction of
its own motion (:mod:`.response`), the vehicle flies to where the marker will be when the set-point takes effect and
matches its velocity and acceleration. It descends while it is inside a cone above the marker, as in Saripalli,
Montgomery and Sukhatme, "Visually Guided Landing of an Unmanned Aerial Vehicle", IEEE T-RA 19(3), 2003. Outside the
cone, the vehicle first closes in, keeping its height or climbing to see more. Once the marker no longer fits into the
image, the vehicle flies by prediction. If the vehicle would touch down too far from the marker, it aborts and climbs
along the marker's predicted path. After a number of aborted attempts it gives up and hovers at a safe height.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np

from skyloop.clock import nanoseconds, seconds
from skyloop.control.airframe import AirframeLaw, Motion, Part
from skyloop.control.kalman import TurnEstimate, TurningTargetFilter
from skyloop.control.limiting import (
    Array,
    SetpointLimiter,
    SetpointLimits,
    clamped,
    lowered,
    require_positive,
    shortened,
    within,
)
from skyloop.control.response import Predicted, ResponseSettings, VelocityResponse
from skyloop.errors import UsageError
from skyloop.messages import Feedback, Value, Velocity
from skyloop.messages.geometry import rotation_from_euler

_MAY_BE_0 = frozenset({"wait_s", "climb_gain", "sight_s"})
_MAY_BE_INFINITE = frozenset({"give_up_s", "ceiling_m"})
_BELOW_CEILING_M = 0.2  # margin of the search height to the maximum altitude, because the proxy slows climbs near it


@dataclass(frozen=True, slots=True)
class LandingSettings:
    """Gains, limits and heights of :class:`~skyloop.control.landing_law.LandingLaw`.

    Unless stated otherwise, heights are measured from the marker to the vehicle's feet.
    """

    response: ResponseSettings = field(default_factory=ResponseSettings)  #: response to velocity set-points
    position_gain: float = 12.0  #: acceleration per metre of offset [1/s²]
    velocity_gain: float = 6.0  #: acceleration per unit of velocity error [1/s]
    climb_gain: float = 1.0  #: fraction of the climb rate error added to the set-point
    speed_m_s: float = 8.0  #: maximum horizontal speed
    climb_m_s: float = 0.7  #: maximum vertical speed
    acceleration_m_s2: float = 15.0  #: maximum rate of change of the horizontal set-point, for fast-responding vehicles
    climb_acceleration_m_s2: float = 2.0  #: maximum rate of change of the vertical set-point
    closing_m_s: float = 1.5  #: maximum speed relative to the marker while approaching it
    braking_m_s2: float = 1.0  #: deceleration to the marker's velocity on arrival
    known_m_s: float = 0.5  #: standard deviation of the marker's velocity below which the vehicle follows it
    sight_m: float = 0.004  #: standard deviation of marker positions close to the camera
    sight_share: float = 0.004  #: increase of this deviation per metre of distance
    sight_s: float = 0.01  #: possible delay between attitude and frame; its effect grows with the turn rate

    descent_m_s: float = 0.45
    cone_m: float = 0.06  #: radius, at the marker, of the cone within which the vehicle descends
    cone: float = 0.2  #: increase of the cone's radius per metre of height above the marker
    view: float = 0.3  #: ratio of offset to height above which the vehicle climbs to see the marker
    #: Height below which the vehicle relies on the filter and descends even if the marker is out of sight, provided
    #: that it is over the marker's centre at the same speed, and the marker moved as predicted ``foresight_s`` earlier.
    commit_m: float = 0.6
    commit_off_m: float = 0.08  #: maximum predicted miss distance
    commit_m_s: float = 0.25  #: maximum speed relative to the marker
    commit_turn_rad_s: float = 1.2  #: maximum turn rate of the marker for touching down
    foresight_s: float = 0.7
    foreseen_m: float = 0.08  #: maximum error of that prediction
    final_descent_m_s: float = 0.65
    #: Miss distance above which a touch-down is aborted; it is also aborted if the marker is out of sight for over
    #: ``blind_s``. Just above the marker (below ``nearly_m``), only a miss of the platform aborts it.
    abort_off_m: float = 0.14
    blind_s: float = 1.3
    nearly_m: float = 0.1
    pad_m: float = 0.3  #: maximum distance from the marker's centre for a safe touch-down on the platform
    touch_m: float = 0.03  #: height below which the vehicle counts as touched down
    feet_m: float = 0.06  #: distance of the feet below the body's centre

    #: Marker speed above which the image's longer side is aligned with its motion, to keep it in view for longer.
    turn_from_m_s: float = 0.8
    turn_rad_s: float = 0.8
    long_side_rad: float = math.pi / 2  #: angle of the image's longer side from forward, counter-clockwise from above

    fresh_s: float = 0.35  #: time to continue without a sighting
    recovering_s: float = 4.0  #: time to follow the predicted position of an unseen marker before searching
    search_height_m: float = 2.6  #: height above the ground for searching and for hovering safely
    search_speed_m_s: float = 1.0
    search_lane_m: float = 1.1  #: distance between the lanes of the spiral: the camera's view minus a margin
    search_largest_m: float = 5.5  #: longest leg of the spiral
    ceiling_m: float = math.inf  #: maximum altitude above the ground
    wait_s: float = 0.0  #: time to wait for the marker to pass by before starting the spiral
    attempts: int = 8  #: number of aborted touch-downs before giving up
    give_up_s: float = math.inf  #: time from the start until giving up

    def __post_init__(self) -> None:
        if isinstance(self.attempts, bool) or not isinstance(self.attempts, int) or self.attempts < 1:
            raise UsageError(f"attempts is {self.attempts!r} and must be a whole number of at least 1")
        numbers = {name: getattr(self, name) for name in self.__dataclass_fields__ if name != "response"}
        infinite = {name for name in _MAY_BE_INFINITE if numbers[name] == math.inf}
        require_positive(_MAY_BE_0, **{name: value for name, value in numbers.items() if name not in infinite})
        for less, more in (("touch_m", "nearly_m"), ("nearly_m", "commit_m"), ("commit_m", "search_height_m")):
            if getattr(self, less) >= getattr(self, more):
                raise UsageError(f"{less} is {getattr(self, less):g} and must be below {more}, {getattr(self, more):g}")

    def within(self, limits: Mapping[str, Value]) -> LandingSettings:
        """Return these settings clamped to a drone's ``limits.…``, so that no set-point exceeds them.

        Missing limits have no effect. Raises UsageError if the limits don't allow the height needed for the search.
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


_KEPT_S = 2.0  # length of the history of estimates, used to check how well the motion was predicted
_MOST_REFUSED = 4  # number of consecutive sightings outside the filter's gate that cause a restart
_CONTRADICTED = 2  # number of consecutive sightings outside the filter's gate that abort a touch-down
_LATEST_S = 0.1  # maximum time over which the turn rate in a frame's feedback is extrapolated
_REACTION_S = 0.25  # time for which a velocity error shifts the touch-down point before it is corrected
_SPEED_MARGIN = 0.999  # factor on the speed limit, because converting a velocity to body axes may round it up
_MOVES_M_S = 0.1  # minimum speed of a marker for its turn rate to matter
_FRESH_S = 0.2  # maximum age of the velocity for a touch-down to count
_GIVEN_UP_CLIMB_S = 4.0  # duration of the climb for a vehicle without an altimeter


class LandingPhase(StrEnum):
    """The phases of :class:`LandingLaw`."""

    SEARCHING = "searching for the marker"  #: waiting, then flying a square spiral, at the search height
    CHASING = "moving over the marker"
    DESCENDING = "descending over the marker"
    RECOVERING = "lost the marker: climbing at its predicted position"
    COMMITTED = "touching down"  #: too close to see the whole marker
    DOWN = "down"
    GIVEN_UP = "giving up: climbing to a safe height"


@dataclass(frozen=True, slots=True, eq=False)
class _Relative:
    """The marker's motion relative to the vehicle at the time when a set-point sent now takes effect."""

    target: TurnEstimate
    offset: Array  #: position relative to the vehicle's centre, (3,) [m]
    velocity: Array  #: relative velocity, (2,) [m/s]
    height: float  #: height of the feet above the marker [m]
    touching_off: float  #: distance by which a touch-down would currently miss [m]


class LandingLaw(AirframeLaw):
    """Computes velocities from feedback and sightings. The motors stop when :attr:`phase` is DOWN.

    Times are on the proxy's clock [ns].
    """

    def __init__(self, settings: LandingSettings | None = None) -> None:
        super().__init__(Part.ATTITUDE, Part.VELOCITY)
        self.settings = s = settings or LandingSettings()
        self.phase = LandingPhase.SEARCHING  #: phase at the last step
        self.height_m: float | None = None  #: height of the feet above the marker; None while searching
        self.off_m: float | None = None  #: horizontal distance from the marker's centre; None while searching
        self.aborted = 0  #: number of aborted touch-downs
        self._response = VelocityResponse(s.response)
        self._target = TurningTargetFilter()
        self._past: deque[TurnEstimate] = deque()
        self._seen_ns: int | None = None
        self._began_ns: int | None = None
        self._searching_ns: int | None = None  # start of the search
        self._gave_up_ns: int | None = None
        self._search = SpiralSearch(s.search_lane_m, s.search_speed_m_s, s.search_largest_m)
        self._place: Array | None = None  # position to wait at
        self._committed_ns: int | None = None
        limits = SetpointLimits(
            s.speed_m_s, acceleration_m_s2=s.acceleration_m_s2, climb_acceleration_m_s2=s.climb_acceleration_m_s2
        )
        self._limiter = SetpointLimiter(limits)

    @property
    def target_speed_m_s(self) -> float | None:
        """Horizontal speed of the marker; None before the first sighting."""
        newest = self._target.newest
        return None if newest is None else float(np.hypot(*newest.velocity[:2]))

    def safe(self, now_ns: int) -> bool:
        """Return whether the law has given up and the vehicle has reached a safe height for hovering."""
        if self._gave_up_ns is None:
            return False
        altitude = self.airframe.altitude_m(now_ns)
        if altitude is None:
            return seconds(now_ns - self._gave_up_ns) > _GIVEN_UP_CLIMB_S
        return altitude > self.settings.search_height_m - 0.3

    def feedback(self, feedback: Feedback) -> None:
        """Update with the vehicle's newest state."""
        super().feedback(feedback)
        if self.airframe.feedback is not None:
            self._response.add(self.airframe.feedback)

    def pause(self) -> None:
        """Restart from rest and search, even after touch-down: another client may have flown the vehicle elsewhere."""
        super().pause()
        self._limiter.reset(Velocity())
        self._response.pause()
        self.forget()
        if self.phase is LandingPhase.DOWN:
            self.phase = LandingPhase.SEARCHING

    def forget(self) -> None:
        """Forget where the marker is, but keep the phases DOWN and GIVEN_UP."""
        self._target, self._seen_ns, self._committed_ns = TurningTargetFilter(), None, None
        self._place, self._searching_ns = None, None
        self._past.clear()
        self._search.restart()
        if self.phase not in (LandingPhase.DOWN, LandingPhase.GIVEN_UP):
            self.phase = LandingPhase.SEARCHING
        self.height_m = self.off_m = None

    def see(self, position: Array, at_capture: Feedback, captured_ns: int) -> None:
        """Update with the marker's centre in body axes, (3,) [m]; ignore it if attitude or motion is unknown.

        The attitude in ``at_capture`` is used; if it is older than the frame, it is extrapolated using the turn rate.
        """
        found = self.airframe.at_capture(at_capture, captured_ns, position)
        if found is None:
            return
        motion, rotation = found
        turning = np.nan_to_num(at_capture.angular_velocity_rad_s or (0.0, 0.0, 0.0), posinf=0.0, neginf=0.0)
        turned = turning * clamped(seconds(captured_ns - at_capture.captured_ns), _LATEST_S)
        place = motion.position + rotation @ rotation_from_euler(*turned.tolist()) @ position
        s, sweep_m_s = self.settings, float(np.linalg.norm(np.cross(turning, position)))
        deviation = s.sight_m + s.sight_share * float(np.linalg.norm(position)) + s.sight_s * sweep_m_s
        unseen_s = self._unseen_s(captured_ns)
        if unseen_s > s.recovering_s or self._target.refused >= _MOST_REFUSED:
            self._target.start(place, deviation, captured_ns)
            self._past.clear()
        elif not self._target.update(place, deviation, captured_ns):
            return
        self._seen_ns = captured_ns
        self._past.append(self._target.at(captured_ns))
        while seconds(captured_ns - self._past[0].at_ns) > _KEPT_S:
            self._past.popleft()

    def step(self, now_ns: int) -> Velocity:
        """Compute the current set-point, which is zero while the vehicle's motion is unknown and after touch-down."""
        if self.phase is LandingPhase.DOWN or not self._ready(now_ns):
            return Velocity()
        newest, ahead = self.airframe.newest, self._response.predict(now_ns)
        if newest is None or ahead is None:
            self.problem = "the vehicle's attitude and velocity were never known at the same time"
            return Velocity()
        if self._began_ns is None:
            self._began_ns = now_ns
        own = _then(newest, ahead)
        relative = self._relative(own, now_ns)
        self.off_m = None if relative is None else float(np.hypot(*relative.offset[:2]))
        self.height_m = None if relative is None else relative.height
        self.phase = self._next_phase(relative, now_ns)
        acceleration, up = self._wanted(own, relative, now_ns)
        velocity = shortened(self._response.setpoint(acceleration, ahead), _SPEED_MARGIN * self.settings.speed_m_s)
        up = self._allowed(up + self.settings.climb_gain * (up - float(own.velocity[2])))
        wanted = self._limiter.step(np.array([*velocity, up, self._turn(own)]), self._since_s(now_ns))
        self._response.sent(np.array([wanted.forward, wanted.left]), now_ns)
        forward, left = own.to_body(np.array([wanted.forward, wanted.left]))
        return Velocity(forward=forward, left=left, up=wanted.up, yaw_rate=wanted.yaw_rate)

    def _turn(self, own: Motion) -> float:
        """Return the yaw rate [rad/s] that aligns the image's longer side with the motion of a fast marker."""
        s, newest = self.settings, self._target.newest
        if newest is None or float(np.hypot(*newest.velocity[:2])) < s.turn_from_m_s:
            return 0.0
        way = math.atan2(newest.velocity[1], newest.velocity[0])
        error = math.remainder(way - own.yaw - s.long_side_rad, math.pi)  # both directions are equally good
        return clamped(1.5 * error, s.turn_rad_s)

    def _relative(self, own: Motion, now_ns: int) -> _Relative | None:
        """Return the marker's motion relative to the vehicle; None if it was never seen, or not recently."""
        s = self.settings
        if self._seen_ns is None or (self._committed_ns is None and self._unseen_s(now_ns) > s.recovering_s):
            return None
        target = self._target.at(own.at_ns)
        if self.phase is LandingPhase.SEARCHING and target.speed_deviation_m_s > s.known_m_s:
            return None  # by position alone, the vehicle would meet a fast marker head-on
        offset, velocity = target.position - own.position, (target.velocity - own.velocity)[:2]
        height = -float(offset[2]) - s.feet_m
        left_s = clamped(height / s.final_descent_m_s, _REACTION_S)
        return _Relative(target, offset, velocity, height, float(np.hypot(*(offset[:2] + velocity * left_s))))

    def _unseen_s(self, now_ns: int) -> float:
        return math.inf if self._seen_ns is None else seconds(now_ns - self._seen_ns)

    def _next_phase(self, relative: _Relative | None, now_ns: int) -> LandingPhase:
        s = self.settings
        if self._gave_up_ns is not None:
            return LandingPhase.GIVEN_UP
        late = seconds(now_ns - (self._began_ns or now_ns)) > s.give_up_s
        if self._committed_ns is not None and relative is not None:
            if relative.height <= s.touch_m and self.airframe.age_s(Part.VELOCITY, now_ns) <= _FRESH_S:
                return LandingPhase.DOWN
            if not self._misses(relative, now_ns):
                return LandingPhase.COMMITTED
            self._committed_ns = None
            self.aborted += 1
        if late or self.aborted >= s.attempts:
            self._gave_up_ns = now_ns
            return LandingPhase.GIVEN_UP
        if relative is None:
            return LandingPhase.SEARCHING
        if self._unseen_s(now_ns) > s.fresh_s:
            return LandingPhase.RECOVERING
        if relative.height < s.commit_m:
            if not self._may_touch_down(relative):
                return LandingPhase.CHASING
            self._committed_ns = now_ns
            return LandingPhase.COMMITTED
        within = relative.touching_off < s.cone_m + s.cone * relative.height
        return LandingPhase.DESCENDING if within else LandingPhase.CHASING

    def _misses(self, relative: _Relative, now_ns: int) -> bool:
        """Return whether to abort a touch-down that is under way."""
        s = self.settings
        if relative.height < s.nearly_m:
            return relative.touching_off > s.pad_m
        contradicted = self._target.refused >= _CONTRADICTED
        return relative.touching_off > s.abort_off_m or self._unseen_s(now_ns) > s.blind_s or contradicted

    def _may_touch_down(self, relative: _Relative) -> bool:
        """Return whether the vehicle is over the marker at matching speed and the marker has moved as predicted."""
        s = self.settings
        if self._target.refused or relative.touching_off > s.commit_off_m:
            return False
        if float(np.hypot(*relative.velocity)) > s.commit_m_s:
            return False
        newest = self._past[-1]
        if newest.turning_rad_s > s.commit_turn_rad_s and float(np.hypot(*newest.velocity[:2])) > _MOVES_M_S:
            return False
        since_ns = newest.at_ns - nanoseconds(s.foresight_s)
        before = next((one for one in reversed(self._past) if one.at_ns <= since_ns), None)
        if before is None:
            return False
        foreseen = self._target.predicted(before, newest.at_ns)
        return float(np.hypot(*(foreseen.position - newest.position)[:2])) < s.foreseen_m

    def _wanted(self, own: Motion, relative: _Relative | None, now_ns: int) -> tuple[Array, float]:
        """Return the horizontal acceleration (2,) [m/s²] in odometry axes, and the climb rate [m/s]."""
        s = self.settings
        if self.phase is LandingPhase.SEARCHING:
            return s.velocity_gain * (self._searched(own, now_ns) - own.velocity[:2]), self._to_search_height()
        self._search.restart()
        self._searching_ns = None
        if self.phase is LandingPhase.GIVEN_UP or relative is None:
            return s.velocity_gain * -own.velocity[:2], self._to_search_height()
        target = relative.target
        velocity = shortened(target.velocity[:2] + self._closing(relative.offset[:2]), s.speed_m_s)
        acceleration = target.acceleration + s.velocity_gain * (velocity - own.velocity[:2])
        return acceleration, float(target.velocity[2]) + self._climb(relative)

    def _closing(self, offset: Array) -> Array:
        """Return the velocity relative to the marker, (2,) [m/s], from which the vehicle can stop above it."""
        s = self.settings
        rate, off = s.position_gain / s.velocity_gain, float(np.hypot(*offset))
        near = s.braking_m_s2 / rate**2
        speed = rate * off if off < near else math.sqrt(2 * s.braking_m_s2 * (off - near / 2))
        return offset * (min(speed, s.closing_m_s) / max(off, 1e-9))

    def _climb(self, relative: _Relative) -> float:
        """Return the vertical speed relative to the marker [m/s]."""
        s, height, off = self.settings, relative.height, relative.touching_off
        if self.phase is LandingPhase.COMMITTED:
            return -s.final_descent_m_s
        if self.phase is LandingPhase.DESCENDING:
            return -s.descent_m_s * clamped(2.0 * (1.0 - off / (s.cone_m + s.cone * height)), 1.0)
        if self.phase is LandingPhase.RECOVERING:
            return self._to_search_height()
        if height < s.commit_m + 0.1:
            return clamped(s.commit_m + 0.05 - height, 0.3)
        return clamped(max(0.0, off / s.view - height), s.climb_m_s)

    def _searched(self, own: Motion, now_ns: int) -> Array:
        """Return the search velocity: wait at the marker's last position or, if unknown, here; then fly the spiral."""
        s = self.settings
        if self._searching_ns is None:
            self._searching_ns = now_ns
            newest = self._target.newest
            self._place = own.position[:2] if newest is None else newest.position[:2]
        if self._place is not None and seconds(now_ns - self._searching_ns) < s.wait_s:
            return shortened(self._place - own.position[:2], s.search_speed_m_s)
        return self._search.step(own.position[:2])

    def _allowed(self, up: float) -> float:
        """Limit a climb rate [m/s], slowing down towards the ceiling as the proxy does."""
        most = self.settings.climb_m_s
        room = math.inf if self._altitude is None else max(0.0, self.settings.ceiling_m - self._altitude)
        return within(up, -most, min(most, room))

    def _to_search_height(self) -> float:
        if self._altitude is None:
            return 0.0 if self._gave_up_ns is None else self.settings.climb_m_s
        return clamped(self.settings.search_height_m - self._altitude, self.settings.climb_m_s)


def _then(newest: Motion, ahead: Predicted) -> Motion:
    """Return the vehicle's predicted motion at the time when a set-point sent now takes effect."""
    dt = seconds(ahead.at_ns - newest.at_ns)
    position = newest.position + np.array([*ahead.moved, newest.velocity[2] * dt])
    velocity = np.array([*ahead.velocity, newest.velocity[2]])
    return Motion(ahead.at_ns, position, velocity, newest.yaw + newest.yaw_rate * dt, newest.yaw_rate)


class SpiralSearch:
    """A search along an expanding square, which returns to its start after the largest square and begins again.

    This is the expanding-square search of sea rescue, with a downward-facing camera: International Aeronautical and
    Maritime Search and Rescue Manual, volume II, section 5.5 (legs of 1, 1, 2, 2, 3, 3 … lanes with quarter turns).
    """

    def __init__(self, lane_m: float = 1.1, speed_m_s: float = 0.7, largest_m: float = 4.4) -> None:
        """Initialise the search with the distance between lanes, the maximum speed and the maximum length of a leg."""
        require_positive(lane_m=lane_m, speed_m_s=speed_m_s, largest_m=largest_m)
        self._lane, self._speed = lane_m, speed_m_s
        self._legs = max(1, int(largest_m / lane_m)) * 2
        self._leg = 0
        self._goal: Array | None = None
        self._begin: Array | None = None

    def restart(self) -> None:
        """Restart the search; it will be centred on the position passed to its first step."""
        self._leg, self._goal = 0, None

    def step(self, position: Array) -> Array:
        """Return the desired velocity (2,) [m/s] at a position (2,) [m], in the same axes."""
        if self._goal is None:
            self._begin = self._goal = position.copy()
        way = self._goal - position
        distance = float(np.linalg.norm(way))
        if distance < 0.2:
            self._goal = self._next(self._goal)
            way = self._goal - position
            distance = float(np.linalg.norm(way))
        return way * (min(self._speed, 1.5 * distance) / max(distance, 1e-9))

    def _next(self, corner: Array) -> Array:
        """Return the end of the next leg."""
        if self._leg >= self._legs and self._begin is not None:
            self._leg = 0
            return self._begin
        length = self._lane * (self._leg // 2 + 1)
        angle = self._leg * math.pi / 2
        self._leg += 1
        return corner + length * np.array([math.cos(angle), math.sin(angle)])
