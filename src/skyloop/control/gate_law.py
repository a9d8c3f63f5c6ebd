"""A control law for flying through a gate, and a planner for the shortest path around posts and gates. Pure.

The law uses position-based visual servoing (Chaumette and Hutchinson, "Visual servo control, part I", IEEE RAM 13(4),
2006) to compute velocities from sightings and feedback. The gate's position and axis are stored in odometry axes, where
only odometry drift affects them. Facing the opening, the vehicle moves onto the gate's axis, approaches as its
alignment improves, and flies through. The last metre and a half is flown by odometry, because at that range the gate no
longer fits into the image.

The path around obstacles is found by Dijkstra's algorithm in a two-dimensional visibility graph over points around each
obstacle (Lozano-Pérez and Wesley, "An algorithm for planning collision-free paths among polyhedral obstacles",
Communications of the ACM 22(10), 1979).
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

import numpy as np

from skyloop.clock import nanoseconds, seconds
from skyloop.control.airframe import Part, TurningSearch, VelocityLaw
from skyloop.control.kalman import ConstantVelocityFilter
from skyloop.control.limiting import Array, SetpointLimits, clamped, shortened
from skyloop.messages import Feedback
from skyloop.messages.geometry import wrap_angle

Point = tuple[float, float]

_AROUND = 8  # number of graph points around each end of a wall
_OUTSIDE = 1.0 / math.cos(math.pi / _AROUND) + 0.01  # radius factor that keeps lines between these points clear
_WITHIN_M = 0.02  # margin by which the path may be closer to a wall than its start or goal is


class GatePhase(StrEnum):
    """The phases of :class:`GateLaw` and :class:`.course_law.CourseLaw`."""

    SEARCHING = "searching for the gate"  #: turning on the spot at a series of heights
    ALIGNING = "moving onto the gate's axis"  #: the gate was seen a moment ago
    RECOVERING = "lost the gate: holding position, turning towards it"
    GOING = "flying to the gate"  #: along a route planned on the map
    PASSING = "flying through"  #: aligned and close, flying by odometry
    PASSED = "through"


@dataclass(frozen=True, slots=True)
class GateSettings:
    """Gains, limits and distances of :class:`GateLaw`.

    The defaults suit a small indoor vehicle and openings about a metre wide.
    """

    lead_s: float = 0.12  #: delay between computing a command and its effect
    #: Fraction of the velocity error added to the set-point, to stiffen a soft velocity loop against gusts.
    velocity_gain: float = 1.0
    speed_m_s: float = 1.1  #: maximum horizontal speed
    cruise_m_s: float = 0.8  #: speed through the gate and maximum speed towards it
    climb_m_s: float = 0.5
    turn_rad_s: float = 1.4
    acceleration_m_s2: float = 2.0
    aside_gain: float = 1.3  #: [1/s]
    height_gain: float = 1.3  #: [1/s]
    yaw_gain: float = 1.8  #: [1/s]
    stand_m: float = 1.7  #: distance in front of the gate at which the vehicle must be aligned
    aligned_m: float = 0.15  #: maximum lateral and vertical offset from the axis
    aligned_rad: float = 0.25  #: maximum heading error
    cone: float = 0.3  #: additional offset allowed per metre of distance beyond ``stand_m``
    beyond_m: float = 0.7  #: distance behind the gate at which the gate counts as passed
    fresh_s: float = 0.4  #: time to continue without a sighting
    recovering_s: float = 3.0
    search_rad_s: float = 0.7
    search_heights_m: tuple[float, ...] = (0.0, 0.5, -0.4)
    lowest_m: float = 0.6
    highest_m: float = 2.4


class Axis(NamedTuple):
    """The vehicle's position in the gate's axes."""

    along_m: float  #: position in the direction of flight; negative in front of the gate
    aside_m: float  #: distance to the left of the axis
    above_m: float


class GateLaw(VelocityLaw):
    """Computes velocities from feedback and sightings. Times are on the proxy's clock [ns]."""

    def __init__(self, settings: GateSettings | None = None) -> None:
        self.settings = s = settings or GateSettings()
        super().__init__(SetpointLimits(s.speed_m_s, s.climb_m_s, acceleration_m_s2=s.acceleration_m_s2), Part.VELOCITY)
        self.phase = GatePhase.SEARCHING  #: phase at the last step
        self.axis: Axis | None = None  #: the vehicle's position at the last step; None while the gate is not located
        self._search = TurningSearch(s.search_rad_s, s.search_heights_m, s.lowest_m, s.highest_m)
        self._gate = _new_filter()
        self._way: Array | None = None  # horizontal direction through the gate
        self._seen_ns: int | None = None

    def next_gate(self, *, turning: float = 0.0) -> None:
        """Forget the gate and search for the next one, first turning counter-clockwise if ``turning`` is positive."""
        self.phase = GatePhase.SEARCHING
        self.forget()
        self._search.restart(turning=turning)

    def forget(self) -> None:
        """Forget where the gate is, and search for it unless the vehicle has passed it."""
        if self.phase is not GatePhase.PASSED:
            self.phase = GatePhase.SEARCHING
        self._gate, self._way, self._seen_ns, self.axis = _new_filter(), None, None, None

    def see(self, position: Array, normal: Array, at_capture: Feedback, captured_ns: int, trust: float = 1.0) -> None:
        """Update with a sighting; ignore it if it is far from earlier ones, or if attitude or motion is unknown.

        A sighting is the opening's centre, (3,) [m], and the normal of the visible side, both in body axes at the time
        of capture; ``at_capture`` contains the attitude at that time. ``trust`` is the confidence in the normal, from 0
        to 1.
        """
        found = self.airframe.at_capture(at_capture, captured_ns, position, normal)
        if found is None:
            return
        motion, to_level = found
        distance = float(np.linalg.norm(position))
        deviation = 0.02 + 0.006 * distance**2  # grows as in FollowLaw.see
        if not self._gate.update(motion.position + to_level @ position, deviation, captured_ns):
            return
        way = -(to_level @ normal)[:2]
        weight = 0.2 * trust / max(1.0, 0.4 * distance)
        self._way = way if self._way is None else (1.0 - weight) * self._way + weight * way
        self._seen_ns = captured_ns

    def _setpoint(self, now_ns: int) -> Array:
        s = self.settings
        own = self._motion(now_ns).moved_to(now_ns + nanoseconds(s.lead_s))
        if self.phase is GatePhase.PASSED:
            return np.zeros(4)
        if self._seen_ns is None or self._way is None:
            return self._search.step(own.yaw, self._altitude)
        unseen_s = seconds(now_ns - self._seen_ns)
        gate = self._gate.at(now_ns, longest_s=0.0).position
        way = self._way / max(1e-6, float(np.linalg.norm(self._way)))
        offset = own.position - gate
        self.axis = axis = Axis(
            float(offset[:2] @ way), float(offset[:2] @ np.array([-way[1], way[0]])), float(offset[2])
        )
        heading = math.atan2(way[1], way[0])
        self.phase = self._next_phase(axis, wrap_angle(heading - own.yaw), unseen_s)
        if self.phase is GatePhase.PASSED:
            return np.zeros(4)
        if self.phase is GatePhase.SEARCHING:
            self.forget()
            return self._search.step(own.yaw, self._altitude)
        bearing = math.atan2(-offset[1], -offset[0])
        look = heading if self.phase is GatePhase.PASSING else bearing
        turn = clamped(s.yaw_gain * wrap_angle(look - own.yaw), s.turn_rad_s)
        self._search.restart(turning=turn)
        if self.phase is GatePhase.RECOVERING:
            return np.array([0.0, 0.0, 0.0, turn])
        along = s.cruise_m_s if self.phase is GatePhase.PASSING else self._approach(axis)
        aside = -s.aside_gain * axis.aside_m
        horizontal = shortened(along * way + aside * np.array([-way[1], way[0]]), s.speed_m_s)
        up = clamped(-s.height_gain * axis.above_m, s.climb_m_s)
        velocity = own.stiffened(np.array([*horizontal, up]), s.velocity_gain)
        return np.array([*own.to_body(velocity[:2]), velocity[2], turn])

    def _next_phase(self, axis: Axis, off_heading: float, unseen_s: float) -> GatePhase:
        s = self.settings
        if self.phase is GatePhase.PASSED or axis.along_m > s.beyond_m:
            return GatePhase.PASSED
        if self.phase is GatePhase.PASSING:
            # Odometry is accurate only for the few seconds that the passage takes.
            late = unseen_s > 2.0 * (s.stand_m + s.beyond_m) / s.cruise_m_s
            return GatePhase.RECOVERING if late else GatePhase.PASSING
        if unseen_s > s.recovering_s:
            return GatePhase.SEARCHING
        if unseen_s > s.fresh_s:
            return GatePhase.RECOVERING
        aligned = max(abs(axis.aside_m), abs(axis.above_m)) < s.aligned_m and abs(off_heading) < s.aligned_rad
        near = -s.stand_m - 0.15 < axis.along_m < 0.0
        return GatePhase.PASSING if near and aligned else GatePhase.ALIGNING

    def _approach(self, axis: Axis) -> float:
        """Return the speed along the axis while aligning [m/s]: 0 well outside the cone, negative if too close."""
        s = self.settings
        left_m = -s.stand_m - axis.along_m
        if left_m < 0.0:
            return clamped(1.0 * left_m, 0.4)
        off = math.hypot(axis.aside_m, axis.above_m)
        share = clamped(1.5 - off / (s.aligned_m + s.cone * left_m), 1.0)
        return max(0.0, share) * min(s.cruise_m_s, 0.1 + 0.9 * left_m)


