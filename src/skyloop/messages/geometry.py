"""Compute with bounded numbers, angles, rotation matrices and quaternions, in the axes of ROS REP 103.

Limits never pass on NaN: they treat it as 0 or, if 0 is out of range, as the limit closest to 0.
"""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

_Angle = TypeVar("_Angle", float, NDArray[np.float64])


def rotation_from_euler(roll: float, pitch: float, yaw: float) -> NDArray[np.float64]:
    """Return the rotation from body axes to world axes, shape (3, 3): ``Rz(yaw) @ Ry(pitch) @ Rx(roll)``.

    Angles [rad] are positive with the right side down, with the nose down, and counter-clockwise seen from above.
    """
    cr, sr = math.cos(roll), math.sin(roll)
    cp, sp = math.cos(pitch), math.sin(pitch)
    cy, sy = math.cos(yaw), math.sin(yaw)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def quaternion_from_euler(roll: float, pitch: float, yaw: float) -> tuple[float, float, float, float]:
    """Return the rotation of :func:`rotation_from_euler` as a unit quaternion (x, y, z, w), as in SciPy and ROS."""
    cr, sr = math.cos(roll / 2), math.sin(roll / 2)
    cp, sp = math.cos(pitch / 2), math.sin(pitch / 2)
    cy, sy = math.cos(yaw / 2), math.sin(yaw / 2)
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


def euler_from_rotation(rotation: NDArray[np.float64]) -> tuple[float, float, float]:
    """Return roll, pitch (within ±π/2) and yaw [rad] of a rotation from body axes to world axes, shape (3, 3)."""
    pitch = math.asin(max(-1.0, min(1.0, -float(rotation[2, 0]))))
    roll = math.atan2(float(rotation[2, 1]), float(rotation[2, 2]))
    yaw = math.atan2(float(rotation[1, 0]), float(rotation[0, 0]))
    return roll, pitch, yaw


def wrap_angle(angle: _Angle) -> _Angle:
    """Wrap an angle, or each angle in an array, to [-π, π) [rad]."""
    return (angle + math.pi) % (2 * math.pi) - math.pi


def turned(x: float, y: float, angle: float) -> tuple[float, float]:
    """Rotate a vector by an angle [rad], counter-clockwise; the yaw turns levelled body axes into world axes."""
    cos, sin = math.cos(angle), math.sin(angle)
    return cos * x - sin * y, sin * x + cos * y


def within(value: float, low: float, high: float) -> float:
    """Limit ``value`` to the range from ``low`` to ``high``; NaN counts as 0."""
    return max(low, min(high, 0.0 if math.isnan(value) else value))


def clamped(value: float, longest: float) -> float:
    """Limit ``value`` to ±``longest``; NaN counts as 0."""
    return within(value, -longest, longest)


def in_16_bits(value: float) -> int:
    """Round and limit ``value`` to a signed 16-bit integer."""
    return round(within(value, -0x8000, 0x7FFF))
