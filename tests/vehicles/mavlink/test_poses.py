"""External poses as the autopilots receive them."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from scipy.spatial.transform import Rotation

from skyloop.clock import NS_PER_S
from skyloop.drivers.base import ExternalPose
from skyloop.errors import DriverError
from skyloop.messages.geometry import quaternion_from_euler
from skyloop.vehicles.mavlink.microservices import pose_message
from skyloop.vehicles.mavlink.options import PoseMessage
from skyloop.vehicles.mavlink.wire.axes import angles_of, from_wire

#: 1 m east, 2 m north, 3 m up; left turned 30° from east, nose down 10°, right side down 5°.
POSE = ExternalPose(
    (1.0, 2.0, 3.0),
    quaternion_from_euler(math.radians(5), math.radians(10), math.radians(30)),
    1_234_567_890,
    0.01,
    0.02,
)
ANGLES = (math.radians(5), math.radians(-10), math.radians(60))  # positive: nose up, and clockwise from north


def test_as_odometry() -> None:
    message = pose_message(POSE, PoseMessage.ODOMETRY)
    assert message.time_usec == 1_234_567
    assert (message.frame_id, message.child_frame_id) == (1, 12)
    assert (message.x, message.y, message.z) == (2.0, 1.0, -3.0)
    assert angles_of(from_wire(message.q)) == pytest.approx(ANGLES)
    assert message.pose_covariance[:8] == pytest.approx([1e-4, 0, 0, 0, 0, 0, 1e-4, 0])
    assert message.pose_covariance[20] == pytest.approx(4e-4)
    assert math.isnan(message.vx)
    assert math.isnan(message.velocity_covariance[0])


def test_the_quaternion_has_mavlinks_axes_and_order() -> None:
    x, y, z, w = Rotation.from_euler("ZYX", ANGLES[::-1]).as_quat()
    assert len({round(abs(each), 3) for each in (x, y, z, w)}) == 4, "all orders differ"
    assert pose_message(POSE, PoseMessage.ODOMETRY).q == pytest.approx([w, x, y, z])


def test_the_poses_quaternion_is_scipys() -> None:
    turned = Rotation.from_quat(POSE.quaternion).as_euler("ZYX", degrees=True)
    assert turned == pytest.approx((30, 10, 5))


def test_as_a_vision_estimate_of_unknown_accuracy() -> None:
    message = pose_message(ExternalPose(POSE.position_m, POSE.quaternion, POSE.captured_ns), PoseMessage.VISION)
    assert (message.usec, message.x, message.y, message.z) == (1_234_567, 2.0, 1.0, -3.0)
    assert (message.roll, message.pitch, message.yaw) == pytest.approx(ANGLES)
    assert math.isnan(message.covariance[0])


def test_a_pose_from_the_future_is_refused_or_dated_now() -> None:
    """After one with a wrong clock, all poses with the right time would look old."""
    for ahead_ns, taken in ((-NS_PER_S, -NS_PER_S), (0, 0), (NS_PER_S // 50, 0)):
        pose = replace(POSE, captured_ns=5 * NS_PER_S + ahead_ns)
        assert pose.bounded(5 * NS_PER_S).captured_ns == 5 * NS_PER_S + taken
    with pytest.raises(DriverError, match=r"stamped 0\.1 s ahead"):
        replace(POSE, captured_ns=5 * NS_PER_S + NS_PER_S // 10).bounded(5 * NS_PER_S)
