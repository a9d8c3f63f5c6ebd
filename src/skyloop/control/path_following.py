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
from skyloop.control.heading import FixedYaw, YawMode
from skyloop.control.path import Path, Polyline
from skyloop.control.path_law import PathLaw, PathSettings
from skyloop.control.position import Fix, PositionSource, fix_of
from skyloop.control.waypoint import Waypoint, lacking
from skyloop.errors import UsageError
from skyloop.messages import EventKind, Feedback, Severity, Vector

if TYPE_CHECKING:
    from skyloop.client import Drone

APPROACH_M_S: Final = 0.5  #: to the begin of a path


@dataclass(slots=True)
class TrackingError:
    """How far off the path it was, summed up."""

    samples: int = 0
    largest_m: float = 0.0
    _squares: float = field(default=0.0, repr=False)

    @property
    def rms_m(self) -> float:
        """Root of the mean square; 0 before the first sample."""
        return math.sqrt(self._squares / self.samples) if self.samples else 0.0

    def add(self, error_m: float) -> None:
        """One more distance from where it should have been."""
        self.samples += 1
        self._squares += error_m**2
        self.largest_m = max(self.largest_m, error_m)


class _PathFlyer(Controller):
    """What both controllers have in common: a law, a source of positions, and what to do when that falls silent."""

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
        self.settings = settings or PathSettings()
        self.error = TrackingError()  #: distance from where it should have been, as the position source has it
        self.done = False  #: all was flown
        self.lost = False  #: the position is not known now, and the vehicle hovers
        self._yaw = yaw
        self._source = source
        self._max_age_ns = nanoseconds(max_age_s)
        self._law: PathLaw | None = None

    @property
    def target(self) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """Where it should be now, and how fast: (3,) [m] and (3,) [m/s], world axes; None before the first fix."""
        return None if self._law is None else self._law.target

    def on_feedback(self, feedback: Feedback) -> None:
        """Fly on; hover while the position is not known, and while it is older than the time allowed.

        Raises :class:`UsageError` if there is no other source and the vehicle does not tell its position at first.
        """
        if self.done:
            return
        fix = fix_of(feedback) if self._source is None else self._source()
        if self._source is None and fix is None and self._law is None:
            raise UsageError(f"it can't fly a path: {lacking(feedback)}; give it a source of positions")
        if fix is None or feedback.captured_ns - fix.at_ns > self._max_age_ns:
            self._lose()
            return
        if self.lost:
            self.lost = False
            self.drone.tell(EventKind.VEHICLE_MESSAGE, "the position is known again: flying on", Severity.INFO)
        if self._law is None:
            self._law = self._begin(fix)
        wanted = self._law.step(fix)
        self._look(self._law, fix)
        if not self.done:
            self.drone.velocity(forward=wanted.forward, left=wanted.left, up=wanted.up, yaw_rate=wanted.yaw_rate)

    def _begin(self, fix: Fix) -> PathLaw:
        """The law for where it is at first."""
        raise NotImplementedError

    def _look(self, law: PathLaw, fix: Fix) -> None:
        """After each step: what comes next."""
        raise NotImplementedError

    def _finish(self) -> None:
        self.done = True
        self.drone.hover()
        self.stop()

    def _lose(self) -> None:
        if not self.lost:
            self.lost = True
            self.drone.tell(EventKind.VEHICLE_MESSAGE, "the position is not known: hovering", Severity.WARNING)
        if self._law is not None:
            self._law.pause()
        self.drone.hover()


class FollowPath(_PathFlyer):
    """Flies to a path's begin, along it, and hovers at its end; then :meth:`run` returns.

    The vehicle must be airborne when that is called. ``error`` counts from the path's begin to its end.
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
        """``yaw``: one of :mod:`skyloop.control.heading`, None keeps the present one; ``source``: what knows where the
        vehicle is, None: its own feedback; ``max_age_s``: with an older position it hovers."""
        super().__init__(drone, settings, yaw, source, max_age_s)
        self.path = path
        self.on_path = False  #: the begin was reached

    def _begin(self, fix: Fix) -> PathLaw:
        return PathLaw(_way(fix.position, _vector(self.path.position(0.0)), APPROACH_M_S), self.settings, self._yaw)

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
    """Flies straight from one waypoint to the next and stays at each as long as wanted; then :meth:`run` returns.

    The vehicle must be airborne when that is called. ``reached`` is how many were; ``error`` counts all the way, as the
    distance from where it should have been at each time.
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
        """``waypoints``: :class:`Waypoint` or (x, y, z) [m]; a waypoint's own yaw goes before ``yaw``. ``hold_s``: how
        long to stay at each. The others as those of :class:`FollowPath`. Raises :class:`UsageError`."""
        super().__init__(drone, settings, yaw, source, max_age_s)
        self.waypoints = tuple(one if isinstance(one, Waypoint) else Waypoint(*one) for one in waypoints)
        if not self.waypoints:
            raise UsageError("there is no waypoint to fly to")
        if not 0.0 <= hold_s < math.inf:
            raise UsageError(f"hold_s is {hold_s!r} and must be a number of seconds, 0 or more")
        self.reached = 0
        self._speed = (speed_m_s, acceleration_m_s2)
        self._hold_ns = nanoseconds(hold_s)
        self._there_ns: int | None = None  # since when it is at the next waypoint
        _way((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), *self._speed)  # says now what is wrong with them

    def _begin(self, fix: Fix) -> PathLaw:
        goal = self.waypoints[0]
        return PathLaw(_way(fix.position, goal.position, *self._speed), self.settings, self._mode(goal))

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
    """A path of one place."""

    duration_s = 0.0

    def __init__(self, place: Vector) -> None:
        self._place = np.array(place)

    def position(self, t_s: float) -> NDArray[np.float64]:  # noqa: ARG002
        return self._place

    def velocity(self, t_s: float) -> NDArray[np.float64]:  # noqa: ARG002
        return np.zeros(3)


def _way(begin: Vector, end: Vector, speed_m_s: float, acceleration_m_s2: float = 0.8) -> Path:
    """Straight from one place to the other; where both are the same, that place."""
    if math.dist(begin, end) < 1e-6:
        return _Stay(end)
    return Polyline([begin, end], speed_m_s=speed_m_s, acceleration_m_s2=acceleration_m_s2)


def _vector(values: NDArray[np.float64]) -> Vector:
    x, y, z = values.tolist()
    return x, y, z
