"""The limits of set-points. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from skyloop.messages import AnyAction, Attitude, Velocity

#: Climb allowed per metre that is left below ``limits.altitude`` [1/s]: the vehicle slows down before it is there, and
#: sinks at this rate per metre that it is above.
ALTITUDE_GAIN: Final = 1.0
#: So little above ``limits.altitude`` is the altimeter's noise [m].
SLACK_M: Final = 0.15


@dataclass(frozen=True, slots=True)
class Clamp:
    """A limit that was in the way of a set-point. For tilt and speed the two numbers are lengths of the vector."""

    limit: str  #: name of the parameter
    asked: float
    applied: float
    zone: str = ""  #: name of the no-fly zone, if it has one


@dataclass(frozen=True, slots=True)
class Limits:
    """The limits in force."""

    tilt: float = 0.35  #: greatest tilt from the vertical by roll and pitch together [rad]
    climb: float = 1.0  #: greatest speed up or down [m/s]
    yaw_rate: float = 1.75  #: [rad/s]
    speed: float = 2.0  #: greatest horizontal speed [m/s]
    altitude: float = 5.0  #: highest height above ground [m]

    def clamp(self, action: Attitude | Velocity, altitude: float | None) -> tuple[AnyAction, tuple[Clamp, ...]]:
        """Return the nearest set-point within the limits, and what was in the way of it.

        Tilt and horizontal speed are shortened with their direction kept. ``altitude`` [m] of the vehicle, if known.
        """
        if type(action) is Velocity:
            x, y, up, yaw_rate, longest = action.forward, action.left, action.up, action.yaw_rate, self.speed
        else:
            assert isinstance(action, Attitude)
            x, y, up, yaw_rate, longest = action.roll, action.pitch, action.climb, action.yaw_rate, self.tilt
        highest = self.climb
        if altitude is not None:  # above the limit it is negative: the vehicle comes down
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
