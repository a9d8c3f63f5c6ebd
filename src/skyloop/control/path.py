"""Paths, which give position and velocity over time, in world axes: x east, y north, z up [m]. Pure.

Any object with the attributes of :class:`Path` is a path. All paths in this module except :class:`FunctionPath` start
and end at rest. Each stretch has its own speed limit, and the speeds at the joints are found by one backward and one
forward pass with ``v² = v₀² + 2·a·s`` (a trapezoidal profile; Biagiotti and Melchiorri, "Trajectory Planning for
Automatic Machines and Robots", Springer 2008, section 3.2).
"""

from __future__ import annotations

import bisect
import itertools
import math
from collections.abc import Callable, Sequence
from operator import itemgetter
from typing import Final, Protocol

import numpy as np
from numpy.typing import ArrayLike

from skyloop.control.limiting import Array, within
from skyloop.errors import MissingExtraError, UsageError

#: Length up to which stretches are skipped, because the squares of their speeds would underflow a float.
SHORTEST_M: Final = 1e-9


class MotionProfile:
    """Distance and speed over time, from rest to rest."""

    def __init__(self, stretches: Sequence[tuple[float, float]], acceleration_m_s2: float) -> None:
        """Compute the profile from the length [m] and maximum speed [m/s] of each stretch.

        A stop is a stretch with length 0 and speed 0. Stretches no longer than :data:`SHORTEST_M` take no time.
        """
        #: Start time [s], start distance [m], speed and acceleration of each piece.
        self._pieces: list[tuple[float, float, float, float]] = []
        self.duration_s = 0.0  #: duration of the whole profile
        self.length_m = 0.0  #: length of the whole profile
        joints = _joint_speeds(stretches, acceleration_m_s2)
        for (length, limit), (begin, end) in zip(stretches, itertools.pairwise(joints), strict=True):
            self._stretch(length, limit, begin, end, acceleration_m_s2)

    def at(self, t_s: float) -> tuple[float, float]:
        """Return the distance covered [m] and the speed [m/s] at a given time; at rest before 0 and after the end."""
        if t_s <= 0.0 or not self._pieces:
            return 0.0, 0.0
        if t_s >= self.duration_s:
            return self.length_m, 0.0
        after = bisect.bisect_right(self._pieces, t_s, key=itemgetter(0))
        begin_s, begin_m, speed, acceleration = self._pieces[after - 1]
        dt = t_s - begin_s
        way = begin_m + speed * dt + acceleration * dt * dt / 2
        return min(self.length_m, way), max(0.0, speed + acceleration * dt)

    def _stretch(self, length: float, limit: float, begin: float, end: float, a: float) -> None:
        if length <= SHORTEST_M:
            return
        top = min(limit, math.sqrt((begin * begin + end * end) / 2 + a * length))
        if not top > 0.0:
            raise UsageError(f"a stretch of {length:g} m with a speed limit of {limit:g} m/s never ends")
        up, down = (top * top - begin * begin) / (2 * a), (top * top - end * end) / (2 * a)
        self._piece(up, begin, a, (top - begin) / a)
        cruise = max(0.0, length - up - down)
        self._piece(cruise, top, 0.0, cruise / top)
        self._piece(down, top, -a, (top - end) / a)

    def _piece(self, length: float, speed: float, acceleration: float, lasts_s: float) -> None:
        if lasts_s > 0.0:
            self._pieces.append((self.duration_s, self.length_m, speed, acceleration))
            self.duration_s += lasts_s
            self.length_m += length


def _joint_speeds(stretches: Sequence[tuple[float, float]], a: float) -> list[float]:
    """Return the speeds at the start of the first stretch, between stretches and at the end of the last one."""
    limits = [limit for _, limit in stretches]
    speeds = [0.0, *(min(pair) for pair in itertools.pairwise(limits)), 0.0]
    for k in range(len(stretches) - 1, -1, -1):
        speeds[k] = min(speeds[k], math.sqrt(speeds[k + 1] ** 2 + 2 * a * stretches[k][0]))
    for k, (length, _) in enumerate(stretches):
        speeds[k + 1] = min(speeds[k + 1], math.sqrt(speeds[k] ** 2 + 2 * a * length))
    return speeds


_DIFFERENCE_S = 0.01  # step of the numerical derivative to either side

_LEAST, _MOST = 1e-6, 1e6  # range of lengths, speeds, accelerations and times that can be divided without overflow


