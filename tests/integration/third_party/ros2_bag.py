"""Writes a bridge's messages into a bag with rosbags as they arrive, and reads it back.

    python ros2_bag.py /alpha FOLDER

Records until there are enough messages of each topic. Prints what was read back as JSON.
"""

import json
import sys
import time
from pathlib import Path
from typing import Any

import rclpy
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Odometry
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from sensor_msgs.msg import BatteryState, CameraInfo, CompressedImage, Image, Imu

from skyloop.ros.names import tf_message_type
from skyloop.vehicles.ros2.wire import TYPE_HASH, TYPE_NAME

LASTING = QoSProfile(depth=10, durability=DurabilityPolicy.TRANSIENT_LOCAL)
TOPICS = {  # type, and the number of messages to wait for
    "front/image_raw": (Image, qos_profile_sensor_data, 10),
    "front/image_raw/compressed": (CompressedImage, qos_profile_sensor_data, 10),
    "front/camera_info": (CameraInfo, qos_profile_sensor_data, 10),
    "imu/data": (Imu, qos_profile_sensor_data, 10),
    "odom": (Odometry, qos_profile_sensor_data, 10),
    "velocity": (TwistStamped, qos_profile_sensor_data, 10),
    "battery_state": (BatteryState, 1, 1),
    "/tf": (tf_message_type(), 100, 10),
    "/tf_static": (tf_message_type(), LASTING, 1),
}


def main() -> None:
    namespace, folder = sys.argv[1], Path(sys.argv[2])
    rclpy.init()
    node = rclpy.create_node("bag", namespace=namespace)
    store = get_typestore(Stores.ROS2_JAZZY)
    assert store.hash_rihs01(TYPE_NAME) == f"RIHS01_{TYPE_HASH.hex()}"
    counts = dict.fromkeys(TOPICS, 0)
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic, (kind, quality, _) in TOPICS.items():
            name = node.resolve_topic_name(topic)
            package = (
                "tf2_msgs/msg" if topic.startswith("/tf") else kind.__module__.rpartition(".")[0].replace(".", "/")
            )
            connection = writer.add_connection(name, f"{package}/{kind.__name__}", typestore=store)

            def write(data: bytes, topic: str = topic, connection: object = connection) -> None:
                counts[topic] += 1
                writer.write(connection, time.time_ns(), data)

            node.create_subscription(kind, topic, write, quality, raw=True)
        end = time.monotonic() + 20.0
        while any(counts[topic] < many for topic, (_, _, many) in TOPICS.items()):
            assert time.monotonic() < end, counts
            rclpy.spin_once(node, timeout_sec=0.1)
    node.destroy_node()
    rclpy.shutdown()
    read: dict[str, dict[str, Any]] = {}
    with Reader(folder) as reader:
        for connection, at_ns, data in reader.messages():
            message = store.deserialize_cdr(data, connection.msgtype)
            stamped = message.transforms[0] if connection.topic.startswith("/tf") else message
            stamp = stamped.header.stamp
            known = read.setdefault(connection.topic, {"count": 0, "type": connection.msgtype})
            known["count"] = known["count"] + 1
            known["age_s"] = at_ns / 1e9 - stamp.sec - stamp.nanosec / 1e9
            known["frame"] = stamped.header.frame_id
            if hasattr(message, "transforms"):
                known["children"] = [each.child_frame_id for each in message.transforms]
                known["rotations"] = [
                    [
                        each.transform.rotation.x,
                        each.transform.rotation.y,
                        each.transform.rotation.z,
                        each.transform.rotation.w,
                    ]
                    for each in message.transforms
                ]
            if connection.msgtype.endswith("/Image"):
                known["image"] = [message.height, message.width, message.encoding, len(message.data)]
    print(json.dumps(read))


if __name__ == "__main__":
    main()
