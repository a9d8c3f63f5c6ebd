"""Set-points, their positions on Earth, and both autopilots' manoeuvres: rise, return, follow, turn.

Pure except for the vehicle.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, auto
from typing import Final

from skyloop.messages.feedback import EarthOrigin
from skyloop.messages.geometry import clamped, wrap_angle
from skyloop.vehicles.emulation.flight import USUAL, YAW_GAIN_PER_S, FlightControl, Speeds
from skyloop.vehicles.mavlink.wire.axes import Vector, angles_of, flip, from_wire, swap, yaw_between
from skyloop.vehicles.mavlink.wire.codec import Message

#: PX4's usual place for simulations, near Zurich, on a sphere with 111,320 m per degree.
ORIGIN: Final = EarthOrigin(47.397742, 8.545594, 488.0, math.degrees(111_320.0))


def geodetic(place: Vector) -> tuple[int, int, int]:
    """Return latitude and longitude [1e-7 degrees] and altitude above mean sea level [mm]."""
    latitude_deg, longitude_deg, altitude_m = ORIGIN.place_of(place)
    return round(latitude_deg * 1e7), round(longitude_deg * 1e7), round(altitude_m * 1000)


def place_of(latitude_deg: float, longitude_deg: float, up: float) -> Vector:
    """Return the coordinates east, north, up [m] of a latitude and longitude at a height above the origin [m]."""
    return ORIGIN.position_of(latitude_deg, longitude_deg, ORIGIN.altitude_m + up)


def on_earth(latitude_deg: float, longitude_deg: float) -> bool:
    """Return whether the coordinates are valid; False for NaN."""
    return abs(latitude_deg) <= 90.0 and abs(longitude_deg) <= 180.0


# MAV_FRAME: local north, east, down, or levelled body axes, from the origin or from the vehicle.
WORLD: Final = 1
WORLD_OFFSET: Final = 7
BODY: Final = 8
BODY_OFFSET: Final = 9
# Bits of a type mask (POSITION_TARGET_TYPEMASK, then ATTITUDE_TARGET_TYPEMASK): fields to ignore.
_POSITION: Final = 0x007
_VELOCITY: Final = 0x038
_YAW: Final = 0x400
_YAW_RATE: Final = 0x800
_NO_RATES: Final = 0x07
_NO_THRUST: Final = 0x40
_NO_ATTITUDE: Final = 0x80
_UNIT_WITHIN: Final = 1e-3  #: tolerance of a unit quaternion's norm


@dataclass(frozen=True, slots=True)
class Target:
    """A target from ``SET_POSITION_TARGET_LOCAL_NED`` or ``…_GLOBAL_INT``, in our axes; None means not requested."""

    place: Vector | None
    velocity: Vector | None = None
    in_body: bool = False
    yaw: float | None = None
    yaw_rate: float = 0.0

    def follow(self, flight: FlightControl, speeds: Speeds = USUAL, turn: float | None = None) -> None:
        """Fly to the target, with ``turn`` as the yaw rate [rad/s] if given. Called on every tick."""
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
    """Return the target from ``SET_POSITION_TARGET_LOCAL_NED``, even if the target is not finite."""
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
    """Return the target from ``SET_POSITION_TARGET_GLOBAL_INT``; None for an invalid position or frame.

    ``datum`` is the height [m] above our origin at which the frame's altitude is 0.
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
    """A target from ``SET_ATTITUDE_TARGET``, in our axes and signs. Without an attitude, it consists of rates only."""

    attitude: Vector | None  #: roll, pitch, yaw
    yaw_rate: float
    thrust: float | None
    unit: bool  #: whether the quaternion has unit length

    def turn(self, flight: FlightControl) -> float:
        """Return the requested yaw rate [rad/s]."""
        return self.yaw_rate if self.attitude is None else flight.yaw_rate_to(self.attitude[2]) + self.yaw_rate

    @property
    def tilt(self) -> tuple[float, float]:
        """Roll and pitch [rad]; level if only rates are requested."""
        return (0.0, 0.0) if self.attitude is None else self.attitude[:2]


