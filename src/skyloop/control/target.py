"""Motion of the vehicle and of a target, for a vehicle that does not know its position. Pure.

Both are in *odometry axes*: levelled, x along yaw 0, z up, origin where the vehicle was at its first sample. The origin
drifts with the error of the vehicle's velocity. That does no harm here, because only differences over about a second
are used.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import seconds
from skyloop.control.kalman import ConstantVelocityFilter
from skyloop.messages import Feedback
from skyloop.messages.geometry import rotation_from_euler, wrap_angle

Array = NDArray[np.float64]

_HISTORY_S = 3.0
_LONGEST_STEP_S = 0.5  # longer gaps are not integrated over: the vehicle may have done anything
_SHORTEST_STEP_S = 0.02  # between samples that came later than they were sent, yaw says little about its rate
_EXTRAPOLATE_S = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """The vehicle's motion at one time, in odometry axes.

    Attributes:
        at_ns: On the proxy's clock.
        position: Shape (3,) [m].
        velocity: Shape (3,) [m/s].
        yaw: [rad]
        yaw_rate: [rad/s]
    """

    at_ns: int
    position: Array
    velocity: Array
    yaw: float
    yaw_rate: float

    def moved_to(self, at_ns: int) -> Motion:
        """Return the motion extrapolated to another time, by at most 0.3 s forward or back."""
        dt = max(-_EXTRAPOLATE_S, min(_EXTRAPOLATE_S, seconds(at_ns - self.at_ns)))
        yaw = wrap_angle(self.yaw + self.yaw_rate * dt)
        return Motion(at_ns, self.position + self.velocity * dt, self.velocity, yaw, self.yaw_rate)

    def to_body(self, horizontal: Array) -> tuple[float, float]:
        """Turn a horizontal vector (2,) from odometry axes into forward and left of the levelled body."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return float(c * horizontal[0] + s * horizontal[1]), float(c * horizontal[1] - s * horizontal[0])

    def stiffened(self, wanted: Array, share: float) -> Array:
        """Add a share of the present velocity error to a wanted velocity.

        Args:
            wanted: Shape (3,) in odometry axes [m/s].
            share: Of the difference between wanted and present velocity; 0 or more.
        """
        return wanted + share * (wanted - self.velocity)


class Odometry:
    """Integrates feedback's velocity and keeps the last three seconds, so that frames can be placed at capture."""

    def __init__(self) -> None:
        self._history: deque[Motion] = deque()

    def add(self, feedback: Feedback) -> None:
        """Integrate the next sample. Samples without velocity or yaw, or not newer than the last, are ignored."""
        if feedback.velocity_m_s is None or feedback.yaw_rad is None:
            return
        last = self._history[-1] if self._history else None
        if last is not None and feedback.captured_ns <= last.at_ns:
            return
        velocity = rotation_from_euler(0.0, 0.0, feedback.yaw_rad) @ np.asarray(feedback.velocity_m_s)
        rate = self._yaw_rate(feedback, last)
        position = np.zeros(3)
        if last is not None:
            dt = min(seconds(feedback.captured_ns - last.at_ns), _LONGEST_STEP_S)
            position = last.position + (last.velocity + velocity) * (dt / 2)
        self._history.append(Motion(feedback.captured_ns, position, velocity, feedback.yaw_rad, rate))
        while seconds(feedback.captured_ns - self._history[0].at_ns) > _HISTORY_S:
            self._history.popleft()

    def _yaw_rate(self, feedback: Feedback, last: Motion | None) -> float:
        """Return the yaw rate that is reported, or else that since the last sample: a Tello reports none."""
        if feedback.angular_velocity_rad_s is not None:
            return feedback.angular_velocity_rad_s[2]
        if last is None or feedback.yaw_rad is None:
            return 0.0
        dt_s = seconds(feedback.captured_ns - last.at_ns)
        if dt_s < _SHORTEST_STEP_S:
            return last.yaw_rate
        return wrap_angle(feedback.yaw_rad - last.yaw) / dt_s if dt_s <= _LONGEST_STEP_S else 0.0

    @property
    def newest(self) -> Motion | None:
        """The motion as of the last sample; None before the first."""
        return self._history[-1] if self._history else None

    def at(self, at_ns: int) -> Motion | None:
        """Return the motion at a time [ns], extrapolated from the nearest sample; None before the first."""
        if not self._history:
            return None
        nearest = self._history[-1]
        for motion in reversed(self._history):
            if abs(motion.at_ns - at_ns) > abs(nearest.at_ns - at_ns):
                break
            nearest = motion
        return nearest.moved_to(at_ns)


class TargetFilter:
    """Position and velocity of a point that is seen now and then: a filter that restarts after a jump."""

    def __init__(self) -> None:
        self._filter = ConstantVelocityFilter(3, intensity_m2_s3=0.1, speed_m_s=0.7, gate=math.inf)

    def see(self, position: Array, deviation_m: float, at_ns: int) -> None:
        """Update with a measured position. One that is older than the last is ignored.

        After two seconds unseen, or when the target is more than a metre (and five deviations) off, the filter
        restarts.

        Args:
            position: Shape (3,) [m].
            deviation_m: Standard deviation of each component.
            at_ns: When it was measured.
        """
        newest = self._filter.newest
        if newest is None or self._jumped(position, deviation_m, at_ns):
            self._filter.start(position, deviation_m, at_ns)
        else:
            self._filter.update(position, deviation_m, at_ns)

    def at(self, at_ns: int, *, longest_s: float = 1.0) -> tuple[Array, Array]:
        """Predict the target's motion.

        Args:
            at_ns: The time to predict for.
            longest_s: How far the last estimate is extrapolated at most.

        Returns:
            Position (3,) [m] and velocity (3,) [m/s].

        Raises:
            UsageError: The target was never seen.
        """
        estimate = self._filter.at(at_ns, longest_s=longest_s)
        return estimate.position, estimate.velocity

    def _jumped(self, position: Array, deviation_m: float, at_ns: int) -> bool:
        expected = self._filter.at(at_ns)
        unseen_s = 0.0 if self._filter.newest is None else seconds(at_ns - self._filter.newest.at_ns)
        spread = expected.covariance[0, 0] + deviation_m**2
        off = float(np.linalg.norm(position - expected.position))
        return unseen_s > 2.0 or (unseen_s >= 0.0 and off > max(1.0, 5 * math.sqrt(spread)))
