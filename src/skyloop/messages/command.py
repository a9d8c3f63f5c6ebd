"""Commands: the full desired state each time; the newest wins.

Axes are the body's (ROS REP 103): x forward, y left, z up; yaw is counter-clockwise seen from above.
"""

from __future__ import annotations

import math

import msgspec

from skyloop.messages.numbers import Count, TimeNs


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


AnyAction = Idle | Takeoff | Hover | Land | EmergencyStop | ResetEmergency | Attitude | Velocity

ACTION_NAMES: dict[type[Action], str] = {
    Idle: "idle",
    Takeoff: "takeoff",
    Hover: "hover",
    Land: "land",
    EmergencyStop: "emergency_stop",
    ResetEmergency: "reset_emergency",
    Attitude: "attitude",
    Velocity: "velocity",
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


class Applied(msgspec.Struct, frozen=True, array_like=True):
    """Echo on the ``commands`` topic: what the proxy made of a command that it received."""

    seq: Count
    lease: Count
    app_id: Count  #: 0: the proxy itself (failsafe, autopilot)
    sent_ns: TimeNs
    applied_ns: TimeNs
    asked: AnyAction
    applied: AnyAction  #: after limits, and as the driver really applied it
