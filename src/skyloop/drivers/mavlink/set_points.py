"""Our set-points as MAVLink's messages. Pure.

``SET_POSITION_TARGET_LOCAL_NED`` in the frames that both autopilots take: 1, of the world, and 8, of the levelled body.
"""

from __future__ import annotations

import math
from typing import Final

from skyloop.clock import seconds
from skyloop.drivers.mavlink.lift import Lift
from skyloop.drivers.mavlink.telemetry import View
from skyloop.messages import Attitude, Velocity
from skyloop.messages.geometry import quaternion_from_euler, wrap_angle
from skyloop.wire.mavlink.axes import Vector, flip
from skyloop.wire.mavlink.codec import Message
from skyloop.wire.mavlink.codec import dialect as m

WORLD: Final = 1
BODY: Final = 8
VELOCITY_AND_YAW_RATE: Final = 0x5C7
POSITION: Final = 0xDF8
ATTITUDE_AND_THRUST: Final = 0x07  #: without rates
STEER_NS: Final = 40_000_000  #: a velocity or place is said again after this: 25 Hz
LEAN_NS: Final = 20_000_000  #: the same for an attitude, which turns meanwhile
MOST_YAW_LEAD_RAD: Final = 0.5  #: the heading that is asked for waits for a vehicle that can't follow
STOPPED_M_S: Final = 0.25  #: slower than this, the place is held instead of the speed
STOPPING_S: Final = 3.0  #: and after this in any case
MOST_STEP_S: Final = 0.1

Target = tuple[int, int]  #: system and component


def velocity_message(action: Velocity, target: Target) -> Message:
    x, y, z = flip(action.forward, action.left, action.up)
    return m.MAVLink_set_position_target_local_ned_message(
        0, *target, BODY, VELOCITY_AND_YAW_RATE, 0, 0, 0, x, y, z, 0, 0, 0, 0, 0.0 - action.yaw_rate
    )


def place_message(place: Vector, target: Target) -> Message:
    """North, east, down from the origin."""
    return m.MAVLink_set_position_target_local_ned_message(0, *target, WORLD, POSITION, *place, 0, 0, 0, 0, 0, 0, 0, 0)


class Stay:
    """Stop, then hold the place where it stopped."""

    period_ns = STEER_NS

    def __init__(self, now_ns: int) -> None:
        self._begun_ns = now_ns
        self._place: Vector | None = None

    def message(self, view: View, target: Target, now_ns: int) -> Message:
        slow = view.velocity is not None and math.hypot(*view.velocity) < STOPPED_M_S
        late = seconds(now_ns - self._begun_ns) > STOPPING_S
        if self._place is None and view.place is not None and (slow or late):
            self._place = view.place
        return velocity_message(Velocity(), target) if self._place is None else place_message(self._place, target)


class Steer:
    """A velocity."""

    period_ns = STEER_NS

    def __init__(self, action: Velocity) -> None:
        self.action = action

    def message(self, view: View, target: Target, now_ns: int) -> Message:  # noqa: ARG002
        return velocity_message(self.action, target)


class Lean:
    """An attitude with climb rate and yaw rate. The heading that is asked for is turned here, step by step."""

    period_ns = LEAN_NS

    def __init__(self, action: Attitude, lift: Lift) -> None:
        self.action = action
        self._lift = lift
        self._yaw: float | None = None  # clockwise from north
        self._before_ns: int | None = None

    def within(self, action: Attitude) -> Attitude:
        """The attitude with the climb rate that can be asked for."""
        return Attitude(action.roll, action.pitch, self._lift.climb_within(action.climb), action.yaw_rate)

    def message(self, view: View, target: Target, now_ns: int) -> Message:
        action = self.action
        step_s = 0.0 if self._before_ns is None else min(MOST_STEP_S, seconds(now_ns - self._before_ns))
        self._before_ns = now_ns
        yaw = self._turned(view.yaw, action.yaw_rate, step_s)
        climbing = None if view.velocity is None else -view.velocity[2]
        tilt = math.hypot(action.roll, action.pitch)
        thrust = self._lift.thrust(action.climb, climbing, tilt, step_s)
        q = list(quaternion_from_euler(action.roll, -action.pitch, yaw))
        return m.MAVLink_set_attitude_target_message(0, *target, ATTITUDE_AND_THRUST, q, 0, 0, 0, thrust)

    def _turned(self, heading: float | None, yaw_rate: float, step_s: float) -> float:
        if self._yaw is None:
            self._yaw = heading if heading is not None else 0.0
        self._yaw -= yaw_rate * step_s
        if heading is not None:
            lead = wrap_angle(self._yaw - heading)
            self._yaw = heading + max(-MOST_YAW_LEAD_RAD, min(MOST_YAW_LEAD_RAD, lead))
        return self._yaw


SetPoint = Stay | Steer | Lean
