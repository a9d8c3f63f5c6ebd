"""A control law that keeps a target in view at a distance, or circles it. Pure; times are on the proxy's clock.

Yaw keeps the target in the centre of the image, the distance is controlled along the line of sight, and height and
sideways motion are controlled separately. This is the decoupling of Pestana, Sanchez-Lopez, Campoy and Saripalli
("Vision based GPS-denied object tracking and following for unmanned aerial vehicles", SSRR 2013). Here it is applied to
distances in metres, so that the gains depend on neither lens nor target size, and the target's velocity is fed forward.
Vehicles that report no velocity are flown by attitude with dead reckoning (:class:`.airframe.TiltVelocity`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from skyloop.clock import nanoseconds, seconds
from skyloop.control.airframe import DRAG_PER_S, Motion
from skyloop.control.filters import LowPass
from skyloop.control.limiting import (
    GRAVITY_M_S2,
    Array,
    SetpointLimiter,
    SetpointLimits,
    clamped,
    lowered,
    shortened,
    within,
)
from skyloop.control.response import Predicted, ResponseSettings, VelocityResponse
from skyloop.control.target_estimate import TargetEstimator, TargetState
from skyloop.errors import UsageError
from skyloop.messages import Attitude, Feedback, Value, Vector, Velocity
from skyloop.messages.geometry import turned, wrap_angle


class FollowMode(StrEnum):
    """How to follow a target."""

    FOLLOW = "follow"  #: keep a distance from the target and, if specified, stay on one side of it
    ORBIT = "orbit"  #: circle the target, even while it moves
    LOOK = "look"  #: stay in place and turn towards the target


class TargetPhase(StrEnum):
    """The phases of a pursuit."""

    LOOKING = "looking for the target"  #: turning on the spot; the target has not been seen yet
    RANGING = "range not yet known: turns only"  #: the target is in view but may be much closer than it seems
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
        UsageError: A number is out of range, ``distance_m`` is not greater than ``nearest_m``, or ``lowest_m`` is
            greater than ``highest_m``.
    """

    distance_m: float = 4.0  #: horizontal distance between the centres of the vehicle and the target
    nearest_m: float = 2.0  #: minimum distance to the target; the vehicle backs off from a target that comes closer
    clear_m: float = 1.5  #: minimum distance to other detected objects
    #: Side of the target to stay on, as a counter-clockwise angle from its direction of motion: 0 is in front of the
    #: target, π behind it and π/2 on its left. If None, the vehicle stays on its current side.
    bearing_rad: float | None = None
    orbit_m_s: float = 0.8  #: speed around the target; positive is counter-clockwise as seen from above
    #: Maximum horizontal distance from the start, not exceeded even to evade a target; None means no leash. It is
    #: computed from the vehicle's position or, if that is unknown, from its integrated velocity, which drifts.
    leash_m: float | None = None
    height_m: float | None = None  #: height above the ground; None for the height at the start
    lowest_m: float = 0.8  #: minimum height above the ground
    highest_m: float = 4.0  #: maximum height above the ground
    #: Distance by which to climb (or descend, if there is no room above) and return, to measure the range of a target
    #: that may not be on the ground. If None, the vehicle waits without moving until the range is known.
    parallax_m: float | None = 0.4
    #: maximum elevation of the target's centre, up or down, at which the vehicle keeps its height
    steep_rad: float = 0.25
    lead_s: float = 0.12  #: total delay of feedback and commands
    response_s: float = 0.4  #: time to reach a commanded velocity; the target's velocity is predicted this far ahead
    range_gain: float = 1.0  #: [1/s]
    velocity_gain: float = 3.0  #: acceleration per unit of velocity error [1/s]
    yaw_gain: float = 2.2  #: [1/s]
    height_gain: float = 1.0  #: [1/s]
    round_gain: float = 1.2  #: gain for moving around to ``bearing_rad`` [1/s]
    speed_m_s: float = 4.0  #: maximum horizontal speed; the proxy's ``limits.speed`` applies as well
    climb_m_s: float = 0.6  #: maximum vertical speed
    turn_rad_s: float = 1.8  #: maximum yaw rate
    #: horizontal acceleration limit for set-points; more would tilt the camera off the target
    acceleration_m_s2: float = 3.0
    #: worst-case reaction time of the vehicle; limits the closing speed so that it can stop in time
    react_s: float = 0.5
    brake_m_s2: float = 1.5  #: deceleration assumed for stopping in time
    tilt_rad: float = 0.33  #: maximum tilt of a vehicle flown by attitude
    tilt_gain: float = 3.0  #: acceleration per unit of velocity error of a vehicle flown by attitude [1/s]
    lean_rad: float = 0.5  #: maximum lean that the model assumes for a vehicle flown by velocity
    seen_s: float = 0.4  #: time for which the target still counts as seen after the last sighting
    predict_s: float = 2.0  #: time to follow a hidden target's predicted motion while slowing down
    hover_s: float = 4.0  #: time to hover afterwards, looking to both sides of the target's predicted position
    give_up_s: float = 25.0  #: time from the last sighting until giving up
    search_rad_s: float = 0.7  #: yaw rate during the search
    sweep_rad: float = 0.6  #: angle by which to look past the target's predicted position while hovering

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
        """Return these settings clamped to a drone's limits, so that the law plans for no more than is allowed.

        Args:
            limits: ``limits.speed``, ``limits.climb``, ``limits.yaw_rate``, ``limits.altitude`` and ``limits.tilt``, as
                in ``drone.config``; missing ones have no effect.
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


_SMOOTHING_S = 0.4  # time constant for smoothing the target's acceleration
_SETPOINT_OVER = 1.5  # set-point limit as a multiple of the top speed, because drag keeps a vehicle below its set-point
_SETPOINT_AHEAD = 4.0  # limit on the set-point's change as a multiple of the acceleration, because set-points lead
_APPROACH_HORIZON_S = 3.0  # time within which the vehicle gives way to an approaching target
_CONFIDENT_SIGMA_M = 0.35  # maximum standard deviation for a position to count as certain
_UNCERTAIN_M = 1.0  # maximum extra clearance from a person whose position is uncertain
_KEEP_SIDE_S = 1.0  # time for which evasion stays on the same side
_HEAD_ON_SHARE = 0.2  # fraction of the clearance below which a pass is head-on, so that both sides are equally good
_SWEEP_BACK_SHARE = 0.4  # fraction of the sweep that goes to the side opposite the target's motion
_HEIGHT_REACHED_M = 0.1  # distance from a parallax height at which the vehicle heads for the other one
_ALONG_M_S = 0.4  # minimum speed for a target's direction of motion to be usable


class _Now(NamedTuple):
    """The inputs for computing a set-point."""

    own: Motion
    ahead: Motion  #: motion when the set-point takes effect
    predicted: Predicted | None  #: None when flying by attitude, or before the first feedback
    altitude_m: float | None
    dt_s: float  #: time since the last step
    relative: bool  #: whether the set-point is an attitude


class ChaseLaw:
    """Computes set-points from the vehicle's motion and the target's state."""

    def __init__(self, settings: ChaseSettings | None = None, mode: FollowMode = FollowMode.FOLLOW) -> None:
        self.settings = settings or ChaseSettings()  #: settings, which can be replaced in flight
        self.mode = mode  #: pursuit mode, which can be changed in flight
        self.phase = TargetPhase.LOOKING  #: phase at the last step
        #: estimated minus desired distance at the last step; None if the distance was not controlled
        self.off_m: float | None = None
        self.constraint = ""  #: constraint that keeps the vehicle from its goal ("leash"); empty if none
        self._heading: float | None = None  # last known direction of the target's motion
        self._out = np.zeros(2)  # the vehicle's position relative to its start
        self._previous_position: Array | None = None  # the vehicle's position at the last step, in odometry axes
        self._begin: Array | None = None  # start position in world axes; None until known
        self._height: float | None = None
        self._away = False  # whether the vehicle is flying to the second parallax height
        self._since_ns: int | None = None  # start of the search
        self._direction = 1.0
        self._sweep_first = 0.0  # side of the first sweep: 1 for left, -1 for right, 0 if not chosen yet
        self._previous_velocity: tuple[int, Array] | None = None  # time and velocity of the target at the last step
        self._acceleration: LowPass[Array] = LowPass(_SMOOTHING_S)
        self._response = VelocityResponse(
            ResponseSettings(delay_s=self.settings.lead_s, tilt_rad=self.settings.lean_rad)
        )
        self._limiter: SetpointLimiter | None = None
        self._last_ns: int | None = None
        self._gave_way: tuple[int | None, Array] = (None, np.zeros(2))  # time and direction of the last evasion

    def step(
        self,
        now_ns: int,  # the current time on the proxy's clock
        motion: Motion,  # the vehicle's newest motion, from dead reckoning if ``relative``
        altitude_m: float | None,  # height above the ground; None to leave the height unchanged
        target: TargetEstimator | None,  # the target's filter; None before the first sighting
        seen_ns: int | None,  # time of the target's last certain or possible sighting; None if there was none
        others: Sequence[TargetState] = (),  # recently seen objects to keep clear of
        *,
        candidate: TargetState | None = None,  # a possible match for the lost target; the vehicle turns towards it
        # whether the vehicle reports no velocity (see :class:`.airframe.TiltVelocity`) and is flown by attitude
        relative: bool = False,
        # the vehicle's position in world axes [m]; without it, the leash relies on integrated velocity
        position: Vector | None = None,
    ) -> Velocity | Attitude:
        """Compute the current set-point."""
        s = self.settings
        dt_s = 0.0 if self._last_ns is None else within(seconds(now_ns - self._last_ns), 0.0, 0.2)
        self._last_ns = now_ns
        own = motion.moved_to(now_ns)
        self._track_offset(own, position)
        if self._height is None and altitude_m is not None:
            self._height = altitude_m
        if self._since_ns is None:
            self._since_ns = now_ns
        unseen_s = seconds(now_ns - (self._since_ns if seen_ns is None else seen_ns))
        self.phase = self._next_phase(unseen_s, never=target is None or seen_ns is None)
        self.constraint, self.off_m = "", None
        predicted = None if relative else self._response.predict(now_ns)
        ahead = self._ahead(motion, now_ns, predicted)
        now = _Now(own, ahead, predicted, altitude_m, dt_s, relative)
        self._limits(own)
        still = np.zeros(2)
        if candidate is not None and self.phase in (TargetPhase.HOVERING, TargetPhase.SEARCHING):
            return self._steer(still, self._turn(ahead, candidate), candidate, now)
        if target is None or self.phase in (TargetPhase.LOOKING, TargetPhase.SEARCHING):
            return self._steer(still, s.search_rad_s * self._direction, None, now)
        state = target.at(ahead.at_ns)
        if self.phase is TargetPhase.GIVEN_UP:
            return self._steer(still, 0.0, state, now)
        aside, sweeping = self._sweep(unseen_s, ahead, state)
        turn = self._turn(ahead, state, aside, sweeping)
        if self.phase is TargetPhase.HOVERING or self.mode is FollowMode.LOOK:
            return self._steer(still, turn, state, now)
        # The vehicle keeps its full speed for half of ``predict_s``, then slows down.
        fade = clamped(2.0 * (1.0 - (unseen_s - s.seen_s) / s.predict_s), 1.0)
        if state.range_known:
            horizontal = self._horizontal(ahead, state) * max(0.0, fade)
        else:  # the target may be much closer than it seems
            horizontal = still
            self.phase = self.phase if self.phase in LOSSES else TargetPhase.RANGING
        if self.phase is TargetPhase.PREDICTING:
            horizontal = _not_towards(horizontal, state.foot[:2] - ahead.position[:2])
        for other in others:
            horizontal = horizontal + self._clear_of(other, ahead, horizontal)
        horizontal = self._leashed(self._out + ahead.position[:2] - own.position[:2], horizontal)
        return self._steer(shortened(horizontal, s.speed_m_s), turn, state, now)

    def feedback(self, feedback: Feedback) -> None:
        """Update the model of the vehicle's response, for vehicles that report their velocity."""
        self._response.add(feedback)

    def pause(self) -> None:
        """Restart from the vehicle's own velocity after another client flew it or its motion was unknown."""
        self._limiter, self._last_ns = None, None
        self._response.pause()

    def _ahead(self, motion: Motion, now_ns: int, predicted: Predicted | None) -> Motion:
        """Return the vehicle's motion at the time when a set-point sent now takes effect, given earlier set-points."""
        delay_s = self.settings.lead_s
        ahead = motion.moved_to(now_ns + nanoseconds(delay_s))
        if predicted is None:
            return ahead
        way = (motion.velocity[:2] + predicted.velocity) / 2 * delay_s
        position = motion.position + motion.velocity * seconds(now_ns - motion.at_ns)
        return replace(
            ahead,
            position=np.array([*(position[:2] + way), ahead.position[2]]),
            velocity=np.array([*predicted.velocity, ahead.velocity[2]]),
        )

    def _steer(self, velocity: Array, turn: float, state: TargetState | None, now: _Now) -> Velocity | Attitude:
        """Return the set-point for a velocity (2,) in odometry axes and a yaw rate, including height control."""
        up = self._up(now.altitude_m, state)
        if now.relative:
            return self._by_attitude(now.ahead, velocity, up, turn)
        return self._by_velocity(velocity, up, turn, now)

    def _by_velocity(self, velocity: Array, up: float, turn: float, now: _Now) -> Velocity:
        """Return the set-point that makes the vehicle reach a velocity despite drag and wind."""
        s, own = self.settings, now.own
        assert self._limiter is not None
        if now.predicted is not None:
            acceleration = shortened(s.velocity_gain * (velocity - now.ahead.velocity[:2]), s.acceleration_m_s2)
            velocity = self._response.setpoint(acceleration, now.predicted)
        setpoint = self._limiter.step(np.array([*own.to_body(velocity), up, turn]), now.dt_s)
        self._response.sent(np.array(turned(setpoint.forward, setpoint.left, own.yaw)), own.at_ns)
        return setpoint

    def _next_phase(self, unseen_s: float, *, never: bool) -> TargetPhase:
        s = self.settings
        if unseen_s > s.give_up_s:
            return TargetPhase.GIVEN_UP
        if never:
            return TargetPhase.LOOKING
        if unseen_s > s.seen_s + s.predict_s + s.hover_s:
            return TargetPhase.SEARCHING
        if unseen_s > s.seen_s + s.predict_s:
            return TargetPhase.HOVERING
        if unseen_s > s.seen_s:
            return TargetPhase.PREDICTING
        return {
            FollowMode.FOLLOW: TargetPhase.FOLLOWING,
            FollowMode.ORBIT: TargetPhase.ORBITING,
            FollowMode.LOOK: TargetPhase.WATCHING,
        }[self.mode]

    def _sweep(self, unseen_s: float, own: Motion, state: TargetState) -> tuple[float, float]:
        """Return the angle [rad] by which to look to the left of the target's expected position, and its rate.

        While hovering, the vehicle looks to both sides: first, and further, to the side towards which the target last
        moved. Both values are 0 in other phases.
        """
        s = self.settings
        if self.phase is not TargetPhase.HOVERING:
            self._sweep_first = 0.0
            return 0.0, 0.0
        if self._sweep_first == 0.0:
            x, y = state.foot[:2] - own.position[:2]
            self._sweep_first = math.copysign(1.0, x * state.velocity[1] - y * state.velocity[0])
        back = _SWEEP_BACK_SHARE * s.sweep_rad
        whole = s.sweep_rad + back
        swept = (s.search_rad_s * (unseen_s - s.seen_s - s.predict_s) + back) % (2.0 * whole)
        aside = self._sweep_first * (whole - abs(swept - whole) - back)  # triangular wave
        return aside, math.copysign(s.search_rad_s, self._sweep_first * (whole - swept))

    def _turn(self, own: Motion, state: TargetState, aside: float = 0.0, sweeping: float = 0.0) -> float:
        """Return the yaw rate for turning to face the target, or a direction ``aside`` [rad] to its left."""
        offset = state.foot[:2] - own.position[:2]
        across = max(0.5, float(np.hypot(*offset)))
        error = wrap_angle(math.atan2(offset[1], offset[0]) + aside - own.yaw)
        moving = state.velocity - own.velocity[:2]
        sweep = float(offset[0] * moving[1] - offset[1] * moving[0]) / across**2  # turn rate of the line of sight
        turn = clamped(self.settings.yaw_gain * error + 0.9 * sweep + sweeping, self.settings.turn_rad_s)
        if abs(turn) > 0.05:
            self._direction = math.copysign(1.0, turn)
        return turn

    def _horizontal(self, own: Motion, state: TargetState) -> Array:
        """Return the desired velocity, (2,) in odometry axes [m/s]."""
        s = self.settings
        offset = state.foot[:2] - own.position[:2]
        across = max(0.3, float(np.hypot(*offset)))
        sight = offset / across
        aside = np.array([-sight[1], sight[0]])
        near = max(0.3, across - state.margin_m)
        self.off_m = near - s.distance_m
        # Approach only at a speed from which the vehicle can stop; back off at the speed given by the gain.
        approach = min(s.range_gain * self.off_m, _stoppable(self.off_m, s))
        moving = self._expected_velocity(state, own.at_ns)
        wanted = moving + sight * approach
        if self.mode is FollowMode.ORBIT:
            wanted = wanted - aside * s.orbit_m_s  # counter-clockwise as seen from above, with the target on the left
        elif s.bearing_rad is None:
            # If no side is chosen, only the yaw follows the target's motion across the line of sight.
            wanted = wanted - aside * float(moving @ aside)
        else:
            wanted = wanted + aside * self._round(state, sight, across)
        wanted = wanted + self._evading(own, state)
        return self._kept_off(wanted, state, sight, near)

    def _expected_velocity(self, state: TargetState, at_ns: int) -> Array:
        """Return the target's velocity, (2,) [m/s], predicted for the time when the vehicle will have matched it."""
        s, velocity = self.settings, state.velocity
        if self._previous_velocity is not None and at_ns > self._previous_velocity[0]:
            dt_s = seconds(at_ns - self._previous_velocity[0])
            if dt_s > 0.5:
                self._acceleration = LowPass(_SMOOTHING_S)
            change = shortened((velocity - self._previous_velocity[1]) / dt_s, s.acceleration_m_s2)
            self._acceleration.step(change, min(dt_s, 0.5))
        self._previous_velocity = (at_ns, velocity)
        change = np.zeros(2) if self._acceleration.value is None else self._acceleration.value
        return velocity + s.response_s * change

    def _round(self, state: TargetState, sight: Array, across: float) -> float:
        """Return the speed to the left, across the line of sight, for moving to the chosen side of the target."""
        s = self.settings
        if float(np.hypot(*state.velocity)) > _ALONG_M_S:
            self._heading = math.atan2(state.velocity[1], state.velocity[0])
        if self._heading is None or s.bearing_rad is None:
            return 0.0
        here = math.atan2(-sight[1], -sight[0])  # direction of the vehicle as seen from the target
        off = wrap_angle(self._heading + s.bearing_rad - here)
        return -clamped(s.round_gain * off * across, 0.6 * s.speed_m_s)

    def _evading(self, own: Motion, state: TargetState) -> Array:
        """Return the velocity, (2,) [m/s], for evading a target that is about to pass closer than allowed."""
        s, velocity = self.settings, state.velocity
        speed = float(np.hypot(*velocity))
        if speed < _ALONG_M_S:
            return np.zeros(2)
        here = own.position[:2] - state.foot[:2]
        left = np.array([-velocity[1], velocity[0]]) / speed
        in_s, aside = float(here @ velocity) / speed**2, float(here @ left)
        if not 0.0 < in_s < _APPROACH_HORIZON_S or abs(aside) >= s.nearest_m:
            return np.zeros(2)
        needed = (s.nearest_m - abs(aside)) / max(0.5, in_s)
        return left * math.copysign(min(needed, 0.7 * s.speed_m_s), aside)

    def _clear_of(self, other: TargetState, own: Motion, wanted: Array) -> Array:
        """Return the velocity, (2,) [m/s], for keeping clear of another object.

        The closest approach is computed for both the vehicle's current and its next velocity. If the other object's
        position is uncertain, for example because it is out of view, the vehicle stays further away and assumes that
        the object may stop.
        """
        uncertain_m = within(other.place_m - _CONFIDENT_SIGMA_M, 0.0, _UNCERTAIN_M)
        clear_m = self.settings.clear_m + uncertain_m
        here = own.position[:2] - other.foot[:2]
        moves = (other.velocity, np.zeros(2)) if uncertain_m > 0.0 else (other.velocity,)
        passes = [_pass(here, velocity - theirs) for velocity in (wanted, own.velocity[:2]) for theirs in moves]
        away, in_s, side = min(passes, key=lambda one: (one[1] >= _APPROACH_HORIZON_S, one[0]))
        if in_s >= _APPROACH_HORIZON_S or away >= clear_m:
            return np.zeros(2)
        gap = clear_m - away
        # With a head-on approach, noise alone would make the vehicle switch sides.
        gave_way_ns, before = self._gave_way
        lately = gave_way_ns is not None and seconds(own.at_ns - gave_way_ns) < _KEEP_SIDE_S
        if lately and float(side @ before) < 0.0 and away < _HEAD_ON_SHARE * clear_m:
            side, gap = -side, clear_m + away
        self._gave_way = own.at_ns, side
        return side * min(gap / max(0.5, in_s), 0.7 * self.settings.speed_m_s)

    def _kept_off(self, wanted: Array, state: TargetState, sight: Array, across: float) -> Array:
        """Limit the closing speed so that the vehicle can stop before it reaches the minimum distance."""
        closing = float((wanted - state.velocity) @ sight)
        gap = across - self.settings.nearest_m
        allowed = _stoppable(gap, self.settings) if gap > 0.0 else 2.0 * gap
        return wanted if closing <= allowed else wanted - sight * (closing - allowed)

    def _track_offset(self, own: Motion, position: Vector | None) -> None:
        """Track the offset from the start, from the position if known, because the integrated velocity drifts."""
        here = own.position[:2]
        self._out = self._out + (np.zeros(2) if self._previous_position is None else here - self._previous_position)
        self._previous_position = here
        if position is not None:
            known = np.array(position[:2])
            self._begin = known - self._out if self._begin is None else self._begin
            self._out = known - self._begin

    def _leashed(self, out: Array, wanted: Array) -> Array:
        """Limit the velocity to stay within the leash; ``out``, (2,) [m], is the vehicle's offset from the start."""
        leash = self.settings.leash_m
        if leash is None:
            return wanted
        length = float(np.hypot(*out))
        if length < 0.1:
            return wanted
        direction = out / length
        outwards = float(wanted @ direction)
        allowed = 1.2 * (leash - length)
        if outwards <= allowed:
            return wanted
        self.constraint = "leash"
        return wanted - direction * (outwards - allowed)

    def _up(self, altitude_m: float | None, state: TargetState | None) -> float:
        """Return the climb rate that keeps the height or moves the target back towards the image's centre."""
        s = self.settings
        if altitude_m is None:
            return 0.0
        height = s.height_m if s.height_m is not None else (self._height if self._height is not None else altitude_m)
        if self.phase is TargetPhase.RANGING:
            height = self._for_parallax(height, altitude_m)
        elif state is not None and (state.range_known or self.phase is TargetPhase.WATCHING):
            reach = math.tan(s.steep_rad) * state.range_m
            middle = float(state.middle[2])
            height = within(height, middle - reach, middle + reach)
        height = within(height, s.lowest_m, s.highest_m)
        return clamped(s.height_gain * (height - altitude_m), s.climb_m_s)

    def _for_parallax(self, height: float, altitude_m: float) -> float:
        """Return the next of two heights for measuring the range; climb first, because people may be below."""
        s = self.settings
        other = height = within(height, s.lowest_m, s.highest_m)
        if s.parallax_m is not None:
            above, below = height + s.parallax_m, height - s.parallax_m
            other = above if above <= s.highest_m else max(below, s.lowest_m)
        goal = other if self._away else height
        if abs(goal - altitude_m) < _HEIGHT_REACHED_M:
            self._away = not self._away
        return other if self._away else height

    def _by_attitude(self, own: Motion, wanted: Array, up: float, turn: float) -> Attitude:
        """Return the attitude for accelerating to a velocity, (2,) in odometry axes [m/s], with drag compensation."""
        s = self.settings
        push = s.tilt_gain * (wanted - own.velocity[:2]) + DRAG_PER_S * own.velocity[:2]
        forward, left = own.to_body(shortened(push, GRAVITY_M_S2 * math.tan(s.tilt_rad)))
        return Attitude(
            roll=-math.atan2(left, GRAVITY_M_S2), pitch=math.atan2(forward, GRAVITY_M_S2), climb=up, yaw_rate=turn
        )

    def _limits(self, own: Motion) -> None:
        """Apply the limits in the settings, and start the first set-point from the vehicle's own velocity."""
        s = self.settings
        limits = SetpointLimits(
            _SETPOINT_OVER * s.speed_m_s, s.climb_m_s, s.turn_rad_s, _SETPOINT_AHEAD * s.acceleration_m_s2
        )
        if self._limiter is None:
            self._limiter = SetpointLimiter(limits)
            forward, left = own.to_body(own.velocity[:2])
            self._limiter.reset(Velocity(forward=forward, left=left))
        self._limiter.limits = limits


