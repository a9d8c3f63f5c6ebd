"""A control law that keeps a vehicle on a path, computing velocities from positions, and controllers that use it.

The path's velocity is fed forward with the vehicle's response time as lead, and a PI controller for the position
removes the remaining error. The integral counteracts wind and errors of the measured velocity (Åström and Hägglund,
"Advanced PID Control", ISA 2006, chapter 5). Each position is compared with the path at the time of its measurement, so
delays cause no error.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import nanoseconds, seconds
from skyloop.control.controller import Controller
from skyloop.control.limiting import Array, SetpointLimiter, SetpointLimits, lowered, require_positive, within
from skyloop.control.path import Path, Polyline
from skyloop.control.pid import Gains, VectorPi
from skyloop.control.waypoint import Fix, PositionSource, Waypoint, fix_of, lacking
from skyloop.errors import UsageError
from skyloop.extend import let_go
from skyloop.messages import EventKind, Feedback, Severity, Value, Vector, Velocity
from skyloop.messages.geometry import turned, wrap_angle

if TYPE_CHECKING:
    from skyloop.client import Drone

_LONGEST_STEP_S = 0.5  # maximum advance of the path's time between two fixes
_MAY_BE_ZERO = ("velocity_gain", "yaw_gain", "lead_s")
_INTEGRAL_SHARE = 0.6  # limit of the integral as a fraction of the maximum speed
_ALONG_M_S = 0.05  # minimum speed for the direction of flight to determine the yaw
_NEAR_M = 0.3  # minimum horizontal distance to a point for its bearing to be reliable
_AHEAD_S = 0.1  # interval for computing the rate of the desired yaw


class YawMode(Protocol):
    """A function that chooses the yaw, given the path's position and velocity, both (3,) in world axes.

    It returns the yaw [rad], or None to keep the current yaw.
    """

    def __call__(self, position: Array, velocity: Array) -> float | None: ...


@dataclass(frozen=True, slots=True)
class FixedYaw:
    """A fixed yaw [rad].

    Raises:
        UsageError: The yaw is not finite.
    """

    yaw: float

    def __post_init__(self) -> None:
        if not math.isfinite(self.yaw):
            raise UsageError(f"yaw is {self.yaw} and must be finite")

    def __call__(self, position: Array, velocity: Array) -> float | None:  # noqa: ARG002
        """Return the yaw."""
        return self.yaw


@dataclass(frozen=True, slots=True)
class AlongPath:
    """Yaw to face along the path, plus ``offset`` [rad]; the yaw is kept while the vehicle hovers or only climbs."""

    offset: float = 0.0

    def __call__(self, position: Array, velocity: Array) -> float | None:  # noqa: ARG002
        """Return the yaw, or None while the horizontal speed is less than 0.05 m/s."""
        if math.hypot(velocity[0], velocity[1]) < _ALONG_M_S:
            return None
        return math.atan2(velocity[1], velocity[0]) + self.offset


@dataclass(frozen=True, slots=True)
class LookAt:
    """Yaw to face a point, x and y in world axes [m]; the yaw is kept while the vehicle is above or below the point."""

    x: float
    y: float

    def __call__(self, position: Array, velocity: Array) -> float | None:  # noqa: ARG002
        """Return the yaw, or None if the horizontal distance to the point is less than 0.3 m."""
        east, north = self.x - position[0], self.y - position[1]
        return math.atan2(north, east) if math.hypot(east, north) >= _NEAR_M else None


@dataclass(frozen=True, slots=True)
class PathSettings:
    """Gains, limits and acceptance radii of :class:`PathLaw`. The defaults suit a small indoor vehicle.

    Raises:
        UsageError: A number is out of range.
    """

    #: Gains for the position error [1/s, 1/s²]; ``velocity_gain`` replaces the derivative gain.
    gains: Gains = field(default_factory=lambda: Gains(p=1.6, i=0.15))
    #: Fraction of the velocity error that is added to the set-point if the velocity is known. Vehicles with a soft
    #: velocity loop then respond sooner, and gusts push them less far.
    velocity_gain: float = 1.0
    yaw_gain: float = 1.5  #: [1/s]
    lead_s: float = 0.25  #: the vehicle's response time; velocity is fed forward to compensate for it
    limits: SetpointLimits = field(
        default_factory=lambda: SetpointLimits(
            speed_m_s=1.5, climb_m_s=0.6, turn_rad_s=1.2, acceleration_m_s2=3.0, climb_acceleration_m_s2=2.0
        )
    )
    leash_m: float = 0.5  #: distance from the target at which the path slows down; at twice this distance it waits
    near_m: float = 0.15  #: acceptance radius
    near_rad: float = 0.15  #: maximum acceptable yaw error

    def __post_init__(self) -> None:
        numbers = (*_MAY_BE_ZERO, "leash_m", "near_m", "near_rad")
        require_positive(_MAY_BE_ZERO, **{name: getattr(self, name) for name in numbers})
        if self.gains.d > 0.0:
            raise UsageError(f"gains.d is {self.gains.d!r} and must be 0, because velocity_gain provides damping")

    def within(self, limits: Mapping[str, Value]) -> PathSettings:
        """Return these settings clamped to a drone's limits, because higher speeds would wind up the integral.

        Args:
            limits: ``limits.speed``, ``limits.climb`` and ``limits.yaw_rate``, as in ``drone.config``; missing ones
                have no effect.
        """
        own = self.limits
        return replace(
            self,
            limits=replace(
                own,
                speed_m_s=lowered(own.speed_m_s, limits, "limits.speed"),
                climb_m_s=lowered(own.climb_m_s, limits, "limits.climb"),
                turn_rad_s=lowered(own.turn_rad_s, limits, "limits.yaw_rate"),
            ),
        )


class PathLaw:
    """Computes velocities from position fixes; the path's time starts with the first fix."""

    def __init__(self, path: Path, settings: PathSettings | None = None, yaw: YawMode | None = None) -> None:
        """Initialise the control law.

        Args:
            path: The path, in world axes.
            settings: Settings for the control law; None for the defaults.
            yaw: The yaw mode; None to keep the yaw of the first fix.
        """
        self.settings = settings or PathSettings()
        self.time_s = 0.0  #: current time on the path
        self.off_m = 0.0  #: distance from the path's target at the last fix
        self._path = path
        self._yaw = yaw
        limits = self.settings.limits
        self._loop = VectorPi(self.settings.gains, 3, most=_INTEGRAL_SHARE * limits.speed_m_s)
        self._limiter = SetpointLimiter(limits)
        self._last: Fix | None = None
        self._wanted_yaw: float | None = None
        self._turning = 0.0  # rate of the desired yaw [rad/s]

    @property
    def over(self) -> bool:
        """Whether the path's time is up."""
        return self.time_s >= self._path.duration_s

    @property
    def target(self) -> tuple[Array, Array]:
        """The vehicle's current target: position (3,) [m] and velocity (3,) [m/s]."""
        return self._path.position(self.time_s), self._path.velocity(self.time_s)

    def follow(self, path: Path, yaw: YawMode | None = None) -> None:
        """Continue with another path from its start, keeping the integral.

        Args:
            path: The path, in world axes.
            yaw: The new yaw mode; None to keep the current one.
        """
        self._path, self.time_s = path, 0.0
        if yaw is not None:
            self._yaw = yaw

    def pause(self) -> None:
        """Pause the path because the vehicle hovers or another client flies it; restart at rest, with no integral."""
        self._limiter.reset(Velocity())
        self._loop.reset()
        self._last = None

    def there(self, fix: Fix) -> bool:
        """Return whether the path's time is up and the vehicle is at its end with the desired yaw."""
        s = self.settings
        turned = 0.0 if self._wanted_yaw is None else wrap_angle(self._wanted_yaw - fix.yaw_rad)
        return self.over and self._off(fix) <= s.near_m and abs(turned) <= s.near_rad

    def step(self, fix: Fix) -> Velocity:
        """Compute the set-point for a fix; the path advances only if the fix is newer than the last one.

        Fixes with non-finite values pause the flight.
        """
        if not fix.finite:
            self.pause()
            return Velocity()
        dt_s = 0.0 if self._last is None else max(0.0, seconds(fix.at_ns - self._last.at_ns))
        self._last = fix
        self._advance(min(dt_s, _LONGEST_STEP_S), self._off(fix))
        self.off_m = self._off(fix)
        target, _ = self.target
        ahead = self._path.velocity(self.time_s + self.settings.lead_s)
        wanted = ahead + self._loop.step(target - fix.position_m, min(dt_s, _LONGEST_STEP_S))
        if fix.velocity_m_s is not None:
            wanted += self.settings.velocity_gain * (wanted - fix.velocity_m_s)
        x, y, up = wanted.tolist()
        velocity = self._limiter.step(np.array([*turned(x, y, -fix.yaw_rad), up, self._turn(fix)]), dt_s)
        asked = (*turned(velocity.forward, velocity.left, fix.yaw_rad), velocity.up)
        self._loop.applied(wanted, np.array(asked))
        return velocity

    def _off(self, fix: Fix) -> float:
        return float(np.linalg.norm(self._path.position(self.time_s) - fix.position_m))

    def _advance(self, dt_s: float, off_m: float) -> None:
        """Advance the path's time; slow down beyond the leash, and stop beyond twice the leash."""
        share = within(2.0 - off_m / self.settings.leash_m, 0.0, 1.0)
        self.time_s = min(self._path.duration_s, self.time_s + share * dt_s)

    def _turn(self, fix: Fix) -> float:
        """Return the desired yaw rate [rad/s]."""
        position, velocity = self.target
        if self._yaw is not None:
            later = self.time_s + _AHEAD_S
            now, soon = self._yaw(position, velocity), self._yaw(self._path.position(later), self._path.velocity(later))
            self._turning = 0.0 if now is None or soon is None else wrap_angle(soon - now) / _AHEAD_S
            self._wanted_yaw = self._wanted_yaw if now is None else now
        if self._wanted_yaw is None:
            self._wanted_yaw = fix.yaw_rad
        return self._turning + self.settings.yaw_gain * wrap_angle(self._wanted_yaw - fix.yaw_rad)


