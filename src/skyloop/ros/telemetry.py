"""Publish a drone's data to ROS: odometry, IMU, battery, geographic position, transforms, flight state and images."""

from __future__ import annotations

import math
import threading
from array import array
from collections.abc import Callable
from typing import Any, Final

from skyloop.client import Drone, Frame
from skyloop.client.channels import Listener
from skyloop.errors import UnsupportedError, install_command
from skyloop.messages import CameraInfo, Feedback, LinkState
from skyloop.messages.geometry import quaternion_from_euler
from skyloop.ros.names import FrameNames, RosTime
from skyloop.vehicles.ros2.node import ros_name
from skyloop.vehicles.ros2.wire import (
    VARIANCE,
    Quaternion,
    Transform,
    body_velocity,
    camera_model,
    covariance,
    encode_transforms,
    quaternion_of,
    stamp_of,
)

SLOW_NS: Final = 1_000_000_000  #: interval between battery messages, and between geographic positions
_NO_ROTATION: Final[Quaternion] = (0.0, 0.0, 0.0, 1.0)
JPEG_QUALITY: Final = 90  #: on OpenCV's scale, 0 to 100


class RosTelemetry:
    """Publishes each feedback sample on the topics that have subscribers."""

    def __init__(self, node: Any, drone: Drone, time: RosTime, frames: FrameNames) -> None:
        from geometry_msgs.msg import TwistStamped
        from nav_msgs.msg import Odometry
        from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
        from sensor_msgs.msg import BatteryState, Imu, NavSatFix
        from std_msgs.msg import String

        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._node = node
        self._time = time
        self._frames = frames
        self._odometry = node.create_publisher(Odometry, "odom", qos_profile_sensor_data)
        self._velocity = node.create_publisher(TwistStamped, "velocity", qos_profile_sensor_data)
        self._imu = node.create_publisher(Imu, "imu/data", qos_profile_sensor_data)
        self._battery = node.create_publisher(BatteryState, "battery_state", 1)
        self._fix = node.create_publisher(NavSatFix, "fix", 1)
        self._state = node.create_publisher(String, "state", latched)
        self._pilot = node.create_publisher(String, "pilot", latched)
        self._transforms: Any = None
        self._static: Any = None
        try:
            self._open_transforms(drone.capabilities.cameras)
        except UnsupportedError as error:
            node.get_logger().warning(f"no /tf and no /tf_static: {error}")
        self._last_text: dict[Any, str] = {}
        self._slow_ns = 0
        drone.on_feedback(self.publish)

    def publish(self, feedback: Feedback) -> None:
        """Publish one sample. Runs on the drone's own thread."""
        self._publish_text(self._state, feedback.state.value)
        self._publish_text(self._pilot, feedback.owner or "")
        stamp_ns = self._time.stamp_ns(feedback.captured_ns)
        if stamp_ns is None or feedback.vehicle_link not in (LinkState.UP, LinkState.DEGRADED):
            return
        rotation = _quaternion(feedback)
        _publish(self._odometry, self._odometry_of, feedback, rotation, stamp_ns)
        _publish(self._velocity, self._velocity_of, feedback, rotation, stamp_ns)
        _publish(self._imu, self._imu_of, feedback, rotation, stamp_ns)
        if rotation is not None and feedback.position_m is not None and self._transforms is not None:
            frames = self._frames
            moved = Transform(stamp_ns, frames.odom, frames.base, feedback.position_m, rotation)
            self._transforms.publish(encode_transforms([moved]))
        if feedback.captured_ns - self._slow_ns >= SLOW_NS:
            self._slow_ns = feedback.captured_ns
            _publish(self._battery, self._battery_of, feedback, stamp_ns)
            _publish(self._fix, self._fix_of, feedback, stamp_ns)

    def _open_transforms(self, cameras: tuple[CameraInfo, ...]) -> None:
        from rclpy.qos import DurabilityPolicy, QoSProfile

        from skyloop.ros.names import forget_error, tf_message_type

        kind = tf_message_type()
        frames = self._frames
        self._transforms = self._node.create_publisher(kind, "/tf", 100)
        lasting = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._static = self._node.create_publisher(kind, "/tf_static", lasting)
        forget_error()
        known = [
            Transform(
                0,
                frames.base,
                frames.optical(each.name),
                each.position_m or (0.0, 0.0, 0.0),
                quaternion_of(each.rotation),
            )
            for each in cameras
            if each.rotation is not None
        ]
        if frames.map:
            known.append(Transform(0, frames.map, frames.odom, (0.0, 0.0, 0.0), _NO_ROTATION))
        if known:
            self._static.publish(encode_transforms(known))

    def _publish_text(self, publisher: Any, text: str) -> None:
        """Publish text if it differs from the last one."""
        if self._last_text.get(publisher) != text:
            from std_msgs.msg import String

            self._last_text[publisher] = text
            publisher.publish(String(data=text))

    # Messages ------------------------------------------------------------------------------------------------------

    def _odometry_of(self, feedback: Feedback, rotation: Quaternion | None, stamp_ns: int) -> Any:
        from nav_msgs.msg import Odometry

        twist = self._twist(feedback)
        if rotation is None or feedback.position_m is None or twist is None:
            return None
        message = Odometry(child_frame_id=self._frames.base)
        self._head(message, stamp_ns, self._frames.odom)
        place = message.pose.pose.position
        place.x, place.y, place.z = feedback.position_m
        _turn(message.pose.pose.orientation, rotation)
        message.pose.covariance = covariance(6)
        message.twist.twist = twist
        message.twist.covariance = covariance(6)
        return message

    def _velocity_of(self, feedback: Feedback, _rotation: Quaternion | None, stamp_ns: int) -> Any:
        from geometry_msgs.msg import TwistStamped

        twist = self._twist(feedback)
        if twist is None:
            return None
        message = TwistStamped(twist=twist)
        self._head(message, stamp_ns, self._frames.base)
        return message

    def _twist(self, feedback: Feedback) -> Any:
        """Return velocity and rates in body axes, or None if the velocity or tilt is unknown."""
        from geometry_msgs.msg import Twist

        if feedback.velocity_m_s is None or feedback.roll_rad is None or feedback.pitch_rad is None:
            return None
        twist = Twist()
        moved = body_velocity(feedback.velocity_m_s, feedback.roll_rad, feedback.pitch_rad)
        twist.linear.x, twist.linear.y, twist.linear.z = moved
        twist.angular.x, twist.angular.y, twist.angular.z = feedback.angular_velocity_rad_s or (math.nan,) * 3
        return twist

    def _imu_of(self, feedback: Feedback, rotation: Quaternion | None, stamp_ns: int) -> Any:
        from sensor_msgs.msg import Imu

        rates, force = feedback.angular_velocity_rad_s, feedback.acceleration_m_s2
        if rotation is None and rates is None and force is None:
            return None
        message = Imu()
        self._head(message, stamp_ns, self._frames.base)
        _turn(message.orientation, rotation or _NO_ROTATION)
        message.orientation_covariance = covariance(3, known=rotation is not None)
        turned, pushed = message.angular_velocity, message.linear_acceleration
        turned.x, turned.y, turned.z = rates or (0.0, 0.0, 0.0)
        message.angular_velocity_covariance = covariance(3, known=rates is not None)
        pushed.x, pushed.y, pushed.z = force or (0.0, 0.0, 0.0)
        message.linear_acceleration_covariance = covariance(3, known=force is not None)
        return message

    def _battery_of(self, feedback: Feedback, stamp_ns: int) -> Any:
        from sensor_msgs.msg import BatteryState

        if feedback.battery is None and feedback.battery_v is None:
            return None
        message = BatteryState(
            voltage=_or_nan(feedback.battery_v),
            percentage=_or_nan(feedback.battery),  # fraction from 0 to 1, as everywhere in Skyloop
            present=True,
            power_supply_status=BatteryState.POWER_SUPPLY_STATUS_DISCHARGING,
            **dict.fromkeys(("temperature", "current", "charge", "capacity", "design_capacity"), math.nan),
        )
        self._head(message, stamp_ns, self._frames.base)
        return message

    def _fix_of(self, feedback: Feedback, stamp_ns: int) -> Any:
        from sensor_msgs.msg import NavSatFix, NavSatStatus

        origin = feedback.origin
        if origin is None or feedback.position_m is None:
            return None
        latitude_deg, longitude_deg, _ = origin.place_of(feedback.position_m)
        # NavSatFix requires the altitude above the ellipsoid, but the vehicle reports it above sea level; the
        # difference (up to 100 m) is not known here.
        message = NavSatFix(latitude=latitude_deg, longitude=longitude_deg, altitude=math.nan)
        message.status.status = NavSatStatus.STATUS_FIX
        message.status.service = NavSatStatus.SERVICE_GPS
        message.position_covariance = covariance(3, variance=100 * VARIANCE)
        message.position_covariance_type = NavSatFix.COVARIANCE_TYPE_APPROXIMATED
        self._head(message, stamp_ns, self._frames.base)
        return message

    def _head(self, message: Any, stamp_ns: int, frame: str) -> None:
        message.header.frame_id = frame
        message.header.stamp.sec, message.header.stamp.nanosec = stamp_of(stamp_ns)


