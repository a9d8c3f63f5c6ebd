"""A control law that flies a course by a map and corrects the map with camera sightings. Pure.

The map contains the positions of gates and poles. The vehicle's own position is known only from odometry. Sightings
correct the positions of the next gate and of the poles, and each gate that was passed corrects the offset between map
and odometry. The route to the next gate leads around poles and other gates to a point in front of the opening, then
along its axis.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from skyloop.clock import nanoseconds, seconds
from skyloop.control.airframe import Motion, Part, VelocityLaw
from skyloop.control.gate_law import Axis, GatePhase, Point, Wall, detour
from skyloop.control.kalman import ConstantVelocityFilter
from skyloop.control.limiting import Array, SetpointLimits, clamped, shortened, within
from skyloop.estimation import corrected
from skyloop.messages import Feedback
from skyloop.messages.geometry import turned, wrap_angle

_MATCH_SIGMAS = 3.0  # maximum distance between a sighting and its pole, in standard deviations
_TILT_RAD = 0.012  # standard deviation of elevations, due to errors of the attitude and of pole tops in the image
_REPEATED = 3.0  # factor on the standard deviation of the noise: errors persist from one sighting to the next
_SIDES = 3  # number of viewing directions: along a gate's axis and from either side


class GatePlace(NamedTuple):
    """A gate's position on the map: the centre of its opening [m] and the heading for flying through [rad]."""

    x_m: float
    y_m: float
    z_m: float
    heading_rad: float


class Pole(NamedTuple):
    """A vertical post on the map."""

    x_m: float
    y_m: float
    radius_m: float = 0.045
    height_m: float = 2.325


@dataclass(frozen=True, slots=True)
class CourseSettings:
    """Gains, limits and distances of :class:`CourseLaw`.

    The defaults suit a vehicle half a metre across and openings of 1.2 m.
    """

    lead_s: float = 0.12  #: delay between computing a command and its effect
    velocity_gain: float = 1.0  #: fraction of the velocity error added to the set-point
    cruise_m_s: float = 0.8
    climb_m_s: float = 0.5
    turn_rad_s: float = 1.4
    acceleration_m_s2: float = 2.0
    aside_gain: float = 1.3  #: [1/s]
    height_gain: float = 1.3  #: [1/s]
    yaw_gain: float = 1.8  #: [1/s]
    body_m: float = 0.27  #: the vehicle's radius
    clearance_m: float = 0.2  #: clearance in addition to the radius
    frame_m: float = 0.12  #: thickness of a gate's bars along and across the axis
    before_m: tuple[float, ...] = (1.2, 0.9, 0.65)  #: distances in front of the opening, in the order to try them
    views_m: tuple[float, ...] = (3.0, 2.5, 3.8)  #: viewing distances for a gate that has not been seen yet
    beyond_m: float = 0.45  #: distance behind the gate at which the gate counts as passed
    aligned_m: float = 0.12  #: maximum lateral and vertical offset from the axis
    map_m: float = 0.05  #: standard deviation of map positions, horizontal and vertical
    start_m: float = 0.2  #: standard deviation of the start position
    sightings: int = 3  #: number of sightings of a gate required before flying through it
    waiting_s: float = 2.5  #: waiting time at each viewpoint; after the last viewpoint, ``stuck`` is set
    braking_per_s: float = 1.3  #: maximum speed towards an obstacle per metre of distance beyond half the clearance
    plan_s: float = 0.4  #: interval between route plans


