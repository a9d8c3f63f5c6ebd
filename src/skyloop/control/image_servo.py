"""Behaviours that hold a position using only images, either in front of a marker or over the ground.

Markers are approached by image-based visual servoing, following Chaumette and Hutchinson, "Visual servo control, part
I: basic approaches", IEEE Robotics & Automation Magazine 13(4), 2006; equation numbers refer to that paper. Camera axes
are optical: x right, y down, z forward. Points are given by the intersections of their rays with the plane at z = 1,
shape (n, 2). A multirotor must tilt to fly, which shifts even fixed points in the image. Points are therefore first
converted to the image of a *virtual level camera* with the vehicle's yaw but without its roll and pitch (Jabbari,
Oriolo and Bolandi, "An adaptive scheme for image-based visual servoing of an underactuated UAV", Int. J. Robotics and
Automation 29(1), 2014), and the twist is restricted to motions of the levelled vehicle: forward, left, up and yaw.

Over the ground, the drift is measured by optical flow and counteracted by attitude set-points.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np

from skyloop.clock import nanoseconds, seconds
from skyloop.control.airframe import AirframeLaw, Part, TurningSearch, VelocityLaw, not_ahead
from skyloop.control.behaviour import LOST, SEARCHING, SEEN, Behaviour, camera_info
from skyloop.control.kalman import ConstantVelocityFilter
from skyloop.control.limiting import GRAVITY_M_S2, Array, SetpointLimits, clamped, require_positive, shortened
from skyloop.control.pid import Gains, VectorPi
from skyloop.errors import UsageError
from skyloop.extend import let_go
from skyloop.messages import Attitude, CameraInfo, Feedback, Points, Polyline, Text, Velocity
from skyloop.messages.geometry import rotation_from_euler, turned, wrap_angle
from skyloop.messages.relayed import Colour, Shape
from skyloop.poses import mounting_rotation
from skyloop.vision import MarkerDetector
from skyloop.vision.flow import GroundTracker
from skyloop.vision.lens import normalised, project
from skyloop.vision.planar import rectangle

if TYPE_CHECKING:
    from skyloop.client import Drone, Frame


def interaction_matrix(points: Array, depths_m: Array) -> Array:
    """Return the interaction matrix (2n, 6) of points (n, 2): their image motion per camera twist (equation 11).

    The twist is the camera's velocity [m/s] and angular velocity [rad/s] along and about its own axes, (6,). The rows
    alternate between x and y, point by point.
    """
    points, depths = np.asarray(points, np.float64), np.asarray(depths_m, np.float64)
    if points.ndim != 2 or points.shape[1] != 2 or depths.shape != (len(points),):
        raise UsageError(f"points need shape (n, 2) and depths (n,), got {points.shape} and {depths.shape}")
    if not (np.isfinite(points).all() and np.isfinite(depths).all() and (depths > 0.0).all()):
        raise UsageError("points must be finite and depths above 0")
    x, y, z, none = points[:, 0], points[:, 1], 1.0 / depths, np.zeros(len(points))
    along_x = np.column_stack([-z, none, x * z, x * y, -(1.0 + x * x), y])
    along_y = np.column_stack([none, -z, y * z, 1.0 + y * y, -x * y, -x])
    return np.stack([along_x, along_y], axis=1).reshape(-1, 6)


def camera_twist(camera: CameraInfo) -> Array:
    """Return the matrix (6, 4) that converts motion of the levelled vehicle to the twist of a level camera.

    The columns are forward, left, up [m/s] and yaw rate [rad/s]. The camera's mounting position matters, because a
    camera ahead of the centre swings sideways when the vehicle turns.
    """
    to_camera = mounting_rotation(camera).T
    place = np.zeros(3) if camera.position_m is None else np.asarray(camera.position_m)
    up = np.array([0.0, 0.0, 1.0])
    twist = np.zeros((6, 4))
    twist[:3, :3] = to_camera
    twist[:3, 3] = to_camera @ np.cross(up, place)
    twist[3:, 3] = to_camera @ up
    return twist


def levelled(points: Array, camera: CameraInfo, roll: float, pitch: float) -> Array:
    """Return points (n, 2) as a level camera would see them; raise UsageError if one would not be in front of it."""
    mounting = mounting_rotation(camera)
    turn = mounting.T @ rotation_from_euler(roll, pitch, 0.0) @ mounting
    rays = np.column_stack([points, np.ones(len(points))]) @ turn.T
    if (rays[:, 2] <= 1e-3).any():
        raise UsageError("a level camera would not see these points: the vehicle is tilted too far")
    return np.asarray(rays[:, :2] / rays[:, 2:])


def servo(points: Array, wanted: Array, depths_m: Array, camera: CameraInfo, gain: float) -> Array:
    """Compute the motion that makes a level camera's points (n, 2) converge exponentially to their goals.

    The result is ``-gain · (L·T)⁺ · e`` (equation 5, with T from :func:`camera_twist`): forward, left, up [m/s] and yaw
    rate [rad/s], (4,). The gain is in 1/s.
    """
    if np.shape(points) != np.shape(wanted) or len(points) < 2:
        raise UsageError(f"servo needs two or more points, and equal shapes: {np.shape(points)}, {np.shape(wanted)}")
    jacobian = interaction_matrix(points, depths_m) @ camera_twist(camera)
    error = (np.asarray(points) - np.asarray(wanted)).reshape(-1)
    return np.asarray(-gain * (np.linalg.pinv(jacobian, rcond=1e-3) @ error))


_WANTED: Colour = (255, 210, 60)


class ServoPhase(StrEnum):
    """The phases of :class:`ImageServoLaw`."""

    SEARCHING = "searching for the marker"
    SERVOING = "servoing"
    HOLDING = "lost the marker: holding position"


@dataclass(frozen=True, slots=True)
class ServoSettings:
    """Gain and limits of :class:`ImageServoLaw`."""

    gain: float = 0.8  #: [1/s]
    #: Fraction of the velocity error that is added to the set-point to counteract gusts, if the velocity is known.
    velocity_gain: float = 1.0
    speed_m_s: float = 0.8
    climb_m_s: float = 0.5
    turn_rad_s: float = 1.0
    acceleration_m_s2: float = 2.0
    fresh_s: float = 0.3  #: time to continue without a sighting
    holding_s: float = 2.0
    search_rad_s: float = 0.7

    def __post_init__(self) -> None:
        require_positive(**asdict(self))


class ImageServoLaw(VelocityLaw):
    """Computes velocities from points in the image. Pure; times are on the proxy's clock [ns]."""

    def __init__(
        self, camera: CameraInfo, wanted: Array, depth_m: float, settings: ServoSettings | None = None
    ) -> None:
        """Initialise the law with the points that a level camera should see, (n, 2) at z = 1, and their depth [m]."""
        mounting_rotation(camera)  # raises any error here rather than in flight
        s = self.settings = settings or ServoSettings()
        limits = SetpointLimits(
            s.speed_m_s, s.climb_m_s, s.turn_rad_s, s.acceleration_m_s2, climb_acceleration_m_s2=2.0
        )
        super().__init__(limits, Part.ATTITUDE)
        self.phase = ServoPhase.SEARCHING  #: phase at the last step
        self.error = math.inf  #: RMS distance between the points and their desired positions in the plane at z = 1
        self._camera = camera
        self._wanted = np.asarray(wanted, np.float64)
        self._depth_m = depth_m
        self._velocity = np.zeros(4)
        self._seen_ns: int | None = None
        self._search = TurningSearch(s.search_rad_s)

    def see(self, points: Array, at_capture: Feedback, captured_ns: int) -> None:
        """Update with the points (n, 2) that the camera saw in a frame, in the plane at z = 1.

        The points are ignored if the attitude is unknown or if the vehicle is tilted so far that a level camera would
        not see them. Their common depth is estimated from their apparent size.
        """
        self.airframe.add(at_capture)
        roll, pitch = at_capture.roll_rad, at_capture.pitch_rad
        if roll is None or pitch is None or not np.isfinite([roll, pitch, *np.ravel(points)]).all():
            return
        try:
            level = levelled(points, self._camera, roll, pitch)
        except UsageError:
            return
        self.error = math.sqrt(float(((level - self._wanted) ** 2).sum(axis=1).mean()))
        # Averaging the current depth and the depth at the goal keeps large motions straight (equation 14).
        now_m = self._depth_m * _size(self._wanted) / max(1e-6, _size(level))
        depths = np.full(len(level), (now_m + self._depth_m) / 2)
        self._velocity = servo(level, self._wanted, depths, self._camera, self.settings.gain)
        self._seen_ns = captured_ns

    def _setpoint(self, now_ns: int) -> Array:
        s, feedback = self.settings, self.airframe.feedback
        self._seen_ns = not_ahead(self._seen_ns, now_ns)
        unseen_s = math.inf if self._seen_ns is None else seconds(now_ns - self._seen_ns)
        wanted = np.zeros(4)
        if unseen_s <= s.fresh_s:
            self.phase, wanted = ServoPhase.SERVOING, self._velocity.copy()
            self._search.restart(turning=float(wanted[3]))
            if feedback is not None and feedback.velocity_m_s is not None:
                wanted[:3] += s.velocity_gain * (wanted[:3] - feedback.velocity_m_s)
        elif unseen_s <= s.holding_s:
            self.phase = ServoPhase.HOLDING
        else:
            self.phase = ServoPhase.SEARCHING
            if feedback is not None and feedback.yaw_rad is not None:
                wanted = self._search.step(feedback.yaw_rad, self._altitude)
        return wanted


