"""A robot as a vehicle: messages become samples for the proxy's sink, actions become velocities and service calls.

This module does not need rclpy: any object with the right fields is a message, and commands go through :class:`Robot`.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Protocol

from skyloop.clock import Clock, LiveClock, nanoseconds, seconds
from skyloop.drivers.base import Sink
from skyloop.errors import DecodeError, DriverError
from skyloop.messages import (
    AnyAction,
    Encoding,
    EventKind,
    Feedback,
    FlightState,
    Hover,
    Idle,
    Intrinsics,
    Land,
    LinkState,
    Severity,
    Takeoff,
    Velocity,
)
from skyloop.vehicles.ros2.options import Options
from skyloop.vehicles.ros2.wire import euler_of, intrinsics_of, levelled_velocity, nanoseconds_of, pixels_of, skew_of

PERIOD_S: Final = 0.05  #: time between repeats of a velocity, because robots stop if they receive none
AIRBORNE_M: Final = 0.1  #: height in the odometry above which a robot counts as flying
SERVICES_S: Final = 5.0  #: time allowed for discovering the robot's services
ANSWER_S: Final = 30.0  #: time allowed for a service's response
BLIND_NS: Final = nanoseconds(0.2)  #: while odometry is missing, older velocities are replaced by a stop


class Robot(Protocol):
    """The session's access to the robot."""

    def send(self, velocity: Velocity) -> None:
        """Publish a velocity."""

    def missing(self) -> str:
        """Return a service that is named in the address but not offered by any node; empty if there is none."""

    def call(self, service: str, answered: Callable[[bool, str], None]) -> None:
        """Call a ``std_srvs/Trigger``; ``answered`` is called with its success and message, on any thread.

        Raises:
            DriverError: No node offers it.
        """


@dataclass
class _Pending:
    """A requested take-off or landing."""

    state: FlightState
    since_ns: int