class Path(Protocol):
    """Position and velocity over time, from 0 to ``duration_s``; outside this interval, the path stays at its ends."""

    @property
    def duration_s(self) -> float: ...

    def position(self, t_s: float) -> Array:
        """Return the position at a given time [s], shape (3,) [m]."""

    def velocity(self, t_s: float) -> Array:
        """Return the velocity at a given time [s], shape (3,) [m/s]."""


class FunctionPath:
    """A path given by functions of time.

    Attributes:
        duration_s: Duration of the path.
    """

    def __init__(
        self,
        position: Callable[[float], ArrayLike],
        duration_s: float,
        velocity: Callable[[float], ArrayLike] | None = None,
    ) -> None:
        """Initialise the path.

        Args:
            position: A function that returns x, y, z [m] at a time from 0 to ``duration_s``.
            duration_s: Duration of the path.
            velocity: A function of time that returns x, y, z [m/s]; None to differentiate ``position`` numerically.

        Raises:
            UsageError: The duration is not between 1e-6 and 1e6 s.
        """
        self.duration_s = _positive("duration_s", duration_s)
        self._position = position
        self._velocity = velocity

    def position(self, t_s: float) -> Array:
        """Return the position at a given time [s], shape (3,) [m].

        Raises:
            UsageError: The function does not return three finite numbers.
        """
        return _point(self._position(within(t_s, 0.0, self.duration_s)))

    def velocity(self, t_s: float) -> Array:
        """Return the velocity at a given time [s], shape (3,) [m/s]; 0 before the start and after the end.

        Raises:
            UsageError: A function does not return three finite numbers.
        """
        if not 0.0 <= t_s < self.duration_s:
            return np.zeros(3)
        if self._velocity is not None:
            return _point(self._velocity(t_s))
        before, after = (within(t_s + d, 0.0, self.duration_s) for d in (-_DIFFERENCE_S, _DIFFERENCE_S))
        return (self.position(after) - self.position(before)) / (after - before)


class _Profiled:
    _profile: MotionProfile

    @property
    def duration_s(self) -> float:
        """Duration of the path [s]."""
        return self._profile.duration_s


class Polyline(_Profiled):
    """Straight legs between points at a constant speed, with stops at the corners or arcs that round them."""

    def __init__(
        self,
        points: Sequence[ArrayLike],
        *,
        speed_m_s: float = 0.5,
        acceleration_m_s2: float = 0.8,
        corner_m: float = 0.0,
    ) -> None:
        """Compute the legs and arcs.

        Args:
            points: Points, each (3,) [m], at least two of which differ.
            speed_m_s: Speed along the legs.
            acceleration_m_s2: Acceleration at the start and end, at stops, and across the arcs.
            corner_m: Distance from the corner at which an arc starts, limited to half of the shorter leg; 0 means a
                stop at each corner. On an arc the vehicle flies no faster than the acceleration allows.

        Raises:
            UsageError: There are fewer than two different points, or a number is out of range.
        """
        speed, acceleration = _speeds(speed_m_s, acceleration_m_s2)
        if not 0.0 <= corner_m < math.inf:
            raise UsageError(f"corner_m is {corner_m!r} and must be a number of metres, 0 or more")
        corners = _distinct([_point(point) for point in points])
        if len(corners) < 2:
            raise UsageError("a polyline needs at least two points that differ")
        self._pieces: list[_Leg | _Arc] = []
        stretches: list[tuple[float, float]] = []
        begin = corners[0]
        for k, end in enumerate(corners[1:], 1):
            arc = None if k + 1 == len(corners) else _arc(corners[k - 1], end, corners[k + 1], corner_m)
            leg = _Leg(begin, end if arc is None else arc.begin)
            self._pieces.append(leg)
            stretches.append((leg.length, speed))
            if arc is None:
                stretches.append((0.0, 0.0))
                begin = end
            else:
                self._pieces.append(arc)
                stretches.append((arc.length, min(speed, math.sqrt(acceleration * arc.radius))))
                begin = arc.end
        self._profile = MotionProfile(stretches, acceleration)
        self._begins = np.cumsum([0.0, *(piece.length for piece in self._pieces)])

    def position(self, t_s: float) -> Array:
        """Return the position at a given time [s], shape (3,) [m]."""
        piece, way, _ = self._at(t_s)
        return piece.point(way)

    def velocity(self, t_s: float) -> Array:
        """Return the velocity at a given time [s], shape (3,) [m/s]."""
        piece, way, speed = self._at(t_s)
        return piece.direction(way) * speed

    def _at(self, t_s: float) -> tuple[_Leg | _Arc, float, float]:
        way, speed = self._profile.at(t_s)
        k = int(np.searchsorted(self._begins, way, side="right")) - 1
        k = min(k, len(self._pieces) - 1)
        return self._pieces[k], way - float(self._begins[k]), speed


