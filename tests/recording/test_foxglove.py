"""Messages for viewers, decoded by the public classes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.ImageAnnotations_pb2 import ImageAnnotations
from foxglove_schemas_protobuf.Log_pb2 import Log
from foxglove_schemas_protobuf.PointsAnnotation_pb2 import PointsAnnotation
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from hypothesis import given
from hypothesis import strategies as st

from skyloop.messages import Annotation, CameraInfo, Feedback, Intrinsics, Severity
from skyloop.messages.geometry import rotation_from_euler
from skyloop.recording import foxglove
from tests.support.recording_files import read_image, read_pose
from tests.support.samples import CAMERA, SAMPLES

AT_NS = 1_700_000_000_123_456_789
angles = st.floats(-math.pi, math.pi)


def matrix(x: float, y: float, z: float, w: float) -> np.ndarray:
    """Return the rotation matrix of a quaternion, shape (3, 3)."""
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


@given(angles, angles, angles)
def test_quaternions_match_the_attitude(roll: float, pitch: float, yaw: float) -> None:
    q = foxglove.quaternion(roll, pitch, yaw)
    assert matrix(q.x, q.y, q.z, q.w) == pytest.approx(rotation_from_euler(roll, pitch, yaw), abs=1e-9)


def test_a_pose_with_a_position_and_one_without() -> None:
    known = Feedback(
        captured_ns=1, roll_rad=0.0, pitch_rad=0.0, yaw_rad=math.pi / 2, altitude_m=9.0, position_m=(1.0, 2.0, 3.0)
    )
    place = foxglove.pose(known)
    assert place is not None
    message = PoseInFrame.FromString(foxglove.pose_in_world(AT_NS, place))
    assert (message.frame_id, message.timestamp.seconds, message.timestamp.nanos) == (
        "world",
        1_700_000_000,
        123_456_789,
    )
    assert read_pose(message.SerializeToString())[0] == (1.0, 2.0, 3.0)
    assert message.pose.orientation.z == pytest.approx(math.sqrt(0.5))
    above = foxglove.pose(Feedback(captured_ns=1, roll_rad=0.0, pitch_rad=0.0, yaw_rad=0.0, altitude_m=1.5))
    assert above is not None
    assert (above.position.x, above.position.y, above.position.z) == (0.0, 0.0, 1.5)
    assert foxglove.pose(Feedback(captured_ns=1, altitude_m=1.5)) is None
    transform = FrameTransform.FromString(foxglove.world_to_drone("alpha", AT_NS, place))
    assert (transform.parent_frame_id, transform.child_frame_id) == ("world", "alpha")
    assert len(PosesInFrame.FromString(foxglove.path_in_world(AT_NS, [place, above])).poses) == 2


def test_a_camera_is_mounted_where_the_vehicle_says() -> None:
    data = foxglove.drone_to_camera("alpha", CAMERA, AT_NS)
    assert data is not None
    transform = FrameTransform.FromString(data)
    assert (transform.parent_frame_id, transform.child_frame_id) == ("alpha", "alpha/front")
    assert CAMERA.rotation is not None
    q = transform.rotation
    assert matrix(q.x, q.y, q.z, q.w) == pytest.approx(np.array(CAMERA.rotation).reshape(3, 3), abs=1e-9)
    assert transform.translation.x == 0.1
    assert foxglove.drone_to_camera("alpha", CameraInfo("front", 4, 3, 30.0), AT_NS) is None


def test_an_image_round_trips() -> None:
    data = foxglove.image("alpha", "front", AT_NS, b"\xff\xd8picture", "jpeg")
    message = CompressedImage.FromString(data)
    assert (message.frame_id, message.format) == ("alpha/front", "jpeg")
    assert read_image(data) == (b"\xff\xd8picture", "jpeg")


@pytest.mark.parametrize(
    ("model", "given", "name", "coefficients"),
    [
        ("pinhole", (), "plumb_bob", [0.0] * 5),
        ("pinhole", (0.1, 0.2, 0.3, 0.4), "plumb_bob", [0.1, 0.2, 0.3, 0.4, 0.0]),
        ("fisheye", (0.1, 0.2), "kannala_brandt", [0.1, 0.2, 0.0, 0.0]),
    ],
)
def test_calibration(model: str, given: tuple[float, ...], name: str, coefficients: list[float]) -> None:
    intrinsics = Intrinsics(300.0, 310.0, 160.0, 120.0, given, model)
    message = CameraCalibration.FromString(foxglove.calibration("alpha", "front", AT_NS, 320, 240, intrinsics))
    assert (message.width, message.height, message.distortion_model) == (320, 240, name)
    assert list(message.D) == coefficients
    assert np.array(message.K).reshape(3, 3) == pytest.approx(intrinsics.matrix)
    assert np.array(message.P).reshape(3, 4)[:, :3] == pytest.approx(intrinsics.matrix)


def test_drawings() -> None:
    annotation = SAMPLES["annotation"]
    assert isinstance(annotation, Annotation)
    message = ImageAnnotations.FromString(foxglove.drawing(annotation, AT_NS))
    line, points = message.points
    assert line.type == PointsAnnotation.LINE_LOOP
    assert [(p.x, p.y) for p in line.points] == [(10.0, 10.0), (50.0, 10.5), (50.0, 50.0)]
    assert line.outline_color.r == 1.0
    assert points.type == PointsAnnotation.POINTS
    (text,) = message.texts
    assert (text.text, text.position.x) == ("1.52 m", 10.0)


def test_log_lines() -> None:
    message = Log.FromString(foxglove.log("alpha", AT_NS, Severity.WARNING, "look out", "follow.py"))
    assert (message.level, message.message, message.name, message.file) == (
        Log.WARNING,
        "look out",
        "alpha",
        "follow.py",
    )


def test_a_schema_has_all_its_dependencies() -> None:
    found = FileDescriptorSet.FromString(foxglove.schema(foxglove.ImageAnnotations))
    names = [file.name for file in found.file]
    assert len(names) == len(set(names))
    for place, file in enumerate(found.file):
        assert set(file.dependency) <= set(names[:place]), "a file follows its imports"
