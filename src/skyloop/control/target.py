"""Where the vehicle went and where a target goes, from what a vehicle without a map knows. Pure.

Both live in *odometry axes*: levelled, x along yaw 0, z up, the origin wherever the vehicle was first heard. The
origin drifts with the vehicle's own velocity error, which does not matter here: only differences over about a second
are ever taken.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import seconds
from skyloop.messages import Feedback
from skyloop.messages.geometry import rotation_from_euler, wrap_angle

Array = NDArray[np.float64]

_HISTORY_S = 3.0
_LONGEST_STEP_S = 0.5  # a longer silence is not integrated over: the vehicle may have done anything
_EXTRAPOLATE_S = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """The vehicle at one time, in odometry axes: position and velocity (3,) [m, m/s], yaw and its rate [rad, rad/s]."""

    at_ns: int
    position: Array
    velocity: Array
    yaw: float
    yaw_rate: float

    def moved_to(self, at_ns: int) -> Motion:
        """The same motion carried on (or back) to another time, by at most 0.3 s."""
        dt = max(-_EXTRAPOLATE_S, min(_EXTRAPOLATE_S, seconds(at_ns - self.at_ns)))
        yaw = wrap_angle(self.yaw + self.yaw_rate * dt)
        return Motion(at_ns, self.position + self.velocity * dt, self.velocity, yaw, self.yaw_rate)


class Odometry:
    """Integrates feedback's velocity and keeps the last three seconds, so that a picture's capture can be placed."""

    def __init__(self) -> None:
        self._history: deque[Motion] = deque()

    def add(self, feedback: Feedback) -> None:
        """Take the next sample. Those without velocity or yaw, and those not newer than the last, are passed over."""
        if feedback.velocity is None or feedback.yaw is None:
            return
        last = self._history[-1] if self._history else None
        if last is not None and feedback.captured_ns <= last.at_ns:
            return
        velocity = rotation_from_euler(0.0, 0.0, feedback.yaw) @ np.asarray(feedback.velocity)
        rate = 0.0 if feedback.angular_velocity is None else feedback.angular_velocity[2]
        position = np.zeros(3)
        if last is not None:
            dt = min(seconds(feedback.captured_ns - last.at_ns), _LONGEST_STEP_S)
            position = last.position + (last.velocity + velocity) * (dt / 2)
        self._history.append(Motion(feedback.captured_ns, position, velocity, feedback.yaw, rate))
        while seconds(feedback.captured_ns - self._history[0].at_ns) > _HISTORY_S:
            self._history.popleft()

    def at(self, at_ns: int) -> Motion | None:
        """The vehicle's motion at a time, from the nearest sample; None before the first sample."""
        if not self._history:
            return None
        nearest = self._history[-1]
        for motion in reversed(self._history):
            if abs(motion.at_ns - at_ns) > abs(nearest.at_ns - at_ns):
                break
            nearest = motion
        return nearest.moved_to(at_ns)


class TargetFilter:
    """A constant-velocity Kalman filter of a point seen now and then; one covariance serves all three axes.

    Bar-Shalom, Li, Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001, section 6.3.2
    (discretised white-noise acceleration).
    """

    def __init__(self, *, acceleration_m_s2: float = 1.0, speed_m_s: float = 0.7) -> None:
        """``acceleration_m_s2``: how hard the target is expected to change its velocity; ``speed_m_s``: how fast it
        may be when first seen (both standard deviations)."""
        self._acceleration = acceleration_m_s2
        self._speed = speed_m_s
        self._state = np.zeros((2, 3))  # position, velocity
        self._covariance = np.zeros((2, 2))
        self._at_ns: int | None = None

    def see(self, position: Array, deviation_m: float, at_ns: int) -> None:
        """Take a measured position (3,) with its standard deviation. One older than the last is passed over.

        After two seconds unseen, or when the target is more than a metre (and five deviations) off, it starts anew.
        """
        if self._at_ns is None:
            self._restart(position, deviation_m, at_ns)
            return
        dt = seconds(at_ns - self._at_ns)
        if dt < 0:
            return
        move = np.array([[1.0, dt], [0.0, 1.0]])
        gain_in = np.array([dt * dt / 2, dt]) * self._acceleration
        state = move @ self._state
        covariance = move @ self._covariance @ move.T + np.outer(gain_in, gain_in)
        spread = covariance[0, 0] + deviation_m**2
        innovation = position - state[0]
        if dt > 2.0 or float(np.linalg.norm(innovation)) > max(1.0, 5 * math.sqrt(spread)):
            self._restart(position, deviation_m, at_ns)
            return
        gain = covariance[:, 0] / spread
        self._state = state + np.outer(gain, innovation)
        self._covariance = covariance - np.outer(gain, covariance[0])
        self._at_ns = at_ns

    def at(self, at_ns: int, *, longest_s: float = 1.0) -> tuple[Array, Array]:
        """Predicted position (3,) [m] and velocity (3,) [m/s]; the motion is carried on for ``longest_s`` at most."""
        if self._at_ns is None:
            raise ValueError("the target was never seen")
        dt = max(0.0, min(longest_s, seconds(at_ns - self._at_ns)))
        return self._state[0] + self._state[1] * dt, self._state[1].copy()

    def _restart(self, position: Array, deviation_m: float, at_ns: int) -> None:
        self._state = np.vstack([position, np.zeros(3)])
        self._covariance = np.diag([deviation_m**2, self._speed**2])
        self._at_ns = at_ns
