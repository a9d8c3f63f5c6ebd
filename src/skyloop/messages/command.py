"""Commands: the full desired state each time; the newest wins.

Axes are the body's (ROS REP 103): x forward, y left, z up; yaw is counter-clockwise seen from above.
"""

from __future__ import annotations

import math
from typing import Final

import msgspec

from skyloop.messages.numbers import Count, TimeNs

FARTHEST_M: Final = 100_000.0  #: a place farther from the origin, along any axis, is taken for a mistake
MOST_TURNS_RAD: Final = 1000.0  #: so is a larger yaw


class Action(msgspec.Struct, frozen=True, array_like=True):
    """Base of the commands for a vehicle."""

    @property
    def name(self) -> str:
        """The action's name in capabilities and on the command line, e.g. ``"reset_emergency"``."""
        return ACTION_NAMES[type(self)]

    @property
    def finite(self) -> bool:
        """Whether all numbers of the action are finite."""
        return True

    @property
    def problem(self) -> str:
        """What makes no sense about its numbers, in words for a person; empty if they can be flown."""
        return ""


class Idle(Action, frozen=True, array_like=True, tag=0):
    """Nothing is wanted: keeps the authority alive and leaves the vehicle as it is."""


class Takeoff(Action, frozen=True, array_like=True, tag=1):
    """Take off and then hover."""


class Hover(Action, frozen=True, array_like=True, tag=2):
    """Stop and hold the place."""


class Land(Action, frozen=True, array_like=True, tag=3):
    """Descend where it is and stop the motors on the ground."""


class EmergencyStop(Action, frozen=True, array_like=True, tag=4):
    """Cut the motors at once: the vehicle falls. Needs no lease."""


class ResetEmergency(Action, frozen=True, array_like=True, tag=5):
    """Leave the emergency state, on the ground. Never sent automatically."""


class Attitude(Action, frozen=True, array_like=True, tag=6):
    """Attitude with climb rate.

    ``roll`` [rad] right side down is positive, ``pitch`` [rad] nose down is positive (REP 103: about y left),
    ``climb`` [m/s] up, ``yaw_rate`` [rad/s] counter-clockwise.
    """

    roll: float = 0.0
    pitch: float = 0.0
    climb: float = 0.0
    yaw_rate: float = 0.0

    @property
    def finite(self) -> bool:
        """Whether all numbers of the action are finite."""
        return math.isfinite(self.roll + self.pitch + self.climb + self.yaw_rate)


class Velocity(Action, frozen=True, array_like=True, tag=7):
    """Velocity in the body's levelled axes: ``forward``, ``left``, ``up`` [m/s], ``yaw_rate`` [rad/s]."""

    forward: float = 0.0
    left: float = 0.0
    up: float = 0.0
    yaw_rate: float = 0.0

    @property
    def finite(self) -> bool:
        """Whether all numbers of the action are finite."""
        return math.isfinite(self.forward + self.left + self.up + self.yaw_rate)


class Position(Action, frozen=True, array_like=True, tag=8):
    """A place to fly to and to stay at, in the world's axes of ``Feedback.position``.

    ``x`` east, ``y`` north, ``z`` up [m]; ``yaw`` counter-clockwise from x [rad], None keeps the present heading;
    ``speed`` [m/s] along the way and ``turn_rate`` [rad/s] are the greatest ones, None: as fast as the limits allow.
    """

    x: float
    y: float
    z: float
    yaw: float | None = None
    speed: float | None = None
    turn_rate: float | None = None

    @property
    def finite(self) -> bool:
        """Whether all numbers of the action are finite."""
        return math.isfinite(
            self.x + self.y + self.z + (self.yaw or 0.0) + (self.speed or 0.0) + (self.turn_rate or 0.0)
        )

    @property
    def problem(self) -> str:
        """What makes no sense about its numbers, in words for a person; empty if they can be flown."""
        for name in ("x", "y", "z"):
            if abs(value := getattr(self, name)) > FARTHEST_M:
                return (
                    f"{name} is {value:g} m and must be within {FARTHEST_M:g} m of the origin of the vehicle's position"
                )
        if self.yaw is not None and abs(self.yaw) > MOST_TURNS_RAD:
            return f"yaw is {self.yaw:g} rad and must be from {-MOST_TURNS_RAD:g} to {MOST_TURNS_RAD:g} rad"
        if self.speed is not None and not self.speed > 0.0:
            return f"speed is {self.speed:g} m/s and must be more than 0 (None: as fast as the limits allow)"
        if self.turn_rate is not None and not self.turn_rate > 0.0:
            return f"turn_rate is {self.turn_rate:g} rad/s and must be more than 0 (None: as fast as the limits allow)"
        return ""

    @property
    def place(self) -> tuple[float, float, float]:
        """The place: x, y, z [m]."""
        return self.x, self.y, self.z


class ReturnToStart(Action, frozen=True, array_like=True, tag=9):
    """Climb, fly to where the vehicle took off (``Feedback.start_position_m``), and land or stay there.

    ``height`` [m] above the start, at least, on the way; ``land`` at the end, or hover. None: as the proxy's parameters
    ``return.height`` and ``return.land`` say.
    """

    height: float | None = None
    land: bool | None = None

    @property
    def finite(self) -> bool:
        """Whether all numbers of the action are finite."""
        return math.isfinite(self.height or 0.0)

    @property
    def problem(self) -> str:
        """What makes no sense about its numbers, in words for a person; empty if they can be flown."""
        if self.height is not None and not 0.0 <= self.height <= FARTHEST_M:
            return f"height is {self.height:g} m above the start and must be from 0 to {FARTHEST_M:g} m"
        return ""


AnyAction = (
    Idle | Takeoff | Hover | Land | EmergencyStop | ResetEmergency | Attitude | Velocity | Position | ReturnToStart
)

#: Actions that set where or how fast to fly: each replaces the one before, and a program sends them periodically.
SET_POINTS: Final = (Velocity, Attitude, Position, ReturnToStart)

ACTION_NAMES: dict[type[Action], str] = {
    Idle: "idle",
    Takeoff: "takeoff",
    Hover: "hover",
    Land: "land",
    EmergencyStop: "emergency_stop",
    ResetEmergency: "reset_emergency",
    Attitude: "attitude",
    Velocity: "velocity",
    Position: "position",
    ReturnToStart: "return_to_start",
}


class Command(msgspec.Struct, frozen=True, array_like=True):
    """One packet of the command channel."""

    seq: Count  #: grows with every packet of a connection
    lease: Count  #: number of the lease that it is sent under; 0 for none (emergency stop only)
    intent: Count  #: grows when the *application* asks for something; repeats by the library keep it
    sent_ns: (
        int  #: when it was sent, on the proxy's clock; not bounded, as an emergency stop counts whatever its time is
    )
    action: AnyAction
    automatic: bool = (
        False  #: asked for by the library, not by a person or a program: it never takes a vehicle from others
    )


class Applied(msgspec.Struct, frozen=True, array_like=True):
    """Echo on the ``commands`` topic: what the proxy made of a command that it received."""

    seq: Count
    lease: Count
    app_id: Count  #: 0: the proxy itself (failsafe, autopilot)
    sent_ns: TimeNs
    applied_ns: TimeNs
    asked: AnyAction
    applied: AnyAction  #: after limits, and as the driver really applied it
