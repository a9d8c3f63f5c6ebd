"""A small flying ROS 2 robot: a point with odometry, a camera, cmd_vel, take-off and landing. Does not know Skyloop.

    python ros2_robot.py /robot

Like many robots it stops when no velocity has come for half a second.
"""

import array
import math
import sys
import time

import rclpy
from geometry_msgs.msg import Twist
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import BatteryState, CameraInfo, Image
from std_srvs.srv import Trigger

PERIOD_S, WIDTH, HEIGHT = 0.03, 320, 240


class Robot(Node):  # type: ignore[misc]  # rclpy has no types here
    def __init__(self, namespace: str) -> None:
        super().__init__("robot", namespace=namespace)
        self.x = self.y = self.z = self.yaw = 0.0
        self.goal: float | None = None  # height at which the current take-off or landing ends
        self.twist, self.told_s, self.steps = Twist(), 0.0, 0
        quality = qos_profile_sensor_data
        self.odom = self.create_publisher(Odometry, "odom", quality)
        self.image = self.create_publisher(Image, "image_raw", quality)
        self.info = self.create_publisher(CameraInfo, "camera_info", quality)
        self.battery = self.create_publisher(BatteryState, "battery_state", 1)
        self.pixels = array.array("B", bytes(i % 251 for i in range(3 * WIDTH * HEIGHT)))
        self.create_subscription(Twist, "cmd_vel", self.on_twist, 1)
        self.create_service(Trigger, "takeoff", lambda request, answer: self.begin(1.0, answer))
        self.create_service(Trigger, "land", lambda request, answer: self.begin(0.0, answer))
        self.create_timer(PERIOD_S, self.step)

    def on_twist(self, twist: Twist) -> None:
        self.twist, self.told_s = twist, time.monotonic()

    def begin(self, goal: float, answer: Trigger.Response) -> Trigger.Response:
        self.goal, answer.success = goal, True
        return answer

    def step(self) -> None:
        speed = self.twist.linear if time.monotonic() - self.told_s < 0.5 else Twist().linear
        turn = self.twist.angular.z if time.monotonic() - self.told_s < 0.5 else 0.0
        up = speed.z
        if self.goal is not None:
            up = max(-1.0, min(1.0, 3.0 * (self.goal - self.z)))
            self.goal = self.goal if abs(self.goal - self.z) > 0.02 else None
        flying = self.z > 0.02
        ahead, aside, turn = (speed.x, speed.y, turn) if flying else (0.0, 0.0, 0.0)
        self.x += (math.cos(self.yaw) * ahead - math.sin(self.yaw) * aside) * PERIOD_S
        self.y += (math.sin(self.yaw) * ahead + math.cos(self.yaw) * aside) * PERIOD_S
        self.z = max(0.0, self.z + (up if flying or self.goal is not None else 0.0) * PERIOD_S)
        self.yaw += turn * PERIOD_S
        self.publish(ahead, aside, up, turn)

    def publish(self, ahead: float, aside: float, up: float, turn: float) -> None:
        now = self.get_clock().now().to_msg()
        odometry = Odometry()
        odometry.header.stamp, odometry.header.frame_id, odometry.child_frame_id = now, "odom", "base_link"
        place, quaternion = odometry.pose.pose.position, odometry.pose.pose.orientation
        place.x, place.y, place.z = self.x, self.y, self.z
        quaternion.z, quaternion.w = math.sin(self.yaw / 2), math.cos(self.yaw / 2)
        linear = odometry.twist.twist.linear
        linear.x, linear.y, linear.z = float(ahead), float(aside), float(up)
        odometry.twist.twist.angular.z = float(turn)
        self.odom.publish(odometry)
        self.steps += 1
        if self.steps % 2:
            image = Image(height=HEIGHT, width=WIDTH, encoding="rgb8", step=3 * WIDTH, data=self.pixels)
            image.header.stamp, image.header.frame_id = now, "camera_optical_frame"
            self.image.publish(image)
            info = CameraInfo(height=HEIGHT, width=WIDTH, distortion_model="plumb_bob", d=[0.0] * 5)
            info.k = [200.0, 0.0, 159.5, 0.0, 200.0, 119.5, 0.0, 0.0, 1.0]
            self.info.publish(info)
        if self.steps % 30 == 1:
            self.battery.publish(BatteryState(percentage=0.8, voltage=11.1))


def main() -> None:
    rclpy.init()
    robot = Robot(sys.argv[1])
    print("ready", flush=True)
    rclpy.spin(robot)


if __name__ == "__main__":
    main()