def attitude_target_of(message: Message) -> AttitudeTarget:
    """Return the target from ``SET_ATTITUDE_TARGET``."""
    mask = message.type_mask
    q = from_wire(message.q)
    roll, pitch, yaw = angles_of(q)
    return AttitudeTarget(
        attitude=None if mask & _NO_ATTITUDE else (roll, -pitch, yaw_between(yaw)),
        yaw_rate=0.0 if mask & _NO_RATES == _NO_RATES else -message.body_yaw_rate,
        thrust=None if mask & _NO_THRUST else message.thrust,
        unit=abs(math.hypot(*q) - 1.0) <= _UNIT_WITHIN,
    )


_THERE_M: Final = 0.3  #: distance within which a return's waypoint counts as reached


class _Leg(Enum):
    CLIMB = auto()
    ACROSS = auto()
    WAIT = auto()
    DOWN = auto()


@dataclass
class _Return:
    start: Vector
    home: Vector
    up: float
    wait_s: float
    final: float | None
    leg: _Leg = _Leg.CLIMB
    waiting_s: float = 0.0


class Turn:
    """A turn by an angle from the present heading [rad]: positive counter-clockwise, may exceed half a turn."""

    def __init__(self, flight: FlightControl, angle: float, fastest: float) -> None:
        self._flight, self._fastest = flight, fastest
        self._left, self._yaw = angle, flight.yaw

    def rate(self) -> float:
        """Return the present yaw rate [rad/s]. Called on every tick."""
        self._left -= wrap_angle(self._flight.yaw - self._yaw)
        self._yaw = self._flight.yaw
        return clamped(YAW_GAIN_PER_S * self._left, self._fastest)


class Manoeuvres:
    """The manoeuvres of one flight. Heights are above the flight's origin [m]."""

    def __init__(self, flight: FlightControl) -> None:
        self._flight = flight
        self._rise_m: float | None = None
        self._return: _Return | None = None

    def begin_rise(self, height_m: float) -> None:
        """Start rising to a height."""
        self._rise_m = height_m

    def rise(self) -> bool:
        """Take off and climb; return whether the height has been reached. Called on every tick."""
        flight = self._flight
        if self._rise_m is None:
            return True
        if not flight.airborne:
            flight.lift_off()
            return False
        east, north, up = flight.place
        flight.go((east, north, self._rise_m + 0.1))
        return up >= self._rise_m - 0.1

    def begin_return(self, home: Vector, height_m: float, *, wait_s: float = 0.0, final_m: float | None = None) -> None:
        """Start returning: climb, fly to ``home`` at that height (or as high as possible), wait there, and land.

        ``final_m`` is the height to descend to instead of landing; None to land.
        """
        self._return = _Return(self._flight.place, home, min(height_m, self._flight.highest_m), wait_s, final_m)

    def return_home(self, speeds: Speeds = USUAL) -> None:
        """Continue the return. Called on every tick."""
        flight, way = self._flight, self._return
        if way is None or flight.standing:
            return
        east, north, _ = way.home
        if way.leg is _Leg.CLIMB:
            flight.go((way.start[0], way.start[1], way.up), speeds)
            if flight.place[2] >= way.up - _THERE_M:
                way.leg = _Leg.ACROSS
        elif way.leg is _Leg.ACROSS:
            flight.go((east, north, way.up), speeds)
            if math.hypot(flight.place[0] - east, flight.place[1] - north) < _THERE_M:
                way.leg, way.waiting_s = _Leg.WAIT, flight.time_s
        elif way.leg is _Leg.WAIT:
            flight.go((east, north, way.up), speeds)
            if flight.time_s - way.waiting_s >= way.wait_s:
                way.leg = _Leg.DOWN
        elif way.final is not None:
            flight.go((east, north, way.final), speeds)
        else:
            flight.land()

    def follow(
        self,
        target: Target | AttitudeTarget | None,
        lean: Callable[[AttitudeTarget], None],
        speeds: Speeds = USUAL,
        turn: float | None = None,
    ) -> None:
        """Follow a set-point (an attitude with ``lean``), or hold position if there is none. Called on every tick."""
        if isinstance(target, Target):
            target.follow(self._flight, speeds, turn)
        elif target is not None:
            lean(target)
        elif turn is not None:
            self._flight.move(0.0, 0.0, 0.0, turn)
        else:
            self._flight.hold()
