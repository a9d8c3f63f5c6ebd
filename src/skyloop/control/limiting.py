"""Limits on the magnitude and rate of change of numbers, vectors and set-points. Pure.

NaN never passes through: it is replaced with 0 or the allowed number nearest to 0.
"""

from __future__ import annotations

import math
from collections.abc import Container, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import UsageError
from skyloop.messages import Value, Velocity
from skyloop.messages.geometry import clamped, within

__all__ = ["GRAVITY_M_S2", "SetpointLimiter", "SetpointLimits", "clamped", "lowered", "shortened", "within"]

Array = NDArray[np.float64]
GRAVITY_M_S2 = 9.80665  #: standard gravity
_LONGEST_STEP_S = 0.2  # maximum time step, so that a longer pause does not allow a larger change


def shortened(vector: Array, longest: float) -> Array:
    """Return a vector (n,), shortened if it is longer than ``longest``; zero if a component is not finite."""
    length = math.sqrt(float(vector @ vector))
    if length <= longest and length < math.inf:
        return vector
    return vector * (longest / length) if length < math.inf else np.zeros_like(vector)


def lowered(own: float, limits: Mapping[str, Value], name: str, less: float = 0.0) -> float:
    """Return a number, reduced to a drone's limit if the limit is lower.

    Args:
        own: The number to limit.
        limits: Limits as in ``drone.config``; a missing name means no limit.
        name: Name of the limit.
        less: Margin to stay below the limit.
    """
    limit = limits.get(name)
    return own if isinstance(limit, bool) or not isinstance(limit, int | float) else min(own, limit - less)


@dataclass(frozen=True, slots=True)
class SetpointLimits:
    """Limits on velocity set-points and their rates of change; infinite means no limit.

    Raises:
        UsageError: A limit is not greater than 0.
    """

    speed_m_s: float = math.inf  #: horizontal speed
    climb_m_s: float = math.inf
    turn_rad_s: float = math.inf
    acceleration_m_s2: float = math.inf  #: horizontal acceleration; more would tilt a camera off its target
    climb_acceleration_m_s2: float = math.inf
    turn_acceleration_rad_s2: float = math.inf

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if not value > 0.0:
                raise UsageError(f"{name} is {value!r} and must be above 0")


def require_positive(zero: Container[str] = (), **values: float) -> None:
    """Raise UsageError unless all values are finite and greater than 0; those named in ``zero`` may be 0."""
    for name, value in values.items():
        if not (0.0 < value < math.inf or (value == 0.0 and name in zero)):
            allowed = "a finite number, 0 or more" if name in zero else "a finite number above 0"
            raise UsageError(f"{name} is {value!r} and must be {allowed}")


class SetpointLimiter:
    """Limits velocity set-points and the change from one to the next; the first change is not limited."""

    def __init__(self, limits: SetpointLimits) -> None:
        self.limits = limits
        self._last: Array | None = None

    def step(self, wanted: Array, dt_s: float) -> Velocity:
        """Limit the next set-point.

        Args:
            wanted: Forward, left, up [m/s] and yaw rate [rad/s], shape (4,); non-finite values count as 0.
            dt_s: Time since the last call; capped at 0.2 s, so that a pause does not allow a larger step.
        """
        limits, dt = self.limits, within(dt_s, 0.0, _LONGEST_STEP_S)
        result = np.nan_to_num(np.asarray(wanted, dtype=np.float64), posinf=0.0, neginf=0.0)
        result[:2] = shortened(result[:2], limits.speed_m_s)
        result[2] = clamped(float(result[2]), limits.climb_m_s)
        result[3] = clamped(float(result[3]), limits.turn_rad_s)
        if self._last is not None:
            change = result - self._last
            change[:2] = shortened(change[:2], _change(limits.acceleration_m_s2, dt))
            change[2] = clamped(float(change[2]), _change(limits.climb_acceleration_m_s2, dt))
            change[3] = clamped(float(change[3]), _change(limits.turn_acceleration_rad_s2, dt))
            result = self._last + change
        self._last = result
        forward, left, up, yaw_rate = result.tolist()
        return Velocity(forward=forward, left=left, up=up, yaw_rate=yaw_rate)

    def reset(self, last: Velocity | None = None) -> None:
        """Restart from a set-point; if it is None, the next change is not limited."""
        self._last = None if last is None else np.array([last.forward, last.left, last.up, last.yaw_rate])


def _change(rate: float, dt_s: float) -> float:
    return math.inf if math.isinf(rate) else rate * dt_s
