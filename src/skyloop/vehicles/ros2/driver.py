"""The driver for ``ros2://`` addresses and, through rclpy, the robot's topics and services."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Final

from skyloop.clock import monotonic_ns
from skyloop.drivers.base import Driver, Sink
from skyloop.drivers.uri import VehicleUri
from skyloop.errors import DriverError
from skyloop.messages import AnyAction, Capabilities, Velocity
from skyloop.vehicles.ros2.node import RosContext, require_rclpy, stay_on_this_machine
from skyloop.vehicles.ros2.options import Options, options_of
from skyloop.vehicles.ros2.protocol import PERIOD_S, RobotSession
from skyloop.vehicles.ros2.wire import stamp_of

_MESSAGES = ("geometry_msgs.msg", "nav_msgs.msg", "sensor_msgs.msg", "std_srvs.srv")


class Ros2Driver(Driver):
    """Any ROS 2 robot with images and ``cmd_vel``. See ``docs/ros.md`` for its options.

    The driver supports velocities, and also take-off and landing if the address names the robot's services for them. If
    the robot's odometry reports its height, the proxy builds the missing actions from velocities.
    """

    def __init__(self, uri: VehicleUri) -> None:
        super().__init__(uri)
        self.options = options_of(uri)
        self._link: RobotLink | None = None

    def capabilities(self) -> Capabilities:
        """Return the capabilities that follow from the topics and services named in the address."""
        return self.options.capabilities()

    def _open(self, sink: Sink) -> None:
        require_rclpy(PURPOSE, *_MESSAGES)
        self._link = RobotLink(self.options, sink)

    def _close(self) -> None:
        link, self._link = self._link, None
        if link is not None:
            link.close()

    def _apply(self, action: AnyAction) -> AnyAction:
        return self._session.command(action)

    def _repeat(self, action: AnyAction) -> AnyAction:
        return self._session.command(action, new=False)

    @property
    def _session(self) -> RobotSession:
        link = self._link
        if link is None:
            raise DriverError(f"{self.uri} is not open")
        return link.session


PURPOSE: Final = "a robot of ROS 2"


class RobotLink:
    """A node that subscribes to a robot's topics and publishes ``cmd_vel`` for it.

    It subscribes to images only while an application wants them, or always if the address names no odometry.
    """

    def __init__(self, options: Options, sink: Sink) -> None:
        self._options = options
        self._sink = sink
        stay_on_this_machine()
        self._context = RosContext(PURPOSE, options.domain)
        try:
            self._node = self._context.node("skyloop_driver")
            self._open()
        except BaseException:
            self._context.close()
            raise

    def _open(self) -> None:
        from geometry_msgs.msg import Twist, TwistStamped
        from nav_msgs.msg import Odometry
        from rclpy.clock import Clock, ClockType
        from rclpy.qos import qos_profile_sensor_data
        from sensor_msgs.msg import BatteryState, CameraInfo
        from std_srvs.srv import Trigger

        options, node, quality = self._options, self._node, qos_profile_sensor_data
        self.session = session = RobotSession(options, self._sink, self, monotonic_ns, time.time_ns)
        self._images: Any = None
        self._twists: Any = None
        if options.cmd_vel:
            self._twists = node.create_publisher(TwistStamped if options.stamped else Twist, options.cmd_vel, 1)
        self._clients = {name: node.create_client(Trigger, name) for name in (options.takeoff, options.land) if name}
        for kind, topic, callback in (
            (Odometry, options.odom, session.on_odometry),
            (BatteryState, options.battery, session.on_battery),
            (CameraInfo, options.info, session.on_info),
        ):
            if topic:
                node.create_subscription(kind, topic, callback, quality)
        self._update_images()
        node.create_timer(PERIOD_S, self._tick, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._context.spin([node], "ros2-robot")

    def close(self) -> None:
        """Stop the robot, then end the threads and the node."""
        self.session.close()
        self._context.close()

    # Called by the session -------------------------------------------------------------------------------------------

    def send(self, velocity: Velocity) -> None:
        """Publish a velocity in body axes."""
        from geometry_msgs.msg import Twist, TwistStamped

        twist = Twist()
        twist.linear.x, twist.linear.y, twist.linear.z = velocity.forward, velocity.left, velocity.up
        twist.angular.z = velocity.yaw_rate
        if not self._options.stamped:
            self._twists.publish(twist)
            return
        message = TwistStamped(twist=twist)
        message.header.stamp.sec, message.header.stamp.nanosec = stamp_of(time.time_ns())
        message.header.frame_id = "base_link"
        self._twists.publish(message)

    def missing(self) -> str:
        """Return a service that is named in the address but not offered by any node; empty if there is none."""
        return next((name for name, client in self._clients.items() if not client.service_is_ready()), "")

    def call(self, service: str, answered: Callable[[bool, str], None]) -> None:
        """Call a ``std_srvs/Trigger`` without waiting for the response; raise DriverError if no node offers it."""
        from std_srvs.srv import Trigger

        client = self._clients[service]
        if not client.service_is_ready():
            raise DriverError(f"no node offers the service {service}: is the robot's node running?")

        def done(future: Any) -> None:
            error = future.exception()
            if error is not None:
                answered(False, str(error))
            elif not future.cancelled():
                answered(bool(future.result().success), str(future.result().message))

        client.call_async(Trigger.Request()).add_done_callback(done)

    # Inside ----------------------------------------------------------------------------------------------------------

    def _tick(self) -> None:
        self.session.tick()
        self._update_images()

    def _update_images(self) -> None:
        from rclpy.qos import qos_profile_sensor_data
        from sensor_msgs.msg import CompressedImage, Image

        options = self._options
        wanted = bool(options.image) and (not options.odom or self._sink.wants(options.camera))
        if wanted and self._images is None:
            kind = CompressedImage if options.compressed else Image
            self._images = self._node.create_subscription(
                kind, options.image, self.session.on_image, qos_profile_sensor_data
            )
        elif not wanted and self._images is not None:
            self._node.destroy_subscription(self._images)
            self._images = None