class ImageServo(Behaviour):
    """Flies to where a marker appears as seen from ``distance_m`` straight in front of it, and holds that position.

    Control works purely in the image: the marker's size only serves to compute the desired image. Runs until stopped.
    """

    name = "servo"
    losses = frozenset({ServoPhase.HOLDING, ServoPhase.SEARCHING})

    def __init__(
        self,
        drone: Drone,
        marker_id: int = 0,
        *,
        distance_m: float = 1.5,
        size_m: float = 0.3,
        dictionary: str = "4x4_50",
        camera: str | None = None,
        settings: ServoSettings | None = None,
    ) -> None:
        """Initialise the behaviour.

        Args:
            drone: The drone to fly; it must be airborne when :meth:`run` is called.
            marker_id: ID of the marker.
            distance_m: Desired distance straight in front of the marker.
            size_m: Edge length of the marker's black square.
            dictionary: The marker's dictionary.
            camera: A forward-facing camera; None for the vehicle's first camera.
            settings: Settings for the control law; None for the defaults.

        Raises:
            UsageError: The distance is not a finite number greater than 0, or the camera does not face forward.
            UnknownNameError: There is no such camera or dictionary.
            MissingExtraError: OpenCV is not installed.
        """
        require_positive(distance_m=distance_m)
        info = camera_info(drone, camera)
        if mounting_rotation(info)[0, 2] < 0.5:
            raise UsageError(f"camera {info.name!r} does not face forward")
        self.marker_id = marker_id
        self._wanted = rectangle(size_m, size_m)[:, :2] * (1.0, -1.0) / distance_m
        self._servo_law = ImageServoLaw(info, self._wanted, distance_m, settings)
        self._detector = MarkerDetector(dictionary, size_m)
        self._focal_px = 0.0
        super().__init__(drone, self._servo_law, camera)

    @property
    def phase(self) -> ServoPhase:
        """The current phase."""
        return self._servo_law.phase

    @property
    def error_px(self) -> float:
        """RMS distance between the corners and their desired positions [px]; infinite before the first sighting."""
        return self._servo_law.error * self._focal_px if self._focal_px else math.inf

    def look(self, frame: Frame) -> list[Shape]:
        """Detect the marker's corners and update the control law."""
        intrinsics = frame.intrinsics
        mine = next((one for one in self._detector.detect(frame) if one.id == self.marker_id), None)
        if mine is None or intrinsics is None:
            return [Text(f"marker {self.marker_id}: {self.phase.value}", (8.0, 16.0), SEARCHING)]
        if frame.feedback is not None:
            self._focal_px = intrinsics.fx
            self._servo_law.see(normalised(mine.corners, intrinsics), frame.feedback, frame.captured_ns)
        rays = np.column_stack([self._wanted, np.ones(len(self._wanted))])
        goal = tuple((float(x), float(y)) for x, y in project(rays, intrinsics))
        return [
            Polyline(goal, True, _WANTED),
            Polyline(mine.outline, True, SEEN),
            Text(f"marker {self.marker_id}: {self.error_px:.0f} px off", (8.0, 16.0), SEEN),
        ]


