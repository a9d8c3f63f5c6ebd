"""Fly up to a marker and stop before it; swing round a marker; circle round a position."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

from skyloop.clock import seconds
from skyloop.control.follow import FollowMarker
from skyloop.control.follow_law import FollowSettings, Mode
from skyloop.control.limiting import clamped
from skyloop.control.path import Circle
from skyloop.control.path_following import FollowPath
from skyloop.control.path_law import AlongPath, LookAt
from skyloop.errors import UsageError

if TYPE_CHECKING:
    from skyloop.client import Drone, Frame
    from skyloop.control.path_law import PathSettings
    from skyloop.control.position import PositionSource
    from skyloop.messages import Vector

_LONGEST_STEP_S = 0.2


class ApproachMarker(FollowMarker):
    """Finds a marker, flies straight before its face, and hovers there; then :meth:`run` returns.

    The goal counts as reached when distance and height were within ``near_m``, and the angle to the marker's face
    within ``near_rad``, for ``hold_s``.
    """

    name = "approach"

    def __init__(
        self,
        drone: Drone,
        marker_id: int = 0,
        *,
        distance_m: float = 1.0,
        near_m: float = 0.1,
        near_rad: float = 0.2,
        hold_s: float = 1.0,
        size_m: float = 0.3,
        dictionary: str = "4x4_50",
        camera: str | None = None,
        settings: FollowSettings | None = None,
    ) -> None:
        """Initialise the behaviour.

        Args:
            drone: The drone to fly; it must be airborne when :meth:`run` is called.
            marker_id: Which marker.
            distance_m: Where to stop before it; replaces that of ``settings``.
            near_m: Acceptance radius of distance and height together.
            near_rad: Acceptance angle to each side of straight before the face.
            hold_s: How long the vehicle must stay within both.
            size_m: Edge of the marker's black square.
            dictionary: The marker's dictionary.
            camera: Whose frames to use; None is the vehicle's first camera.
            settings: Of the law; None are the defaults, with ``aside_rad`` 0.

        Raises:
            UsageError: A number is not finite and above 0.
            UnknownNameError: There is no such camera or dictionary.
            MissingExtraError: OpenCV is not installed.
        """
        _require_above_0(distance_m=distance_m, near_m=near_m, near_rad=near_rad, hold_s=hold_s)
        wanted = replace(settings or FollowSettings(aside_rad=0.0), distance_m=distance_m)
        super().__init__(drone, marker_id, size_m=size_m, dictionary=dictionary, camera=camera, settings=wanted)
        self._near_m, self._near_rad, self._hold_s = near_m, near_rad, hold_s
        self._there_ns: int | None = None

    def on_frame(self, frame: Frame) -> None:
        """Follow the marker, and finish once the vehicle has stayed at the goal for ``hold_s``."""
        super().on_frame(frame)
        law = self._follow_law
        there = (
            self.mode is Mode.FOLLOWING
            and law.off_m is not None
            and law.off_m < self._near_m
            and law.aside_rad is not None
            and abs(law.aside_rad) < self._near_rad
        )
        if not there:
            self._there_ns = None
        elif self._there_ns is None:
            self._there_ns = frame.captured_ns
        elif not self.done and seconds(frame.captured_ns - self._there_ns) >= self._hold_s:
            self.finish(f"{self.distance_m:.2f} m before marker {self.marker_id}")


class OrbitMarker(FollowMarker):
    """Swings to and fro round a marker on an arc, looking at it: a flat marker can't be seen from behind.

    Starts on the side from which it sees the marker, and runs until it is stopped.

    Attributes:
        turns: How often the end of the arc was reached.
    """

    name = "orbit"

    def __init__(
        self,
        drone: Drone,
        marker_id: int = 0,
        *,
        radius_m: float = 1.5,
        reach_rad: float = 0.8,
        rate_rad_s: float = 0.25,
        size_m: float = 0.3,
        dictionary: str = "4x4_50",
        camera: str | None = None,
        settings: FollowSettings | None = None,
    ) -> None:
        """Initialise the behaviour.

        Args:
            drone: The drone to fly; it must be airborne when :meth:`run` is called.
            marker_id: Which marker.
            radius_m: Distance from it; replaces that of ``settings``.
            reach_rad: How far to each side of straight before the marker's face, at most 1.1.
            rate_rad_s: Angular rate round the marker.
            size_m: Edge of the marker's black square.
            dictionary: The marker's dictionary.
            camera: Whose frames to use; None is the vehicle's first camera.
            settings: Of the law; None are the defaults, with ``aside_rad`` 0.05.

        Raises:
            UsageError: A number is out of its range.
            UnknownNameError: There is no such camera or dictionary.
            MissingExtraError: OpenCV is not installed.
        """
        _require_above_0(radius_m=radius_m, reach_rad=reach_rad, rate_rad_s=rate_rad_s)
        if reach_rad > 1.1:
            raise UsageError(f"reach_rad is {reach_rad!r}: from farther aside than 1.1 the marker is not seen any more")
        wanted = replace(settings or FollowSettings(aside_rad=0.05), distance_m=radius_m)
        super().__init__(drone, marker_id, size_m=size_m, dictionary=dictionary, camera=camera, settings=wanted)
        self.turns = 0
        self._reach, self._rate = reach_rad, rate_rad_s
        self._last_ns: int | None = None

    def on_frame(self, frame: Frame) -> None:
        """Move the station along the arc while the marker is seen, and follow the marker."""
        law = self._follow_law
        dt_s = 0.0 if self._last_ns is None else min(_LONGEST_STEP_S, seconds(frame.captured_ns - self._last_ns))
        self._last_ns = frame.captured_ns
        going = self.mode is Mode.FOLLOWING and law.aside_rad is not None
        law.station_rate_rad_s = self._rate if going else 0.0
        if law.aside_rad is not None and not going:
            law.station_rad = law.aside_rad  # from where it is found again
        if abs(law.station_rad) >= self._reach and law.station_rad * self._rate > 0.0:
            self._rate = -self._rate
            self.turns += 1
        law.station_rad = clamped(law.station_rad + law.station_rate_rad_s * dt_s, self._reach)
        super().on_frame(frame)


class OrbitPlace(FollowPath):
    """Flies round a position on a circle, facing it or away from it; then hovers, and :meth:`run` returns.

    Needs the vehicle's position: see :class:`FollowPath`.
    """

    def __init__(
        self,
        drone: Drone,
        centre: Vector,
        radius_m: float,
        *,
        look: Literal["in", "out"] = "in",
        speed_m_s: float = 0.4,
        laps: float = 1.0,
        settings: PathSettings | None = None,
        source: PositionSource | None = None,
    ) -> None:
        """Initialise the controller.

        Args:
            drone: The drone to fly; it must be airborne when :meth:`run` is called.
            centre: x, y and the height to fly at [m], world axes.
            radius_m: Of the circle.
            look: Whether the front points ``"in"`` to the centre or ``"out"``.
            speed_m_s: Along the circle.
            laps: How often round; counter-clockwise.
            settings: Of the path law; None are the defaults.
            source: Of positions; None is the vehicle's own feedback.

        Raises:
            UsageError: An argument is out of its range.
        """
        if look not in ("in", "out"):
            raise UsageError(f"look is {look!r} and must be 'in' or 'out'")
        circle = Circle(centre, radius_m, laps=laps, speed_m_s=speed_m_s)
        yaw = LookAt(centre[0], centre[1]) if look == "in" else AlongPath(offset=-math.pi / 2)
        super().__init__(drone, circle, yaw=yaw, settings=settings, source=source)


def _require_above_0(**values: float) -> None:
    for name, value in values.items():
        if not 0.0 < value < math.inf:
            raise UsageError(f"{name} is {value!r} and must be a finite number above 0")