class RobotSession:
    """An open driver's session. Actions may come from any thread; everything else runs on the node's own thread.

    The sink is called without holding the lock, because the proxy may hold its own lock while it sends commands.
    """

    def __init__(self, options: Options, sink: Sink, robot: Robot, clock: Clock, system_clock: Clock) -> None:
        self._options = options
        self._sink = sink
        self._robot = robot
        self._clock = clock
        self._system_clock = system_clock
        self._lock = threading.RLock()
        self._clocks = {topic: CaptureClock() for topic in ("odom", "image")}
        self._fields: dict[str, Any] = {}  # feedback fields from the newest odometry
        self._battery: dict[str, Any] = {}
        self._intrinsics: Intrinsics | None = None
        self._captured_ns = 0  # capture time of the newest feedback
        self._received_ns: int | None = None
        self._odometry_ns: int | None = None
        self._measures_height = False  # whether odometry has ever been above the ground, which planar odometry never is
        self._fed_ns = 0  # when feedback was last published
        self._opened_ns = clock()
        self._link: LinkState | None = None
        self._velocity: Velocity | None = None  # velocity in force
        self._commanded_ns = 0  # when the velocity was commanded
        self._pending: _Pending | None = None
        self._up: bool | None = False if options.ground else None  # whether it flies or drives, judging by the services
        self._refused = ""  # why a take-off was refused
        self._warned: set[str] = set()

    # From the robot --------------------------------------------------------------------------------------------------

    def on_odometry(self, message: Any) -> None:
        """Publish feedback."""
        self._odometry_ns = self._clock()
        now_ns = self._received()
        with self._lock:
            self._fields = state_of(message, ground=self._options.ground)
            self._measures_height |= self._fields.get("altitude_m", 0.0) > AIRBORNE_M
        stamp_ns = nanoseconds_of(message.header.stamp)
        self._publish(self._clocks["odom"].captured_ns(stamp_ns, now_ns, self._system_clock()), now_ns)

    def on_battery(self, message: Any) -> None:
        """Store the battery's state for the next feedback."""
        self._battery = battery_of(message)

    def on_info(self, message: Any) -> None:
        """Store the camera's intrinsics for the next frame."""
        try:
            self._intrinsics = intrinsics_of(message)
        except DecodeError as error:
            self._intrinsics = None
            self._warn_once(f"the camera's intrinsics can't be used: {error}")
        skew = skew_of(message)
        if skew and self._intrinsics is not None:
            self._warn_once(f"the camera's pixels have a skew of {skew:g} px, which is ignored: calibrate without it")

    def on_image(self, message: Any) -> None:
        """Publish a frame, decoded only as far as necessary."""
        now_ns = self._received()
        stamp_ns = nanoseconds_of(message.header.stamp)
        captured_ns = self._clocks["image"].captured_ns(stamp_ns, now_ns, self._system_clock())
        camera, (width, height) = self._options.camera, (self._options.width, self._options.height)
        if not self._sink.wants(camera):
            return
        try:
            if self._options.compressed:
                pixels, size = jpeg_of(message)
                encoding = Encoding.JPEG
            else:
                pixels, encoding = pixels_of(message)
                size = (int(message.width), int(message.height))
        except DecodeError as error:
            self._warn_once(f"an image can't be decoded: {error}")
            return
        if size != (width, height):
            self._warn_once(f"images are {size[0]}×{size[1]}: write width={size[0]}&height={size[1]} into the address")
            return
        self._sink.frame(
            camera, pixels, captured_ns, width=width, height=height, encoding=encoding, intrinsics=self._intrinsics
        )

    # To the robot ----------------------------------------------------------------------------------------------------

    def command(self, action: AnyAction, *, new: bool = True) -> AnyAction:
        """Accept an action that is among the capabilities.

        A repeated take-off or landing (not ``new``) does not call the service again. Raises :class:`DriverError` if the
        robot does not offer the service, sends no data before a take-off, or has already refused this take-off.
        """
        with self._lock:
            if isinstance(action, Velocity):
                self._velocity, self._commanded_ns = action, self._clock()
            elif isinstance(action, Takeoff):
                self._begin(FlightState.TAKING_OFF, self._options.takeoff, new=new)
            elif isinstance(action, Land):
                self._begin(FlightState.LANDING, self._options.land, new=new)
            elif isinstance(action, Hover):
                self._velocity = Velocity()
            elif isinstance(action, Idle):
                self._velocity = None
            if self._velocity is not None:
                self._robot.send(self._velocity)
        return action

    def tick(self) -> None:
        """Repeat the velocity in force and check the link. Call this every :data:`PERIOD_S`."""
        now_ns = self._clock()
        blind = self._is_blind(now_ns)
        silent_s = self._silent_s(now_ns)
        lost = silent_s > self._options.timeout_s
        with self._lock:
            if blind:
                self._fields = {}
            if (blind or lost) and self._velocity is not None and now_ns - self._commanded_ns > BLIND_NS:
                self._velocity = Velocity()  # the robot's motion is unknown without odometry
            if self._velocity is not None:
                self._robot.send(self._velocity)
            if self._pending is not None and now_ns - self._pending.since_ns > nanoseconds(ANSWER_S):
                self._fail_pending()
        if lost:
            self._lose(LinkState.LOST, silent_s, self._options.odom, self._options.image)
            return
        if blind and self._odometry_ns is not None:
            self._lose(LinkState.DEGRADED, seconds(now_ns - self._odometry_ns), self._options.odom)
        if not self._fields and self._received_ns is not None and now_ns - self._fed_ns > nanoseconds(2 * PERIOD_S):
            self._publish(self._received_ns, now_ns)  # without odometry, images at least show that the robot is present

    def close(self) -> None:
        """Stop the robot, which must not continue with an old velocity."""
        with self._lock:
            if self._velocity is not None:
                self._velocity = None
                self._robot.send(Velocity())

    # Inside ----------------------------------------------------------------------------------------------------------

    def _silent_s(self, now_ns: int) -> float:
        return seconds(now_ns - (self._opened_ns if self._received_ns is None else self._received_ns))

    @property
    def _state(self) -> FlightState:
        if self._pending is not None:
            return self._pending.state
        altitude_m = self._fields.get("altitude_m")
        by_services = self._up is not None and not self._measures_height  # odometry may be planar
        up = self._up if self._options.ground or altitude_m is None or by_services else altitude_m > AIRBORNE_M
        if up is None:
            return FlightState.UNKNOWN
        if not up:
            return FlightState.LANDED
        return FlightState.HOVERING if self._velocity in (None, Velocity()) else FlightState.FLYING

    def _begin(self, state: FlightState, service: str, *, new: bool) -> None:
        up = state is FlightState.TAKING_OFF
        self._velocity = None
        if self._options.ground:
            self._up = up
            self._robot.send(Velocity())
            return
        if up and not new:  # call the take-off service only once per request, whatever the outcome
            if self._refused:
                raise DriverError(self._refused)
            return
        if up and self._silent_s(self._clock()) > self._options.timeout_s:
            raise DriverError("no data from the robot: a take-off would start once data returns")
        under_way = self._pending is not None and self._pending.state is state
        there = (self._state is FlightState.LANDED) is not up and self._state is not FlightState.UNKNOWN
        if self._up:
            there = up  # according to the services, because odometry may not show a take-off yet
        if (under_way or there) and not new:
            return
        if not (up or self._up) and self._state is FlightState.LANDED and (self._measures_height or self._up is False):
            return  # on the ground
        pending = _Pending(state, self._clock())

        def answered(success: bool, text: str) -> None:
            why = f"the robot refused {service}: {text or 'without a reason'}"
            with self._lock:
                if success:
                    self._up = up
                elif up:
                    self._refused = why
                if self._pending is pending and success:
                    self._pending = None
                elif self._pending is pending:
                    self._fail_pending()
            if not success:
                self._sink.event(EventKind.VEHICLE_MESSAGE, why, Severity.ERROR, reason="service_failed")

        self._refused = ""
        if not up:
            self._velocity = Velocity()  # stops the robot if no node offers the service
        self._robot.call(service, answered)
        self._velocity, self._pending = None, pending

    def _fail_pending(self) -> None:
        """Drop the pending action, and stop the robot after a landing: without a watchdog, it keeps its velocity."""
        if self._pending is not None and self._pending.state is FlightState.LANDING and self._velocity is None:
            self._velocity = Velocity()
        self._pending = None

    def _received(self) -> int:
        """Record the arrival of a message and return its time."""
        self._received_ns = now_ns = self._clock()
        if self._link is not LinkState.UP and not self._is_blind(now_ns):
            self._find(now_ns)
        return now_ns

    def _is_blind(self, now_ns: int) -> bool:
        """Return whether odometry has stopped arriving, even if other messages still do."""
        return self._odometry_ns is not None and seconds(now_ns - self._odometry_ns) > self._options.timeout_s

    def _find(self, now_ns: int) -> None:
        """Report the robot as found once its services have been found too, or have been missing for too long."""
        missing = self._robot.missing()
        if not missing:
            self._link = LinkState.UP
            self._sink.link(LinkState.UP)
        elif self._link is not LinkState.DEGRADED and seconds(now_ns - self._opened_ns) > SERVICES_S:
            self._link = LinkState.DEGRADED
            remedy = "start its node, or correct its name in the address"
            self._sink.link(LinkState.DEGRADED, f"no node offers the service {missing}", remedy)

    def _lose(self, state: LinkState, silent_s: float, *topics: str) -> None:
        if self._link is state:
            return
        self._link = state
        options = self._options
        domain = "ROS_DOMAIN_ID" if options.domain is None else f"domain={options.domain}"
        self._sink.link(
            state,
            f"no messages on {' and '.join(filter(None, topics))} for {silent_s:.1f} s",
            f"start the robot's nodes, and compare the topics' names and {domain} with theirs",
        )

    def _publish(self, captured_ns: int, now_ns: int) -> None:
        self._captured_ns, self._fed_ns = max(self._captured_ns, captured_ns), now_ns
        with self._lock:
            feedback = Feedback(captured_ns=self._captured_ns, state=self._state, **self._fields, **self._battery)
        self._sink.feedback(feedback)

    def _warn_once(self, text: str) -> None:
        """Emit a warning once for each text, and for at most eight texts."""
        if text not in self._warned and len(self._warned) < 8:
            self._warned.add(text)
            self._sink.event(EventKind.DRIVER_ERROR, text, Severity.ERROR, where="image")