APPROACH_M_S: Final = 0.5  #: speed while flying to the start of a path


@dataclass(slots=True)
class TrackingError:
    """Statistics on the distance between the vehicle and its target on the path."""

    samples: int = 0
    largest_m: float = 0.0
    _squares: float = field(default=0.0, repr=False)

    @property
    def rms_m(self) -> float:
        """Root mean square of the distances; 0 before the first sample."""
        return math.sqrt(self._squares / self.samples) if self.samples else 0.0

    def add(self, error_m: float) -> None:
        """Add a distance [m]."""
        self.samples += 1
        self._squares += error_m**2
        self.largest_m = max(self.largest_m, error_m)


class _PathFlyer(Controller):
    """The base class for both controllers, which hover while their position source provides no position."""

    def __init__(
        self,
        drone: Drone,
        settings: PathSettings | None,
        yaw: YawMode | None,
        source: PositionSource | None,
        max_age_s: float,
    ) -> None:
        super().__init__(drone)
        if not 0.0 < max_age_s < math.inf:
            raise UsageError(f"max_age_s is {max_age_s!r} and must be a number of seconds above 0")
        self.settings = (settings or PathSettings()).within(dict(drone.config.items()))
        self.error = TrackingError()  #: distance from the target as measured by the position source
        self.done = False  #: whether the whole path has been flown
        self.lost = False  #: whether the vehicle hovers because its position is unknown
        self._yaw = yaw
        self._source = source
        self._max_age_ns = nanoseconds(max_age_s)
        self._law: PathLaw | None = None

    @property
    def target(self) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """The vehicle's current target on the path.

        Position (3,) [m] and velocity (3,) [m/s] in world axes; None before the first fix.
        """
        return None if self._law is None else self._law.target

    def on_feedback(self, feedback: Feedback) -> None:
        """Send the next set-point, or hover while the position is unknown or older than ``max_age_s``."""
        if self.done:
            return
        fix = fix_of(feedback) if self._source is None else self._source()
        if self._source is None and fix is None and self._law is None:
            raise UsageError(f"can't fly a path: {lacking(feedback)}; or give the controller a position source")
        if fix is None or not fix.finite or abs(feedback.captured_ns - fix.at_ns) > self._max_age_ns:
            self._lose()
            return
        if self.lost:
            self.lost = False
            self.drone.emit(EventKind.VEHICLE_MESSAGE, "the position is known again: continuing", Severity.INFO)
        if self._law is None:
            self._law = self._begin(fix)
        if self._is_overruled(feedback):
            self._law.pause()
        wanted = self._law.step(fix)
        self._after_step(self._law, fix)
        if not self.done:
            self.drone.velocity(forward=wanted.forward, left=wanted.left, up=wanted.up, yaw_rate=wanted.yaw_rate)

    def _begin(self, fix: Fix) -> PathLaw:
        """Create the control law from the first fix."""
        raise NotImplementedError

    def _after_step(self, law: PathLaw, fix: Fix) -> None:
        """Decide whether to go on to the next part of the flight, or to end it."""
        raise NotImplementedError

    def _finish(self) -> None:
        self.done = True
        let_go(self.drone, "the path has ended")
        self._end()

    def _lose(self) -> None:
        if not self.lost:
            self.lost = True
            self.drone.emit(EventKind.VEHICLE_MESSAGE, "the position is not known: hovering", Severity.WARNING)
        if self._law is not None:
            self._law.pause()
        let_go(self.drone, "the position is not known")


