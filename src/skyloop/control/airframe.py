"""Tracking of a vehicle's recent motion, and base classes for the control laws that depend on it. Pure.

Motion is given in *odometry axes*: levelled, x along yaw 0, z up, origin at the first sample. Errors of the reported
velocity make the origin drift, which is harmless because the laws only use differences over about a second. The origin
may also jump after a gap (:attr:`Airframe.interruptions`). Times are on the proxy's clock.

A vehicle that holds its height but reports no velocity accelerates by gravity times the tangent of its tilt, minus air
drag. Integrating the attitude therefore gives its velocity through the air, and drag makes old errors fade within about
two seconds. Wind and an inaccurate drag constant cause a slowly changing error, so differences, such as the vehicle's
speed relative to its target, are still accurate. Holding a speed against the vehicle's own drag estimate also
compensates for wind, as an integral term would, because that estimate is the averaged tilt.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, Final

import msgspec
import numpy as np

from skyloop.clock import nanoseconds, seconds
from skyloop.control.limiting import GRAVITY_M_S2, Array, SetpointLimiter, SetpointLimits, clamped, within
from skyloop.messages import Feedback, FlightState, Vector, Velocity
from skyloop.messages.geometry import rotation_from_euler, turned, wrap_angle

STALE_S: Final = 0.5  #: age after which a value counts as unknown; after such a gap the odometry may have jumped
#: Drag on a small quadrotor at a few metres per second [1/s]. Identified values: 0.58 for an AR.Drone 2 (Engel, Sturm
#: and Cremers, "Camera-Based Navigation of a Low-Cost Quadrocopter", IROS 2012), 0.40 for an AR.Drone 1
#: (``sim/vehicles``).
DRAG_PER_S: Final = 0.45
_HISTORY_S: Final = 3.0  # length of the motion history
_SHORTEST_STEP_S: Final = 0.02  # shorter intervals between samples are due to delays and give unreliable yaw rates
_EXTRAPOLATE_S: Final = 0.3  # maximum time over which to extrapolate motion
_TILTING_S: Final = 0.3  # time over which the tilt rate is measured
_STEEPEST: Final = 0.5  # minimum cosine of the tilt; a vehicle that tilts more does not hold its height


def not_ahead(seen_ns: int | None, now_ns: int) -> int | None:
    """Return a sighting's time; None if it lies in the future, because such a sighting would seem fresh until then."""
    return None if seen_ns is not None and seconds(seen_ns - now_ns) > STALE_S else seen_ns


class Part(StrEnum):
    """A part of the vehicle's state that a control law may need."""

    ATTITUDE = "attitude"
    YAW = "yaw"
    VELOCITY = "velocity"
    HEIGHT = "height above the ground"
    POSITION = "position"


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """The vehicle's motion at a point in time, in odometry axes."""

    at_ns: int  #: time of the motion on the proxy's clock
    position: Array  #: shape (3,) [m]
    velocity: Array  #: shape (3,) [m/s]
    yaw: float  #: [rad]
    yaw_rate: float  #: [rad/s]

    def moved_to(self, at_ns: int) -> Motion:
        """Return the motion extrapolated to another time, at most 0.3 s forwards or backwards."""
        dt = clamped(seconds(at_ns - self.at_ns), _EXTRAPOLATE_S)
        yaw = wrap_angle(self.yaw + self.yaw_rate * dt)
        return Motion(at_ns, self.position + self.velocity * dt, self.velocity, yaw, self.yaw_rate)

    def to_body(self, horizontal: Array) -> tuple[float, float]:
        """Convert a horizontal vector (2,) from odometry axes to the levelled body's axes, forward and left."""
        return turned(float(horizontal[0]), float(horizontal[1]), -self.yaw)

    def stiffened(self, wanted: Array, share: float) -> Array:
        """Add a fraction of the current velocity error to a desired velocity.

        Args:
            wanted: The desired velocity in odometry axes, (3,) [m/s].
            share: Fraction of the difference between the desired and the current velocity to add; 0 or more.
        """
        return wanted + share * (wanted - self.velocity)