def jpeg_of(message: Any) -> tuple[Any, tuple[int, int]]:
    """Return a ``sensor_msgs/CompressedImage``'s bytes as uint8, shape (bytes,), with the image's width and height."""
    import numpy as np

    from skyloop.messages.frame import image_size

    data = np.frombuffer(message.data, np.uint8)
    if bytes(data[:2]) != b"\xff\xd8":
        raise DecodeError(f"compressed images of format {message.format!r} are not supported, only JPEG")
    size = image_size(data.tobytes())
    if size is None:
        raise DecodeError("this JPEG does not contain its size")
    return data, size


PLAUSIBLE_AGE_NS: Final = 2_000_000_000  #: a stamp older than this is from another clock, as is a stamp in the future


class CaptureClock:
    """Converts one topic's stamps to this host's monotonic clock.

    A stamp slightly older than the system clock's time is assumed to come from that clock. Other stamps come from a
    simulation or an unset clock; for them the smallest recent delay counts as zero. Times never go backwards.
    """

    def __init__(self) -> None:
        self._live = LiveClock()
        self._newest_ns = 0

    def captured_ns(self, stamp_ns: int, arrived_ns: int, system_ns: int) -> int:
        """Return a message's capture time from its stamp (0 for none) and its arrival on both of this host's clocks."""
        age_ns = system_ns - stamp_ns
        if stamp_ns == 0:
            captured_ns = arrived_ns
        elif 0 <= age_ns <= PLAUSIBLE_AGE_NS:
            captured_ns = arrived_ns - age_ns
        else:
            captured_ns = min(arrived_ns, self._live.captured_ns(seconds(stamp_ns), arrived_ns))
        self._newest_ns = max(self._newest_ns, captured_ns)
        return self._newest_ns


