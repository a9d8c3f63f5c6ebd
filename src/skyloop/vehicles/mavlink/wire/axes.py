"""Conversions between MAVLink's axes and ours. Pure.

World axes: MAVLink uses north, east, down; we use east, north, up. Body axes: MAVLink uses forward, right, down; we use
forward, left, up. Yaw: MAVLink measures clockwise from north; we measure counter-clockwise from east. Quaternions are
w, x, y, z in messages and x, y, z, w everywhere in the code.

:func:`flip`, :func:`swap` and :func:`yaw_between` are their own inverses. :class:`WorldAxes` moves the origin.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

from skyloop.messages.feedback import EarthOrigin
from skyloop.messages.geometry import wrap_angle
from skyloop.vehicles.mavlink.wire.codec import Message
from skyloop.vehicles.mavlink.wire.codec import dialect as m

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]  #: x, y, z, w

_HALF = math.sqrt(0.5)


def flip(x: float, y: float, z: float) -> Vector:
    """Convert between our body axes and MAVLink's, in either direction."""
    return x, 0.0 - y, 0.0 - z


def swap(x: float, y: float, z: float) -> Vector:
    """Convert between our world axes and MAVLink's, in either direction."""
    return y, x, 0.0 - z


def yaw_between(yaw: float) -> float:
    """Convert between our heading and MAVLink's, in either direction."""
    return wrap_angle(math.pi / 2 - yaw)


def to_wire(q: Quaternion) -> list[float]:
    """Convert a quaternion (x, y, z, w) to a message's field ``q`` (w, x, y, z)."""
    x, y, z, w = q
    return [w, x, y, z]


def from_wire(q: Sequence[float]) -> Quaternion:
    """Convert a message's field ``q`` (w, x, y, z) to x, y, z, w."""
    w, x, y, z = q
    return x, y, z, w


def turned_axes(q: Sequence[float]) -> tuple[float, float, float, float]:
    """Convert a body-to-world rotation (w, x, y, z) between our axes and MAVLink's, up to the quaternion's sign."""
    w, x, y, z = q
    return _HALF * (w + z), _HALF * (x + y), _HALF * (x - y), _HALF * (w - z)


def angles_of(q: Quaternion) -> Vector:
    """Return the roll, pitch and yaw of a unit quaternion (x, y, z, w)."""
    x, y, z, w = q
    return (
        math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
        math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x)))),
        math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
    )


ORIGIN: Final = "GPS_GLOBAL_ORIGIN"  #: the message with the origin of the autopilot's axes
ORIGIN_HZ: Final = 1.0  #: rate at which that message is requested
_POSITIONS: Final = ("SET_POSITION_TARGET_LOCAL_NED", "ODOMETRY", "VISION_POSITION_ESTIMATE")


class WorldAxes:
    """Converts positions in messages between the world's axes and the autopilot's, which are parallel.

    This is needed for autopilots whose axes have their origin at the first fix. ArduPilot refuses another origin while
    it uses GPS, so each of several vehicles would have its own origin. ``begin`` is the world's origin: latitude and
    longitude [°] and altitude [m]; None for the autopilot's own origin.
    """

    def __init__(self, begin: tuple[float, float, float] | None) -> None:
        self.begin = begin
        self._shift: Vector | None = None if begin is not None else (0.0, 0.0, 0.0)  # origin's offset north, east, down

    def forget(self) -> None:
        """Forget the autopilot's origin, because the autopilot may have rebooted."""
        if self.begin is not None:
            self._shift = None

    def received(self, message: Message, radius_m: float) -> bool:
        """Convert the vehicle's local position to the world's axes; return whether the message can be used."""
        if self.begin is None:
            return True
        kind = message.get_type()
        if kind == ORIGIN:
            world = EarthOrigin(*self.begin, radius_m)
            theirs = message.latitude / 1e7, message.longitude / 1e7, message.altitude / 1000.0
            self._shift = swap(*world.position_of(*theirs))
        return kind != "LOCAL_POSITION_NED" or self._move(message, 1.0)

    def sent(self, message: Message) -> bool:
        """Convert a position to the vehicle's own axes; return whether to send the message."""
        if self.begin is None or message.get_type() not in _POSITIONS:
            return True
        if getattr(message, "coordinate_frame", m.MAV_FRAME_LOCAL_NED) != m.MAV_FRAME_LOCAL_NED:
            return True  # a velocity in body axes
        return self._move(message, -1.0)

    def _move(self, message: Message, sign: float) -> bool:
        if self._shift is None:
            return False
        north, east, down = self._shift
        message.x += sign * north
        message.y += sign * east
        message.z += sign * down
        return True
