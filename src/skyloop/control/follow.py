"""Follow a marker using a camera, staying squarely in front of it, and search for it while it is out of view.

The control law is pure and computes velocities from sightings and feedback. It uses position-based visual servoing
(Chaumette and Hutchinson, "Visual servo control, part I", IEEE RAM 13(4), 2006). The marker's pose is converted to
odometry axes using the vehicle's attitude and position when the image was captured, and a filter predicts it for the
time when the command takes effect. The vehicle keeps its height and its distance along the line of sight, and moves
around the marker if it sees the marker from too far to the side.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np

from skyloop.clock import nanoseconds, seconds
from skyloop.control.airframe import Motion, Part, TurningSearch, VelocityLaw
from skyloop.control.behaviour import LOST, OTHER, SEARCHING, SEEN, Behaviour
from skyloop.control.kalman import ConstantVelocityFilter
from skyloop.control.limiting import Array, SetpointLimits, clamped, shortened, within
from skyloop.messages import Feedback, Points, Polyline, Text
from skyloop.messages.geometry import wrap_angle
from skyloop.messages.relayed import Shape
from skyloop.vision import MarkerDetector, MarkerSighting

if TYPE_CHECKING:
    from skyloop.client import Drone, Frame


class FollowPhase(StrEnum):
    """The phases of :class:`FollowLaw`."""

    SEARCHING = "searching"  #: turning on the spot at a series of heights
    FOLLOWING = "following"  #: the marker was seen a moment ago
    RECOVERING = "recovering"  #: the marker is lost; turning to its predicted position


@dataclass(frozen=True, slots=True)
class FollowSettings:
    """Goals, gains and limits of :class:`FollowLaw`. The defaults suit a small indoor vehicle with velocity control."""

    distance_m: float = 1.5
    lead_s: float = 0.12  #: delay between computing a command and its effect
    range_gain: float = 1.1  #: [1/s]
    height_gain: float = 1.2  #: [1/s]
    yaw_gain: float = 2.2  #: [1/s]
    #: Fraction of the velocity error added to the set-point, to stiffen a soft velocity loop against gusts.
    velocity_gain: float = 0.7
    aside_gain: float = 1.2  #: gain for moving around to the front of the marker [1/s]
    aside_rad: float = 0.3  #: maximum angle from the station at which the vehicle stays in place
    speed_m_s: float = 1.2  #: maximum horizontal speed
    climb_m_s: float = 0.6
    turn_rad_s: float = 1.8
    acceleration_m_s2: float = 2.0  #: limit for set-points; more would tilt the camera off the marker
    following_s: float = 0.35  #: time after the last sighting for which the marker counts as followed
    recovering_s: float = 3.0
    search_rad_s: float = 0.7
    search_heights_m: tuple[float, ...] = (0.0, 0.4, -0.3, 0.8)  #: relative heights for successive turns
    lowest_m: float = 0.6
    highest_m: float = 2.2


class FollowLaw(VelocityLaw):
    """Computes velocities from feedback and sightings. Times are on the proxy's clock [ns]."""

    def __init__(self, settings: FollowSettings | None = None) -> None:
        self.settings = s = settings or FollowSettings()
        limits = SetpointLimits(speed_m_s=s.speed_m_s, acceleration_m_s2=s.acceleration_m_s2)
        super().__init__(limits, Part.VELOCITY)
        self.mode = FollowPhase.SEARCHING  #: phase at the last step
        #: Desired angle around the marker, counter-clockwise from its normal as seen from above [rad].
        self.station_rad = 0.0
        self.station_rate_rad_s = 0.0  #: rate of change of ``station_rad``
        self.off_m: float | None = None  #: combined error of distance and height at the last step; None while searching
        self.aside_rad: float | None = None  #: actual angle around the marker; None while its normal is unknown
        self._target = TargetFilter()
        self._face: Array | None = None  # horizontal part of the marker's normal, in odometry axes
        self._seen_ns: int | None = None
        self._search = TurningSearch(s.search_rad_s, s.search_heights_m, s.lowest_m, s.highest_m)

    def forget(self) -> None:
        """Forget where the marker was."""
        self._target, self._seen_ns = TargetFilter(), None

    def see(self, position: Array, normal: Array, at_capture: Feedback, captured_ns: int, trust: float = 1.0) -> None:
        """Update with a sighting; ignore it if the vehicle's attitude or motion is unknown.

        The position of the marker's centre, (3,) [m], and its normal are in body axes at the time of capture, and
        ``at_capture`` contains the attitude at that time. ``trust`` is the confidence in the normal, 0 to 1.
        """
        found = self.airframe.at_capture(at_capture, captured_ns, position, normal)
        if found is None:
            return
        motion, to_level = found
        distance = float(np.linalg.norm(position))
        # With a constant corner error in pixels, the range error grows with the square of the range.
        self._target.see(motion.position + to_level @ position, 0.015 + 0.01 * distance**2, captured_ns)
        face = (to_level @ normal)[:2]
        weight = 0.25 * trust
        self._face = face if self._face is None else (1 - weight) * self._face + weight * face
        self._seen_ns = captured_ns

    def _setpoint(self, now_ns: int) -> Array:
        motion = self._motion(now_ns)
        ahead = motion.moved_to(now_ns + nanoseconds(self.settings.lead_s))
        unseen_s = math.inf if self._seen_ns is None else seconds(now_ns - self._seen_ns)
        if unseen_s > self.settings.recovering_s:
            self.mode, self.off_m = FollowPhase.SEARCHING, None
            return self._search.step(motion.yaw, self._altitude)
        self.mode = FollowPhase.FOLLOWING if unseen_s <= self.settings.following_s else FollowPhase.RECOVERING
        wanted = self._follow(ahead, unseen_s)
        self._search.restart(turning=float(wanted[3]))
        return wanted

    def _follow(self, own: Motion, unseen_s: float) -> Array:
        """Return the desired forward, left and up velocity [m/s] and yaw rate [rad/s] while the target is known."""
        s = self.settings
        # After losing the marker, the vehicle stops moving within a second but keeps turning.
        fade = within(1.0 - (unseen_s - s.following_s), 0.0, 1.0)
        place, speed = self._target.at(own.at_ns)
        speed = speed * fade
        offset = place - own.position
        across = max(0.3, math.hypot(offset[0], offset[1]))
        sight = offset[:2] / across
        aside = np.array([-sight[1], sight[0]])  # unit vector to the left of the line of sight
        away = float(np.linalg.norm(offset)) - s.distance_m
        self.off_m = math.hypot(away, float(offset[2]))
        horizontal = speed[:2] + sight * (s.range_gain * away) + aside * self._come_round(sight, across)
        horizontal = shortened(horizontal * fade, s.speed_m_s)
        up = fade * s.height_gain * offset[2] + speed[2]
        error = wrap_angle(math.atan2(offset[1], offset[0]) - own.yaw)
        sweep = float((speed[:2] - own.velocity[:2]) @ aside) / across  # turn rate of the line of sight
        turn = s.yaw_gain * error + fade * 0.8 * sweep
        velocity = own.stiffened(np.array([*horizontal, up]), s.velocity_gain)
        up = self._within_heights(float(velocity[2]))
        return np.array([*own.to_body(velocity[:2]), up, clamped(turn, s.turn_rad_s)])

    def _come_round(self, sight: Array, across: float) -> float:
        """Return the speed [m/s] to the left of the line of sight that moves the vehicle to its station."""
        s = self.settings
        if self._face is None or float(np.hypot(*self._face)) < 0.3:  # facing up or down, or estimates cancel out
            self.aside_rad = None
            return 0.0
        turned = float(self._face[0] * sight[1] - self._face[1] * sight[0])
        self.aside_rad = -math.atan2(turned, -float(self._face @ sight))
        off = wrap_angle(self.station_rad - self.aside_rad)
        excess = math.copysign(max(0.0, abs(off) - s.aside_rad), off)
        return clamped(-(s.aside_gain * excess + self.station_rate_rad_s) * across, 0.9)

    def _within_heights(self, up: float) -> float:
        s = self.settings
        if self._altitude is not None:
            up = max(0.0, up) if self._altitude < s.lowest_m else up
            up = min(0.0, up) if self._altitude > s.highest_m else up
        return clamped(up, s.climb_m_s)


