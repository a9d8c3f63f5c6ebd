"""Set-point messages, understood. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from skyloop.sim.firmware.mavlink.flyer import Flyer
from skyloop.wire.mavlink.axes import Quaternion, Vector, angles_of, flip, swap, yaw_between
from skyloop.wire.mavlink.codec import Message

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
    """What ``SET_POSITION_TARGET_LOCAL_NED`` asks for, in our axes. None: not asked for."""

    place: Vector | None
    velocity: Vector | None
    in_body: bool
    yaw: float | None
    yaw_rate: float

    def follow(self, flyer: Flyer) -> None:
        """To be said at every tick."""
        turn = self.yaw_rate if self.yaw is None else flyer.yaw_rate_to(self.yaw)
        if self.velocity is not None and self.place is None:
            move = flyer.move_body if self.in_body else flyer.move
            x, y, z = (0.0 if math.isnan(each) else each for each in self.velocity)
            move(x, y, z, turn)
        elif self.place is not None:
            flyer.go(self.place, yaw_rate=turn)
        else:
            flyer.hold()


def target_of(message: Message) -> Target:
    """Positions and velocities as they are, finite or not."""
    mask, in_body = message.type_mask, message.coordinate_frame in (BODY, BODY_OFFSET)
    turn = flip if in_body else swap
    return Target(
        place=None if mask & _POSITION == _POSITION else swap(message.x, message.y, message.z),
        velocity=None if mask & _VELOCITY == _VELOCITY else turn(message.vx, message.vy, message.vz),
        in_body=in_body,
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

    def turn(self, flyer: Flyer) -> float:
        """Yaw rate that it asks for."""
        return self.yaw_rate if self.attitude is None else flyer.yaw_rate_to(self.attitude[2]) + self.yaw_rate

    @property
    def tilt(self) -> tuple[float, float]:
        """Roll and pitch; rates alone keep it level here."""
        return (0.0, 0.0) if self.attitude is None else self.attitude[:2]


def attitude_target_of(message: Message) -> AttitudeTarget:
    mask = message.type_mask
    q: Quaternion = (message.q[0], message.q[1], message.q[2], message.q[3])
    roll, pitch, yaw = angles_of(q)
    return AttitudeTarget(
        attitude=None if mask & _NO_ATTITUDE else (roll, -pitch, yaw_between(yaw)),
        yaw_rate=0.0 if mask & _NO_RATES == _NO_RATES else -message.body_yaw_rate,
        thrust=None if mask & _NO_THRUST else message.thrust,
        unit=abs(math.hypot(*q) - 1.0) <= _UNIT_WITHIN,
    )
