"""Positions in axes that begin where we say, for an autopilot that lets its own begin where it got its first fix. Pure.

ArduPilot refuses an origin while it flies by satellites; several vehicles would then have several axes.
"""

from __future__ import annotations

from typing import Final

from skyloop.messages.feedback import EarthOrigin
from skyloop.vehicles.mavlink.wire.axes import Vector, swap
from skyloop.vehicles.mavlink.wire.codec import Message
from skyloop.vehicles.mavlink.wire.codec import dialect as m

ORIGIN: Final = "GPS_GLOBAL_ORIGIN"  #: says where the autopilot's axes begin
ORIGIN_HZ: Final = 1.0
_POSITIONS: Final = ("SET_POSITION_TARGET_LOCAL_NED", "ODOMETRY", "VISION_POSITION_ESTIMATE")


class WorldAxes:
    """Moves the positions in messages between the world's axes and the autopilot's. Both point the same way.

    Args:
        begin: Latitude and longitude [°] and altitude [m] of where the world's axes begin; None: where the autopilot's
            do.
    """

    def __init__(self, begin: tuple[float, float, float] | None) -> None:
        self.begin = begin
        self._shift: Vector | None = None if begin is not None else (0.0, 0.0, 0.0)  # north, east, down, of theirs

    def forget(self) -> None:
        """Forget where the autopilot's axes begin: it may have been started again."""
        if self.begin is not None:
            self._shift = None

    def received(self, message: Message, radius_m: float) -> bool:
        """Move a position of the vehicle's into the world's axes; return whether the message is of use.

        Args:
            message: Of any kind. A local position is changed.
            radius_m: Of the sphere that the autopilot takes the earth for [m].
        """
        if self.begin is None:
            return True
        kind = message.get_type()
        if kind == ORIGIN:
            world = EarthOrigin(*self.begin, radius_m)
            theirs = message.latitude / 1e7, message.longitude / 1e7, message.altitude / 1000.0
            self._shift = swap(*world.position_of(*theirs))
        return kind != "LOCAL_POSITION_NED" or self._move(message, 1.0)

    def sent(self, message: Message) -> bool:
        """Move a position for the vehicle into its own axes; return whether the message is to be sent."""
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
