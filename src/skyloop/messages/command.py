"""Define the samples sent to the vehicle: commands, their outcomes, and externally measured poses.

Each command describes the full desired state, and the newest command wins. Axes are the body axes (ROS REP 103): x
forward, y left, z up; yaw is counter-clockwise seen from above.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import StrEnum
from typing import Annotated, Final

import msgspec

from skyloop.errors import UsageError
from skyloop.messages.fields import Count, Refusal, TimeNs

MAX_RANGE_M: Final = 100_000.0  #: a coordinate larger than this is rejected as a mistake [m]
MAX_YAW_RAD: Final = 1000.0  #: a yaw larger than this is also rejected [rad]


class Action(msgspec.Struct, frozen=True, array_like=True):
    """Base class of all actions that a command can request from a vehicle."""

    @property
    def name(self) -> str:
        """Name of the action in capabilities and on the command line, e.g. ``"reset_emergency"``."""
        return ACTION_NAMES[type(self)]

    @property
    def finite(self) -> bool:
        """Whether all numbers of the action are finite."""
        return True

    @property
    def problem(self) -> str:
        """Human-readable reason why the numbers are invalid; empty if the vehicle can fly them."""
        return ""


class Idle(Action, frozen=True, array_like=True, tag=0):
    """Do nothing: keep the authority without changing what the vehicle does."""


class Takeoff(Action, frozen=True, array_like=True, tag=1):
    """Take off and then hover."""


class Hover(Action, frozen=True, array_like=True, tag=2):
    """Stop and hold position."""


class Land(Action, frozen=True, array_like=True, tag=3):
    """Descend in place and stop the motors on the ground."""


class EmergencyStop(Action, frozen=True, array_like=True, tag=4):
    """Cut the motors immediately: the vehicle falls. Requires no lease."""


class ResetEmergency(Action, frozen=True, array_like=True, tag=5):
    """Leave the emergency state while on the ground. The library never sends this automatically."""


class Attitude(Action, frozen=True, array_like=True, tag=6):
    """A set-point that holds an attitude while the vehicle climbs and turns.

    ``roll`` [rad] is positive with the right side down, ``pitch`` [rad] is positive with the nose down (REP 103: about
    y, left), ``climb`` [m/s] is upwards, and ``yaw_rate`` [rad/s] is counter-clockwise.
    """

    roll: float = 0.0
    pitch: float = 0.0
    climb: float = 0.0
    yaw_rate: float = 0.0

    @property
    def finite(self) -> bool:
        return math.isfinite(self.roll + self.pitch + self.climb + self.yaw_rate)  # NaN or infinite if any of them is


class Velocity(Action, frozen=True, array_like=True, tag=7):
    """A velocity set-point in the levelled body axes: ``forward``, ``left``, ``up`` [m/s] and ``yaw_rate`` [rad/s]."""

    forward: float = 0.0
    left: float = 0.0
    up: float = 0.0
    yaw_rate: float = 0.0

    @property
    def finite(self) -> bool:
        return math.isfinite(self.forward + self.left + self.up + self.yaw_rate)


class Position(Action, frozen=True, array_like=True, tag=8):
    """A set-point that flies to a position and holds it, in the same world axes as ``Feedback.position``.

    ``x`` is east, ``y`` north, ``z`` up [m]; ``yaw`` is counter-clockwise from x [rad], or None to keep the heading.
    ``speed`` [m/s] and ``turn_rate`` [rad/s] are upper bounds; None means as fast as the limits allow.
    """

    x: float
    y: float
    z: float
    yaw: float | None = None
    speed: float | None = None
    turn_rate: float | None = None

    @property
    def finite(self) -> bool:
        return math.isfinite(
            self.x + self.y + self.z + (self.yaw or 0.0) + (self.speed or 0.0) + (self.turn_rate or 0.0)
        )

    @property
    def problem(self) -> str:
        for name in ("x", "y", "z"):
            if abs(value := getattr(self, name)) > MAX_RANGE_M:
                return f"{name} is {value:g} m and must be within {MAX_RANGE_M:g} m of the vehicle's origin"
        if self.yaw is not None and abs(self.yaw) > MAX_YAW_RAD:
            return f"yaw is {self.yaw:g} rad and must be from {-MAX_YAW_RAD:g} to {MAX_YAW_RAD:g} rad"
        if self.speed is not None and not self.speed > 0.0:
            return f"speed is {self.speed:g} m/s and must be more than 0 (None: as fast as the limits allow)"
        if self.turn_rate is not None and not self.turn_rate > 0.0:
            return f"turn_rate is {self.turn_rate:g} rad/s and must be more than 0 (None: as fast as the limits allow)"
        return ""

    @property
    def place(self) -> tuple[float, float, float]:
        """The position: x, y, z [m]."""
        return self.x, self.y, self.z


class ReturnToStart(Action, frozen=True, array_like=True, tag=9):
    """Climb, fly to where the vehicle took off (``Feedback.start_position_m``), and land there or hover above it.

    ``height`` [m] is the minimum height above the start during the flight; ``land`` selects landing rather than
    hovering at the end. If these are None, the proxy's parameters ``return.height`` and ``return.land`` apply.
    """

    height: float | None = None
    land: bool | None = None

    @property
    def finite(self) -> bool:
        return math.isfinite(self.height or 0.0)

    @property
    def problem(self) -> str:
        if self.height is not None and not 0.0 <= self.height <= MAX_RANGE_M:
            return f"height is {self.height:g} m above the start and must be from 0 to {MAX_RANGE_M:g} m"
        return ""


AnyAction = (
    Idle | Takeoff | Hover | Land | EmergencyStop | ResetEmergency | Attitude | Velocity | Position | ReturnToStart
)

#: Actions that set where to fly, or how fast. Each replaces the previous one, and programs send them periodically.
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
    """One packet of the command channel, containing the action that the vehicle is to execute.

    A packet is refused unless its ``seq`` is higher than that of every earlier packet, or it stops the motors.
    """

    seq: Count  #: increases with every packet sent on a connection
    lease: Count  #: number of the sender's lease; 0 if there is none (emergency stop only)
    intent: Count  #: increases with each request by the *application*; the library's repeats don't change it
    sent_ns: int  #: sending time on the proxy's clock; unbounded, because an emergency stop is always valid
    action: AnyAction
    automatic: bool = False  #: whether the library itself requests it; it then takes no vehicle that others are flying


class Applied(msgspec.Struct, frozen=True, array_like=True):
    """Echo on the ``commands`` topic: a command that the proxy received, and what the proxy applied."""

    seq: Count
    lease: Count
    app_id: Count  #: number of the application; 0 for the proxy itself (failsafe, autopilot)
    sent_ns: TimeNs
    applied_ns: TimeNs
    asked: AnyAction
    applied: AnyAction  #: action as limited and applied by the driver


MAX_OUTCOME_TEXT: Final = 300  #: maximum length of an outcome's text [characters]


class Fate(StrEnum):
    """State of an intent: in progress, or how it ended. Repeating an intent that has ended never executes it."""

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


#: The single list of everything that can end an intent, in readable form; it generates part of ``docs/proxy.md``.
ENDINGS: Final[dict[Fate, str]] = {
    Fate.COMPLETED: "it was carried out",
    Fate.REFUSED: "it was refused",
    Fate.REPLACED: "a newer command took its place",
    Fate.WITHDRAWN: "its application withdrew it: the call was cancelled, failed, or timed out",
    Fate.TIMED_OUT: "it did not leave the ground within 20 s, or was silent for 60 s before it hovered or landed",
    Fate.LANDED: "the vehicle is landing, or has landed or disarmed, for whatever reason",
    Fate.EMERGENCY: "there was an emergency, or someone stopped the motors",
    Fate.AUTHORITY: "the authority was granted again, lost or given back",
    Fate.LINK: "the vehicle link broke or came back (which ends no landing), or the application's connection was lost",
    Fate.FAILSAFE: "a failsafe took over",
    Fate.OTHERS: "another controller took the vehicle",
    Fate.SLEPT: "the proxy's computer slept",
    Fate.JUMPED: "the vehicle's position jumped",
}


class Outcome(msgspec.Struct, frozen=True, array_like=True):
    """Outcome of the newest intent of the application that commands the vehicle, or was the last to do so."""

    app_id: Count = 0  #: number of the application in this run of the proxy; 0: no intent to report
    intent: Count = 0  #: number of the intent, as in its commands
    fate: Fate = Fate.UNDER_WAY
    reason: Refusal | None = None  #: why the intent, or a repeat of it, was refused
    text: Annotated[str, msgspec.Meta(max_length=MAX_OUTCOME_TEXT)] = ""  #: human-readable reason

    @property
    def over(self) -> bool:
        """Whether the intent has ended."""
        return self.fate is not Fate.UNDER_WAY

    @property
    def failed(self) -> bool:
        """Whether the intent ended without being completed."""
        return self.over and self.fate is not Fate.COMPLETED


class VehiclePose(msgspec.Struct, frozen=True, array_like=True):
    """A measured pose of the vehicle, sent to it by the pilot's application. World axes: x east, y north, z up."""

    captured_ns: TimeNs  #: time of the measurement, on the proxy's clock
    position_m: tuple[float, float, float]  #: position of the body's origin [m]
    quaternion: tuple[float, float, float, float]  #: x, y, z, w, from body axes (forward, left, up) to world axes
    position_std_m: float | None = None  #: standard deviation of the position [m], if known
    attitude_std_rad: float | None = None  #: standard deviation of the attitude [rad], if known


def check_pose(
    position: Sequence[float],
    quaternion: Sequence[float],
    position_std_m: float | None = None,
    attitude_std_rad: float | None = None,
) -> None:
    """Check a pose: position x, y, z [m]; quaternion x, y, z, w; standard deviations [m, rad] or None if unknown.

    Raises :class:`UsageError` if a number is missing or not finite, if a standard deviation is negative, or if the
    quaternion's length differs from 1 by more than 0.001.
    """
    for name, axes, values in (("position", "x, y, z", position), ("quaternion", "x, y, z, w", quaternion)):
        count = len(axes.split(", "))
        if len(values) != count or not all(map(math.isfinite, values)):
            raise UsageError(f"{name} must have {count} finite numbers ({axes}), got {tuple(values)!r}")
    length = math.hypot(*quaternion)
    if abs(length - 1.0) > 1e-3:
        raise UsageError(f"quaternion (x, y, z, w) must have length 1, got {length:.4g}")
    for name, value in (("position_std_m", position_std_m), ("attitude_std_rad", attitude_std_rad)):
        if value is not None and not 0.0 <= value < math.inf:
            raise UsageError(f"{name} is {value!r} and must be 0 or more, or None if unknown")
