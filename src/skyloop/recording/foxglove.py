"""Encode messages in Foxglove's public protobuf schemas: images, calibrations, poses, drawings, text.

Pure. Needs the extra ``record``. Times are in Unix ns; frame names are those of :mod:`skyloop.recording.layout`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, Final

from skyloop.errors import MissingExtraError
from skyloop.messages import Annotation, CameraInfo, Feedback, Intrinsics, Points, Polyline, Severity
from skyloop.messages.frame import H264
from skyloop.messages.geometry import quaternion_from_euler
from skyloop.messages.relayed import Colour, Point, Shape, Text
from skyloop.recording.layout import WORLD, optical_frame

try:
    from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
    from foxglove_schemas_protobuf.Color_pb2 import Color
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
    from foxglove_schemas_protobuf.CompressedVideo_pb2 import CompressedVideo
    from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
    from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
    from foxglove_schemas_protobuf.Log_pb2 import Log
    from foxglove_schemas_protobuf.Point2_pb2 import Point2
    from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
    from foxglove_schemas_protobuf.Pose_pb2 import Pose
    from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
    from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
    from foxglove_schemas_protobuf.Quaternion_pb2 import Quaternion
    from foxglove_schemas_protobuf.Vector3_pb2 import Vector3
    from google.protobuf.descriptor_pb2 import FileDescriptorSet
    from google.protobuf.timestamp_pb2 import Timestamp
except ImportError as error:
    raise MissingExtraError("recording", "record", cause=str(error)) from None

if TYPE_CHECKING:
    from google.protobuf.message import Message

__all__ = [
    "CameraCalibration",
    "CompressedImage",
    "CompressedVideo",
    "FrameTransform",
    "ImageAnnotations",
    "Log",
    "PoseInFrame",
    "PosesInFrame",
]

LINE_WIDTH: Final = 2.0  # width of the lines of a drawing [px]
FONT_SIZE: Final = 14.0  # size of its texts [px]
_LEVELS: Final = {Severity.INFO: Log.INFO, Severity.WARNING: Log.WARNING, Severity.ERROR: Log.ERROR}


def schema(message: type[Message]) -> bytes:
    """Return the file descriptor set of a message, including all its dependencies, as MCAP requires."""
    found = FileDescriptorSet()
    seen: set[str] = set()

    def add(file: Any) -> None:
        if file.name not in seen:
            seen.add(file.name)
            for needed in file.dependencies:
                add(needed)
            file.CopyToProto(found.file.add())

    add(message.DESCRIPTOR.file)
    return found.SerializeToString()


def timestamp(unix_ns: int) -> Timestamp:
    """Convert Unix time [ns] to a protobuf timestamp."""
    seconds, nanos = divmod(unix_ns, 1_000_000_000)
    return Timestamp(seconds=seconds, nanos=nanos)


# Images --------------------------------------------------------------------------------------------------------


def image(drone: str, camera: str, captured_ns: int, data: bytes, format_: str) -> bytes:
    """Encode an image file (``jpeg`` or ``png``) captured at the given Unix time."""
    message = CompressedImage(
        timestamp=timestamp(captured_ns), frame_id=optical_frame(drone, camera), data=data, format=format_
    )
    return message.SerializeToString()


def video(drone: str, camera: str, captured_ns: int, data: bytes) -> bytes:
    """Encode one H.264 frame: an access unit in Annex B format, with SPS and PPS if it is a key frame."""
    message = CompressedVideo(
        timestamp=timestamp(captured_ns), frame_id=optical_frame(drone, camera), data=data, format=H264
    )
    return message.SerializeToString()


def calibration(drone: str, camera: str, at_ns: int, width: int, height: int, intrinsics: Intrinsics) -> bytes:
    """Encode a camera's intrinsics for images of the given size [px]."""
    fx, fy, cx, cy = intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy
    message = CameraCalibration(
        timestamp=timestamp(at_ns),
        frame_id=optical_frame(drone, camera),
        width=width,
        height=height,
        distortion_model="kannala_brandt" if intrinsics.model == "fisheye" else "plumb_bob",
        D=_coefficients(intrinsics),
        K=(fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0),
        R=(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0),
        P=(fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0),
    )
    return message.SerializeToString()


def _coefficients(intrinsics: Intrinsics) -> Sequence[float]:
    """Return the distortion coefficients that viewers expect: 4 for a fisheye, 5 for a pinhole camera."""
    wanted = 4 if intrinsics.model == "fisheye" else 5
    given = intrinsics.distortion
    return given if len(given) > wanted else (*given, *[0.0] * (wanted - len(given)))