def _new_filter() -> ConstantVelocityFilter:
    """Create a filter for a fixed point, given in axes that drift by a few centimetres per second."""
    return ConstantVelocityFilter(3, intensity_m2_s3=0.002, speed_m_s=0.03, gate=6.0)


class Wall(NamedTuple):
    """An obstacle: all points within ``reach_m`` of a line segment, or of a point if its ends are equal."""

    begin: Point
    end: Point
    reach_m: float


def detour(start: Point, goal: Point, walls: Sequence[Wall]) -> list[Point] | None:
    """Return the points of the shortest path, including the goal but not the start; None if there is no path.

    The start and goal may be too close to a wall, but the path gets no closer to that wall than they are. Points are
    east, north [m]. Pass at most a few dozen walls, because the effort grows with the cube of their number.
    """
    ends = np.array([[wall.begin, wall.end] for wall in walls], dtype=np.float64).reshape(-1, 2, 2)
    reach = np.array([wall.reach_m for wall in walls], dtype=np.float64)
    both = np.array([start, goal], dtype=np.float64)
    for point in both:
        reach = np.minimum(reach, _distances(point[None], point[None], ends)[0] - _WITHIN_M)
    points = np.concatenate([both, *_corners(ends, reach)])
    begin, end = np.triu_indices(len(points), 1)
    clear = (_distances(points[begin], points[end], ends) >= reach - 1e-9).all(axis=1)
    lengths = np.full((len(points), len(points)), math.inf)
    apart = np.linalg.norm(points[begin] - points[end], axis=1)
    lengths[begin[clear], end[clear]] = lengths[end[clear], begin[clear]] = apart[clear]
    return _shortest(points, lengths)


