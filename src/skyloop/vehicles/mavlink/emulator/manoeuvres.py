"""Manoeuvres that both autopilots' modes share: rise, return, follow, turn. Pure but for the vehicle."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, auto
from typing import Final

from skyloop.messages.geometry import clamped, wrap_angle
from skyloop.vehicles.emulation.flight import USUAL, YAW_GAIN_PER_S, FlightControl, Speeds
from skyloop.vehicles.mavlink.emulator.setpoints import AttitudeTarget, Target
from skyloop.vehicles.mavlink.wire.axes import Vector

_THERE_M: Final = 0.3


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
    """Turns by an angle from the present heading.

    Args:
        flight: What turns.
        angle: Counter-clockwise [rad]; may be more than half a turn.
        fastest: Greatest yaw rate [rad/s].
    """

    def __init__(self, flight: FlightControl, angle: float, fastest: float) -> None:
        self._flyer, self._fastest = flight, fastest
        self._left, self._yaw = angle, flight.yaw

    def rate(self) -> float:
        """Return the yaw rate now [rad/s]. Called at every tick."""
        self._left -= wrap_angle(self._flyer.yaw - self._yaw)
        self._yaw = self._flyer.yaw
        return clamped(YAW_GAIN_PER_S * self._left, self._fastest)


class Manoeuvres:
    """The manoeuvres of one flight. Heights are above the flight's origin [m].

    Args:
        flight: What flies them.
    """

    def __init__(self, flight: FlightControl) -> None:
        self._flyer = flight
        self._rise_m: float | None = None
        self._return: _Return | None = None

    def begin_rise(self, height_m: float) -> None:
        """Begin to rise to a height."""
        self._rise_m = height_m

    def rise(self) -> bool:
        """Take off and climb. Return whether it is up. Called at every tick."""
        flight = self._flyer
        if self._rise_m is None:
            return True
        if not flight.airborne:
            flight.lift_off()
            return False
        east, north, up = flight.place
        flight.go((east, north, self._rise_m + 0.1))
        return up >= self._rise_m - 0.1

    def begin_return(self, home: Vector, height_m: float, *, wait_s: float = 0.0, final_m: float | None = None) -> None:
        """Begin to return: climb, go home at that height, wait there, and land.

        Args:
            home: East, north, up from the origin [m].
            height_m: Of the way, or as high as it can.
            wait_s: Over home.
            final_m: Height to descend to instead of landing; None: land.
        """
        self._return = _Return(self._flyer.place, home, min(height_m, self._flyer.highest_m), wait_s, final_m)

    def return_home(self, speeds: Speeds = USUAL) -> None:
        """Go on with the return. Called at every tick."""
        flight, way = self._flyer, self._return
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
        """Follow a set-point, or hold the position without one. Called at every tick.

        Args:
            target: The set-point.
            lean: Flies an attitude.
            speeds: The greatest ones on the way to a position.
            turn: A yaw rate instead of the set-point's [rad/s].
        """
        if isinstance(target, Target):
            target.follow(self._flyer, speeds, turn)
        elif target is not None:
            lean(target)
        elif turn is not None:
            self._flyer.move(0.0, 0.0, 0.0, turn)
        else:
            self._flyer.hold()