# Poses ---------------------------------------------------------------------------------------------------------


def pose(feedback: Feedback) -> Pose | None:
    """Return the vehicle's pose in world axes, or None while its attitude is unknown.

    If the position is unknown, place the drone above the origin, so that at least its attitude and height are visible.
    """
    if feedback.roll_rad is None or feedback.pitch_rad is None or feedback.yaw_rad is None:
        return None
    x, y, z = feedback.position_m or (0.0, 0.0, feedback.altitude_m or 0.0)
    return Pose(
        position=Vector3(x=x, y=y, z=z), orientation=quaternion(feedback.roll_rad, feedback.pitch_rad, feedback.yaw_rad)
    )


def quaternion(roll: float, pitch: float, yaw: float) -> Quaternion:
    """Return the quaternion of the rotation Rz(yaw) · Ry(pitch) · Rx(roll); angles in rad."""
    x, y, z, w = quaternion_from_euler(roll, pitch, yaw)
    return Quaternion(x=x, y=y, z=z, w=w)


def pose_of(values: Sequence[float]) -> Pose:
    """Build a pose from a position [m] and a quaternion, in the order x, y, z, qx, qy, qz, qw."""
    x, y, z, qx, qy, qz, qw = values[:7]
    return Pose(position=Vector3(x=x, y=y, z=z), orientation=Quaternion(x=qx, y=qy, z=qz, w=qw))


def pose_in_world(at_ns: int, place: Pose) -> bytes:
    """Encode a pose in world axes."""
    return PoseInFrame(timestamp=timestamp(at_ns), frame_id=WORLD, pose=place).SerializeToString()


def path_in_world(at_ns: int, places: Iterable[Pose]) -> bytes:
    """Encode a path in world axes."""
    return PosesInFrame(timestamp=timestamp(at_ns), frame_id=WORLD, poses=places).SerializeToString()


def world_to_drone(drone: str, at_ns: int, place: Pose) -> bytes:
    """Encode the transform from the world frame to a drone's frame."""
    return _transform(WORLD, drone, at_ns, place.position, place.orientation)


def drone_to_camera(drone: str, camera: CameraInfo, at_ns: int) -> bytes | None:
    """Encode a camera's mounting, or return None if it is unknown."""
    if camera.rotation is None:
        return None
    import numpy as np

    from skyloop.messages.geometry import euler_from_rotation

    x, y, z = camera.position_m or (0.0, 0.0, 0.0)
    turned = quaternion(*euler_from_rotation(np.array(camera.rotation).reshape(3, 3)))
    return _transform(drone, optical_frame(drone, camera.name), at_ns, Vector3(x=x, y=y, z=z), turned)


def _transform(parent: str, child: str, at_ns: int, translation: Vector3, rotation: Quaternion) -> bytes:
    return FrameTransform(
        timestamp=timestamp(at_ns),
        parent_frame_id=parent,
        child_frame_id=child,
        translation=translation,
        rotation=rotation,
    ).SerializeToString()


# Drawings and texts --------------------------------------------------------------------------------------------


def drawing(annotation: Annotation, captured_ns: int) -> bytes:
    """Encode the drawing on a frame captured at the given Unix time."""
    message = ImageAnnotations()
    at = timestamp(captured_ns)
    for shape in annotation.shapes:
        _draw(message, shape, at)
    return message.SerializeToString()


def _draw(message: ImageAnnotations, shape: Shape, at: Timestamp) -> None:
    colour = _colour(shape.colour)
    if isinstance(shape, Text):
        message.texts.add(
            timestamp=at, position=_point(shape.at), text=shape.text, font_size=FONT_SIZE, text_color=colour
        )
        return
    kind = PointsAnnotation.POINTS
    if isinstance(shape, Polyline):
        kind = PointsAnnotation.LINE_LOOP if shape.closed else PointsAnnotation.LINE_STRIP
    assert isinstance(shape, Polyline | Points)
    message.points.add(
        timestamp=at,
        type=kind,
        points=[_point(point) for point in shape.points],
        outline_color=colour,
        thickness=LINE_WIDTH,
    )


def _point(point: Point) -> Point2:
    return Point2(x=point[0], y=point[1])


def _colour(colour: Colour) -> Color:
    red, green, blue = (channel / 255 for channel in colour)
    return Color(r=red, g=green, b=blue, a=1.0)


def log(drone: str, at_ns: int, severity: Severity, text: str, source: str) -> bytes:
    """Encode a line of log text."""
    message = Log(timestamp=timestamp(at_ns), level=_LEVELS[severity], message=text, name=drone, file=source)
    return message.SerializeToString()
