"""The motion of targets. Each path is a sequence of points on a fixed time grid, computed as far ahead as requested.

A target's position therefore depends only on the time and the seed.
"""

from __future__ import annotations

import itertools
import math
import threading
from collections import deque
from collections.abc import Iterator

import numpy as np

from skyloop.errors import UsageError
from skyloop.messages.geometry import clamped, wrap_angle
from skyloop.sim.streams import Purpose, stream
from skyloop.sim.world import (
    AlongYaw,
    CirclePath,
    FixedYaw,
    LissajousPath,
    OvalPath,
    Path,
    RingWalkPath,
    StillPath,
    Target,
    TargetState,
    TowardsYaw,
    Vec3,
    WalkPath,
    WaypointPath,
    Yaw,
    vec3,
)

GRID_S = 0.02  # spacing of the points, between which motion is linear
KEPT_S = 60.0  # length of the history that is available for a target

_TURN_BACK = 0.25  # probability that a ring walk reverses at a waypoint
_RING_STEP_RAD = (math.radians(20), math.radians(45))  # minimum and maximum angle between waypoints of a ring walk

_Point = tuple[Vec3, float, float]  # position, yaw (not wrapped), distance walked


class TargetTrack:
    """A target's motion over time. May be used from any thread."""

    def __init__(self, target: Target, seed: int, index: int) -> None:
        self.target = target
        positions = _positions(target.path, stream(seed, Purpose.TARGETS, index))
        self._points = _with_yaw(positions, target.yaw)
        self._kept: deque[_Point] = deque(maxlen=round(KEPT_S / GRID_S) + 2)
        self._known = 0  # number of points computed so far, including those no longer kept
        self._lock = threading.Lock()

    def at(self, time_s: float) -> TargetState:
        """Return the state at a simulation time [s]."""
        if not (math.isfinite(time_s) and time_s >= 0):
            raise UsageError(f"time must be a finite number of at least 0 s, not {time_s!r}")
        index, part = divmod(time_s / GRID_S, 1.0)
        with self._lock:
            (here, heading, walked), (there, next_heading, next_walked) = self._pair(int(index))
        position = tuple(a + part * (b - a) for a, b in zip(here, there, strict=True))
        yaw = wrap_angle(heading + part * (next_heading - heading))
        walked += part * (next_walked - walked)
        place = (position[0], position[1], position[2])
        # Use the velocity between the points rather than at the first one; otherwise a drone on a platform would creep.
        velocity = vec3((np.array(there) - np.array(here)) / GRID_S)
        rate = (next_heading - heading) / GRID_S
        return TargetState(self.target.name, time_s, place, yaw, velocity, walked, rate)

    def _pair(self, index: int) -> tuple[_Point, _Point]:
        while self._known < index + 2:
            self._kept.append(next(self._points))
            self._known += 1
        back = self._known - index
        if back > len(self._kept):
            raise UsageError(f"the target {self.target.name!r} is remembered for only {KEPT_S:g} s")
        return self._kept[-back], self._kept[1 - back]


def top_speed(path: Path) -> float:
    """Return a target's maximum speed [m/s] on the path."""
    if isinstance(path, LissajousPath):
        rates = (a * 2 * math.pi * c / path.period_s for a, c in zip(path.amplitude_m, path.cycles, strict=True))
        return math.hypot(*rates)
    if isinstance(path, WalkPath | RingWalkPath):
        return path.speed_m_s[1]
    if isinstance(path, StillPath):
        return 0.0
    return path.speed_m_s


def _positions(path: Path, rng: np.random.Generator) -> Iterator[tuple[Vec3, Vec3]]:
    """Yield position and velocity at 0, GRID_S, 2 GRID_S … indefinitely."""
    if isinstance(path, WaypointPath):
        return _waypoints(path)
    if isinstance(path, CirclePath):
        return (_circle(path, step * GRID_S) for step in itertools.count())
    if isinstance(path, OvalPath):
        return (_oval(path, step * GRID_S) for step in itertools.count())
    if isinstance(path, LissajousPath):
        return (_lissajous(path, step * GRID_S) for step in itertools.count())
    if isinstance(path, StillPath):
        return itertools.repeat((path.position_m, (0.0, 0.0, 0.0)))
    if isinstance(path, WalkPath):
        return _steer(_walk_goals(path, rng), path.speed_m_s, path.acceleration_m_s2, rng)
    return _steer(_ring_goals(path, rng), path.speed_m_s, path.acceleration_m_s2, rng)


def _waypoints(path: WaypointPath) -> Iterator[tuple[Vec3, Vec3]]:
    points = list(path.points_m)
    tour = points if path.closed else points + points[-2:0:-1]
    starts = [np.array(point) for point in tour]
    legs = [end - start for start, end in zip(starts, starts[1:] + starts[:1], strict=True)]
    lengths = [float(np.linalg.norm(leg)) for leg in legs]
    ends = list(itertools.accumulate(lengths))
    for step in itertools.count():
        distance = step * GRID_S * path.speed_m_s % ends[-1]
        leg = next((n for n, end in enumerate(ends) if distance < end), len(ends) - 1)
        along = 1.0 - (ends[leg] - distance) / lengths[leg]
        yield vec3(starts[leg] + along * legs[leg]), vec3(legs[leg] * (path.speed_m_s / lengths[leg]))