def state_of(odometry: Any, *, ground: bool) -> dict[str, Any]:
    """Return the feedback fields in a ``nav_msgs/Odometry``, leaving out values that are not finite.

    The pose is in world axes, the twist in body axes. A ground vehicle has no height.
    """
    found: dict[str, Any] = {}
    turn, place = odometry.pose.pose.orientation, odometry.pose.pose.position
    angles = euler_of((turn.x, turn.y, turn.z, turn.w))
    position = (float(place.x), float(place.y), float(place.z))
    if all(map(math.isfinite, position)):
        found["position_m"] = position
        if not ground:
            found["altitude_m"] = position[2]
    if angles is None:
        return found
    found["roll_rad"], found["pitch_rad"], found["yaw_rad"] = angles
    linear, angular = odometry.twist.twist.linear, odometry.twist.twist.angular
    moved, turned = (linear.x, linear.y, linear.z), (angular.x, angular.y, angular.z)
    if all(map(math.isfinite, moved)):
        found["velocity_m_s"] = levelled_velocity(moved, angles[0], angles[1])
    if all(map(math.isfinite, turned)):
        found["angular_velocity_rad_s"] = tuple(map(float, turned))
    return found


def battery_of(message: Any) -> dict[str, float | None]:
    """Return the feedback fields in a ``sensor_msgs/BatteryState``."""
    charge, voltage = _finite(message.percentage), _finite(message.voltage)
    if charge is not None and not 0.0 <= charge <= 1.0:
        charge = charge / 100.0 if 1.0 < charge <= 100.0 else None  # some robots report a percentage
    return {"battery": charge, "battery_v": voltage}


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