def _size(points: Array) -> float:
    """Return the apparent size of the points: the root mean square distance from their mean."""
    return math.sqrt(float(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean()))


_PLACE_DEVIATION_M = 0.02  # standard deviation of positions from optical flow


class FlowPhase(StrEnum):
    """The phases of :class:`FlowLaw`."""

    WAITING = "waiting for the first images of the ground"
    HOLDING = "holding position by images of the ground"
    LOST = "lost the ground: hovering"


@dataclass(frozen=True, slots=True)
class FlowSettings:
    """Gains and limits of :class:`FlowLaw`."""

    gain: float = 2.5  #: acceleration per metre of distance [1/s²]
    damping: float = 2.6  #: acceleration per unit of velocity [1/s]
    integral: float = 0.6  #: acceleration per metre of distance per second, against wind [1/s³]
    tilt_rad: float = 0.2
    height_gain: float = 1.0  #: [1/s]
    yaw_gain: float = 1.5  #: [1/s]
    lead_s: float = 0.12  #: delay between computing a set-point and its effect
    fresh_s: float = 0.3  #: time to continue while the ground is out of sight

    def __post_init__(self) -> None:
        require_positive(self.__dataclass_fields__, **asdict(self))


@dataclass(slots=True)
class _Kept:
    """The state to hold: yaw [rad], altitude [m], and position (2,) [m] in the ground tracker's axes."""

    yaw: float
    altitude: float
    place: Array = field(default_factory=lambda: np.zeros(2))