def _circle(path: CirclePath, time_s: float) -> tuple[Vec3, Vec3]:
    sense = -1.0 if path.clockwise else 1.0
    angle = path.start_rad + sense * path.speed_m_s / path.radius_m * time_s
    c, s = math.cos(angle), math.sin(angle)
    x, y, z = path.centre_m
    speed = sense * path.speed_m_s
    return (x + path.radius_m * c, y + path.radius_m * s, z), (-speed * s, speed * c, 0.0)


def _oval(path: OvalPath, time_s: float) -> tuple[Vec3, Vec3]:
    half, radius, bend = path.length_m / 2, path.radius_m, math.pi * path.radius_m
    along = (path.start_m + path.speed_m_s * time_s) % (2 * (path.length_m + bend))
    back = along >= path.length_m + bend  # the second half is the first half turned by 180°
    along -= (path.length_m + bend) * back
    if along < path.length_m:
        x, y, c, s = along - half, -radius, 1.0, 0.0
    else:
        angle = (along - path.length_m) / radius
        c, s = math.cos(angle), math.sin(angle)
        x, y = half + radius * s, -radius * c
    side = -1.0 if back else 1.0
    turn = -side if path.clockwise else side
    centre, speed = path.centre_m, path.speed_m_s
    return (centre[0] + side * x, centre[1] + turn * y, centre[2]), (side * speed * c, turn * speed * s, 0.0)


def _lissajous(path: LissajousPath, time_s: float) -> tuple[Vec3, Vec3]:
    rates = 2 * math.pi * np.array(path.cycles) / path.period_s
    angles = rates * time_s + np.array(path.phase_rad)
    amplitude = np.array(path.amplitude_m)
    return vec3(np.array(path.centre_m) + amplitude * np.sin(angles)), vec3(amplitude * rates * np.cos(angles))


def _walk_goals(path: WalkPath, rng: np.random.Generator) -> Iterator[Vec3]:
    while True:
        yield vec3(rng.uniform(path.low_m, path.high_m))


def _ring_goals(path: RingWalkPath, rng: np.random.Generator) -> Iterator[Vec3]:
    angle = float(rng.uniform(-math.pi, math.pi))
    sense = 1.0 if rng.random() < 0.5 else -1.0
    while True:
        radius = float(rng.uniform(*path.radius_m))
        x, y = path.centre_m
        yield (x + radius * math.cos(angle), y + radius * math.sin(angle), float(rng.uniform(*path.height_m)))
        if rng.random() < _TURN_BACK:
            sense = -sense
        angle += sense * float(rng.uniform(*_RING_STEP_RAD))


def _steer(
    goals: Iterator[Vec3], speeds: tuple[float, float], acceleration: float, rng: np.random.Generator
) -> Iterator[tuple[Vec3, Vec3]]:
    """Walk from goal to goal, at a different speed on each leg and with limited acceleration.

    A goal counts as reached at the braking distance, so that a reversal at the goal does not overshoot it.
    """
    position, goal = np.array(next(goals)), np.array(next(goals))
    velocity = np.zeros(3)
    speed = float(rng.uniform(*speeds))
    while True:
        yield vec3(position), vec3(velocity)
        way = goal - position
        distance = float(np.linalg.norm(way))
        while distance < speed * speed / (2 * acceleration) + 0.02:
            goal, speed = np.array(next(goals)), float(rng.uniform(*speeds))
            way = goal - position
            distance = float(np.linalg.norm(way))
        change = way * (speed / distance) - velocity
        size = float(np.linalg.norm(change))
        velocity = velocity + change * min(1.0, acceleration * GRID_S / size if size > 0 else 0.0)
        position = position + velocity * GRID_S


def _with_yaw(positions: Iterator[tuple[Vec3, Vec3]], yaw: Yaw) -> Iterator[_Point]:
    heading: float | None = None
    walked, last = 0.0, None
    for position, velocity in positions:
        wanted = _wanted_yaw(yaw, position, velocity)
        if heading is None:
            heading = 0.0 if wanted is None else wanted
        elif wanted is not None and not isinstance(yaw, FixedYaw):
            most = yaw.turn_rate_rad_s * GRID_S
            heading += clamped(wrap_angle(wanted - heading), most)
        walked += 0.0 if last is None else math.dist(position, last)
        last = position
        yield position, heading, walked


def _wanted_yaw(yaw: Yaw, position: Vec3, velocity: Vec3) -> float | None:
    """Return the heading to turn to, or None if there is none (at rest, or directly above the point to look at)."""
    if isinstance(yaw, FixedYaw):
        return yaw.yaw_rad
    if isinstance(yaw, TowardsYaw):
        x, y = yaw.point_m[0] - position[0], yaw.point_m[1] - position[1]
        return math.atan2(y, x) if math.hypot(x, y) > 0.05 else None
    assert isinstance(yaw, AlongYaw)
    if math.hypot(velocity[0], velocity[1]) < 0.02:
        return None
    return math.atan2(velocity[1], velocity[0]) + yaw.offset_rad
