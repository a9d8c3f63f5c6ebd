"""A Kalman filter of a point that goes straight, turns or speeds up, such as a platform on wheels. Pure.

The horizontal state is (x, y, vx, vy, ω, ax, ay): a coordinated turn with an unknown turn rate (Bar-Shalom, Li and
Kirubarajan, "Estimation with Applications to Tracking and Navigation", Wiley 2001, section 11.7) and an acceleration
that fades (Singer, "Estimating Optimal Tracking Filter Performance for Manned Maneuvering Targets", IEEE T-AES 6(4),
1970). What is fast and turns is explained by the turn, which is predicted to go on; what is slow, by the acceleration;
with neither it is the straight motion of :mod:`.kalman`. The height has a filter of its own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import nanoseconds, seconds
from skyloop.control.kalman import ConstantVelocityFilter, Estimate
from skyloop.control.limiting import within
from skyloop.errors import UsageError

Array = NDArray[np.float64]

_SEEN = np.eye(2, 7)  # what of the state is measured
_STEP_S = 0.1  # longest step of a prediction: within it the acceleration keeps its direction
_STRAIGHT_RAD = 1e-4  # below this angle the transition is computed by its series
_HEIGHT_INTENSITY_M2_S3 = 0.01
_CLIMB_M_S = 0.3  # standard deviation of the vertical velocity at first


@dataclass(frozen=True, slots=True, eq=False)
class TurnEstimate:
    """Motion of a point at one time.

    Attributes:
        at_ns: The time.
        position: (3,) [m].
        velocity: (3,) [m/s].
        turn_rate: Of the horizontal velocity, counter-clockwise from above [rad/s].
        extra: Horizontal acceleration beside that of the turn, (2,) [m/s²].
        covariance: Of x, y, their velocities, the turn rate and the extra acceleration, (7, 7).
    """

    at_ns: int
    position: Array
    velocity: Array
    turn_rate: float
    extra: Array
    covariance: Array

    @property
    def acceleration(self) -> Array:
        """Horizontal acceleration, (2,) [m/s²]."""
        return self.extra + self.turn_rate * np.array([-self.velocity[1], self.velocity[0]])

    @property
    def turning_rad_s(self) -> float:
        """How fast the horizontal velocity turns, by both accelerations, either way; 0 for what stands."""
        (vx, vy), (ax, ay) = self.velocity[:2].tolist(), self.acceleration.tolist()
        squared = vx * vx + vy * vy
        return abs(vx * ay - vy * ax) / squared if squared > 0.0 else 0.0

    @property
    def deviation_m(self) -> float:
        """Standard deviation of the horizontal position."""
        return math.sqrt(float(self.covariance[0, 0] + self.covariance[1, 1]))

    @property
    def speed_deviation_m_s(self) -> float:
        """Standard deviation of the horizontal velocity."""
        return math.sqrt(float(self.covariance[2, 2] + self.covariance[3, 3]))


class TurningTargetFilter:
    """Estimates the motion of a point in levelled axes from measured positions. Times are nanoseconds on one clock.

    Attributes:
        refused: Measurements outside of the gate since the last one within it.
    """

    def __init__(
        self,
        *,
        intensity_m2_s3: float = 0.01,
        speed_m_s: float = 2.0,
        turn_rad_s: float = 0.3,
        turn_wander_rad_s: float = 0.06,
        extra_m_s2: float = 0.3,
        extra_s: float = 2.0,
        gate: float = 8.0,
    ) -> None:
        """Initialise the filter.

        Args:
            intensity_m2_s3: Of the acceleration's white noise, beside the other two.
            speed_m_s: Standard deviation of each component of the velocity at first.
            turn_rad_s: Standard deviation of the turn rate at first.
            turn_wander_rad_s: By how much the turn rate wanders within a second.
            extra_m_s2: Standard deviation of each component of the acceleration beside the turn.
            extra_s: Within this time that acceleration fades to a third; above 0.
            gate: Positions farther off than so many standard deviations (Mahalanobis distance) are refused.

        Raises:
            UsageError: An argument is out of its range.
        """
        given = {
            "intensity_m2_s3": intensity_m2_s3,
            "speed_m_s": speed_m_s,
            "turn_rad_s": turn_rad_s,
            "turn_wander_rad_s": turn_wander_rad_s,
            "extra_m_s2": extra_m_s2,
        }
        for name, value in given.items():
            if not 0.0 <= value < math.inf:
                raise UsageError(f"{name} is {value!r} and must be a finite number, 0 or more")
        if not gate > 0.0:
            raise UsageError(f"gate is {gate!r} and must be above 0")
        if not 0.0 < extra_s < math.inf:
            raise UsageError(f"extra_s is {extra_s!r} and must be a finite number above 0")
        self._intensity = intensity_m2_s3
        first = [0.0, 0.0, speed_m_s, speed_m_s, turn_rad_s, extra_m_s2, extra_m_s2]
        self._first = np.diag(np.square(first))
        self._again = turn_rad_s**2 / 9
        self._wander = turn_wander_rad_s**2
        self._extra, self._fade_s = extra_m_s2**2, extra_s
        self._gate = gate
        self._height = ConstantVelocityFilter(1, intensity_m2_s3=_HEIGHT_INTENSITY_M2_S3, speed_m_s=_CLIMB_M_S)
        self._estimate: TurnEstimate | None = None
        self.refused = 0

    @property
    def newest(self) -> TurnEstimate | None:
        """The estimate as of the last measurement; None before the first."""
        return self._estimate

    def start(self, position: Array, deviation_m: float, at_ns: int) -> TurnEstimate:
        """Restart at a measured position, with velocity 0.

        Args:
            position: As in :meth:`update`.
            deviation_m: As in :meth:`update`.
            at_ns: When it was measured.

        Raises:
            UsageError: The shape is wrong, or a number is not finite.
        """
        place = _checked(position, deviation_m)
        covariance = self._first + _SEEN.T @ _SEEN * deviation_m**2
        rate = 0.0
        if self._estimate is not None:  # what turned may well go on turning
            rate, known = self._estimate.turn_rate, float(self._estimate.covariance[4, 4])
            covariance[4, 4] = min(covariance[4, 4], known + self._again)
        height = self._height.start(place[2:], deviation_m, at_ns)
        self.refused = 0
        self._estimate = _combined(at_ns, np.array([*place[:2], 0.0, 0.0, rate, 0.0, 0.0]), covariance, height)
        return self._estimate

    def update(self, position: Array, deviation_m: float, at_ns: int) -> bool:
        """Update with a measured position.

        Args:
            position: Shape (3,) [m].
            deviation_m: Standard deviation of each component, above 0.
            at_ns: When it was measured.

        Returns:
            Whether it was used; False outside of the gate (counted in :attr:`refused`), or if older than the last one.

        Raises:
            UsageError: The shape is wrong, or a number is not finite.
        """
        if self._estimate is None:
            self.start(position, deviation_m, at_ns)
            return True
        place = _checked(position, deviation_m)
        if at_ns < self._estimate.at_ns:
            return False
        before = self.at(at_ns)
        noise = np.eye(2) * deviation_m**2
        spread = before.covariance[:2, :2] + noise
        innovation = place[:2] - before.position[:2]
        if innovation @ np.linalg.solve(spread, innovation) > self._gate**2:
            self.refused += 1
            return False
        self.refused = 0
        share = np.linalg.solve(spread, before.covariance[:2]).T  # the gain, (7, 2)
        state = np.array([*before.position[:2], *before.velocity[:2], before.turn_rate, *before.extra])
        state = state + share @ innovation
        keep = np.eye(7) - share @ _SEEN
        covariance = keep @ before.covariance @ keep.T + share @ noise @ share.T
        if not self._height.update(place[2:], deviation_m, at_ns):
            self._height.start(place[2:], deviation_m, at_ns)
        self._estimate = _combined(at_ns, state, covariance, self._height.at(at_ns))
        return True

    def at(self, at_ns: int, *, longest_s: float = math.inf) -> TurnEstimate:
        """Predict the motion for a time; before the last measurement it is the estimate as of that measurement.

        Args:
            at_ns: The time to predict for.
            longest_s: How far the last measurement is extrapolated at most.

        Raises:
            UsageError: There was no measurement.
        """
        if self._estimate is None:
            raise UsageError("the target was never seen")
        return self.predicted(self._estimate, at_ns, longest_s=longest_s)

    def predicted(self, last: TurnEstimate, at_ns: int, *, longest_s: float = math.inf) -> TurnEstimate:
        """Predict the motion from any estimate of this filter; see :meth:`at`."""
        left_s = within(seconds(at_ns - last.at_ns), 0.0, longest_s)
        steps = math.ceil(left_s / _STEP_S)
        for _ in range(steps):
            last = self._moved(last, left_s / steps)
        return last

    def _moved(self, last: TurnEstimate, dt: float) -> TurnEstimate:
        """Predict one step [s]."""
        (x, y, z), (vx, vy, climb), rate, (ax, ay) = last.position, last.velocity, last.turn_rate, last.extra
        along, aside, by_along, by_aside = _turn(rate, dt)
        c, s, fade = math.cos(rate * dt), math.sin(rate * dt), math.exp(-dt / self._fade_s)
        half = dt * dt / 2
        move = np.eye(7)
        move[:4, 2:4] = [[along, -aside], [aside, along], [c, -s], [s, c]]
        move[:4, 4] = [
            by_along * vx - by_aside * vy,
            by_aside * vx + by_along * vy,
            -dt * (s * vx + c * vy),
            dt * (c * vx - s * vy),
        ]
        move[0, 5] = move[1, 6] = half
        move[2, 5] = move[3, 6] = dt
        move[5, 5] = move[6, 6] = fade
        wander = np.zeros((7, 7))
        wander[:4, :4] = np.kron(np.array([[dt**3 / 3, half], [half, dt]]) * self._intensity, np.eye(2))
        wander[4, 4] = self._wander * dt
        wander[5, 5] = wander[6, 6] = self._extra * (1.0 - fade * fade)
        return TurnEstimate(
            last.at_ns + nanoseconds(dt),
            np.array(
                [x + along * vx - aside * vy + half * ax, y + aside * vx + along * vy + half * ay, z + climb * dt]
            ),
            np.array([c * vx - s * vy + dt * ax, s * vx + c * vy + dt * ay, climb]),
            rate,
            last.extra * fade,
            move @ last.covariance @ move.T + wander,
        )


def _turn(rate: float, dt: float) -> tuple[float, float, float, float]:
    """Return sin(ωt)/ω and (1 - cos(ωt))/ω [s], and their derivatives by ω [s²]."""
    angle = rate * dt
    if abs(angle) < _STRAIGHT_RAD:
        return dt, angle * dt / 2, -angle * dt * dt / 3, dt * dt / 2
    along, aside = math.sin(angle) / rate, (1.0 - math.cos(angle)) / rate
    return along, aside, (dt * math.cos(angle) - along) / rate, (dt * math.sin(angle) - aside) / rate


def _combined(at_ns: int, state: Array, covariance: Array, height: Estimate) -> TurnEstimate:
    position = np.array([*state[:2], height.position[0]])
    velocity = np.array([*state[2:4], height.velocity[0]])
    return TurnEstimate(at_ns, position, velocity, float(state[4]), state[5:].copy(), covariance)


def _checked(position: Array, deviation_m: float) -> Array:
    place = np.asarray(position, dtype=np.float64)
    if place.shape != (3,) or not np.isfinite(place).all():
        raise UsageError(f"a measured position must be three finite numbers, got {position!r}")
    if not 0.0 < deviation_m < math.inf:
        raise UsageError(f"deviation_m is {deviation_m!r} and must be a finite number above 0")
    return place