class CourseLaw(VelocityLaw):
    """Computes velocities from feedback and sightings. Times are on the proxy's clock [ns]."""

    def __init__(
        self,
        gates: Sequence[GatePlace],
        widths_m: Sequence[float],
        poles: Sequence[Pole] = (),
        start: Point = (0.0, 0.0),
        settings: CourseSettings | None = None,
    ) -> None:
        """Initialise the law.

        ``start`` is the vehicle's map position at the first feedback. Yaw 0 is the map's x axis.
        """
        self.settings = s = settings or CourseSettings()
        super().__init__(
            SetpointLimits(s.cruise_m_s * 1.3, s.climb_m_s, s.turn_rad_s, s.acceleration_m_s2),
            Part.VELOCITY,
            Part.HEIGHT,
        )
        #: Phase and position of the vehicle in the gate's axes at the last step.
        self.phase, self.axis = GatePhase.SEARCHING, Axis(0.0, 0.0, 0.0)
        self.way: list[Point] = []  #: the points of the route, in odometry axes
        self.stuck: str | None = None  #: reason why the vehicle can't continue; None if it can
        self._gates, self._widths = tuple(gates), tuple(widths_m)
        self._shift = np.array([-start[0], -start[1], 0.0])  # offset from map axes to odometry axes
        self._shift_m = s.start_m
        self._poles = [_Spot(np.array(pole[:2]) + self._shift[:2], pole, s) for pole in poles]
        self.number = 0  #: number of the next gate, from 0
        self._lift: float | None = None  # altitude above the ground minus the odometry's height
        self._planned_ns: int | None = None
        self._waiting_ns: int | None = None
        self._view = 0  # index of the current viewpoint
        self._begin_gate(0)

    def next_gate(self) -> None:
        """Advance to the next gate; if the last one was seen often enough, its measured position corrects the map."""
        if self._seen >= self.settings.sightings:
            learnt = self._gate_at(self.number) - self._nominal(self.number)
            share = self._shift_m**2 / (self._shift_m**2 + self.settings.map_m**2)
            for spot in self._poles:
                spot.move(share * learnt[:2])
            self._shift = self._shift + share * learnt
            self._shift_m = max(0.1, self._shift_m * math.sqrt(1.0 - share))
        self._begin_gate(self.number + 1)

    def _begin_gate(self, number: int) -> None:
        self.number, self._seen, self._view = number, 0, 0
        self.phase, self.way, self._planned_ns, self._waiting_ns = GatePhase.GOING, [], None, None
        self._passing_ns: int | None = None
        self._filter = ConstantVelocityFilter(3, intensity_m2_s3=0.001, speed_m_s=0.02, gate=5.0)
        if number < len(self._gates):
            heading = self._gates[number].heading_rad
            self._heading = np.array([math.cos(heading), math.sin(heading)])

    def forget(self) -> None:
        """Add the start's uncertainty to the map's offset, and start again with the current gate unless passed."""
        self._shift_m = math.hypot(self._shift_m, self.settings.start_m)
        if self.phase is not GatePhase.PASSED:
            self._begin_gate(self.number)

    def feedback(self, feedback: Feedback) -> None:
        """Update with the vehicle's newest state."""
        super().feedback(feedback)
        newest, altitude = self.airframe.newest, self.airframe.altitude_m(feedback.captured_ns)
        if newest is None or altitude is None:
            return
        lift = altitude - float(newest.position[2])
        self._lift = lift if self._lift is None else self._lift + 0.1 * (lift - self._lift)

    def see(self, position: Array, normal: Array, at_capture: Feedback, captured_ns: int, trust: float = 1.0) -> None:
        """Update with a sighting of the next gate, as in :meth:`GateLaw.see`; ignore impossible positions."""
        found = self.airframe.at_capture(at_capture, captured_ns, position, normal)
        if found is None or self._lift is None or self.number >= len(self._gates):
            return
        motion, to_level = self._motion(captured_ns), found[1]
        distance = float(np.linalg.norm(position))
        across = (to_level @ normal)[:2]
        across = across / max(1e-6, float(np.linalg.norm(across)))
        if float(across @ self._heading) < 0.0:  # a gate looks the same from behind
            across = -across
        # The visible opening ends at the far edges of the bars, half their thickness behind the gate's centre.
        seen = to_level @ position
        off = float(across @ seen[:2]) / max(distance, 1e-6) * self.settings.frame_m / 2
        middle = motion.position + seen - np.array([*(off * across), 0.0])
        if self._filter.newest is None:
            expected = math.hypot(self.settings.map_m, self._shift_m, 0.05)
            self._filter.start(self._nominal(self.number), expected, captured_ns)
        if not self._filter.update(middle, 0.03 + 0.008 * distance**2, captured_ns):  # grows as in FollowLaw.see
            return
        weight = 0.15 * trust / max(1.0, 0.4 * distance)
        mixed = (1.0 - weight) * self._heading + weight * across
        self._heading = mixed / max(1e-6, float(np.linalg.norm(mixed)))
        self._seen += 1

    def see_pole(self, top: Array, at_capture: Feedback, captured_ns: int) -> None:
        """Update with the direction of the top of a pole in body axes, (3,); ignore it if it matches no pole."""
        found = self.airframe.at_capture(at_capture, captured_ns, top)
        if found is None or self._lift is None or not self._poles:
            return
        motion, ray = self._motion(captured_ns), found[1] @ top
        level = float(np.linalg.norm(ray[:2]))
        if level < 1e-6:
            return
        ahead, rise = ray[:2] / level, float(ray[2]) / level
        sightings = [spot.sighting(motion.position, ahead, rise) for spot in self._poles]
        nearest = min(range(len(sightings)), key=lambda number: sightings[number][0])
        if sightings[nearest][0] < _MATCH_SIGMAS:
            self._poles[nearest].update(sightings[nearest])

    def _motion(self, at_ns: int) -> Motion:
        """Return the vehicle's motion, with z as the height above the ground."""
        motion = super()._motion(at_ns)
        return replace(motion, position=motion.position + np.array([0.0, 0.0, self._lift or 0.0]))

    def _nominal(self, number: int) -> Array:
        place: Array = np.array(self._gates[number][:3]) + self._shift
        return place

    def _gate_at(self, number: int) -> Array:
        newest = self._filter.newest if number == self.number else None
        place: Array = self._nominal(number) if newest is None else newest.position
        return place

    def _setpoint(self, now_ns: int) -> Array:
        s = self.settings
        if self.number >= len(self._gates):
            return np.zeros(4)
        own = self._motion(now_ns).moved_to(now_ns + nanoseconds(s.lead_s))
        gate, ahead = self._gate_at(self.number), self._heading
        left = np.array([-ahead[1], ahead[0]])
        offset = own.position - gate
        self.axis = axis = Axis(float(offset[:2] @ ahead), float(offset[:2] @ left), float(offset[2]))
        if self.phase is GatePhase.PASSED or (self.phase is GatePhase.PASSING and axis.along_m > s.beyond_m):
            self.phase = GatePhase.PASSED
            return np.zeros(4)
        if self.phase is GatePhase.PASSING:
            if self._passing_ns is None:
                self._passing_ns = now_ns
            elif seconds(now_ns - self._passing_ns) > 3.0 * (s.before_m[0] + s.beyond_m) / s.cruise_m_s:
                self.stuck = "the vehicle does not get through the gate"
            heading = math.atan2(ahead[1], ahead[0])
            return self._to_velocity(
                own, s.cruise_m_s * ahead - s.aside_gain * axis.aside_m * left, -axis.above_m, heading
            )
        look = math.atan2(-offset[1], -offset[0])
        walls = [*self._walls_of_gates(), *self._walls_of_poles()]
        self._plan(own, walls, now_ns)
        seen = self._seen >= s.sightings
        if not self.way:
            self._wait(now_ns)
            return self._to_velocity(own, self._kept_off(np.zeros(2), own.position[:2], walls), -axis.above_m, look)
        goal = np.array(self.way[-1])
        left_m = float(np.linalg.norm(goal - own.position[:2]))
        here = left_m < 0.2 and abs(axis.above_m) < s.aligned_m
        if here and seen and abs(axis.aside_m) < s.aligned_m and abs(wrap_angle(look - own.yaw)) < 0.3:
            self.phase = GatePhase.PASSING
        elif here and not seen:
            self._wait(now_ns)
        else:
            self.phase, self._waiting_ns = GatePhase.GOING, None
        horizontal = self._kept_off(self._along(own.position[:2]), own.position[:2], walls)
        return self._to_velocity(own, horizontal, -axis.above_m, look)

    def _wait(self, now_ns: int) -> None:
        self.phase = GatePhase.SEARCHING
        if self._waiting_ns is None:
            self._waiting_ns = now_ns
        elif seconds(now_ns - self._waiting_ns) > self.settings.waiting_s:
            self._waiting_ns, self._planned_ns, self._view = None, None, self._view + 1
            if self._view >= _SIDES * len(self.settings.views_m):
                self.stuck = "the gate is not seen where it should be"

    def _kept_off(self, velocity: Array, place: Array, walls: Sequence[Wall]) -> Array:
        """Limit the components of a horizontal velocity towards obstacles."""
        s = self.settings
        for wall in walls:
            away = place - np.array(_nearest(place, wall))
            far = float(np.linalg.norm(away))
            away = away / max(far, 1e-6)
            room = far - (wall.reach_m - s.clearance_m / 2)
            towards, most = -float(velocity @ away), s.braking_per_s * room
            if towards > most:
                velocity = velocity + (towards - max(most, -0.3)) * away
        return velocity

    def _to_velocity(self, own: Motion, horizontal: Array, up_m: float, look: float) -> Array:
        s = self.settings
        turn = clamped(s.yaw_gain * wrap_angle(look - own.yaw), s.turn_rad_s)
        up = clamped(s.height_gain * up_m, s.climb_m_s)
        velocity = own.stiffened(np.array([*shortened(horizontal, s.cruise_m_s), up]), s.velocity_gain)
        return np.array([*own.to_body(velocity[:2]), velocity[2], turn])

    def _along(self, place: Array) -> Array:
        """Return the horizontal velocity along the route."""
        while len(self.way) > 1 and math.dist(self.way[0], place) < 0.2:
            del self.way[0]
        aim = np.array(self.way[0]) - place
        far = float(np.linalg.norm(aim))
        rest = far + sum(math.dist(a, b) for a, b in zip(self.way[:-1], self.way[1:], strict=True))
        speed = min(self.settings.cruise_m_s, 1.0 * rest)
        if len(self.way) > 1:  # slow down for corners
            speed = min(speed, 0.35 + 0.8 * far)
        return aim * (speed / max(far, 1e-6))

    def _plan(self, own: Motion, walls: Sequence[Wall], now_ns: int) -> None:
        """Plan the route to a point in front of the gate, at most once every ``plan_s``."""
        s = self.settings
        if self._planned_ns is not None and seconds(now_ns - self._planned_ns) < s.plan_s:
            return
        self._planned_ns = now_ns
        gate, ahead = self._gate_at(self.number)[:2], self._heading
        here: Point = (float(own.position[0]), float(own.position[1]))
        if self._seen >= s.sightings:
            goals = [gate - ahead * before for before in s.before_m]
        else:
            x, y = ahead.tolist()
            ways = [np.asarray(turned(x, y, side)) for side in (0.0, 0.5, -0.5)]
            goals = [gate - way * far for far in s.views_m for way in ways]
            goals = sorted(goals, key=lambda goal: self._hides(goal, gate, ahead))  # (a stable sort)
            goals = goals[self._view :] + goals[: self._view]
        free = [goal for goal in goals if _room(goal, walls) >= 0.0]
        for goal in free or sorted(goals, key=lambda goal: -_room(goal, walls)):
            way = detour(here, (float(goal[0]), float(goal[1])), walls)
            if way is not None:
                self.way = way
                return
        self.way = []

    def _hides(self, place: Array, gate: Array, ahead: Array) -> bool:
        """Return whether a pole is between a position and the gate's opening."""
        half = np.array([-ahead[1], ahead[0]]) * (self._widths[self.number] / 2 + self.settings.frame_m)
        corners = [place, gate - half, gate + half]
        edges = [
            (b - a) / max(1e-6, float(np.linalg.norm(b - a)))
            for a, b in zip(corners, corners[1:] + corners[:1], strict=True)
        ]
        inward = [np.array([-edge[1], edge[0]]) for edge in edges]
        if float(inward[0] @ (corners[2] - corners[0])) < 0.0:
            inward = [-one for one in inward]
        return any(
            all(
                float(one @ (spot.place - corner)) > -spot.radius_m - 0.05
                for one, corner in zip(inward, corners, strict=True)
            )
            for spot in self._poles
        )

    def _walls_of_gates(self) -> list[Wall]:
        s = self.settings
        walls = []
        for number, (place, width) in enumerate(zip(self._gates, self._widths, strict=True)):
            middle = self._gate_at(number)[:2]
            along = (
                self._heading
                if number == self.number
                else np.array([math.cos(place.heading_rad), math.sin(place.heading_rad)])
            )
            half = np.array([-along[1], along[0]]) * (width / 2 + s.frame_m / 2)
            (x, y), (u, v) = (middle - half).tolist(), (middle + half).tolist()
            spread = s.map_m if number != self.number or not self._seen else 0.0
            walls.append(Wall((x, y), (u, v), s.frame_m / 2 + s.body_m + s.clearance_m + spread))
        return walls

    def _walls_of_poles(self) -> list[Wall]:
        s = self.settings
        return [
            Wall(place, place, spot.radius_m + s.body_m + s.clearance_m + spot.spread_m)
            for spot in self._poles
            for place in [(float(spot.place[0]), float(spot.place[1]))]
        ]


