"""Flight settings, derived from parameters: limits for set-points, and others. Pure."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Final

from skyloop.clock import nanoseconds
from skyloop.messages import AnyAction, Attitude, Velocity
from skyloop.zones import Space, space_of

#: Permitted climb rate per metre below ``limits.altitude`` [1/s], so that the vehicle slows down as it approaches.
#: Above the limit, it sinks at the same rate per metre.
ALTITUDE_GAIN: Final = 1.0
#: Altitudes above ``limits.altitude`` by up to this much count as altimeter noise [m].
SLACK_M: Final = 0.15


@dataclass(frozen=True, slots=True)
class Clamp:
    """A limit that reduced a set-point. For tilt and speed, the two numbers are lengths of the vector."""

    limit: str  #: name of the parameter
    asked: float
    applied: float
    zone: str = ""  #: name of the no-fly zone, if any


@dataclass(frozen=True, slots=True)
class Limits:
    """The effective limits."""

    tilt: float = 0.35  #: maximum tilt from the vertical, by roll and pitch combined [rad]
    climb: float = 1.0  #: maximum speed up or down [m/s]
    yaw_rate: float = 1.75  #: maximum yaw rate [rad/s]
    speed: float = 2.0  #: maximum horizontal speed [m/s]
    altitude: float = 5.0  #: maximum height above ground [m]

    def clamp(self, action: Attitude | Velocity, altitude: float | None) -> tuple[AnyAction, tuple[Clamp, ...]]:
        """Return the nearest set-point within the limits, and the limits that applied.

        Tilt and horizontal speed are reduced without changing their direction. ``altitude`` is given [m] if known.
        """
        if type(action) is Velocity:
            x, y, up, yaw_rate, longest = action.forward, action.left, action.up, action.yaw_rate, self.speed
        else:
            assert isinstance(action, Attitude)
            x, y, up, yaw_rate, longest = action.roll, action.pitch, action.climb, action.yaw_rate, self.tilt
        highest = self.climb
        if altitude is not None:  # above the limit, room is negative and the vehicle descends
            room = self.altitude - altitude
            highest = max(-self.climb, min(highest, room * ALTITUDE_GAIN)) if not -SLACK_M <= room <= 0.0 else 0.0
        if (
            x * x + y * y <= longest * longest
            and -self.climb <= up <= highest
            and -self.yaw_rate <= yaw_rate <= self.yaw_rate
        ):
            return action, ()
        clamps: list[Clamp] = []
        length = math.hypot(x, y)
        if length > longest:
            clamps.append(Clamp("limits.speed" if type(action) is Velocity else "limits.tilt", length, longest))
            x, y = x / length * longest, y / length * longest
        allowed_up = max(-self.climb, min(highest, up))
        if allowed_up != up:
            near_the_top = up > highest and highest < self.climb
            clamps.append(Clamp("limits.altitude" if near_the_top else "limits.climb", up, allowed_up))
        allowed_yaw_rate = max(-self.yaw_rate, min(self.yaw_rate, yaw_rate))
        if allowed_yaw_rate != yaw_rate:
            clamps.append(Clamp("limits.yaw_rate", yaw_rate, allowed_yaw_rate))
        return type(action)(x, y, allowed_up, allowed_yaw_rate), tuple(clamps)


@dataclass(frozen=True, slots=True)
class AirspaceSettings:
    """Parameters for where the vehicle may fly, and how fast."""

    limits: Limits = field(default_factory=Limits)
    space: Space = field(default_factory=Space)
    deceleration: float = 1.0  #: deceleration that the vehicle can reliably achieve [m/s²]
    reaction_s: float = 0.3  #: delay before the vehicle begins to brake


@dataclass(frozen=True, slots=True)
class FailsafeSettings:
    """The failsafe's thresholds: times in s, battery levels as charge from 0 to 1."""

    hover_after_s: float = 0.5
    land_after_s: float = 5.0
    retry_s: float = 0.25
    battery_warn: float = 0.2
    battery_land: float = 0.1  #: charge at which to land; 0: never
    battery_return: float = 0.0  #: charge at which to return; 0: never
    returns: bool = False  #: whether a vehicle without a pilot lands at its start