class FollowPath(_PathFlyer):
    """Flies to the start of a path, follows it and hovers at its end. Then :meth:`run` returns.

    The vehicle must be airborne when :meth:`run` is called.

    Attributes:
        path: The path.
        on_path: Whether the vehicle has reached the start of the path.
        error: Tracking error from the start of the path to its end.
        done: Whether the whole path has been flown.
        lost: Whether the vehicle hovers because its position is unknown.
    """

    def __init__(
        self,
        drone: Drone,
        path: Path,
        *,
        yaw: YawMode | None = None,
        settings: PathSettings | None = None,
        source: PositionSource | None = None,
        max_age_s: float = 0.5,
    ) -> None:
        """Initialise the controller.

        Args:
            drone: The drone to fly.
            path: The path, in world axes.
            yaw: A :class:`skyloop.control.YawMode`; None to keep the current yaw.
            settings: Settings for the control law; None for the defaults.
            source: Position source; None for the vehicle's own feedback.
            max_age_s: Maximum age of positions; the vehicle hovers if the newest one is older.

        Raises:
            UsageError: ``max_age_s`` is not a finite number greater than 0.
        """
        super().__init__(drone, settings, yaw, source, max_age_s)
        self.path = path
        self.on_path = False

    def _begin(self, fix: Fix) -> PathLaw:
        return PathLaw(_way(fix.position_m, _vector(self.path.position(0.0)), APPROACH_M_S), self.settings, self._yaw)

    def _after_step(self, law: PathLaw, fix: Fix) -> None:
        if self.on_path:
            self.error.add(law.off_m)
        if not law.there(fix):
            return
        if self.on_path:
            self._finish()
        else:
            self.on_path = True
            law.follow(self.path)


