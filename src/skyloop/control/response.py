"""A model of how a vehicle responds to velocity set-points, used to predict its motion and invert the response. Pure.

The vehicle's own velocity loop is modelled as follows: ``delay_s`` after a set-point was sent, the loop demands a lean
proportional to the velocity error, plus a trim. The lean follows with a lag of ``lag_s``. Both the lean and the push of
the air accelerate the vehicle. The lean is known from the attitude. A Kalman filter for velocity and push attributes
the remaining acceleration to the push; the trim is the part of the lean that the velocity error does not explain. The
model includes all set-points in transit, so a control law can use the velocity that the vehicle will have when its
set-point takes effect, with gains that would otherwise make it oscillate (O. J. M. Smith, "Closer Control of Loops with
Dead Time", Chemical Engineering Progress 53(5), 1957). Such a law can also cancel the push before it causes an error (a
disturbance observer: Ohnishi, Shibata and Murakami, "Motion Control for Advanced Mechatronics", IEEE/ASME Trans.
Mechatronics 1(1), 1996).
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import asdict, dataclass

import numpy as np

from skyloop.clock import nanoseconds, seconds
from skyloop.control.filters import gain
from skyloop.control.limiting import GRAVITY_M_S2, Array, require_positive, shortened, within
from skyloop.errors import UsageError
from skyloop.estimation import corrected, drift
from skyloop.messages import Feedback
from skyloop.messages.geometry import rotation_from_euler

_STEP_S = 0.01  # time step of the prediction
_LONGEST_GAP_S = 0.25  # maximum gap in the feedback across which the model continues
_LONGEST_PREDICTION_S = 0.5  # maximum time to predict beyond the last feedback
_KEPT_SETPOINTS = 64  # number of recent set-points to keep


@dataclass(frozen=True, slots=True)
class ResponseSettings:
    """The response of a vehicle's velocity loop; the defaults describe the AR.Drone, from public sources."""

    gain_per_s: float = 2.0  #: acceleration demanded per m/s of velocity error
    lag_s: float = 0.1  #: time constant of the lean; Engel, Sturm and Cremers, IROS 2012, give a rate of 10 1/s
    delay_s: float = 0.05  #: time from sending a set-point until it takes effect in the loop
    tilt_rad: float = 0.5  #: maximum lean demanded by the loop; see also ``LandingSettings.within``
    push_m_s3: float = 1.5  #: typical change of the push of the air in one second [m/s² per √s]
    velocity_noise_m_s: float = 0.05  #: noise of the velocity reported in feedback
    trim_s: float = 0.3  #: time constant for learning the trim

    def __post_init__(self) -> None:
        require_positive({"delay_s"}, **asdict(self))
        if not self.tilt_rad < math.pi / 2:
            raise UsageError(f"tilt_rad is {self.tilt_rad!r} and must be below a quarter turn")

    @property
    def most_m_s2(self) -> float:
        """Maximum horizontal acceleration that leaning can produce."""
        return GRAVITY_M_S2 * math.tan(self.tilt_rad)


@dataclass(frozen=True, slots=True, eq=False)
class Predicted:
    """The predicted motion when a set-point sent now takes effect. Axes are horizontal, with x along yaw 0."""

    at_ns: int  #: time at which the set-point takes effect
    moved: Array  #: distance moved since the last feedback, (2,) [m]
    velocity: Array  #: velocity, (2,) [m/s]
    push: Array  #: acceleration caused by the air, (2,) [m/s²]
    trim: Array  #: acceleration that the loop demands in addition to its response to the velocity error, (2,) [m/s²]


