"""How fast a vehicle moves that does not report it, by its attitude. Pure: times are on the proxy's clock.

A vehicle that keeps its height accelerates by gravity times the tangent of its tilt, less the drag of the air. So the
attitude, integrated, gives the velocity through the air; drag makes it forget its errors after two seconds. The wind
and a drag other than the assumed one remain as an error, but one that changes slowly: differences, such as how much
faster than a target the vehicle moves, are right. To fly at a speed against its own drag estimate also holds a vehicle
against the wind, as an integral would: the estimate is the tilt, averaged.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import seconds
from skyloop.control.limiting import GRAVITY_M_S2
from skyloop.messages import Feedback, FlightState
from skyloop.messages.geometry import rotation_from_euler

Array = NDArray[np.float64]

#: Of a small quadrotor, at a few metres a second [1/s]: 0.58 was identified for an AR.Drone 2 (J. Engel, J. Sturm, D.
#: Cremers, "Camera-Based Navigation of a Low-Cost Quadrocopter", IROS 2012), 0.28 for an AR.Drone 1 (``sim/vehicles``).
DRAG_PER_S: Final = 0.45
_LONGEST_STEP_S: Final = 0.5  # longer gaps are not integrated over
_TILTING_S: Final = 0.3
_STEEPEST: Final = 0.5  # cosine of the tilt, beyond which the vehicle does not keep its height


class TiltVelocity:
    """Integrates attitude to the velocity through the air."""

    def __init__(self, drag_per_s: float = DRAG_PER_S) -> None:
        """Initialise the estimate: at rest.

        Args:
            drag_per_s: Deceleration per speed [1/s].
        """
        self.drag_per_s = drag_per_s
        self._velocity = np.zeros(2)  # horizontal, along yaw 0 and to its left
        self._last_ns: int | None = None

    def step(self, feedback: Feedback) -> tuple[float, float, float] | None:
        """Integrate the next sample.

        Args:
            feedback: The vehicle's newest state; landed, it is at rest.

        Returns:
            The velocity forward, left and up (which is 0), in the levelled body's axes [m/s]; None while the attitude
            is not known.
        """
        roll, pitch, yaw = feedback.roll_rad, feedback.pitch_rad, feedback.yaw_rad
        if roll is None or pitch is None or yaw is None:
            return None
        dt_s = 0.0 if self._last_ns is None else seconds(feedback.captured_ns - self._last_ns)
        self._last_ns = max(feedback.captured_ns, self._last_ns or feedback.captured_ns)
        if feedback.state is FlightState.LANDED:
            self._velocity = np.zeros(2)
        elif dt_s > 0.0:
            up = rotation_from_euler(roll, pitch, yaw)[:, 2]
            push = GRAVITY_M_S2 * up[:2] / max(_STEEPEST, up[2])
            kept = math.exp(-self.drag_per_s * min(dt_s, _LONGEST_STEP_S))
            self._velocity = kept * self._velocity + (1.0 - kept) / self.drag_per_s * push
        c, s = math.cos(yaw), math.sin(yaw)
        x, y = self._velocity.tolist()
        return c * x + s * y, c * y - s * x, 0.0


class Tilting:
    """How fast a vehicle tilted lately, by differences: for one whose feedback has no gyroscope."""

    def __init__(self) -> None:
        """Initialise: it does not tilt."""
        self._kept: deque[tuple[int, float, float]] = deque()

    def add(self, feedback: Feedback) -> None:
        """Note the next sample; one without roll and pitch, or not newer than the last, is ignored."""
        roll, pitch = feedback.roll_rad, feedback.pitch_rad
        if roll is None or pitch is None or (self._kept and feedback.captured_ns <= self._kept[-1][0]):
            return
        self._kept.append((feedback.captured_ns, roll, pitch))
        while seconds(feedback.captured_ns - self._kept[0][0]) > _TILTING_S:
            self._kept.popleft()

    @property
    def rate_rad_s(self) -> float:
        """The farthest that roll and pitch are apart within the last 0.3 s, per 0.15 s [rad/s]."""
        if not self._kept:
            return 0.0
        _, rolls, pitches = zip(*self._kept, strict=True)
        return math.hypot(max(rolls) - min(rolls), max(pitches) - min(pitches)) / (_TILTING_S / 2)