class Circle(_Profiled):
    """A circle flown at constant height and speed, starting and ending at rest."""

    def __init__(
        self,
        centre: ArrayLike,
        radius_m: float,
        *,
        speed_m_s: float = 0.5,
        laps: float = 1.0,
        begin_rad: float = 0.0,
        clockwise: bool = False,
        acceleration_m_s2: float = 0.8,
    ) -> None:
        """Initialise the path.

        Args:
            centre: x, y, z [m].
            radius_m: Radius of the circle.
            speed_m_s: Speed along the circle.
            laps: Number of laps.
            begin_rad: Angle at which the circle starts, counter-clockwise from east.
            clockwise: Whether to fly clockwise as seen from above.
            acceleration_m_s2: Acceleration at the start and end.

        Raises:
            UsageError: A number is out of range.
        """
        self._centre = _point(centre)
        self._radius = _positive("radius_m", radius_m)
        self._begin = begin_rad
        self._sense = -1.0 if clockwise else 1.0
        length = 2 * math.pi * self._radius * _positive("laps", laps)
        speed, acceleration = _speeds(speed_m_s, acceleration_m_s2)
        self._profile = MotionProfile([(length, speed)], acceleration)

    def position(self, t_s: float) -> Array:
        """Return the position at a given time [s], shape (3,) [m]."""
        angle, _ = self._angle(t_s)
        return self._centre + self._radius * np.array([math.cos(angle), math.sin(angle), 0.0])

    def velocity(self, t_s: float) -> Array:
        """Return the velocity at a given time [s], shape (3,) [m/s]."""
        angle, speed = self._angle(t_s)
        return self._sense * speed * np.array([-math.sin(angle), math.cos(angle), 0.0])

    def _angle(self, t_s: float) -> tuple[float, float]:
        way, speed = self._profile.at(t_s)
        return self._begin + self._sense * way / self._radius, speed


class Lemniscate(_Profiled):
    """A horizontal figure of eight (Gerono's: ``x = a·sin u``, ``y = a·sin u·cos u``), rotated by ``yaw_rad``."""

    def __init__(
        self,
        centre: ArrayLike,
        half_width_m: float,
        *,
        speed_m_s: float = 0.5,
        laps: float = 1.0,
        yaw_rad: float = 0.0,
        acceleration_m_s2: float = 0.8,
    ) -> None:
        """Initialise the path, which starts at its centre.

        Args:
            centre: x, y, z [m].
            half_width_m: ``a``, the distance from the centre to each end.
            speed_m_s: Maximum speed, which is reached at the centre.
            laps: Number of laps.
            yaw_rad: Counter-clockwise rotation of the figure.
            acceleration_m_s2: Acceleration at the start and end.

        Raises:
            UsageError: A number is out of range.
        """
        self._centre = _point(centre)
        self._a = _positive("half_width_m", half_width_m)
        c, s = math.cos(yaw_rad), math.sin(yaw_rad)
        self._turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        speed, acceleration = _speeds(speed_m_s, acceleration_m_s2)
        steepest = self._a * math.sqrt(2.0)  # maximum distance flown per unit of u
        turns = 2 * math.pi * _positive("laps", laps)
        self._profile = MotionProfile([(turns, speed / steepest)], acceleration / steepest)

    def position(self, t_s: float) -> Array:
        """Return the position at a given time [s], shape (3,) [m]."""
        u, _ = self._profile.at(t_s)
        return self._centre + self._turn @ (self._a * np.array([math.sin(u), math.sin(u) * math.cos(u), 0.0]))

    def velocity(self, t_s: float) -> Array:
        """Return the velocity at a given time [s], shape (3,) [m/s]."""
        u, rate = self._profile.at(t_s)
        along: Array = self._turn @ (self._a * rate * np.array([math.cos(u), math.cos(2 * u), 0.0]))
        return along