class TargetFilter:
    """Filters the position and velocity of a point that is seen intermittently; restarts after jumps."""

    def __init__(self) -> None:
        self._filter = ConstantVelocityFilter(3, intensity_m2_s3=0.1, speed_m_s=0.7, gate=math.inf)

    def see(self, position: Array, deviation_m: float, at_ns: int) -> None:
        """Update with a measured position (3,) [m] and its standard deviation; ignore it if older than the last one.

        The filter restarts after two seconds without a sighting, or if the target is more than a metre (and five
        standard deviations) away from its prediction.
        """
        newest = self._filter.newest
        if newest is None or self._jumped(position, deviation_m, at_ns):
            self._filter.start(position, deviation_m, at_ns)
        else:
            self._filter.update(position, deviation_m, at_ns)

    def at(self, at_ns: int, *, longest_s: float = 1.0) -> tuple[Array, Array]:
        """Predict the target's position (3,) [m] and velocity (3,) [m/s]; raise UsageError if it was never seen."""
        estimate = self._filter.at(at_ns, longest_s=longest_s)
        return estimate.position, estimate.velocity

    def _jumped(self, position: Array, deviation_m: float, at_ns: int) -> bool:
        expected = self._filter.at(at_ns)
        unseen_s = 0.0 if self._filter.newest is None else seconds(at_ns - self._filter.newest.at_ns)
        spread = expected.covariance[0, 0] + deviation_m**2
        off = float(np.linalg.norm(position - expected.position))
        return unseen_s > 2.0 or (unseen_s >= 0.0 and off > max(1.0, 5 * math.sqrt(spread)))


_COLOURS = {FollowPhase.FOLLOWING: SEEN, FollowPhase.RECOVERING: LOST, FollowPhase.SEARCHING: SEARCHING}


