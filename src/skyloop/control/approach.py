"""Behaviours that approach or orbit a marker, circle a position, or land on a still or moving marker."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

from skyloop.clock import seconds
from skyloop.control.behaviour import SEARCHING, SEEN, Behaviour
from skyloop.control.follow import FollowMarker, FollowPhase, FollowSettings
from skyloop.control.landing_law import LandingLaw, LandingPhase, LandingSettings
from skyloop.control.limiting import clamped, require_positive
from skyloop.control.path import Circle
from skyloop.control.path_law import AlongPath, FollowPath, LookAt
from skyloop.errors import UsageError
from skyloop.extend import let_go
from skyloop.messages import FlightState, Polyline, Severity, Text
from skyloop.messages.relayed import Shape
from skyloop.vision import MarkerDetector

if TYPE_CHECKING:
    from skyloop.client import Drone, Frame
    from skyloop.control.path_law import PathSettings
    from skyloop.control.waypoint import PositionSource
    from skyloop.messages import Attitude, Feedback, Vector, Velocity

_LONGEST_STEP_S = 0.2  # maximum time step for moving the station along the arc after a gap between frames


class ApproachMarker(FollowMarker):
    """Finds a marker, flies to a point squarely in front of it and hovers there. Then :meth:`run` returns.

    The goal counts as reached once the error of distance and height has stayed below ``near_m``, and the angle to the
    marker's normal below ``near_rad``, for ``hold_s``.
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
            marker_id: ID of the marker.
            distance_m: Distance from the marker at which to stop; overrides ``settings``.
            near_m: Maximum combined error of distance and height.
            near_rad: Maximum angle to either side of the marker's normal.
            hold_s: How long the vehicle must stay within both limits.
            size_m: Edge length of the marker's black square.
            dictionary: The marker's dictionary.
            camera: Camera to use; None for the vehicle's first camera.
            settings: Settings for the control law; if None, the defaults with ``aside_rad`` set to 0.

        Raises:
            UsageError: A number is not finite and greater than 0.
            UnknownNameError: There is no such camera or dictionary.
            MissingExtraError: OpenCV is not installed.
        """
        require_positive(distance_m=distance_m, near_m=near_m, near_rad=near_rad, hold_s=hold_s)
        wanted = replace(settings or FollowSettings(aside_rad=0.0), distance_m=distance_m)
        super().__init__(drone, marker_id, size_m=size_m, dictionary=dictionary, camera=camera, settings=wanted)
        self._near_m, self._near_rad, self._hold_s = near_m, near_rad, hold_s
        self._there_ns: int | None = None

    def on_frame(self, frame: Frame) -> None:
        """Follow the marker and finish once the vehicle has stayed at the goal for ``hold_s``."""
        super().on_frame(frame)
        law = self._follow_law
        there = (
            self.mode is FollowPhase.FOLLOWING
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
    """Swings back and forth on an arc in front of a marker while facing it (a flat marker can't be seen from behind).

    It starts at the angle from which it first sees the marker, and runs until stopped.

    Attributes:
        turns: Number of times the vehicle has turned back at an end of the arc.
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
            marker_id: ID of the marker.
            radius_m: Distance from the marker; overrides ``settings``.
            reach_rad: Angle of the arc to either side of the marker's normal, at most 1.1.
            rate_rad_s: Angular rate around the marker.
            size_m: Edge length of the marker's black square.
            dictionary: The marker's dictionary.
            camera: Camera to use; None for the vehicle's first camera.
            settings: Settings for the control law; None for the defaults with ``aside_rad`` 0.05.

        Raises:
            UsageError: A number is out of range.
            UnknownNameError: There is no such camera or dictionary.
            MissingExtraError: OpenCV is not installed.
        """
        require_positive(radius_m=radius_m, reach_rad=reach_rad, rate_rad_s=rate_rad_s)
        if reach_rad > 1.1:
            raise UsageError(f"reach_rad is {reach_rad!r} and must be at most 1.1, to keep the marker visible")
        wanted = replace(settings or FollowSettings(aside_rad=0.05), distance_m=radius_m)
        super().__init__(drone, marker_id, size_m=size_m, dictionary=dictionary, camera=camera, settings=wanted)
        self.turns = 0
        self._reach, self._rate = reach_rad, rate_rad_s
        self._last_ns: int | None = None

    def on_frame(self, frame: Frame) -> None:
        """Move the station along the arc while the marker is in sight, and keep following the marker."""
        law = self._follow_law
        dt_s = 0.0 if self._last_ns is None else min(_LONGEST_STEP_S, seconds(frame.captured_ns - self._last_ns))
        self._last_ns = frame.captured_ns
        going = self.mode is FollowPhase.FOLLOWING and law.aside_rad is not None
        law.station_rate_rad_s = self._rate if going else 0.0
        if law.aside_rad is not None and not going:
            law.station_rad = law.aside_rad  # continue from where the marker was found again
        if abs(law.station_rad) >= self._reach and law.station_rad * self._rate > 0.0:
            self._rate = -self._rate
            self.turns += 1
        law.station_rad = clamped(law.station_rad + law.station_rate_rad_s * dt_s, self._reach)
        super().on_frame(frame)


class OrbitPlace(FollowPath):
    """Circles a position while facing towards or away from it. At the end, the vehicle hovers and :meth:`run` returns.

    Requires the vehicle's position, like :class:`FollowPath`.
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
            centre: x, y and the height to fly at, in world axes [m].
            radius_m: Radius of the circle.
            look: Direction the vehicle faces: ``"in"`` (towards the centre) or ``"out"``.
            speed_m_s: Speed along the circle.
            laps: Number of laps, counter-clockwise.
            settings: Settings for the path law; None for the defaults.
            source: Position source; None for the vehicle's own feedback.

        Raises:
            UsageError: An argument is out of range.
        """
        if look not in ("in", "out"):
            raise UsageError(f"look is {look!r} and must be 'in' or 'out'")
        circle = Circle(centre, radius_m, laps=laps, speed_m_s=speed_m_s)
        yaw = LookAt(centre[0], centre[1]) if look == "in" else AlongPath(offset=-math.pi / 2)
        super().__init__(drone, circle, yaw=yaw, settings=settings, source=source)


class LandOnMarker(Behaviour):
    """Searches for a marker in a spiral, descends above it, following its motion, and stops the motors after landing.

    If the marker is lost during the approach, the vehicle climbs at its predicted position, then searches for the
    marker. When the vehicle is so low that the marker no longer fits into the image, it descends using the marker's
    predicted motion; if it would miss, it aborts and tries again. After too many aborts or too long a time, it climbs
    to a safe height and hovers, and :meth:`run` returns with :attr:`landed` false. :attr:`landed` is also false if
    another client lands it. The vehicle must be airborne when :meth:`run` is called; it hovers if :meth:`run` ends
    early.

    Attributes:
        marker_id: ID of the marker.
    """

    name = "landing"
    losses = frozenset({LandingPhase.RECOVERING, LandingPhase.SEARCHING})

    def __init__(
        self,
        drone: Drone,
        marker_id: int = 30,
        *,
        size_m: float = 0.2,
        dictionary: str = "4x4_50",
        camera: str = "bottom",
        settings: LandingSettings | None = None,
    ) -> None:
        """Initialise the behaviour.

        Args:
            drone: The drone to fly.
            marker_id: ID of the marker.
            size_m: Edge length of the marker's black square.
            dictionary: The marker's dictionary.
            camera: A downward-facing camera.
            settings: Settings for the control law; None for the defaults. Clamped to the drone's ``limits.*``.

        Raises:
            UnknownNameError: There is no such camera or dictionary.
            UsageError: The vehicle does not support landing.
            MissingExtraError: OpenCV is not installed.
        """
        if "land" not in drone.capabilities.actions:
            raise UsageError("this vehicle does not support landing")
        limits = {parameter.name: parameter.value for parameter in drone.config.parameters()}
        self._landing_law = LandingLaw((settings or LandingSettings()).within(limits))
        self._detector = MarkerDetector(dictionary, size_m)
        self.marker_id = marker_id
        self._flew = False
        super().__init__(drone, self._landing_law, camera)

    @property
    def phase(self) -> LandingPhase:
        """The current phase."""
        return self._landing_law.phase

    @property
    def landed(self) -> bool:
        """Whether the vehicle has landed on the marker."""
        return self.done and self.phase is LandingPhase.DOWN

    def on_feedback(self, feedback: Feedback) -> None:
        """Update the control law and send its set-point; after touch-down, wait for the vehicle to report a landing."""
        self._flew = self._flew or feedback.state.airborne
        down = self.phase is LandingPhase.DOWN
        if self._flew and feedback.state is FlightState.LANDED and not self.done:
            self.done = True
            text = "standing on the marker" if down else "another client landed the vehicle"
            self.emit(text, Severity.INFO if down else Severity.WARNING)
            self._end()
        if down or self.done:
            self._landing_law.feedback(feedback)  # another client may still take over and fly the vehicle
            return
        super().on_feedback(feedback)
        if self._frame_ns is not None and not self.blind and not self.done:
            self.fly(self.drone.now_ns)  # called on every sample, not only on frames, to react to gusts sooner

    def on_frame(self, frame: Frame) -> None:
        """Search the frame, and end the behaviour if the control law has given up."""
        super().on_frame(frame)
        if not self.done and self._landing_law.safe(frame.captured_ns):
            self.finish("gave up: hovering at a safe height", Severity.WARNING)

    def look(self, frame: Frame) -> list[Shape]:
        """Detect the marker and update the control law."""
        law = self._landing_law
        mine = next((one for one in self._detector.detect(frame) if one.id == self.marker_id), None)
        if mine is None:
            return [Text(f"marker {self.marker_id}: {self.phase.value}", (8.0, 16.0), SEARCHING)]
        if frame.feedback is not None:
            law.see(mine.position_in_body(self._mounting), frame.feedback, frame.captured_ns)
        shapes: list[Shape] = [
            Text(f"marker {self.marker_id}: {self.phase.value}", (8.0, 16.0), SEEN),
            Polyline(mine.outline, True, SEEN),
        ]
        if law.height_m is not None and law.target_speed_m_s is not None:
            shapes.append(Text(f"{law.height_m:.2f} m over it, at {law.target_speed_m_s:.2f} m/s", (8.0, 32.0), SEEN))
        return shapes

    def steer(self, wanted: Velocity | Attitude) -> None:
        """Send velocities until touch-down, then stop the motors using the vehicle's own landing function."""
        if self.phase is LandingPhase.DOWN:
            # The landing is requested at every step, so that it continues after a brief loss of the link.
            let_go(self.drone, "it has touched down on its marker", land=True)
        else:
            super().steer(wanted)
