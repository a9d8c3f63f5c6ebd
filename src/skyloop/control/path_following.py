"""Controllers that fly along paths and to waypoints."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import nanoseconds
from skyloop.control.controller import Controller
from skyloop.control.path import Path, Polyline
from skyloop.control.path_law import FixedYaw, PathLaw, PathSettings, YawMode
from skyloop.control.waypoint import Fix, PositionSource, Waypoint, fix_of, lacking
from skyloop.errors import UsageError
from skyloop.extend import let_go
from skyloop.messages import EventKind, Feedback, Severity, Vector

if TYPE_CHECKING:
    from skyloop.client import Drone

APPROACH_M_S: Final = 0.5  #: speed on the way to the start of a path


@dataclass(slots=True)
class TrackingError:
    """Statistics of the distance between the vehicle and its target on the path."""

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
    """Common base of both controllers: a law and a position source. Hovers while the source has no position."""

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
        self.error = TrackingError()  #: distance from the target, according to the position source
        self.done = False  #: the whole path has been flown
        self.lost = False  #: the vehicle hovers because the position is unknown
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
        self._look(self._law, fix)
        if not self.done:
            self.drone.velocity(forward=wanted.forward, left=wanted.left, up=wanted.up, yaw_rate=wanted.yaw_rate)

    def _begin(self, fix: Fix) -> PathLaw:
        """Create the law for the first fix."""
        raise NotImplementedError

    def _look(self, law: PathLaw, fix: Fix) -> None:
        """Decide on the next leg after each step."""
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
    """Flies to a path's start and along the path, and hovers at its end. Then :meth:`run` returns.

    The vehicle must be airborne when :meth:`run` is called.

    Attributes:
        path: The path.
        on_path: Whether the vehicle has reached the start.
        error: Tracking error from the path's start to its end.
        done: Whether the whole path has been flown.
        lost: Whether the vehicle hovers because the position is unknown.
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
            yaw: A :class:`skyloop.control.YawMode`; None keeps the current yaw.
            settings: Settings of the law; None for the defaults.
            source: Position source; None for the vehicle's own feedback.
            max_age_s: Maximum age of a position; if it is older, the vehicle hovers.

        Raises:
            UsageError: ``max_age_s`` is not a finite number greater than 0.
        """
        super().__init__(drone, settings, yaw, source, max_age_s)
        self.path = path
        self.on_path = False  #: the vehicle has reached the start

    def _begin(self, fix: Fix) -> PathLaw:
        return PathLaw(_way(fix.position_m, _vector(self.path.position(0.0)), APPROACH_M_S), self.settings, self._yaw)

    def _look(self, law: PathLaw, fix: Fix) -> None:
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
    """Flies straight from waypoint to waypoint, staying at each, and then hovers; :meth:`run` returns.

    The vehicle must be airborne when :meth:`run` is called.

    Attributes:
        waypoints: The waypoints.
        reached: Number of waypoints reached.
        error: Distance from the moving target over the whole flight.
        done: Whether the vehicle has reached the last waypoint.
        lost: Whether the vehicle hovers because the position is unknown.
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
            hold_s: How long to stay at each waypoint.
            yaw: A :class:`skyloop.control.YawMode` for waypoints without a yaw; None keeps the current yaw.
            settings: Settings of the law; None for the defaults.
            source: Position source; None for the vehicle's own feedback.
            max_age_s: Maximum age of a position; if it is older, the vehicle hovers.

        Raises:
            UsageError: There are no waypoints, or a number is out of its range.
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
        self._there_ns: int | None = None  # time of arrival at the next waypoint
        _way((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), *self._speed)  # raises here if speed or acceleration is out of range

    def _begin(self, fix: Fix) -> PathLaw:
        goal = self.waypoints[0]
        return PathLaw(_way(fix.position_m, goal.position, *self._speed), self.settings, self._mode(goal))

    def _look(self, law: PathLaw, fix: Fix) -> None:
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
    """Return a straight path, or one that stays in place if both ends are equal."""
    if math.dist(begin, end) < 1e-6:
        return _Stay(end)
    return Polyline([begin, end], speed_m_s=speed_m_s, acceleration_m_s2=acceleration_m_s2)


def _vector(values: NDArray[np.float64]) -> Vector:
    x, y, z = values.tolist()
    return x, y, z
