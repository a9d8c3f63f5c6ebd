"""The thrust field of ``SET_ATTITUDE_TARGET`` for a climb rate. Pure.

ArduCopter takes it as a climb rate: 0.5 holds the altitude. PX4 takes it as collective thrust, and altitude is ours to
hold: a proportional and integral loop on the climb rate, whose integral is an altitude error.
"""

from __future__ import annotations

import math
from typing import Final, Protocol

STANDARD_GRAVITY: Final = 9.80665  #: m/s²
CLIMB_GAIN_PER_S: Final = 2.0
ALTITUDE_GAIN_PER_S2: Final = 0.8
MOST_ALTITUDE_ERROR_M: Final = 1.5
LEAST_THRUST: Final = 0.1
MOST_THRUST: Final = 0.9


class Lift(Protocol):
    """One flight by attitude."""

    def climb_within(self, climb_m_s: float) -> float:
        """The climb rate that is really asked for."""

    def thrust(self, climb_m_s: float, climbing_m_s: float | None, tilt_rad: float, step_s: float) -> float:
        """From 0 to 1. ``climbing_m_s``: measured, if known; ``tilt_rad``: that is asked for; ``step_s``: since the
        last call."""


class ClimbByShare:
    """ArduCopter: a share of its fastest climb, or of its fastest descent."""

    def __init__(self, up_m_s: float, down_m_s: float) -> None:
        self._up, self._down = up_m_s, down_m_s

    def climb_within(self, climb_m_s: float) -> float:
        return max(-self._down, min(self._up, climb_m_s))

    def thrust(self, climb_m_s: float, climbing_m_s: float | None, tilt_rad: float, step_s: float) -> float:  # noqa: ARG002
        climb = self.climb_within(climb_m_s)
        return 0.5 + 0.5 * climb / (self._up if climb > 0 else self._down)


class ClimbByThrust:
    """PX4: ``hover`` is the thrust that carries the weight (``MPC_THR_HOVER``)."""

    def __init__(self, hover: float) -> None:
        self._hover = hover if math.isfinite(hover) and 0.1 <= hover <= 0.9 else 0.5
        self._error_m = 0.0

    def climb_within(self, climb_m_s: float) -> float:
        return climb_m_s

    def thrust(self, climb_m_s: float, climbing_m_s: float | None, tilt_rad: float, step_s: float) -> float:
        error = climb_m_s - climbing_m_s if climbing_m_s is not None else 0.0
        self._error_m += error * step_s
        self._error_m = max(-MOST_ALTITUDE_ERROR_M, min(MOST_ALTITUDE_ERROR_M, self._error_m))
        upward = CLIMB_GAIN_PER_S * error + ALTITUDE_GAIN_PER_S2 * self._error_m
        thrust = self._hover * (1.0 + upward / STANDARD_GRAVITY) / max(0.5, math.cos(tilt_rad))
        return max(LEAST_THRUST, min(MOST_THRUST, thrust))