class FlowLaw(AirframeLaw):
    """Computes attitudes from horizontal positions. Pure; times are on the proxy's clock [ns].

    A PID controller for each axis computes the acceleration from the position, its integral and the velocity. The
    velocity comes from a constant-velocity filter applied to the positions, not from the vehicle.
    """

    def __init__(self, settings: FlowSettings | None = None) -> None:
        super().__init__(Part.ATTITUDE, Part.HEIGHT)
        self.settings = s = settings or FlowSettings()
        self.phase = FlowPhase.WAITING  #: phase at the last step
        self.off_m: float | None = None  #: estimated distance from the position to hold; None if unknown
        self._loop = VectorPi(Gains(p=s.gain, i=s.integral), 2, most=0.5 * s.tilt_rad * GRAVITY_M_S2)
        self._filter = ConstantVelocityFilter(2, intensity_m2_s3=0.5, speed_m_s=0.5, gate=math.inf)
        self._kept: _Kept | None = None
        self._seen_ns: int | None = None

    def pause(self) -> None:
        """Restart with the integral at zero."""
        super().pause()
        self._loop.reset()

    def see(self, place: Array, captured_ns: int) -> None:
        """Update with the vehicle's position when a frame was captured, (2,) [m], along yaw 0 and to the left of it.

        The first position becomes the position to hold, as does the first one after a gap of more than a second.
        """
        newest, altitude = self.airframe.feedback, self.airframe.altitude_m(captured_ns)
        if newest is None or newest.yaw_rad is None or altitude is None or not np.isfinite(place).all():
            return
        if self._seen_ns is None or seconds(captured_ns - self._seen_ns) > 1.0:
            self._filter.start(place, _PLACE_DEVIATION_M, captured_ns)
            self._kept = _Kept(newest.yaw_rad, altitude, np.asarray(place, np.float64))
        else:
            self._filter.update(place, _PLACE_DEVIATION_M, captured_ns)
        self._seen_ns = captured_ns

    def step(self, now_ns: int) -> Attitude:
        """Compute the current set-point. While the position is unknown, the vehicle is level and does not brake."""
        s, ready, newest = self.settings, self._ready(now_ns), self.airframe.feedback
        if self._seen_ns is not None and not_ahead(self._seen_ns, now_ns) is None:
            self._seen_ns, self.phase, self.off_m = None, FlowPhase.LOST, None
        if self._seen_ns is None or self._kept is None:
            return Attitude()
        altitude, yaw = self._altitude, None if newest is None else newest.yaw_rad
        if not ready or altitude is None or yaw is None or seconds(now_ns - self._seen_ns) > s.fresh_s:
            self.phase, self.off_m, self._last_ns = FlowPhase.LOST, None, None
            return Attitude()
        self.phase = FlowPhase.HOLDING
        ahead = self._filter.at(now_ns + nanoseconds(s.lead_s))
        off = self._kept.place - ahead.position
        self.off_m = float(np.linalg.norm(self._kept.place - self._filter.at(now_ns).position))
        asked = self._loop.step(off, min(0.2, self._since_s(now_ns))) - s.damping * ahead.velocity
        wanted = shortened(asked, s.tilt_rad * GRAVITY_M_S2)
        self._loop.applied(asked, wanted)
        forward, left = turned(float(wanted[0]), float(wanted[1]), -yaw)
        return Attitude(
            roll=-math.atan2(left, GRAVITY_M_S2),
            pitch=math.atan2(forward, GRAVITY_M_S2),
            climb=clamped(s.height_gain * (self._kept.altitude - altitude), 0.5),
            yaw_rate=clamped(s.yaw_gain * wrap_angle(self._kept.yaw - yaw), 1.0),
        )