class VelocityResponse:
    """Predicts a vehicle's horizontal motion from its feedback and the set-points in transit."""

    def __init__(self, settings: ResponseSettings | None = None) -> None:
        self.settings = settings or ResponseSettings()
        self._setpoints: deque[tuple[int, Array]] = deque(maxlen=_KEPT_SETPOINTS)  #: time of effect and velocity
        self._at_ns: int | None = None
        self._velocity = np.zeros(2)
        self._push = np.zeros(2)
        self._trim = np.zeros(2)
        self._lean = np.zeros(2)  # acceleration caused by the lean
        self._covariance = np.diag([self.settings.velocity_noise_m_s**2, 1.0])  # covariance of velocity and push

    def add(self, feedback: Feedback) -> None:
        """Update with the next sample; ignore it if it lacks velocity or attitude or is not newer than the last one.

        The model restarts if the sample is over half a second older than the last, whose time must have been wrong.
        """
        if feedback.velocity_m_s is None or feedback.yaw_rad is None:
            return
        if feedback.roll_rad is None or feedback.pitch_rad is None:
            return
        turn = rotation_from_euler(0.0, 0.0, feedback.yaw_rad)[:2, :2]
        velocity = turn @ np.asarray(feedback.velocity_m_s[:2])
        lean = turn @ (np.tan([feedback.pitch_rad, -feedback.roll_rad]) * GRAVITY_M_S2)
        before_ns = self._at_ns
        if before_ns is not None and seconds(before_ns - feedback.captured_ns) > _LONGEST_PREDICTION_S:
            before_ns = None  # the last sample's time was in the future and would hide all samples until then
            self._setpoints.clear()
        self._at_ns = max(feedback.captured_ns, before_ns or 0)
        if before_ns is None or seconds(feedback.captured_ns - before_ns) > _LONGEST_GAP_S:
            self._velocity, self._lean = velocity, lean
        elif feedback.captured_ns > before_ns:
            self._learn_trim(lean, before_ns, feedback.captured_ns)
            self._correct((self._lean + lean) / 2, velocity, seconds(feedback.captured_ns - before_ns))
            self._lean = lean

    def pause(self) -> None:
        """Forget the set-points in transit and the trim learned from them, because another client flew the vehicle."""
        self._setpoints.clear()
        self._trim = np.zeros(2)

    def sent(self, velocity: Array, now_ns: int) -> None:
        """Record a velocity set-point (2,) [m/s] sent now."""
        self._setpoints.append((now_ns + nanoseconds(self.settings.delay_s), np.asarray(velocity, dtype=np.float64)))

    def predict(self, now_ns: int) -> Predicted | None:
        """Predict the motion for the time at which a set-point sent now takes effect; None before any feedback."""
        if self._at_ns is None:
            return None
        end_ns = now_ns + nanoseconds(self.settings.delay_s)
        horizon_s = within(seconds(end_ns - self._at_ns), 0.0, _LONGEST_PREDICTION_S)
        steps = max(1, round(horizon_s / _STEP_S))
        dt = horizon_s / steps
        moved, velocity, lean = np.zeros(2), self._velocity, self._lean
        for step in range(steps):
            asked = self._asked(velocity, self._at_ns + nanoseconds((step + 0.5) * dt))
            lean = lean + gain(self.settings.lag_s, dt) * (asked - lean)
            moved = moved + velocity * dt
            velocity = velocity + (lean + self._push) * dt
        return Predicted(end_ns, moved, velocity, self._push, self._trim)

    def setpoint(self, acceleration: Array, motion: Predicted) -> Array:
        """Return the velocity set-point (2,) [m/s] that causes an acceleration (2,) [m/s²], up to the maximum lean."""
        by_lean = shortened(acceleration - motion.push, self.settings.most_m_s2)
        return motion.velocity + (by_lean - motion.trim) / self.settings.gain_per_s

    def _asked(self, velocity: Array, at_ns: int) -> Array:
        """Return the acceleration that the vehicle's loop demands by leaning."""
        setpoint = velocity  # without a set-point, assume that the vehicle keeps its velocity
        for from_ns, asked in reversed(self._setpoints):
            if from_ns <= at_ns:
                setpoint = asked
                break
        wanted = self.settings.gain_per_s * (setpoint - velocity) + self._trim
        return shortened(wanted, self.settings.most_m_s2)

    def _learn_trim(self, lean: Array, from_ns: int, to_ns: int) -> None:
        dt = seconds(to_ns - from_ns)
        asked = self._asked(self._velocity, (from_ns + to_ns) // 2)
        expected = self._lean + gain(self.settings.lag_s, dt) * (asked - self._lean)
        self._trim = self._trim + gain(self.settings.trim_s, dt) * (lean - expected) / gain(self.settings.lag_s, dt)
        self._trim = shortened(self._trim, self.settings.most_m_s2)

    def _correct(self, lean: Array, measured: Array, dt: float) -> None:
        """Run one step of the Kalman filter for velocity and push."""
        s = self.settings
        move, wander = drift(dt, s.push_m_s3**2)
        velocity = self._velocity + (lean + self._push) * dt
        state, covariance = np.array([velocity, self._push]), move @ self._covariance @ move.T + wander
        noise = np.array([[s.velocity_noise_m_s**2]])
        state, self._covariance = corrected(state, covariance, measured[None] - velocity, np.eye(1, 2), noise)
        self._velocity, self._push = state[0], shortened(state[1], s.most_m_s2)