def _corners(ends: Array, reach: Array) -> list[Array]:
    """Return the points around both ends of each wall, (n, 2) each."""
    turns = np.arange(_AROUND) * (2 * math.pi / _AROUND)
    circle = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    corners = []
    for (first, last), far in zip(ends, reach, strict=True):
        for end in (first,) if np.array_equal(first, last) else (first, last):
            corners.append(end + circle * (max(far, 0.05) * _OUTSIDE))
    return corners


def _shortest(points: Array, lengths: Array) -> list[Point] | None:
    """Return the shortest path from the first point to the second."""
    best, came = {0: 0.0}, {0: 0}
    queue = [(0.0, 0)]
    while queue:
        far, here = heapq.heappop(queue)
        if here == 1:
            way = [here]
            while came[way[-1]] != 0:
                way.append(came[way[-1]])
            return [(float(points[number, 0]), float(points[number, 1])) for number in reversed(way)]
        if far > best[here]:
            continue
        for there in np.flatnonzero(np.isfinite(lengths[here])).tolist():
            total = far + float(lengths[here, there])
            if total < best.get(there, math.inf):
                best[there], came[there] = total, here
                heapq.heappush(queue, (total, there))
    return None


def _distances(begin: Array, end: Array, walls: Array) -> Array:
    """Return the distances (n, m) between n segments, given by their ends (n, 2), and m walls (m, 2, 2)."""
    a, b = begin[:, None], end[:, None]
    c, d = walls[None, :, 0], walls[None, :, 1]
    apart = np.minimum(
        np.minimum(_to_segment(a, c, d), _to_segment(b, c, d)), np.minimum(_to_segment(c, a, b), _to_segment(d, a, b))
    )
    crossing = (_side(a, b, c) * _side(a, b, d) < 0) & (_side(c, d, a) * _side(c, d, b) < 0)
    return np.where(crossing, 0.0, apart)


def _to_segment(point: Array, begin: Array, end: Array) -> Array:
    way = end - begin
    share = ((point - begin) * way).sum(axis=-1) / np.maximum((way * way).sum(axis=-1), 1e-12)
    nearest = begin + np.clip(share, 0.0, 1.0)[..., None] * way
    distance: Array = np.linalg.norm(point - nearest, axis=-1)
    return distance


def _side(begin: Array, end: Array, point: Array) -> Array:
    side: Array = (end[..., 0] - begin[..., 0]) * (point[..., 1] - begin[..., 1]) - (end[..., 1] - begin[..., 1]) * (
        point[..., 0] - begin[..., 0]
    )
    return side