class Waypoints(_PathFlyer):
    """Flies straight from waypoint to waypoint, stays at each and hovers at the last. Then :meth:`run` returns.

    The vehicle must be airborne when :meth:`run` is called.

    Attributes:
        waypoints: The waypoints.
        reached: Number of waypoints reached.
        error: Statistics on the distance from the moving target during the flight.
        done: Whether the vehicle has reached the last waypoint.
        lost: Whether the vehicle hovers because its position is unknown.
    """

    def __init__(
        self,
        drone: Drone,
        waypoints: Iterable[Waypoint | Vector],
        *,
        speed_m_s: float = 0.5,
        acceleration_m_s2: float = 0.8,
        hold_s: float = 0.0,
        yaw: YawMode | None = None,
        settings: PathSettings | None = None,
        source: PositionSource | None = None,
        max_age_s: float = 0.5,
    ) -> None:
        """Initialise the controller.

        Args:
            drone: The drone to fly.
            waypoints: Waypoints as :class:`Waypoint` or (x, y, z) in world axes [m].
            speed_m_s: Maximum speed between waypoints.
            acceleration_m_s2: Acceleration at the start and end of each leg.
            hold_s: Time to stay at each waypoint.
            yaw: A :class:`skyloop.control.YawMode` for waypoints without a yaw; None to keep the current yaw.
            settings: Settings for the control law; None for the defaults.
            source: Position source; None for the vehicle's own feedback.
            max_age_s: Maximum age of positions; the vehicle hovers if the newest one is older.

        Raises:
            UsageError: There are no waypoints, or a number is out of range.
        """
        super().__init__(drone, settings, yaw, source, max_age_s)
        self.waypoints = tuple(one if isinstance(one, Waypoint) else Waypoint(*one) for one in waypoints)
        if not self.waypoints:
            raise UsageError("there is no waypoint to fly to")
        if not 0.0 <= hold_s < math.inf:
            raise UsageError(f"hold_s is {hold_s!r} and must be a number of seconds, 0 or more")
        self.reached = 0
        self._speed = (speed_m_s, acceleration_m_s2)
        self._hold_ns = nanoseconds(hold_s)
        self._there_ns: int | None = None  # time of arrival at the current waypoint
        _way((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), *self._speed)  # raises an error if an argument is out of range

    def _begin(self, fix: Fix) -> PathLaw:
        goal = self.waypoints[0]
        return PathLaw(_way(fix.position_m, goal.position, *self._speed), self.settings, self._mode(goal))

    def _after_step(self, law: PathLaw, fix: Fix) -> None:
        self.error.add(law.off_m)
        if self._there_ns is None and law.there(fix):
            self._there_ns = fix.at_ns
        if self._there_ns is None or fix.at_ns - self._there_ns < self._hold_ns:
            return
        before, self._there_ns = self.waypoints[self.reached], None
        self.reached += 1
        if self.reached == len(self.waypoints):
            self._finish()
            return
        goal = self.waypoints[self.reached]
        law.follow(_way(before.position, goal.position, *self._speed), self._mode(goal))

    def _mode(self, goal: Waypoint) -> YawMode | None:
        return self._yaw if goal.yaw is None else FixedYaw(goal.yaw)


class _Stay:
    """A path that stays at one position."""

    duration_s = 0.0

    def __init__(self, place: Vector) -> None:
        self._place = np.array(place)

    def position(self, t_s: float) -> NDArray[np.float64]:  # noqa: ARG002
        return self._place

    def velocity(self, t_s: float) -> NDArray[np.float64]:  # noqa: ARG002
        return np.zeros(3)


def _way(begin: Vector, end: Vector, speed_m_s: float, acceleration_m_s2: float = 0.8) -> Path:
    """Return a straight path, or a stationary one if both ends are equal."""
    if math.dist(begin, end) < 1e-6:
        return _Stay(end)
    return Polyline([begin, end], speed_m_s=speed_m_s, acceleration_m_s2=acceleration_m_s2)


def _vector(values: NDArray[np.float64]) -> Vector:
    x, y, z = values.tolist()
    return x, y, z
