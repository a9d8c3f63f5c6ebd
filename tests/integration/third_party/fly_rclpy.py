"""Follows a marker with rclpy and OpenCV alone: images and odometry in, Twist out. Knows nothing of Skyloop.

    python fly_rclpy.py /alpha 30

Asks for the authority, takes off, turns until it sees marker 7, follows it at 1.5 m for this many seconds, lands, and
prints the outcome as JSON.
"""

import json
import math
import sys
import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import rclpy
from geometry_msgs.msg import Twist
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image
from std_srvs.srv import Trigger

MARKER, SIZE_M, DISTANCE_M = 7, 0.3, 1.5


class Follower(Node):  # type: ignore[misc]  # rclpy has no types here
    def __init__(self, namespace: str) -> None:
        super().__init__("follower", namespace=namespace)
        self.detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
        half = SIZE_M / 2
        self.square = np.array([(-half, half, 0), (half, half, 0), (half, -half, 0), (-half, -half, 0)])
        self.matrix: Any = None
        self.flying = False
        self.frames = self.in_view = 0
        self.ages_ms: list[float] = []
        self.command = self.create_publisher(Twist, "cmd_vel", 1)
        self.last = Twist()
        self.create_subscription(CameraInfo, "front/camera_info", self.on_info, qos_profile_sensor_data)
        self.create_subscription(Image, "front/image_raw", self.on_image, qos_profile_sensor_data)

    def on_info(self, info: CameraInfo) -> None:
        self.matrix, self.distortion = np.array(info.k).reshape(3, 3), np.array(info.d)

    def on_image(self, image: Image) -> None:
        stamp = image.header.stamp
        self.ages_ms.append((time.time() - stamp.sec - stamp.nanosec * 1e-9) * 1e3)
        if not self.flying or self.matrix is None:
            return
        pixels = np.frombuffer(image.data, np.uint8).reshape(image.height, image.width, 3)
        corners, ids, _ = self.detector.detectMarkers(cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY))
        found = [
            each for each, number in zip(corners, () if ids is None else ids.ravel(), strict=True) if number == MARKER
        ]
        if found:
            self.in_view += 1
        if self.in_view:
            self.frames += 1
        self.command.publish(self.towards(found[0]) if found else self.searching())

    def towards(self, corners: Any) -> Twist:
        _, _, (right, down, ahead) = cv2.solvePnP(
            self.square, corners.reshape(4, 2), self.matrix, self.distortion, flags=cv2.SOLVEPNP_IPPE_SQUARE
        )
        twist = Twist()
        twist.linear.x = float(np.clip(0.9 * (ahead[0] - DISTANCE_M), -0.8, 0.8))
        twist.linear.z = float(np.clip(-1.0 * down[0], -0.4, 0.4))
        twist.angular.z = float(np.clip(-2.0 * math.atan2(right[0], ahead[0]), -1.2, 1.2))
        self.last = twist
        return twist

    def searching(self) -> Twist:
        twist = Twist()
        twist.angular.z = math.copysign(0.5, self.last.angular.z or 1.0)
        return twist

    def call(self, name: str) -> None:
        client = self.create_client(Trigger, name)
        if not client.wait_for_service(15.0):
            raise TimeoutError(f"no node offers {name}")
        future = client.call_async(Trigger.Request())
        rclpy.spin_until_future_complete(self, future, timeout_sec=30.0)
        if future.result() is None or not future.result().success:
            raise RuntimeError(f"{name}: {future.result()}")

    def spin(self, seconds: float, until: Callable[[], bool] = lambda: False) -> None:
        end = time.monotonic() + seconds
        while time.monotonic() < end and not until():
            rclpy.spin_once(self, timeout_sec=0.1)


def main() -> None:
    namespace, seconds = sys.argv[1], float(sys.argv[2])
    rclpy.init()
    node = Follower(namespace)
    node.call("authority/request")
    node.call("takeoff")
    node.flying = True
    node.spin(20.0, until=lambda: node.in_view > 0)
    node.spin(seconds)
    node.flying = False
    node.call("land")
    node.call("authority/release")
    share = node.in_view / node.frames if node.frames else 0.0
    print(json.dumps({"share_in_view": share, "frames": node.frames, "age_ms": float(np.median(node.ages_ms))}))


if __name__ == "__main__":
    main()
