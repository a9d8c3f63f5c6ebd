"""MAVLink's axes and ours.

World: north, east, down there; east, north, up here. Body: forward, right, down there;
forward, left, up here. Yaw: clockwise from north there; counter-clockwise from east here. Quaternions: w, x, y, z in
messages, x, y, z, w in all code. Pure.

``flip`` and ``swap`` are their own inverses, and so is :func:`yaw_between`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from skyloop.messages.geometry import wrap_angle

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]  #: x, y, z, w

_HALF = math.sqrt(0.5)


def flip(x: float, y: float, z: float) -> Vector:
    """Body axes, either way."""
    return x, 0.0 - y, 0.0 - z


def swap(x: float, y: float, z: float) -> Vector:
    """World axes, either way."""
    return y, x, 0.0 - z


def yaw_between(yaw: float) -> float:
    """Heading, either way."""
    return wrap_angle(math.pi / 2 - yaw)


def to_wire(q: Quaternion) -> list[float]:
    """A quaternion (x, y, z, w) as the field ``q`` of a message: w, x, y, z."""
    x, y, z, w = q
    return [w, x, y, z]


def from_wire(q: Sequence[float]) -> Quaternion:
    """The field ``q`` of a message (w, x, y, z) as x, y, z, w."""
    w, x, y, z = q
    return x, y, z, w


def turned_axes(q: Sequence[float]) -> Quaternion:
    """A rotation from body to world, w, x, y, z, from our axes to MAVLink's or back, up to its sign."""
    w, x, y, z = q
    return _HALF * (w + z), _HALF * (x + y), _HALF * (x - y), _HALF * (w - z)


def angles_of(q: Quaternion) -> Vector:
    """Roll, pitch and yaw of a unit quaternion (x, y, z, w)."""
    x, y, z, w = q
    return (
        math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
        math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x)))),
        math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
    )
