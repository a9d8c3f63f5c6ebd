"""ROS 2 through rclpy: standard messages, "sensor data" quality of service, the default executor in a thread.

Runs under an interpreter with ``rclpy``, which need not be Skyloop's own.
"""

from __future__ import annotations

import os
import threading
import time
from array import array
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import TwistStamped
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy
from sensor_msgs.msg import Image as ImageMessage
from sensor_msgs.msg import Imu

from benchmarks.measuring.contract import Image, Received
from benchmarks.measuring.schedule import COMMAND, FEEDBACK, VIDEO
from benchmarks.measuring.waypoints import Setpoint

_FOUND_WITHIN_S = 10.0
_QUALITY = QoSProfile(history=QoSHistoryPolicy.KEEP_LAST, depth=1, reliability=QoSReliabilityPolicy.BEST_EFFORT)


class _End:
    def __init__(self, name: str, address: str) -> None:
        os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        rclpy.init()
        # A namespace for this run alone, because there may be other nodes on this host.
        self._node: Any = rclpy.create_node(name, namespace=Path(address).name.replace("-", "_"))
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._spin, name="ros-spin", daemon=True)

    def _spin(self) -> None:
        try:
            self._executor.spin()
        except ExternalShutdownException:
            return

    def close(self) -> None:
        self._executor.shutdown()
        self._thread.join()
        self._node.destroy_node()
        rclpy.shutdown()


class Vehicle(_End):
    def __init__(self, address: str, received: Received) -> None:
        super().__init__("vehicle", address)
        self._feedback = self._node.create_publisher(Imu, FEEDBACK, _QUALITY)
        self._video = self._node.create_publisher(ImageMessage, VIDEO, _QUALITY)
        self._node.create_subscription(
            TwistStamped, COMMAND, lambda message: received(COMMAND, _stamp_of(message)), _QUALITY
        )
        self._thread.start()

    def feedback(self, sent_ns: int) -> None:
        message = Imu()
        _stamp(message, sent_ns)
        message.orientation.w = 1.0
        message.angular_velocity.z = 0.5
        message.linear_acceleration.z = 9.8
        self._feedback.publish(message)

    def frame(self, sent_ns: int, image: Image) -> None:
        message = ImageMessage()
        _stamp(message, sent_ns)
        message.height, message.width, _ = image.shape
        message.encoding = "rgb8"
        message.step = 3 * message.width
        pixels = array("B")  # this type is used directly; bytes would be converted one by one
        pixels.frombytes(image.data.cast("B"))
        message.data = pixels
        self._video.publish(message)


class Application(_End):
    def __init__(self, address: str, received: Received) -> None:
        super().__init__("application", address)
        self._commands = self._node.create_publisher(TwistStamped, COMMAND, _QUALITY)

        def show(message: Any) -> None:
            np.frombuffer(message.data, np.uint8).reshape(message.height, message.width, 3)
            received(VIDEO, _stamp_of(message))

        self._node.create_subscription(Imu, FEEDBACK, lambda message: received(FEEDBACK, _stamp_of(message)), _QUALITY)
        self._node.create_subscription(ImageMessage, VIDEO, show, _QUALITY)
        self._thread.start()
        self._wait_for_the_vehicle()

    def command(self, sent_ns: int, setpoint: Setpoint) -> None:
        message = TwistStamped()
        _stamp(message, sent_ns)
        message.twist.linear.x, message.twist.linear.y, message.twist.angular.z = setpoint
        self._commands.publish(message)

    def _wait_for_the_vehicle(self) -> None:
        deadline = time.monotonic() + _FOUND_WITHIN_S
        topics = [self._node.resolve_topic_name(topic) for topic in (FEEDBACK, VIDEO)]
        while not (
            self._commands.get_subscription_count() and all(self._node.count_publishers(topic) for topic in topics)
        ):
            if time.monotonic() > deadline:
                raise TimeoutError(f"the two ROS nodes did not find each other within {_FOUND_WITHIN_S:g} s")
            time.sleep(0.02)


def _stamp(message: Any, sent_ns: int) -> None:
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(sent_ns, 1_000_000_000)


def _stamp_of(message: Any) -> int:
    stamp = message.header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