class Spline:
    """SciPy's clamped cubic spline: a smooth curve through points at given times, at rest at both ends.

    Attributes:
        duration_s: Duration of the path.
    """

    def __init__(self, points: Sequence[ArrayLike], times_s: Sequence[float]) -> None:
        """Compute the curve.

        Args:
            points: At least two points, each (3,) [m].
            times_s: Time at each point, starting at 0 and increasing.

        Raises:
            UsageError: There are more or fewer times than points, or the times don't start at 0 or don't increase.
            MissingExtraError: SciPy is not installed.
        """
        places, times = np.array([_point(point) for point in points]), np.asarray(times_s, dtype=np.float64)
        if len(places) < 2 or times.shape != (len(places),):
            raise UsageError(
                f"a spline needs at least two points and a time for each, got {len(places)} and {times.size}"
            )
        if times[0] != 0.0 or not np.isfinite(times).all() or not (np.diff(times) >= _LEAST).all():
            raise UsageError(f"the times of a spline must start at 0 and increase by at least {_LEAST:g} s")
        try:
            from scipy.interpolate import CubicSpline
        except ImportError as error:
            raise MissingExtraError("a spline", "control", cause=str(error)) from error
        self._curve = CubicSpline(times, places, bc_type="clamped")
        self._slope = self._curve.derivative()
        self.duration_s = float(times[-1])

    def position(self, t_s: float) -> Array:
        """Return the position at a given time [s], shape (3,) [m]."""
        return np.asarray(self._curve(within(t_s, 0.0, self.duration_s)), dtype=np.float64)

    def velocity(self, t_s: float) -> Array:
        """Return the velocity at a given time [s], shape (3,) [m/s]."""
        return np.asarray(self._slope(t_s), dtype=np.float64) if 0.0 <= t_s <= self.duration_s else np.zeros(3)


class _Leg:
    """A straight segment."""

    def __init__(self, begin: Array, end: Array) -> None:
        self.length = float(np.linalg.norm(end - begin))
        self._begin = begin
        self._direction = (end - begin) / self.length if self.length > 0.0 else np.zeros(3)

    def point(self, way: float) -> Array:
        return self._begin + self._direction * way

    def direction(self, way: float) -> Array:  # noqa: ARG002  (same signature as _Arc)
        return self._direction


class _Arc:
    """A circular arc that leaves one leg and joins the next."""

    def __init__(self, corner: Array, before: Array, after: Array, reach: float, turn: float) -> None:
        """Compute the arc from the legs' directions, the distance from its ends to the corner, and the angle [rad]."""
        self.begin, self.end = corner - before * reach, corner + after * reach
        self.radius = reach / math.tan(turn / 2)
        self.length = self.radius * turn
        self._before = before
        aside = after - before * float(after @ before)
        self._aside = aside / np.linalg.norm(aside)

    def point(self, way: float) -> Array:
        angle = way / self.radius
        forward, sideward = math.sin(angle), 1.0 - math.cos(angle)
        return self.begin + self.radius * (self._before * forward + self._aside * sideward)

    def direction(self, way: float) -> Array:
        angle = way / self.radius
        return self._before * math.cos(angle) + self._aside * math.sin(angle)


def _arc(before: Array, corner: Array, after: Array, reach: float) -> _Arc | None:
    """Return the arc; None if there is no corner or the path turns back on itself."""
    come, go = corner - before, after - corner
    reach = min(reach, float(np.linalg.norm(come)) / 2, float(np.linalg.norm(go)) / 2)
    come, go = come / np.linalg.norm(come), go / np.linalg.norm(go)
    turn = math.atan2(float(np.linalg.norm(np.cross(come, go))), float(come @ go))
    return _Arc(corner, come, go, reach, turn) if reach > 0.0 and 1e-6 < turn < math.pi - 1e-3 else None


def _distinct(points: list[Array]) -> list[Array]:
    kept: list[Array] = []
    for point in points:
        if not kept or float(np.linalg.norm(point - kept[-1])) > 1e-9:
            kept.append(point)
    return kept


def _point(value: ArrayLike) -> Array:
    point = np.asarray(value, dtype=np.float64)
    if point.shape != (3,) or not (np.abs(point) <= _MOST).all():
        raise UsageError(f"a point needs three numbers x, y, z in metres, each at most {_MOST:g}, got {value!r:.80}")
    return point


def _positive(name: str, value: float) -> float:
    if not _LEAST <= value <= _MOST:
        raise UsageError(f"{name} is {value!r} and must be from {_LEAST:g} to {_MOST:g}")
    return float(value)


def _speeds(speed_m_s: float, acceleration_m_s2: float) -> tuple[float, float]:
    return _positive("speed_m_s", speed_m_s), _positive("acceleration_m_s2", acceleration_m_s2)
