"""The driver of ``ros2://``: what the proxy calls."""

from __future__ import annotations

from skyloop.drivers.base import Driver, Sink
from skyloop.drivers.uri import VehicleUri
from skyloop.errors import DriverError
from skyloop.messages import AnyAction, Capabilities
from skyloop.vehicles.ros2.link import PURPOSE, RobotLink
from skyloop.vehicles.ros2.node import require_rclpy
from skyloop.vehicles.ros2.options import options_of
from skyloop.vehicles.ros2.protocol import RobotSession

_MESSAGES = ("geometry_msgs.msg", "nav_msgs.msg", "sensor_msgs.msg", "std_srvs.srv")


class Ros2Driver(Driver):
    """Any robot of ROS 2 with an image and ``cmd_vel``. ``docs/ros.md`` has its options.

    It takes velocities; take-off and landing only where the address names the robot's services for them. What it lacks
    the proxy makes of velocities, where the robot's odometry says how high it is.
    """

    def __init__(self, uri: VehicleUri) -> None:
        super().__init__(uri)
        self.options = options_of(uri)
        self._link: RobotLink | None = None

    def capabilities(self) -> Capabilities:
        """Return what the robot can do, by the topics and services that the address names."""
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
