"""Rotations: axes, signs and inverses."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from skyloop.messages import Feedback
from skyloop.messages.geometry import (
    clamped,
    euler_from_rotation,
    in_16_bits,
    quaternion_from_euler,
    rotation_from_euler,
    turned,
    within,
    wrap_angle,
)

angles = st.floats(-math.pi + 1e-6, math.pi - 1e-6)
pitches = st.floats(-math.pi / 2 + 1e-3, math.pi / 2 - 1e-3)


@pytest.mark.parametrize(
    ("roll", "pitch", "yaw", "body", "world"),
    [
        (0.0, 0.0, math.pi / 2, (1, 0, 0), (0, 1, 0)),  # facing north
        (0.0, 0.1, 0.0, (1, 0, 0), (math.cos(0.1), 0, -math.sin(0.1))),  # nose down
        (0.1, 0.0, 0.0, (0, 1, 0), (0, math.cos(0.1), math.sin(0.1))),  # right side down lifts the left one
    ],
)
def test_signs(roll: float, pitch: float, yaw: float, body: tuple[float, ...], world: tuple[float, ...]) -> None:
    assert rotation_from_euler(roll, pitch, yaw) @ np.array(body) == pytest.approx(np.array(world))


@given(angles, pitches, angles)
def test_round_trip(roll: float, pitch: float, yaw: float) -> None:
    rotation = rotation_from_euler(roll, pitch, yaw)
    assert rotation @ rotation.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    assert euler_from_rotation(rotation) == pytest.approx((roll, pitch, yaw), abs=1e-6)


@given(angles, pitches, angles)
def test_a_quaternion_matches_scipy(roll: float, pitch: float, yaw: float) -> None:
    rotation = Rotation.from_quat(quaternion_from_euler(roll, pitch, yaw))  # x, y, z, w
    assert rotation.as_matrix() == pytest.approx(rotation_from_euler(roll, pitch, yaw), abs=1e-9)


@given(st.floats(-100, 100))
def test_wrapped_angles_are_the_same_angle(angle: float) -> None:
    wrapped = wrap_angle(angle)
    assert -math.pi <= wrapped < math.pi
    assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-9)
    assert math.sin(wrapped) == pytest.approx(math.sin(angle), abs=1e-9)


def test_a_quarter_turn_is_counter_clockwise() -> None:
    assert turned(1.0, 0.0, math.pi / 2) == pytest.approx((0.0, 1.0))


def test_nan_counts_as_the_middle_of_a_range() -> None:
    assert (clamped(math.nan, 2.0), within(math.nan, 2.0, 3.0), in_16_bits(math.nan)) == (0.0, 2.0, 0)
    assert (in_16_bits(4e4), in_16_bits(-math.inf)) == (32767, -32768)


def test_feedback_has_a_rotation_once_the_attitude_is_known() -> None:
    known = Feedback(captured_ns=1, roll_rad=0.1, pitch_rad=-0.2, yaw_rad=0.3)
    assert euler_from_rotation(known.rotation) == pytest.approx((0.1, -0.2, 0.3))
    with pytest.raises(ValueError, match="not reported its attitude"):
        _ = Feedback(captured_ns=1, roll_rad=0.1, pitch_rad=None, yaw_rad=0.3).rotation
