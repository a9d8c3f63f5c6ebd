"""Publishes a camera's frames as raw and as compressed images, with the camera's intrinsics."""

from __future__ import annotations

import threading
from array import array
from typing import Any, Final

from skyloop.client import Drone, Frame
from skyloop.client.channels import Listener
from skyloop.errors import install_command
from skyloop.messages import CameraInfo
from skyloop.ros.names import Frames
from skyloop.ros.time import RosTime
from skyloop.vehicles.ros2.node import ros_name
from skyloop.vehicles.ros2.wire import camera_model, stamp_of

JPEG_QUALITY: Final = 90


class CameraPublisher:
    """Publishes one camera, while somebody subscribes to it: until then its frames are not asked for.

    Args:
        node: Of rclpy, in the drone's namespace.
        drone: Connected.
        camera: Of the drone.
        time: Stamps of captures.
        frames: Names of the drone's frames.
    """

    def __init__(self, node: Any, drone: Drone, camera: CameraInfo, time: RosTime, frames: Frames) -> None:
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
        """Whether somebody subscribes to one of the topics."""
        publishers = (self._image, self._info, self._compressed)
        return any(each is not None and each.get_subscription_count() for each in publishers)

    def update(self) -> None:
        """Ask for frames, or no longer: called a few times a second, from one thread."""
        watched = self.watched
        if watched and self._listener is None:
            self._listener = self._drone.on_frame(self.publish, self._camera.name)
        elif not watched and self._listener is not None:
            self._listener.cancel()
            self._listener = None

    def publish(self, frame: Frame) -> None:
        """Publish one frame. On a thread of the drone's own."""
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
        pixels = array("B")  # the type that rclpy takes as it is; bytes are converted one by one
        pixels.frombytes(frame.data.cast("B"))
        message.data = pixels
        return message

    def _jpeg(self, frame: Frame, stamp_ns: int) -> Any:
        import cv2
        from sensor_msgs.msg import CompressedImage

        message = self._head(CompressedImage(), stamp_ns)
        message.format = "bgr8; jpeg compressed bgr8"  # as image_transport's compressed publisher words it
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
