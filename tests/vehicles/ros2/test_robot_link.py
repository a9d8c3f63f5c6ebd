"""The driver's node: topics, services and their answers, with an rclpy that tests deliver messages to."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from skyloop.drivers.recording_sink import RecordingSink
from skyloop.drivers.uri import parse_uri
from skyloop.errors import DriverError
from skyloop.messages import Land, LinkState, Takeoff, Velocity
from skyloop.vehicles.ros2.driver import Ros2Driver
from tests.support.fake_rclpy import Fake, Node
from tests.vehicles.ros2.messages import image, odometry


@pytest.fixture(autouse=True)
def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")  # no profile is written for this process


def opened(fake: Fake, sink: RecordingSink, options: str = "takeoff=takeoff&land=land") -> tuple[Ros2Driver, Node]:
    driver = Ros2Driver(parse_uri(f"ros2://robot?{options}"))
    driver.open(sink)
    return driver, fake.nodes["skyloop_driver"]


def test_images_are_subscribed_to_while_needed(rclpy: Fake) -> None:
    sink = RecordingSink(watch=set())
    driver, node = opened(rclpy, sink)
    assert set(node.subscriptions) == {"/robot/odom", "/robot/battery_state", "/robot/camera_info"}
    sink.watch = None
    [tick] = node.timers
    tick()
    assert "/robot/image_raw" in node.subscriptions
    node.subscriptions["/robot/odom"](odometry(0))
    assert sink.link_state is LinkState.UP
    sink.watch = set()
    tick()
    assert "/robot/image_raw" not in node.subscriptions
    driver.close()
    assert node.destroyed


def test_without_odometry_images_show_that_the_robot_is_there(rclpy: Fake) -> None:
    sink = RecordingSink(watch=set())
    driver, node = opened(rclpy, sink, "odom=&compressed=1")
    node.subscriptions["/robot/image_raw"](image(0))
    assert sink.link_state is LinkState.UP
    driver.close()


@pytest.mark.parametrize("stamped", [False, True])
def test_velocities(rclpy: Fake, stamped: bool) -> None:
    driver, node = opened(rclpy, RecordingSink(), f"stamped={int(stamped)}")
    driver.apply(Velocity(forward=0.1, left=0.2, up=0.3, yaw_rate=0.4))
    message: Any = node.publishers["/robot/cmd_vel"].newest
    twist = message.twist if stamped else message
    assert (twist.linear.x, twist.linear.y, twist.linear.z, twist.angular.z) == (0.1, 0.2, 0.3, 0.4)
    if stamped:
        assert message.header.frame_id == "base_link"
        assert message.header.stamp.sec > 0
    driver.close()
    stop = node.publishers["/robot/cmd_vel"].newest
    assert (stop.twist if stamped else stop).linear.x == 0.0


def test_services_and_their_answers(rclpy: Fake) -> None:
    sink = RecordingSink()
    driver, node = opened(rclpy, sink)
    takeoff = node.clients["/robot/takeoff"]
    takeoff.ready = False
    with pytest.raises(DriverError, match="no node offers the service /robot/takeoff"):
        driver.apply(Takeoff())
    takeoff.ready = True
    driver.apply(Takeoff())
    takeoff.calls[-1].finish(SimpleNamespace(success=True, message=""))
    driver.apply(Land())
    node.clients["/robot/land"].calls[-1].finish(error=RuntimeError("gone"))
    assert "refused /robot/land: gone" in sink.events[-1].text
    driver.close()
