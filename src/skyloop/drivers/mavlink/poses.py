"""Poses from outside as MAVLink's messages. Pure.

Times are microseconds of our own clock: ``TIMESYNC`` tells it to the vehicle.
"""

from __future__ import annotations

import math
from typing import Final

from skyloop.drivers.mavlink.options import PoseMessage
from skyloop.drivers.seams import ExternalPose
from skyloop.messages.geometry import quaternion_from_euler
from skyloop.wire.mavlink.axes import Quaternion, angles_of, swap, yaw_between
from skyloop.wire.mavlink.codec import Message
from skyloop.wire.mavlink.codec import dialect as m

WORLD: Final = m.MAV_FRAME_LOCAL_NED
BODY: Final = m.MAV_FRAME_BODY_FRD
_NAN: Final = math.nan


def pose_message(pose: ExternalPose, kind: PoseMessage) -> Message:
    """North, east, down, and angles of a body whose axes are forward, right, down."""
    position = swap(*pose.position)
    roll, pitch, yaw = angles_of(pose.quaternion)
    angles = roll, 0.0 - pitch, yaw_between(yaw)
    covariance = _covariance(pose)
    if kind is PoseMessage.VISION:
        return m.MAVLink_vision_position_estimate_message(pose.captured_ns // 1000, *position, *angles, covariance, 0)
    q: Quaternion = quaternion_from_euler(*angles)
    unknown = [_NAN] * 21
    estimator = m.MAV_ESTIMATOR_TYPE_MOCAP
    return m.MAVLink_odometry_message(
        pose.captured_ns // 1000, WORLD, BODY, *position, list(q), *[_NAN] * 6, covariance, unknown, 0, estimator, 100
    )


def _covariance(pose: ExternalPose) -> list[float]:
    """The upper right triangle of x, y, z, roll, pitch, yaw; its first number is NaN where nothing is known."""
    if pose.position_std_m is None or pose.attitude_std_rad is None:
        return [_NAN] * 21
    variances = [pose.position_std_m**2] * 3 + [pose.attitude_std_rad**2] * 3
    return [variances[row] if row == column else 0.0 for row in range(6) for column in range(row, 6)]