class Airframe:
    """A vehicle's motion over the last three seconds and the age of each part of its state.

    Attributes:
        feedback: The newest sample, with non-finite values removed; None before the first sample.
        by_tilt: Whether the vehicle reports no velocity, so that :class:`TiltVelocity` estimates it from the attitude.
        interruptions: Number of times the motion was unknown for longer than :data:`STALE_S` or the history restarted.
            Positions in odometry axes stored before that are wrong by the distance flown meanwhile.
    """

    def __init__(self, *needs: Part) -> None:
        """Initialise the airframe.

        Args:
            *needs: Parts of the state that the caller can't fly without; see :meth:`missing`.
        """
        self.feedback: Feedback | None = None
        self.by_tilt = False
        self.interruptions = 0
        self._needs = needs
        self._known: dict[Part, tuple[int, Any]] = {}  # time and value of each known part
        self._history: deque[Motion] = deque()
        self._reckoning = TiltVelocity()
        self._tilts: deque[tuple[int, float, float]] = deque()

    def add(self, feedback: Feedback) -> None:
        """Update with the next sample; ignore it if it is not newer than the last one.

        Args:
            feedback: The new sample; non-finite values count as missing. If it is several seconds older than the last
                one, the history restarts, because the last sample's time was wrong or the proxy's clock was set back.
        """
        at_ns = feedback.captured_ns
        if self.feedback is not None and seconds(self.feedback.captured_ns - at_ns) > _HISTORY_S:
            self._restart_history(at_ns)
        elif self.feedback is not None and at_ns <= self.feedback.captured_ns:
            return
        self.feedback = feedback = _finite(feedback)
        roll, pitch, yaw = feedback.roll_rad, feedback.pitch_rad, feedback.yaw_rad
        if roll is not None and pitch is not None:
            self._tilts.append((at_ns, roll, pitch))
            while seconds(at_ns - self._tilts[0][0]) > _TILTING_S:
                self._tilts.popleft()
        if yaw is not None:
            self._known[Part.YAW] = at_ns, yaw
            if roll is not None and pitch is not None:
                self._known[Part.ATTITUDE] = at_ns, (roll, pitch, yaw)
            velocity = self._reckoning.step(feedback) if self.by_tilt else feedback.velocity_m_s
            if velocity is not None:
                self._known[Part.VELOCITY] = at_ns, velocity
                self._integrate(feedback, velocity, yaw)
        if feedback.altitude_m is not None:
            self._known[Part.HEIGHT] = at_ns, feedback.altitude_m
        if feedback.position_m is not None:
            self._known[Part.POSITION] = at_ns, feedback.position_m

    def age_s(self, part: Part, now_ns: int) -> float:
        """Return the age of a part of the state [s]; infinite if it was never known."""
        known = self._known.get(part)
        return math.inf if known is None else seconds(now_ns - known[0])

    def missing(self, now_ns: int) -> str:
        """Return a sentence naming the required parts of the state that are unknown; empty if all are known."""
        old = [part.value for part in self._needs if abs(self.age_s(part, now_ns)) > STALE_S]
        return f"the vehicle's {' and '.join(old)} {'is' if len(old) == 1 else 'are'} not known" if old else ""

    def altitude_m(self, now_ns: int) -> float | None:
        """Return the newest height above the ground [m]; None if it is unknown."""
        altitude: float | None = self._newest(Part.HEIGHT, now_ns)
        return altitude

    def yaw_rad(self, now_ns: int) -> float | None:
        """Return the newest yaw [rad]; None if it is unknown."""
        yaw: float | None = self._newest(Part.YAW, now_ns)
        return yaw

    def position_m(self, now_ns: int, *, longest_s: float = STALE_S) -> Vector | None:
        """Return the newest position in world axes [m]; None if it is unknown or older than ``longest_s``."""
        position: Vector | None = self._newest(Part.POSITION, now_ns, longest_s)
        return position

    @property
    def newest(self) -> Motion | None:
        """Motion from the last sample that contained it, regardless of its age; None before the first such sample."""
        return self._history[-1] if self._history else None

    def at(self, at_ns: int) -> Motion | None:
        """Return the motion at a given time [ns], extrapolated from the nearest sample.

        None if there is no sample within :data:`STALE_S`.
        """
        if not self._history:
            return None
        nearest = self._history[-1]
        for motion in reversed(self._history):
            if abs(motion.at_ns - at_ns) > abs(nearest.at_ns - at_ns):
                break
            nearest = motion
        return nearest.moved_to(at_ns) if abs(seconds(nearest.at_ns - at_ns)) <= STALE_S else None

    def at_capture(self, frame: Feedback, captured_ns: int, *seen: Array) -> tuple[Motion, Array] | None:
        """Return the motion when a frame was captured, and the rotation (3, 3) from the body to odometry axes.

        Args:
            frame: Feedback with the attitude at the time when the frame was captured.
            captured_ns: Capture time of the frame.
            *seen: Measurements from the frame.

        Returns:
            None if the motion or attitude is unknown or a measurement is not finite.
        """
        motion, frame = self.at(captured_ns), _finite(frame)
        if motion is None or frame.roll_rad is None or frame.pitch_rad is None or frame.yaw_rad is None:
            return None
        return (motion, frame.rotation) if all(np.isfinite(one).all() for one in seen) else None

    @property
    def tilt_rate_rad_s(self) -> float:
        """Recent tilt rate, computed from differences because some vehicles report no gyroscope data.

        Root sum square of the roll and pitch ranges over the last 0.3 s, divided by 0.15 s [rad/s].
        """
        if not self._tilts:
            return 0.0
        _, rolls, pitches = zip(*self._tilts, strict=True)
        return math.hypot(max(rolls) - min(rolls), max(pitches) - min(pitches)) / (_TILTING_S / 2)

    def _newest(self, part: Part, now_ns: int, longest_s: float = STALE_S) -> Any:
        return self._known[part][1] if abs(self.age_s(part, now_ns)) <= longest_s and part in self._known else None

    def _restart_history(self, at_ns: int) -> None:
        """Restart the history at the last known position, because the vehicle is still close to it."""
        self._known.clear()
        self._tilts.clear()
        self._reckoning = TiltVelocity()
        if self._history:
            before = replace(self._history[-1], at_ns=at_ns - nanoseconds(STALE_S))
            self._history = deque([before])
            self.interruptions += 1

    def _integrate(self, feedback: Feedback, levelled: Vector, yaw: float) -> None:
        last, at_ns = self.newest, feedback.captured_ns
        velocity = rotation_from_euler(0.0, 0.0, yaw) @ np.asarray(levelled)
        position = np.zeros(3)
        if last is not None:
            dt = seconds(at_ns - last.at_ns)
            self.interruptions += dt > STALE_S
            position = last.position + (last.velocity + velocity) * (min(dt, STALE_S) / 2)
        self._history.append(Motion(at_ns, position, velocity, yaw, _yaw_rate(feedback, yaw, last)))
        while seconds(at_ns - self._history[0].at_ns) > _HISTORY_S:
            self._history.popleft()


