"""The ROS 2 side of ``benchmarks.ros``: sends velocities and receives images, with rclpy alone.

    python ros_probe.py /alpha SECONDS

Takes off, flies for this time and lands. Prints as JSON when each velocity was published, by its yaw rate, and how old
each image was when its callback ran, by its stamp [ns].
"""

import json
import sys
import time

import rclpy
from geometry_msgs.msg import Twist
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image
from std_srvs.srv import Trigger

PERIOD_S = 1 / 32
STEP = 1e-4  # the n-th velocity turns by n times this [rad/s], which identifies its echo


def main() -> None:
    namespace, seconds = sys.argv[1], float(sys.argv[2])
    rclpy.init()
    node = rclpy.create_node("probe", namespace=namespace)
    publisher = node.create_publisher(Twist, "cmd_vel", 1)
    published_ns: list[int] = []
    ages_ns: list[int] = []

    def on_image(image: Image) -> None:
        stamp = image.header.stamp
        ages_ns.append(time.time_ns() - stamp.sec * 10**9 - stamp.nanosec)

    def call(name: str) -> None:
        client = node.create_client(Trigger, name)
        if not client.wait_for_service(15.0):
            raise TimeoutError(f"nobody offers {name}")
        future = client.call_async(Trigger.Request())
        rclpy.spin_until_future_complete(node, future, timeout_sec=30.0)
        if not future.result().success:
            raise RuntimeError(f"{name}: {future.result().message}")

    call("takeoff")
    images = node.create_subscription(Image, "front/image_raw", on_image, qos_profile_sensor_data)
    end = time.monotonic() + 10.0
    while len(ages_ns) < 30:  # until the camera is found and images flow
        if time.monotonic() > end:
            raise TimeoutError(f"{len(ages_ns)} images arrived within 10 s")
        rclpy.spin_once(node, timeout_sec=0.1)
    ages_ns.clear()
    due = time.monotonic()
    end = due + seconds
    while due < end:
        twist = Twist()
        twist.angular.z = STEP * len(published_ns)
        published_ns.append(time.monotonic_ns())
        publisher.publish(twist)
        due += PERIOD_S
        while (left := due - time.monotonic()) > 0:
            rclpy.spin_once(node, timeout_sec=left)
    node.destroy_subscription(images)
    call("land")
    print(json.dumps({"published_ns": published_ns, "image_ages_ns": ages_ns}))


if __name__ == "__main__":
    main()
