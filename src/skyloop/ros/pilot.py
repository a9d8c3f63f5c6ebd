"""Control of a drone through ROS topics and services, which requires authority, and access to its parameters."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Final

from skyloop.client import Drone
from skyloop.errors import SkyloopError, UsageError
from skyloop.messages import Event, EventKind, Parameter, ParameterType, Value
from skyloop.ros.names import FrameNames, RosTime
from skyloop.vehicles.ros2.wire import euler_of, nanoseconds_of

NEAR_M: Final = 0.2  #: tolerance for a goal that specifies none
WARN_AGAIN_S: Final = 5.0  #: interval between warnings of the same kind


class Pilot:
    """Converts messages on topics and service calls to commands. Commands require control authority.

    ``topics`` is the rclpy node in the drone's namespace whose callbacks never wait; the callbacks of ``services`` may
    block, several at a time. ``drone`` is connected as a pilot, with the time limit after which a velocity becomes a
    hover. ``priority``: for requesting authority, 0 (highest) to 31; None uses the default. ``timeout_s``: maximum age
    of a stamped velocity [s].
    """

    def __init__(
        self,
        topics: Any,
        services: Any,
        drone: Drone,
        time: RosTime,
        frames: FrameNames,
        *,
        priority: int | None,
        timeout_s: float,
    ) -> None:
        from geometry_msgs.msg import PoseStamped, Twist, TwistStamped
        from nav_msgs.srv import GetPlan
        from rclpy.callback_groups import ReentrantCallbackGroup
        from rclpy.qos import QoSProfile, ReliabilityPolicy
        from std_srvs.srv import Trigger

        self._drone = drone
        self._time = time
        self._frames = frames
        self._priority = priority
        self._timeout_s = timeout_s
        self._log = topics.get_logger()
        self._lock = threading.Lock()
        self._under_way: list[str] = []  # services that are waiting for the drone
        # Accept both reliable and best-effort publishers, and keep only the newest sample.
        newest = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        topics.create_subscription(Twist, "cmd_vel", self.on_velocity, newest)
        topics.create_subscription(TwistStamped, "cmd_vel_stamped", self.on_stamped_velocity, newest)
        topics.create_subscription(PoseStamped, "goal_pose", self.on_goal, newest)
        group = ReentrantCallbackGroup()
        # These services never wait, and must not be queued behind services that do.
        topics.create_service(Trigger, "hover", self._trigger("hover", drone.hover))
        topics.create_service(Trigger, "emergency_stop", self._trigger("emergency_stop", drone.emergency_stop))
        actions: dict[str, Callable[[], object]] = {
            "takeoff": drone.takeoff,
            "land": drone.land,
            "return_to_start": drone.return_to_start,
            "authority/request": self.request_authority,
            "authority/release": drone.release_authority,
        }
        for name, act in actions.items():
            services.create_service(Trigger, name, self._trigger(name, act), callback_group=group)
        services.create_service(GetPlan, "go_to", self._go_to, callback_group=group)

    def request_authority(self) -> None:
        """Request control authority with the configured priority.

        Raise ``AuthorityError`` if another application, named in the error, holds the authority.
        """
        self._drone.request_authority(self._priority)

    def close(self) -> None:
        """Ignore further messages on topics, because they could abort the final landing."""
        with self._lock:
            self._under_way.append("the end of the bridge")

    # Topics: never wait ----------------------------------------------------------------------------------------------

    def on_velocity(self, twist: Any) -> None:
        """Fly at the velocity in a ``geometry_msgs/Twist`` (levelled axes); roll and pitch rates are ignored."""
        linear, angular = twist.linear, twist.angular
        rates = {"forward": linear.x, "left": linear.y, "up": linear.z, "yaw_rate": angular.z}
        self._unless_occupied("cmd_vel", lambda: self._drone.velocity(**rates))

    def on_stamped_velocity(self, message: Any) -> None:
        """Fly at the velocity in a ``TwistStamped``, unless the message is too old or in another frame."""
        frame = message.header.frame_id
        stamp_ns = nanoseconds_of(message.header.stamp)
        age_s = self._time.age_s(stamp_ns) if stamp_ns else 0.0
        if frame not in ("", "base_link", self._frames.base):
            self._ignored("cmd_vel_stamped", UsageError(f"its frame is {frame!r} and must be {self._frames.base}"))
        elif not abs(age_s) <= self._timeout_s:
            limit_s = self._timeout_s
            self._ignored("cmd_vel_stamped", UsageError(f"its stamp is {age_s:.3g} s old; the limit is {limit_s:g} s"))
        else:
            self.on_velocity(message.twist)

    def on_goal(self, pose: Any) -> None:
        """Fly to a pose without waiting for arrival."""

        def fly() -> None:
            place = self._place(pose)
            self._drone.go_to(x=place["x"], y=place["y"], z=place["z"], yaw=place.get("yaw"), wait=False)

        self._unless_occupied("goal_pose", fly)

    def _unless_occupied(self, topic: str, send: Callable[[], object]) -> None:
        """Send a set-point unless a service is running, because programs keep publishing while they wait for a service.

        A service takes the same lock before it begins; otherwise a velocity that was checked before a landing could be
        sent after it. ``send`` must not block.
        """
        try:
            with self._lock:
                service = self._under_way[-1] if self._under_way else ""
                if not service:
                    send()
        except SkyloopError as error:
            self._ignored(topic, error)
        if service:
            self._log.info(f"{topic} is ignored during {service}", throttle_duration_sec=WARN_AGAIN_S)

    @contextmanager
    def _occupied(self, service: str) -> Iterator[None]:
        """Ignore velocities and goals within the block."""
        with self._lock:
            self._under_way.append(service)
        try:
            yield
        finally:
            with self._lock:
                self._under_way.remove(service)

    def _ignored(self, topic: str, error: SkyloopError) -> None:
        self._log.warning(f"{topic} is ignored: {_in_words_of_ros(error)}", throttle_duration_sec=WARN_AGAIN_S)

    def _place(self, pose: Any) -> dict[str, float]:
        """Return the arguments of ``go_to`` for a ``PoseStamped``.

        A pose drawn in a plane has no height, so with z = 0 the drone keeps its current height. If the orientation is
        missing, the current heading is kept. Raise ``UsageError`` if the pose is in another frame, its numbers are not
        finite, or its height is unknown.
        """
        frame, place, turn = pose.header.frame_id, pose.pose.position, pose.pose.orientation
        allowed = [each for each in ("odom", self._frames.odom, self._frames.map) if each]
        if frame and frame not in allowed:
            raise UsageError(f"the goal's frame is {frame!r} and must be {' or '.join(allowed)}")
        if not all(map(math.isfinite, (place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w))):
            raise UsageError("the goal's numbers must be finite")
        found = {"x": place.x, "y": place.y, "z": place.z}
        if place.z == 0.0:
            position = self._drone.feedback().position_m
            if position is None:
                raise UsageError("the goal's height is 0 and the drone's own is unknown: give z")
            found["z"] = position[2]
        angles = euler_of((turn.x, turn.y, turn.z, turn.w))
        as_made = (turn.x, turn.y, turn.z, turn.w) == (0.0, 0.0, 0.0, 1.0) and not frame  # default of a new message
        if angles is not None and not as_made:
            found["yaw"] = angles[2]
        return found

    # Services: may wait ----------------------------------------------------------------------------------------------

    def _trigger(self, name: str, act: Callable[[], object]) -> Callable[[Any, Any], Any]:
        def call(_request: Any, response: Any) -> Any:
            try:
                with self._occupied(name):
                    done = act()
            except SkyloopError as error:
                response.success, response.message = False, _in_words_of_ros(error)
                self._log.warning(f"{name} failed: {response.message}")
                return response
            response.success = done is not False
            response.message = "" if response.success else "it was not sent: the proxy is not reachable at the moment"
            return response

        return call

    def _go_to(self, request: Any, response: Any) -> Any:
        """Fly to ``goal`` and wait. The plan is the straight path that was flown, or empty if nothing was flown."""
        from geometry_msgs.msg import PoseStamped

        try:
            place = self._place(request.goal)
            start = self._drone.feedback().position_m
            near_m = request.tolerance if request.tolerance > 0.0 else NEAR_M
            with self._occupied("go_to"):
                self._drone.go_to(x=place["x"], y=place["y"], z=place["z"], yaw=place.get("yaw"), tolerance_m=near_m)
        except SkyloopError as error:
            self._log.error(f"go_to failed: {_in_words_of_ros(error)}")
            return response
        response.plan.header.frame_id = self._frames.odom
        for x, y, z in (start or (math.nan,) * 3, (place["x"], place["y"], place["z"])):
            pose = PoseStamped(header=response.plan.header)
            pose.pose.position.x, pose.pose.position.y, pose.pose.position.z = x, y, z
            response.plan.poses.append(pose)
        return response


def _in_words_of_ros(error: SkyloopError) -> str:
    """Return the reason, with Python calls replaced by the equivalent services."""
    return error.reason.replace("request_authority()", "the service authority/request")


class RosParameters:
    """Declares the drone's parameters on a node, writes values set through ROS, and mirrors changes made elsewhere.

    ``node``: the rclpy node. Setting a parameter waits for the drone's proxy. ``drone``: the drone, connected as a
    pilot, because writing requires control authority.
    """

    def __init__(self, node: Any, drone: Drone) -> None:
        self._node = node
        self._drone = drone
        self._known: dict[str, Parameter] = {each.name: each for each in drone.config.parameters()}
        for each in self._known.values():
            node.declare_parameter(each.name, _to_ros(each.value), _described(each))
        node.add_on_set_parameters_callback(self._set)
        drone.on_event(self._on_event)

    def _set(self, parameters: list[Any]) -> Any:
        """Write the values that differ. Stop at the first refusal and return the proxy's reason."""
        from rcl_interfaces.msg import SetParametersResult

        for each in parameters:
            known = self._known.get(each.name)
            if known is None or _same(known.value, each.value):
                continue  # either the node's own parameter, or already set
            try:
                self._drone.config[each.name] = each.value
                self._known[each.name] = self._drone.config.describe(each.name)
            except SkyloopError as error:
                return SetParametersResult(successful=False, reason=error.reason)
        return SetParametersResult(successful=True)

    def _on_event(self, event: Event) -> None:
        """Update a parameter whose value was changed elsewhere. Runs on the drone's own thread."""
        name = event.data.get("name")
        if event.kind is not EventKind.PARAMETER_CHANGED or name not in self._known:
            return
        from rclpy.parameter import Parameter as RosParameter

        try:
            changed = self._drone.config.describe(str(name))
        except SkyloopError as error:
            self._node.get_logger().warning(f"{name} was changed, but can't be read: {error.reason}")
            return
        self._known[changed.name] = changed
        if not _same(changed.value, self._node.get_parameter(changed.name).value):
            self._node.set_parameters([RosParameter(changed.name, value=_to_ros(changed.value))])


def _described(parameter: Parameter) -> Any:
    from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor

    unit = f" [{parameter.unit}]" if parameter.unit else ""
    once = " (momentary: each write triggers one action)" if parameter.momentary else ""
    descriptor = ParameterDescriptor(description=f"{parameter.description}{unit}{once}")
    if parameter.read_only:
        descriptor.additional_constraints = "read-only"
    elif parameter.choices:
        descriptor.additional_constraints = f"one of {', '.join(map(str, parameter.choices))}"
    low, high = parameter.minimum, parameter.maximum
    if low is not None and high is not None:
        if parameter.type is ParameterType.FLOAT:
            descriptor.floating_point_range = [FloatingPointRange(from_value=float(low), to_value=float(high))]
        elif parameter.type is ParameterType.INT:
            descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high), step=1)]
    return descriptor


def _to_ros(value: Value) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _same(ours: Value, theirs: Any) -> bool:
    return bool(_to_ros(ours) == (theirs if isinstance(theirs, bool | int | float | str) else list(theirs)))