class TiltVelocity:
    """Velocity through the air, integrated from the attitude."""

    def __init__(self, drag_per_s: float = DRAG_PER_S) -> None:
        """Initialise the estimate at rest.

        Args:
            drag_per_s: Deceleration per unit of speed [1/s].
        """
        self.drag_per_s = drag_per_s
        self._velocity = np.zeros(2)  # horizontal components along yaw 0 and to the left of it
        self._last_ns: int | None = None

    def step(self, feedback: Feedback) -> tuple[float, float, float] | None:
        """Integrate the next sample.

        Args:
            feedback: The vehicle's newest state; a landed vehicle is taken to be at rest.

        Returns:
            The velocity forward, left, up (0) in the levelled body's axes [m/s]; None if the attitude is unknown.
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
            kept = math.exp(-self.drag_per_s * min(dt_s, STALE_S))
            self._velocity = kept * self._velocity + (1.0 - kept) / self.drag_per_s * push
        x, y = self._velocity.tolist()
        return *turned(x, y, -yaw), 0.0


class AirframeLaw:
    """Base class for control laws that hover while any part of the vehicle's state that they need is unknown.

    Attributes:
        airframe: The recent motion of the vehicle.
        problem: The reason for hovering at the last step; empty if the law is flying the vehicle.
    """

    def __init__(self, *needs: Part) -> None:
        """Initialise the control law.

        Args:
            *needs: Parts of the state that the law can't fly without.
        """
        self.airframe = Airframe(*needs)
        self.problem = ""
        self._altitude: float | None = None  # altitude at the last step; None if unknown
        self._last_ns: int | None = None  # time of the last step

    def feedback(self, feedback: Feedback) -> None:
        """Update with the vehicle's newest state."""
        before = self.airframe.interruptions
        self.airframe.add(feedback)
        if self.airframe.interruptions != before:
            self.forget()

    def pause(self) -> None:
        """Restart from rest after another client has flown the vehicle or its motion was unknown."""
        self._last_ns = None

    def forget(self) -> None:
        """Forget everything stored in odometry axes, because the motion was interrupted."""

    def _ready(self, now_ns: int) -> bool:
        """Return whether all required parts of the state are known; pause if not, or after a long gap between steps."""
        self.problem = self.airframe.missing(now_ns)
        self._altitude = self.airframe.altitude_m(now_ns)
        if self.problem or (self._last_ns is not None and seconds(now_ns - self._last_ns) > STALE_S):
            self.pause()
        return not self.problem

    def _since_s(self, now_ns: int) -> float:
        """Return the time since the last step [s]; 0 after a pause."""
        last_ns, self._last_ns = self._last_ns, now_ns
        return 0.0 if last_ns is None else max(0.0, seconds(now_ns - last_ns))

    def _motion(self, at_ns: int) -> Motion:
        """Return the motion at a given time; the caller must have checked that the motion is known."""
        motion = self.airframe.at(at_ns)
        assert motion is not None, "a law without its motion is not ready"
        return motion


