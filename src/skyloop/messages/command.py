"""From an application to the vehicle: commands, their outcome, and poses measured from outside.

A command is the full desired state each time; the newest wins. Axes are the body's (ROS REP 103): x forward, y left, z
up; yaw is counter-clockwise seen from above.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import StrEnum
from typing import Annotated, Final

import msgspec

from skyloop.errors import UsageError
from skyloop.messages.fields import Count, Refusal, TimeNs

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


MAX_OUTCOME_TEXT: Final = 300  #: characters


class Fate(StrEnum):
    """How far an intent is, or what ended it. Nothing that is over is ever done again by a repeat."""

    UNDER_WAY = "under_way"
    COMPLETED = "completed"
    REFUSED = "refused"
    REPLACED = "replaced"
    WITHDRAWN = "withdrawn"
    TIMED_OUT = "timed_out"
    LANDED = "landed"
    EMERGENCY = "emergency"
    AUTHORITY = "authority"
    LINK = "link"
    FAILSAFE = "failsafe"
    OTHERS = "others"
    SLEPT = "slept"
    JUMPED = "jumped"


#: The one list of what ends an intent, in words for people; ``docs/proxy.md`` has it, too.
ENDINGS: Final[dict[Fate, str]] = {
    Fate.COMPLETED: "it was done",
    Fate.REFUSED: "it was refused",
    Fate.REPLACED: "a newer command took its place",
    Fate.WITHDRAWN: "its application wants it no more: the call was cancelled, failed, or ran out of time",
    Fate.TIMED_OUT: "it did not leave the ground within 20 s, or was to hover or land and was not heard for 60 s",
    Fate.LANDED: "the vehicle lands, or has landed or disarmed, whoever made it",
    Fate.EMERGENCY: "there was an emergency, or somebody stopped the motors",
    Fate.AUTHORITY: "the authority was granted anew, lost or given back",
    Fate.LINK: "the link to the vehicle broke or came back, which ends no landing, or the application's own was lost",
    Fate.FAILSAFE: "a failsafe took over",
    Fate.OTHERS: "somebody else took the vehicle",
    Fate.SLEPT: "the proxy's computer slept",
    Fate.JUMPED: "the vehicle's position jumped",
}


class Outcome(msgspec.Struct, frozen=True, array_like=True):
    """What became of the newest intent of the application that commands, or commanded last."""

    app_id: Count = 0  #: number of the application in this run of the proxy; 0: nothing is told
    intent: Count = 0  #: the number of the intent, as in its commands
    fate: Fate = Fate.UNDER_WAY
    reason: Refusal | None = None  #: why it, or a repeat of it, is refused
    text: Annotated[str, msgspec.Meta(max_length=MAX_OUTCOME_TEXT)] = ""  #: the same for a person

    @property
    def over(self) -> bool:
        """Whether it ended."""
        return self.fate is not Fate.UNDER_WAY

    @property
    def failed(self) -> bool:
        """Whether it ended otherwise than by being done."""
        return self.over and self.fate is not Fate.COMPLETED


class VehiclePose(msgspec.Struct, frozen=True, array_like=True):
    """A pose for the vehicle itself, from a pilot's application. World axes x east, y north, z up."""

    captured_ns: TimeNs  #: when it was so, on the proxy's clock
    position_m: tuple[float, float, float]  #: of the body's origin [m]
    quaternion: tuple[float, float, float, float]  #: x, y, z, w, from body axes (forward, left, up) to world axes
    position_std_m: float | None = None  #: standard deviation, if it is known
    attitude_std_rad: float | None = None  #: standard deviation, if it is known


def check_pose(
    position: Sequence[float],
    quaternion: Sequence[float],
    position_std_m: float | None = None,
    attitude_std_rad: float | None = None,
) -> None:
    """Check the numbers of a pose.

    Args:
        position: x, y, z [m].
        quaternion: x, y, z, w.
        position_std_m: Standard deviation of the position [m], 0 or more; None if it is not known.
        attitude_std_rad: Standard deviation of the orientation [rad], 0 or more; None if it is not known.

    Raises:
        UsageError: If a number is missing or not finite, a standard deviation is negative, or the quaternion's length
            differs from 1 by more than 0.001.
    """
    for name, axes, values in (("position", "x, y, z", position), ("quaternion", "x, y, z, w", quaternion)):
        count = len(axes.split(", "))
        if len(values) != count or not all(map(math.isfinite, values)):
            raise UsageError(f"{name} must have {count} finite numbers ({axes}), got {tuple(values)!r}")
    length = math.hypot(*quaternion)
    if abs(length - 1.0) > 1e-3:
        raise UsageError(f"quaternion (x, y, z, w) of a rotation must have length 1, got {length:.4g}")
    for name, value in (("position_std_m", position_std_m), ("attitude_std_rad", attitude_std_rad)):
        if value is not None and not 0.0 <= value < math.inf:
            raise UsageError(f"{name} is {value!r} and must be 0 or more, or None where it is not known")