#: A sighting's distance from a pole in standard deviations, its offset, (2,) [m], and its noise, (2, 2) [m²].
_Sighting = tuple[float, Array, Array]


class _Spot:
    """A pole's estimated position and covariance, from a Kalman filter for a fixed point in two dimensions."""

    def __init__(self, place: Array, pole: Pole, settings: CourseSettings) -> None:
        self.place, self.radius_m, self._height = place, pole.radius_m, pole.height_m
        self._covariance = np.eye(2) * (settings.map_m**2 + 0.05**2)

    @property
    def spread_m(self) -> float:
        """Standard deviation in the least certain direction."""
        return float(math.sqrt(np.linalg.eigvalsh(self._covariance)[-1]))

    def move(self, by: Array) -> None:
        self.place = self.place + by

    def sighting(self, own: Array, ahead: Array, rise: float) -> _Sighting:
        """Compare the bearing and slope of a pole's top with this estimate; a steeper slope means a closer pole."""
        height = self._height - float(own[2])
        if rise * height <= 0.01 or abs(height) < 0.2:
            return math.inf, np.zeros(2), np.eye(2)
        distance = height / rise
        aside = np.array([-ahead[1], ahead[0]])
        along_m = 0.05 + _TILT_RAD * (distance**2 + height**2) / abs(height)
        noise = np.outer(ahead, ahead) * along_m**2 + np.outer(aside, aside) * (0.03 + 0.02 * distance) ** 2
        miss, spread = own[:2] + distance * ahead - self.place, self._covariance + noise
        off = float(miss @ np.linalg.solve(spread, miss)) ** 0.5
        return off, miss, noise * _REPEATED**2

    def update(self, sighting: _Sighting) -> None:
        _, miss, noise = sighting
        self.place, known = corrected(self.place, self._covariance, miss, np.eye(2), noise)
        # The odometry drifts, so keep the variance from vanishing.
        self._covariance = known + np.eye(2) * 1e-5


def _room(place: Array, walls: Sequence[Wall]) -> float:
    """Return a position's distance to the nearest wall minus the required distance [m]; negative if too close."""
    return min((math.dist(place, _nearest(place, wall)) - wall.reach_m for wall in walls), default=math.inf)


def _nearest(place: Array, wall: Wall) -> Point:
    """Return the point on a wall nearest to a position."""
    (x, y), (u, v) = wall.begin, wall.end
    along, aside = u - x, v - y
    share = ((float(place[0]) - x) * along + (float(place[1]) - y) * aside) / max(along**2 + aside**2, 1e-12)
    share = within(share, 0.0, 1.0)
    return x + share * along, y + share * aside
