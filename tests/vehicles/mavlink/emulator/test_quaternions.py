"""Attitude quaternions: MAVLink's axes and order in messages, ours elsewhere."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest
from scipy.spatial.transform import Rotation

from skyloop.messages import Attitude
from skyloop.vehicles.mavlink.emulator.manoeuvres import attitude_target_of
from skyloop.vehicles.mavlink.emulator.telemetry import MAKERS
from skyloop.vehicles.mavlink.manoeuvres import AttitudeSetpoint
from skyloop.vehicles.mavlink.wire.codec import dialect as m

ROLL, PITCH, YAW = math.radians(5), math.radians(10), math.radians(30)  # ours: right down, nose down, to the left
#: Forward, right, down to north, east, down; all of its numbers differ.
X, Y, Z, W = Rotation.from_euler("ZYX", [math.radians(60), math.radians(-10), math.radians(5)]).as_quat().tolist()


def test_a_flown_attitude() -> None:
    thrust: Any = SimpleNamespace(thrust=lambda *_: 0.5)
    vehicle: Any = SimpleNamespace(yaw=math.radians(60), velocity=None)
    message = AttitudeSetpoint(Attitude(ROLL, PITCH), thrust).message(vehicle, (1, 1), 0)
    assert message.q == pytest.approx([W, X, Y, Z])


def test_a_requested_attitude() -> None:
    message = m.MAVLink_set_attitude_target_message(0, 1, 1, 7, [W, X, Y, Z], 0, 0, 0, 0.5)
    target = attitude_target_of(message)
    assert target.attitude == pytest.approx((ROLL, PITCH, YAW))
    assert target.unit


def test_a_reported_attitude() -> None:
    believed = SimpleNamespace(roll_rad=ROLL, pitch_rad=PITCH, yaw_rad=YAW, angular_velocity_rad_s=(0.1, 0.2, 0.3))
    autopilot: Any = SimpleNamespace(boot_ms=7, report=SimpleNamespace(believed=believed))
    message: Any = MAKERS[m.MAVLINK_MSG_ID_ATTITUDE_QUATERNION](autopilot)
    assert (message.q1, message.q2, message.q3, message.q4) == pytest.approx((W, X, Y, Z))
