"""MAVLink's axes and ours.

World: north, east, down there; east, north, up here. Body: forward, right, down there;
forward, left, up here. Yaw: clockwise from north there; counter-clockwise from east here. Pure.

``flip`` and ``swap`` are their own inverses, and so is :func:`yaw_between`.
"""

from __future__ import annotations

import math

from skyloop.messages.geometry import wrap_angle

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]  #: w, x, y, z


def flip(x: float, y: float, z: float) -> Vector:
    """Body axes, either way."""
    return x, 0.0 - y, 0.0 - z


def swap(x: float, y: float, z: float) -> Vector:
    """World axes, either way."""
    return y, x, 0.0 - z


def yaw_between(yaw: float) -> float:
    """Heading, either way."""
    return wrap_angle(math.pi / 2 - yaw)


def angles_of(q: Quaternion) -> Vector:
    """Roll, pitch and yaw of a unit quaternion."""
    w, x, y, z = q
    return (
        math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
        math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x)))),
        math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
    )


def turned(forward: float, left: float, yaw: float) -> tuple[float, float]:
    """Levelled body axes to east and north, for a yaw of ours; by ``-yaw`` the other way."""
    cos, sin = math.cos(yaw), math.sin(yaw)
    return cos * forward - sin * left, sin * forward + cos * left
