"""The law that lands on a marker that may move: sightings and feedback in, velocities out. Pure: no clock, no thread.

The marker's position and velocity come from a constant-velocity filter in odometry axes (see :mod:`.kalman`). The
vehicle takes up that velocity, and descends while it is within a cone over the marker, as in Saripalli, Montgomery and
Sukhatme, "Visually Guided Landing of an Unmanned Aerial Vehicle", IEEE T-RA 19(3), 2003: outside of the cone it keeps
its height and closes up first. The last part, where the marker no longer fits into the image, is flown by the filter's
prediction; when the feet touch, or must have touched, the motors are to stop.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import nanoseconds, seconds
from skyloop.control.filters import LowPass
from skyloop.control.kalman import ConstantVelocityFilter
from skyloop.control.limiting import SetpointLimiter, SetpointLimits, clamped, shortened
from skyloop.control.spiral import SpiralSearch
from skyloop.control.target import Motion, Odometry
from skyloop.messages import Feedback, Velocity

Array = NDArray[np.float64]


class LandingPhase(StrEnum):
    """What :class:`LandingLaw` is doing."""

    SEARCHING = "searching the marker"  #: on a square spiral, at the search height
    CHASING = "going over the marker"
    DESCENDING = "going down over the marker"
    RECOVERING = "lost the marker: climbing where it must be"
    COMMITTED = "touching down"  #: too near to see the marker whole
    DOWN = "down"


@dataclass(frozen=True, slots=True)
class LandingSettings:
    """Gains, limits and heights of :class:`LandingLaw`. Heights are of the feet over the marker by default."""

    lead_s: float = 0.12  #: from a command's decision to its taking hold
    #: Share of the velocity's error that is asked for on top: gusts push a vehicle with a soft velocity loop less far.
    velocity_gain: float = 1.0
    speed_m_s: float = 1.2  #: greatest, horizontally
    acceleration_m_s2: float = 2.0
    gain: float = 1.6  #: velocity by horizontal offset [1/s]
    descent_m_s: float = 0.35
    cone_m: float = 0.06  #: radius of the cone at the marker
    cone: float = 0.2  #: how much wider it is for each metre of height
    #: Below this it descends by the filter, whether it sees the marker or not, if it is near the marker's centre and
    #: the marker's velocity is steady: it waits for a marker that is turning.
    commit_m: float = 0.55
    commit_off_m: float = 0.07
    steady_m_s: float = 0.06  #: between the marker's velocity and that velocity through a low pass of ``steady_s``
    steady_s: float = 0.6
    final_descent_m_s: float = 0.6
    #: Farther off than this, or unseen for longer than ``blind_s``, it does not go on, unless it is all but down.
    abort_off_m: float = 0.15
    blind_s: float = 0.9
    nearly_m: float = 0.12
    touch_m: float = 0.03  #: so near it counts as touched
    feet_m: float = 0.06  #: below the body's centre
    fresh_s: float = 0.35  #: since last seen: it flies on
    recovering_s: float = 3.5
    search_height_m: float = 2.6  #: above the ground
    search_speed_m_s: float = 0.7
    search_lane_m: float = 1.1  #: between the lanes of the spiral: what the camera sees from there, less a margin


class LandingLaw:
    """Computes velocities from feedback and sightings; the motors are to stop at :attr:`phase` DOWN.

    Times are on the proxy's clock [ns].

    Attributes:
        phase: As of the last step.
        height_m: Of the feet over the marker, as of the last step; None while searching.
        off_m: Horizontal distance from the marker's centre, as of the last step; None while searching.
    """

    def __init__(self, settings: LandingSettings | None = None) -> None:
        """Initialise the law."""
        self.settings = s = settings or LandingSettings()
        self.phase = LandingPhase.SEARCHING
        self.height_m: float | None = None  #: of the feet over the marker, as of the last step
        self.off_m: float | None = None  #: horizontally from the marker's centre, as of the last step
        self._odometry = Odometry()
        self._altitude: float | None = None
        self._target = _new_filter()
        self._seen_ns: int | None = None
        self._search = SpiralSearch(s.search_lane_m, s.search_speed_m_s)
        self._limiter = SetpointLimiter(
            SetpointLimits(s.speed_m_s, acceleration_m_s2=s.acceleration_m_s2, climb_acceleration_m_s2=2.0)
        )
        self._last_ns: int | None = None
        self._committed_ns: int | None = None
        self._of_late: LowPass[Array] = LowPass(s.steady_s)  # the marker's velocity

    @property
    def target_speed_m_s(self) -> float | None:
        """Horizontal speed of the marker; None before it was seen."""
        newest = self._target.newest
        return None if newest is None else float(np.hypot(*newest.velocity[:2]))

    def feedback(self, feedback: Feedback) -> None:
        """Update with the vehicle's newest state."""
        self._odometry.add(feedback)
        self._altitude = feedback.altitude_m

    def see(self, position: Array, at_capture: Feedback, captured_ns: int) -> None:
        """Update with a sighting. Ignored while the vehicle's attitude or motion is not known.

        Args:
            position: The marker's centre in body axes, (3,) [m].
            at_capture: Feedback with the attitude at the capture.
            captured_ns: Capture of the frame.
        """
        motion = self._odometry.at(captured_ns)
        if motion is None or at_capture.roll_rad is None or at_capture.pitch_rad is None or at_capture.yaw_rad is None:
            return
        place = motion.position + at_capture.rotation @ position
        # Tilt's error of half a degree moves the place by a hundredth of the distance.
        deviation = 0.01 + 0.015 * float(np.linalg.norm(position))
        if self._target.update(place, deviation, captured_ns):
            self._of_late.step(
                self._target.at(captured_ns).velocity, seconds(captured_ns - (self._seen_ns or captured_ns))
            )
            self._seen_ns = captured_ns
        elif self._target.refused > 4:
            self._target.start(place, deviation, captured_ns)

    def step(self, now_ns: int) -> Velocity:
        """Compute the set-point for now. All zero until the vehicle's motion is known, and when it is down."""
        motion = self._odometry.at(now_ns)
        if motion is None or self.phase is LandingPhase.DOWN:
            return Velocity()
        ahead = motion.moved_to(now_ns + nanoseconds(self.settings.lead_s))
        wanted = self._wanted(motion, ahead, now_ns)
        dt_s = 0.0 if self._last_ns is None else seconds(now_ns - self._last_ns)
        self._last_ns = now_ns
        return self._limiter.step(wanted, dt_s)

    def _wanted(self, now: Motion, ahead: Motion, now_ns: int) -> Array:
        """Return forward, left, up [m/s] and yaw rate [rad/s]; sets the phase."""
        s = self.settings
        unseen_s = math.inf if self._seen_ns is None else seconds(now_ns - self._seen_ns)
        if self._seen_ns is None or (unseen_s > s.recovering_s and self._committed_ns is None):
            return self._look_for_it(ahead)
        present = self._target.at(now_ns)
        offset = present.position - now.position
        self.off_m = off = float(np.hypot(*offset[:2]))
        self.height_m = height = -float(offset[2]) - s.feet_m
        self.phase = self._next_phase(off, height, unseen_s, now_ns)
        self._search.restart()
        target = self._target.at(ahead.at_ns)
        horizontal = target.velocity[:2] + s.gain * (target.position - ahead.position)[:2]
        up = float(target.velocity[2]) + self._climb(off, height)
        velocity = ahead.stiffened(np.array([*shortened(horizontal, s.speed_m_s), up]), s.velocity_gain)
        return np.array([*ahead.to_body(velocity[:2]), velocity[2], 0.0])

    def _next_phase(self, off: float, height: float, unseen_s: float, now_ns: int) -> LandingPhase:
        s = self.settings
        seen, low = unseen_s <= s.fresh_s, height < s.commit_m
        if self._committed_ns is None and seen and low and off < s.commit_off_m and self._steady:
            self._committed_ns = now_ns
        elif height > s.nearly_m and (unseen_s > s.blind_s or off > s.abort_off_m):
            self._committed_ns = None
        if self._committed_ns is not None:
            return LandingPhase.DOWN if height <= s.touch_m else LandingPhase.COMMITTED
        if not seen:
            return LandingPhase.RECOVERING
        within = off < s.cone_m + s.cone * height and not low
        return LandingPhase.DESCENDING if within else LandingPhase.CHASING

    @property
    def _steady(self) -> bool:
        """Whether the marker has kept its velocity lately."""
        newest, late = self._target.newest, self._of_late.value
        if newest is None or late is None:
            return False
        return float(np.hypot(*(newest.velocity - late)[:2])) < self.settings.steady_m_s

    def _climb(self, off: float, height: float) -> float:
        """Return the vertical speed relative to the marker [m/s]."""
        s = self.settings
        if self.phase is LandingPhase.COMMITTED:
            return -s.final_descent_m_s
        if self.phase is LandingPhase.DESCENDING:
            return -s.descent_m_s * clamped(2.0 * (1.0 - off / (s.cone_m + s.cone * height)), 1.0)
        if self.phase is LandingPhase.RECOVERING:
            return self._to_search_height(0.5)
        return clamped(1.0 * (s.commit_m + 0.05 - height), 0.3) if height < s.commit_m + 0.1 else 0.0

    def _look_for_it(self, own: Motion) -> Array:
        self.phase = LandingPhase.SEARCHING
        self.height_m = self.off_m = None
        forward, left = own.to_body(self._search.step(own.position[:2]))
        return np.array([forward, left, self._to_search_height(0.5), 0.0])

    def _to_search_height(self, most_m_s: float) -> float:
        if self._altitude is None:
            return 0.0
        return clamped(1.0 * (self.settings.search_height_m - self._altitude), most_m_s)


def _new_filter() -> ConstantVelocityFilter:
    """Create a filter for a thing that moves on a floor and seldom changes its velocity."""
    return ConstantVelocityFilter(3, intensity_m2_s3=0.03, speed_m_s=0.4, gate=6.0)