def _pass(here: Array, moving: Array) -> tuple[float, float, Array]:
    """Return the distance [m] and time [s] of the closest approach, and the unit vector (2,) towards the passing side.

    ``here`` is the vehicle's position relative to the other object, and ``moving`` its relative velocity.
    """
    square = float(moving @ moving)
    in_s = clamped(-float(here @ moving) / square, _APPROACH_HORIZON_S) if square > 0.01 else 0.0
    nearest = here + moving * max(0.0, in_s)
    away = float(np.hypot(*nearest))
    aside = np.array([-moving[1], moving[0]]) / max(0.1, math.sqrt(square))
    return away, in_s, nearest / away if away > 0.1 else aside


def _stoppable(gap_m: float, settings: ChaseSettings) -> float:
    """Return the highest speed [m/s] from which the vehicle can stop within a gap, allowing for its reaction time."""
    react_s, brake = settings.react_s, settings.brake_m_s2
    return brake * (math.sqrt(react_s**2 + 2.0 * max(0.0, gap_m) / brake) - react_s)


def _not_towards(velocity: Array, sight: Array) -> Array:
    """Remove the velocity component towards a hidden target, because the obstacle that hides it may be in the way."""
    direction = sight / max(1e-6, float(np.hypot(*sight)))
    return velocity - direction * max(0.0, float(velocity @ direction))