@dataclass(frozen=True, slots=True)
class AutopilotSettings:
    """The autopilot's tuning. Altitude [m], speeds [m/s], ``tilt`` [rad], gains [rad per m/s] and [rad per m]."""

    takeoff_altitude: float = 1.0
    climb: float = 0.5
    descent: float = 0.4
    velocity_p: float = 0.15
    velocity_i: float = 0.05
    tilt: float = 0.35


@dataclass(frozen=True, slots=True)
class ReturnSettings:
    """Settings of a return."""

    height: float = 2.0  #: minimum height above the start on the way [m]
    speed: float = 1.0  #: maximum speed on the way [m/s]
    land: bool = True  #: whether to land at the end rather than hover


@dataclass(frozen=True, slots=True)
class FlightSettings:
    """All flight settings."""

    airspace: AirspaceSettings = field(default_factory=AirspaceSettings)
    failsafe: FailsafeSettings = field(default_factory=FailsafeSettings)
    autopilot: AutopilotSettings = field(default_factory=AutopilotSettings)
    returns: ReturnSettings = field(default_factory=ReturnSettings)
    max_age_ns: int = 0  #: maximum age of a command [ns]
    authority_timeout_ns: int = 0
    authority_ask_ns: int = 0

    def updated(self, value: Mapping[str, Any], changed: Collection[str]) -> FlightSettings:
        """Return the settings with new values; parts without changed parameters stay the same object.

        ``value``: the effective values by name; ``changed``: prefixes of the changed names, such as ``limits``. Raises
        :class:`ParameterError` if the no-fly zones can't be parsed.
        """
        new: dict[str, Any] = {}
        limits, space = self.airspace.limits, self.airspace.space
        if "limits" in changed:
            limits = Limits(
                tilt=value["limits.tilt"],
                climb=value["limits.climb"],
                yaw_rate=value["limits.yaw_rate"],
                speed=value["limits.speed"],
                altitude=value["limits.altitude"],
            )
        if "safety" in changed:
            space = space_of(value.__getitem__, value.__getitem__)
        if not {"limits", "safety"}.isdisjoint(changed):
            new["airspace"] = AirspaceSettings(limits, space, value["safety.deceleration"], value["safety.reaction_s"])
        if not {"limits", "autopilot"}.isdisjoint(changed):
            new["autopilot"] = AutopilotSettings(
                takeoff_altitude=min(value["autopilot.takeoff_altitude"], limits.altitude),
                climb=min(value["autopilot.climb"], limits.climb),
                descent=min(value["autopilot.descent"], limits.climb),
                velocity_p=value["autopilot.velocity_p"],
                velocity_i=value["autopilot.velocity_i"],
                tilt=limits.tilt,
            )
        if not {"failsafe", "battery"}.isdisjoint(changed):
            new["failsafe"] = FailsafeSettings(
                hover_after_s=value["failsafe.hover_after_s"],
                land_after_s=value["failsafe.land_after_s"],
                retry_s=value["failsafe.retry_s"],
                battery_warn=value["battery.warn"],
                battery_land=value["battery.land"],
                battery_return=value["battery.return"],
                returns=value["failsafe.return"],
            )
        if "return" in changed:
            new["returns"] = ReturnSettings(value["return.height"], value["return.speed"], value["return.land"])
        if "command" in changed:
            new["max_age_ns"] = nanoseconds(value["command.max_age_s"])
        if "authority" in changed:
            new["authority_timeout_ns"] = nanoseconds(value["authority.timeout_s"])
            new["authority_ask_ns"] = nanoseconds(value["authority.ask_s"])
        return replace(self, **new) if new else self
