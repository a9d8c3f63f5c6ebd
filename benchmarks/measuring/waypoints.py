"""The measured commands: those of an ideal point flown through waypoints."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import cycle
from typing import Final, NamedTuple

from benchmarks.measuring.schedule import PACKET_PERIOD_S

WAYPOINTS_M: Final = ((0.0, 0.0), (3.0, 0.0), (3.0, 3.0), (0.0, 3.0))
SPEED_M_S: Final = 1.0
GAIN_1_S: Final = 1.2  #: speed per distance
REACHED_M: Final = 0.1


class Setpoint(NamedTuple):
    """Velocity [m/s] in the body's axes, x forward and y left, and yaw rate [rad/s] counter-clockwise."""

    forward: float
    left: float
    yaw_rate: float


def fly(period_s: float = PACKET_PERIOD_S) -> Iterator[Setpoint]:
    """Yield a set-point each period, forever, like a controller that flies from waypoint to waypoint."""
    x = y = yaw = 0.0
    for target_x, target_y in cycle(WAYPOINTS_M):
        while (away := math.hypot(target_x - x, target_y - y)) > REACHED_M:
            speed = min(SPEED_M_S, GAIN_1_S * away)
            bearing = math.atan2(target_y - y, target_x - x) - yaw
            turn = math.atan2(math.sin(bearing), math.cos(bearing))
            setpoint = Setpoint(speed * math.cos(bearing), speed * math.sin(bearing), max(-1.0, min(1.0, turn)))
            x += speed * math.cos(bearing + yaw) * period_s
            y += speed * math.sin(bearing + yaw) * period_s
            yaw += setpoint.yaw_rate * period_s
            yield setpoint