def _publish(publisher: Any, make: Callable[..., Any], *given: Any) -> None:
    """Make and publish a message if the topic has subscribers, unless the data is missing."""
    if publisher.get_subscription_count() and (message := make(*given)) is not None:
        publisher.publish(message)


def _quaternion(feedback: Feedback) -> Quaternion | None:
    if feedback.roll_rad is None or feedback.pitch_rad is None or feedback.yaw_rad is None:
        return None
    return quaternion_from_euler(feedback.roll_rad, feedback.pitch_rad, feedback.yaw_rad)


def _turn(orientation: Any, rotation: Quaternion) -> None:
    orientation.x, orientation.y, orientation.z, orientation.w = rotation


def _or_nan(value: float | None) -> float:
    return math.nan if value is None else value


class RosCameraPublisher:
    """Publishes the images of one camera while there are subscribers; otherwise frames are not requested."""

    def __init__(self, node: Any, drone: Drone, camera: CameraInfo, time: RosTime, frames: FrameNames) -> None:
        from rclpy.qos import qos_profile_sensor_data
        from sensor_msgs.msg import CameraInfo as CameraInfoMessage
        from sensor_msgs.msg import CompressedImage, Image

        topic = ros_name(camera.name)
        self._drone = drone
        self._camera = camera
        self._time = time
        self._frame_id = frames.optical(camera.name)
        self._image = node.create_publisher(Image, f"{topic}/image_raw", qos_profile_sensor_data)
        self._info = node.create_publisher(CameraInfoMessage, f"{topic}/camera_info", qos_profile_sensor_data)
        self._compressed: Any = None
        try:
            import cv2  # noqa: F401
        except ImportError:
            node.get_logger().warning(f"no {topic}/image_raw/compressed: {install_command('vision')} for JPEG")
        else:
            self._compressed = node.create_publisher(
                CompressedImage, f"{topic}/image_raw/compressed", qos_profile_sensor_data
            )
        self._lock = threading.Lock()
        self._listener: Listener[Any] | None = None

    @property
    def watched(self) -> bool:
        publishers = (self._image, self._info, self._compressed)
        return any(each is not None and each.get_subscription_count() for each in publishers)

    def update(self) -> None:
        """Subscribe to frames or unsubscribe. Called a few times a second, on one thread."""
        watched = self.watched
        if watched and self._listener is None:
            self._listener = self._drone.on_frame(self.publish, self._camera.name)
        elif not watched and self._listener is not None:
            self._listener.cancel()
            self._listener = None

    def publish(self, frame: Frame) -> None:
        """Publish one frame. Runs on the drone's own thread."""
        stamp_ns = self._time.stamp_ns(frame.captured_ns)
        if stamp_ns is None:
            return
        if self._image.get_subscription_count():
            self._image.publish(self._raw(frame, stamp_ns))
        if self._compressed is not None and self._compressed.get_subscription_count():
            self._compressed.publish(self._jpeg(frame, stamp_ns))
        if self._info.get_subscription_count():
            self._info.publish(self._intrinsics(frame, stamp_ns))

    def _raw(self, frame: Frame, stamp_ns: int) -> Any:
        from sensor_msgs.msg import Image

        message = self._head(Image(), stamp_ns)
        message.height, message.width = frame.shape[:2]
        message.encoding = "bgr8"
        message.step = 3 * message.width
        pixels = array("B")  # rclpy accepts this type directly but converts bytes one at a time
        pixels.frombytes(frame.data.cast("B"))
        message.data = pixels
        return message

    def _jpeg(self, frame: Frame, stamp_ns: int) -> Any:
        import cv2
        from sensor_msgs.msg import CompressedImage

        message = self._head(CompressedImage(), stamp_ns)
        message.format = "bgr8; jpeg compressed bgr8"  # the format string that the publisher of image_transport uses
        _, encoded = cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        message.data = array("B", encoded.tobytes())
        return message

    def _intrinsics(self, frame: Frame, stamp_ns: int) -> Any:
        from sensor_msgs.msg import CameraInfo as CameraInfoMessage

        message = self._head(CameraInfoMessage(), stamp_ns)
        message.height, message.width = frame.shape[:2]
        model = camera_model(frame.intrinsics)
        message.distortion_model, message.d, message.k, message.r, message.p = model
        return message

    def _head(self, message: Any, stamp_ns: int) -> Any:
        message.header.frame_id = self._frame_id
        message.header.stamp.sec, message.header.stamp.nanosec = stamp_of(stamp_ns)
        return message