class FlowHover(Behaviour):
    """Holds the position, height and yaw at which it first saw the ground, using a downward-facing camera.

    It requires only attitude and height from the vehicle's feedback and flies by attitude set-points. If the camera
    can't see the ground, the vehicle hovers and may drift, and a warning event is published. Once the ground is in view
    again, the behaviour holds its new position.
    """

    name = "flow hover"
    losses = frozenset({FlowPhase.LOST})

    def __init__(self, drone: Drone, *, camera: str = "bottom", settings: FlowSettings | None = None) -> None:
        """Initialise the behaviour.

        Args:
            drone: The drone to fly; it must be airborne when :meth:`run` is called.
            camera: A downward-facing camera.
            settings: Settings for the control law; None for the defaults.

        Raises:
            UnknownNameError: The vehicle has no such camera.
            UsageError: The vehicle does not accept attitude set-points.
            MissingExtraError: OpenCV is not installed.
        """
        if "attitude" not in drone.capabilities.actions:
            raise UsageError("this vehicle does not accept attitude set-points")
        self._flow_law = FlowLaw(settings)
        super().__init__(drone, self._flow_law, camera)
        self._tracker = GroundTracker(self._mounting)

    @property
    def phase(self) -> FlowPhase:
        """The current phase."""
        return self._flow_law.phase

    @property
    def off_m(self) -> float | None:
        """Estimated distance from the position to hold [m]; None if unknown."""
        return self._flow_law.off_m

    def steer(self, wanted: Velocity | Attitude) -> None:
        """Send the set-point, or hover while the ground is out of view; the event for the phase reports this."""
        if self.phase is FlowPhase.HOLDING:
            super().steer(wanted)
        else:
            let_go(self.drone, "the ground is out of view")

    def look(self, frame: Frame) -> list[Shape]:
        """Track the ground, update the control law and draw the tracked corners."""
        found = None if frame.feedback is None else self._tracker.see(frame, frame.feedback)
        if found is None:
            return [Text(self.phase.value, (8.0, 16.0), LOST)]
        place, count = found
        self._flow_law.see(place, frame.captured_ns)
        off = "" if self.off_m is None else f", {self.off_m:.2f} m off"
        return [Points(self._tracker.points, SEEN), Text(f"{count} corners{off}", (8.0, 16.0), SEEN)]