@dataclass(slots=True)
class FollowScore:
    """Quality of a pursuit from the first sighting onwards; ranges are estimates from the vehicle's centre."""

    frames: int = 0  #: number of frames from the first sighting onwards
    in_view: int = 0  #: number of these frames that showed the marker
    frames_before: int = 0  #: number of frames before the first sighting
    first_seen_ns: int | None = None  #: capture time of the first frame that showed the marker
    ranges: list[tuple[int, float]] = field(default_factory=list)  #: time [ns] and range error [m] of each sighting

    @property
    def share_in_view(self) -> float | None:
        """Fraction of the frames that showed the marker, 0 to 1; None if it was never seen."""
        return self.in_view / self.frames if self.frames else None

    def range_errors_m(self, after_s: float = 0.0) -> list[float]:
        """Return the estimated minus the desired distance for each sighting, starting ``after_s`` after the first."""
        begin = (self.first_seen_ns or 0) + nanoseconds(after_s)
        return [error for at_ns, error in self.ranges if at_ns >= begin]

    def count(self, captured_ns: int, range_error_m: float | None) -> None:
        """Count a frame; ``range_error_m`` is the estimated minus the desired distance, or None without a sighting."""
        if range_error_m is not None:
            if self.first_seen_ns is None:
                self.first_seen_ns = captured_ns
            self.in_view += 1
            self.ranges.append((captured_ns, range_error_m))
        if self.first_seen_ns is None:
            self.frames_before += 1
        else:
            self.frames += 1


class FollowMarker(Behaviour):
    """Finds a marker and follows it. The vehicle must be airborne when :meth:`run` is called.

    Markers found in a frame are drawn on it as annotations.

    Attributes:
        marker_id: ID of the followed marker.
        score: Quality of the pursuit.
    """

    name = "follow"
    losses = frozenset({FollowPhase.RECOVERING, FollowPhase.SEARCHING})

    def __init__(
        self,
        drone: Drone,
        marker_id: int = 0,
        *,
        size_m: float = 0.3,
        dictionary: str = "4x4_50",
        camera: str | None = None,
        settings: FollowSettings | None = None,
    ) -> None:
        """Initialise the behaviour.

        Args:
            drone: The drone to fly.
            marker_id: ID of the marker.
            size_m: Edge length of the marker's black square.
            dictionary: The marker's dictionary.
            camera: Camera to use; None for the vehicle's first camera.
            settings: Settings for the control law; None for the defaults.

        Raises:
            UnknownNameError: There is no such camera or dictionary.
            MissingExtraError: OpenCV is not installed.
        """
        self.marker_id = marker_id
        self.score = FollowScore()
        self._follow_law = FollowLaw(settings)
        self._detector = MarkerDetector(dictionary, size_m)
        super().__init__(drone, self._follow_law, camera)

    @property
    def mode(self) -> FollowPhase:
        """The current phase: searching, following or recovering."""
        return self._follow_law.mode

    @property
    def phase(self) -> FollowPhase:
        """The same as :attr:`mode`, under the name common to all behaviours."""
        return self.mode

    @property
    def distance_m(self) -> float:
        """Desired distance from the marker [m]."""
        return self._follow_law.settings.distance_m

    def look(self, frame: Frame) -> list[Shape]:
        """Detect the marker, update the control law and count the frame."""
        seen = self._detector.detect(frame, camera=self._mounting)
        mine = next((one for one in seen if one.id == self.marker_id), None)
        self.score.count(frame.captured_ns, None if mine is None else self._use(mine, frame))
        return self._drawing(frame, seen, mine)

    def _use(self, sighting: MarkerSighting, frame: Frame) -> float:
        """Update the control law and return the estimated minus the desired distance [m]."""
        place = sighting.position_in_body(self._mounting)
        if frame.feedback is not None:
            normal = sighting.normal_in_body(self._mounting)
            self._follow_law.see(place, normal, frame.feedback, frame.captured_ns, trust=1.0 - sighting.ambiguity)
        return math.hypot(*place) - self.distance_m

    def _drawing(self, frame: Frame, seen: list[MarkerSighting], mine: MarkerSighting | None) -> list[Shape]:
        height, width = frame.shape[:2]
        colour = _COLOURS[self.mode]
        shapes: list[Shape] = [Polyline(one.outline, True, OTHER) for one in seen if one is not mine]
        if mine is None:
            shapes.append(Text(f"{self.mode} marker {self.marker_id}", (8.0, 16.0), colour))
            return shapes
        outline = mine.outline
        centre = (sum(x for x, _ in outline) / 4, sum(y for _, y in outline) / 4)
        below = (min(x for x, _ in outline), max(y for _, y in outline) + 14.0)
        return [
            *shapes,
            Polyline(((width / 2, height / 2), centre), False, colour),
            Polyline(outline, True, colour),
            Points((outline[0], centre), colour),
            Text(f"marker {mine.id}  {math.hypot(*mine.position_in_body(self._mounting)):.2f} m", below, colour),
        ]
