"""Set-point messages to targets in our axes. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from skyloop.vehicles.emulation.flight import USUAL, FlightControl, Speeds
from skyloop.vehicles.mavlink.emulator.places import on_earth, place_of
from skyloop.vehicles.mavlink.wire.axes import Vector, angles_of, flip, from_wire, swap, yaw_between
from skyloop.vehicles.mavlink.wire.codec import Message

WORLD: Final = 1  #: MAV_FRAME_LOCAL_NED
WORLD_OFFSET: Final = 7
BODY: Final = 8
BODY_OFFSET: Final = 9
_POSITION: Final = 0x007
_VELOCITY: Final = 0x038
_YAW: Final = 0x400
_YAW_RATE: Final = 0x800
_NO_RATES: Final = 0x07
_NO_THRUST: Final = 0x40
_NO_ATTITUDE: Final = 0x80
_UNIT_WITHIN: Final = 1e-3


@dataclass(frozen=True, slots=True)
class Target:
    """What ``SET_POSITION_TARGET_LOCAL_NED`` and ``…_GLOBAL_INT`` ask for, in our axes. None: not asked for."""

    place: Vector | None
    velocity: Vector | None = None
    in_body: bool = False
    yaw: float | None = None
    yaw_rate: float = 0.0

    def follow(self, flight: FlightControl, speeds: Speeds = USUAL, turn: float | None = None) -> None:
        """Fly it. Called at every tick.

        Args:
            flight: What flies.
            speeds: The greatest ones on the way to a position.
            turn: A yaw rate instead of its own [rad/s].
        """
        if turn is None:
            turn = self.yaw_rate if self.yaw is None else flight.yaw_rate_to(self.yaw)
        if self.velocity is not None and self.place is None:
            move = flight.move_body if self.in_body else flight.move
            x, y, z = (0.0 if math.isnan(each) else each for each in self.velocity)
            move(x, y, z, turn)
        elif self.place is not None:
            flight.go(self.place, speeds, yaw_rate=turn)
        else:
            flight.hold()


def target_of(message: Message) -> Target:
    """Return the target of ``SET_POSITION_TARGET_LOCAL_NED``, its numbers finite or not."""
    mask, in_body = message.type_mask, message.coordinate_frame in (BODY, BODY_OFFSET)
    turn = flip if in_body else swap
    return Target(
        place=None if mask & _POSITION == _POSITION else swap(message.x, message.y, message.z),
        velocity=None if mask & _VELOCITY == _VELOCITY else turn(message.vx, message.vy, message.vz),
        in_body=in_body,
        yaw=None if mask & _YAW else yaw_between(message.yaw),
        yaw_rate=0.0 if mask & _YAW_RATE else -message.yaw_rate,
    )


def global_target_of(message: Message, datum: float | None) -> Target | None:
    """Return the target of ``SET_POSITION_TARGET_GLOBAL_INT``.

    Args:
        message: The set-point.
        datum: How high its altitude 0 is above our origin [m]; None for an unknown frame.

    Returns:
        None for a position that does not exist, or that is in an unknown frame.
    """
    mask, place = message.type_mask, None
    if not mask & _POSITION:
        latitude, longitude = message.lat_int / 1e7, message.lon_int / 1e7
        if datum is None or not on_earth(latitude, longitude):
            return None
        place = place_of(latitude, longitude, datum + message.alt)
    return Target(
        place=place,
        velocity=None if mask & _VELOCITY else swap(message.vx, message.vy, message.vz),
        yaw=None if mask & _YAW else yaw_between(message.yaw),
        yaw_rate=0.0 if mask & _YAW_RATE else -message.yaw_rate,
    )


@dataclass(frozen=True, slots=True)
class AttitudeTarget:
    """What ``SET_ATTITUDE_TARGET`` asks for, in our axes and signs. No attitude: rates alone."""

    attitude: Vector | None  #: roll, pitch, yaw
    yaw_rate: float
    thrust: float | None
    unit: bool  #: whether the quaternion is one of a rotation

    def turn(self, flight: FlightControl) -> float:
        """Return the yaw rate that it asks for [rad/s]."""
        return self.yaw_rate if self.attitude is None else flight.yaw_rate_to(self.attitude[2]) + self.yaw_rate

    @property
    def tilt(self) -> tuple[float, float]:
        """Roll and pitch [rad]; rates alone keep it level here."""
        return (0.0, 0.0) if self.attitude is None else self.attitude[:2]


def attitude_target_of(message: Message) -> AttitudeTarget:
    """Return the target of ``SET_ATTITUDE_TARGET``."""
    mask = message.type_mask
    q = from_wire(message.q)
    roll, pitch, yaw = angles_of(q)
    return AttitudeTarget(
        attitude=None if mask & _NO_ATTITUDE else (roll, -pitch, yaw_between(yaw)),
        yaw_rate=0.0 if mask & _NO_RATES == _NO_RATES else -message.body_yaw_rate,
        thrust=None if mask & _NO_THRUST else message.thrust,
        unit=abs(math.hypot(*q) - 1.0) <= _UNIT_WITHIN,
    )