class VelocityLaw(AirframeLaw):
    """Base class for control laws whose set-points are velocities within limits."""

    def __init__(self, limits: SetpointLimits, *needs: Part) -> None:
        """Initialise the control law.

        Args:
            limits: Limits for the set-points.
            *needs: Parts of the state that the law can't fly without.
        """
        super().__init__(*needs)
        self._limiter = SetpointLimiter(limits)

    def step(self, now_ns: int) -> Velocity:
        """Compute the current set-point, which is zero while any required part of the state is unknown."""
        if not self._ready(now_ns):
            return Velocity()
        return self._limiter.step(self._setpoint(now_ns), self._since_s(now_ns))

    def pause(self) -> None:
        """Restart the set-points from rest."""
        super().pause()
        self._limiter.reset(Velocity())

    def _setpoint(self, now_ns: int) -> Array:
        """Return forward, left, up [m/s] and yaw rate [rad/s], (4,), before limits are applied."""
        raise NotImplementedError


def _yaw_rate(feedback: Feedback, yaw: float, last: Motion | None) -> float:
    """Return the reported yaw rate or, if there is none (as on a Tello), the rate since the last sample."""
    if feedback.angular_velocity_rad_s is not None:
        return feedback.angular_velocity_rad_s[2]
    if last is None:
        return 0.0
    dt_s = seconds(feedback.captured_ns - last.at_ns)
    if dt_s < _SHORTEST_STEP_S:
        return last.yaw_rate
    return wrap_angle(yaw - last.yaw) / dt_s if dt_s <= STALE_S else 0.0


_NUMBERS: Final = ("roll_rad", "pitch_rad", "yaw_rad", "altitude_m")
_VECTORS: Final = ("velocity_m_s", "angular_velocity_rad_s", "position_m")


def _finite(feedback: Feedback) -> Feedback:
    """Return feedback with non-finite values removed, because a driver or a position source may be faulty."""
    wrong = [name for name in _NUMBERS if not math.isfinite(getattr(feedback, name) or 0.0)]
    wrong += [name for name in _VECTORS if not all(map(math.isfinite, getattr(feedback, name) or ()))]
    return msgspec.structs.replace(feedback, **dict.fromkeys(wrong)) if wrong else feedback


class TurningSearch:
    """A search with a forward-facing camera: turn on the spot, and change height after each full turn."""

    def __init__(
        self,
        turn_rad_s: float = 0.7,
        heights_m: tuple[float, ...] = (0.0, 0.4, -0.3, 0.8),
        lowest_m: float = 0.6,
        highest_m: float = 2.2,
    ) -> None:
        """Initialise the search.

        Args:
            turn_rad_s: Yaw rate.
            heights_m: Heights of successive full turns, relative to the height at the start.
            lowest_m: Minimum height above the ground.
            highest_m: Maximum height above the ground.
        """
        self._rate = turn_rad_s
        self._heights = heights_m
        self._lowest, self._highest = lowest_m, highest_m
        self._direction = 1.0
        self._turned = 0.0
        self._yaw: float | None = None
        self._base: float | None = None

    def restart(self, *, turning: float) -> None:
        """Start the next search in the direction in which the vehicle is already turning.

        Args:
            turning: Yaw rate [rad/s], positive counter-clockwise; below 0.05 the previous direction is kept.
        """
        if abs(turning) > 0.05:
            self._direction = math.copysign(1.0, turning)
        self._turned, self._yaw, self._base = 0.0, None, None

    def step(self, yaw: float, altitude: float | None) -> Array:
        """Compute the set-point.

        Args:
            yaw: Yaw of the vehicle [rad].
            altitude: Height above the ground [m]; None to keep the current height.

        Returns:
            Forward, left, up [m/s] and yaw rate [rad/s], (4,).
        """
        if self._yaw is not None:
            self._turned += abs(wrap_angle(yaw - self._yaw))
        self._yaw = yaw
        up = 0.0
        if altitude is not None:
            self._base = altitude if self._base is None else self._base
            sweep = int(self._turned / (2 * math.pi))
            goal = self._base + self._heights[sweep % len(self._heights)]
            goal = within(goal, self._lowest, self._highest)
            up = clamped(0.8 * (goal - altitude), 0.4)
        return np.array([0.0, 0.0, up, self._direction * self._rate])
