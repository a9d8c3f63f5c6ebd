"""Kalman filters for points seen intermittently. Pure. All times are in nanoseconds on the same clock.

:class:`ConstantVelocityFilter` assumes straight motion in any number of dimensions. :class:`TurningTargetFilter` also
models turns and acceleration, for example of a platform on wheels. Its horizontal state is (x, y, vx, vy, ω, ax, ay): a
coordinated turn with an unknown turn rate (Bar-Shalom, Li and Kirubarajan, "Estimation with Applications to Tracking
and Navigation", Wiley 2001, section 11.7) plus an acceleration that fades (Singer, "Estimating Optimal Tracking Filter
Performance for Manned Maneuvering Targets", IEEE T-AES 6(4), 1970). The turn accounts for fast motion on a curve and is
predicted to continue; the acceleration accounts for slow motion. The height has a separate filter.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from skyloop.clock import nanoseconds, seconds
from skyloop.control.limiting import Array, require_positive, within
from skyloop.errors import UsageError
from skyloop.estimation import corrected, drift

#: Lower bounds, absolute and relative, of a term added to an innovation's variance to avoid a division by zero if the
#: state is nearly exact.
_EXACT_M2, _ROUNDING = 1e-18, 1e-12

_SEEN = np.eye(2, 7)  # selection of the measured part of the state
_STEP_S = 0.1  # maximum time step of a prediction; within a step, the acceleration's direction is constant
_STRAIGHT_RAD = 1e-4  # angle below which the transition is computed by series expansion
_HEIGHT_INTENSITY_M2_S3 = 0.01  # intensity of the random vertical acceleration
_CLIMB_M_S = 0.3  # initial standard deviation of the vertical velocity


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """The position and velocity of a target at a point in time, with their covariance."""

    at_ns: int
    position: Array  #: position, (n,) [m]
    velocity: Array  #: velocity, (n,) [m/s]
    covariance: Array  #: covariance of position and velocity, in that order, (2n, 2n) [m², m²/s, m²/s²]

    @property
    def deviation_m(self) -> float:
        """Standard deviation of the position: the root of the sum of its variances."""
        n = len(self.position)
        return math.sqrt(float(np.trace(self.covariance[:n, :n])))


@dataclass(frozen=True, slots=True, eq=False)
class TurnEstimate:
    """The motion of a turning target at a point in time."""

    at_ns: int
    position: Array  #: position, (3,) [m]
    velocity: Array  #: velocity, (3,) [m/s]
    turn_rate: float  #: turn rate of the horizontal velocity, counter-clockwise as seen from above [rad/s]
    extra: Array  #: horizontal acceleration in addition to the turn's, (2,) [m/s²]
    covariance: Array  #: covariance of x, y, their velocities, the turn rate and the extra acceleration, (7, 7)

    @property
    def acceleration(self) -> Array:
        """Horizontal acceleration, (2,) [m/s²]."""
        return self.extra + self.turn_rate * np.array([-self.velocity[1], self.velocity[0]])

    @property
    def turning_rad_s(self) -> float:
        """Unsigned turn rate of the horizontal velocity due to both accelerations; 0 for a point at rest."""
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


_E = TypeVar("_E", Estimate, TurnEstimate)


class _Filter(ABC, Generic[_E]):
    """The common base class of both filters."""

    def __init__(self, dimensions: int, gate: float, **finite: float) -> None:
        require_positive(finite, **finite)
        if not gate > 0.0:
            raise UsageError(f"gate is {gate!r} and must be above 0")
        self._n, self._gate = dimensions, gate
        self._estimate: _E | None = None
        self.refused = 0  #: number of measurements refused by the gate since the last accepted one

    @property
    def newest(self) -> _E | None:
        """Estimate after the last measurement; None before the first one."""
        return self._estimate

    def start(self, position: Array, deviation_m: float | Array, at_ns: int) -> _E:
        """Restart at a measured position with zero velocity.

        Args:
            position: As in :meth:`update`.
            deviation_m: As in :meth:`update`.
            at_ns: Time of the measurement.

        Raises:
            UsageError: An array has the wrong shape, or a number is not finite.
        """
        self._estimate = self._started(*self._checked(position, deviation_m), at_ns)
        self.refused = 0
        return self._estimate

    def update(self, position: Array, deviation_m: float | Array, at_ns: int) -> bool:
        """Update with a measured position.

        Args:
            position: Shape (n,) [m].
            deviation_m: The position's standard deviation [m], the same for all axes, or its covariance (n, n) [m²].
            at_ns: Time of the measurement.

        Returns:
            Whether the position was used: it must be inside the gate and not older than the last one that was used.

        Raises:
            UsageError: A shape is wrong, a number is not finite, or estimate and measurement are both exact.
        """
        if self._estimate is None:
            self.start(position, deviation_m, at_ns)
            return True
        if at_ns < self._estimate.at_ns:
            return False
        after = self._corrected(self.at(at_ns), *self._checked(position, deviation_m), at_ns)
        if after is None:
            self.refused += 1
            return False
        self._estimate, self.refused = after, 0
        return True

    def at(self, at_ns: int, *, longest_s: float = math.inf) -> _E:
        """Predict the estimate for a given time; for times before the last measurement, return the last estimate.

        Args:
            at_ns: Time of the prediction.
            longest_s: Maximum time over which to extrapolate from the last measurement.

        Raises:
            UsageError: There has been no measurement.
        """
        if self._estimate is None:
            raise UsageError("the target was never seen")
        return self.predicted(self._estimate, at_ns, longest_s=longest_s)

    def predicted(self, last: _E, at_ns: int, *, longest_s: float = math.inf) -> _E:
        """Predict from any earlier estimate of this filter, as in :meth:`at`."""
        return self._moved(last, within(seconds(at_ns - last.at_ns), 0.0, longest_s))

    @abstractmethod
    def _started(self, measured: Array, noise: Array, at_ns: int) -> _E: ...

    @abstractmethod
    def _corrected(self, before: _E, measured: Array, noise: Array, at_ns: int) -> _E | None:
        """Return the estimate after a measurement; None if the measurement is outside the gate."""

    @abstractmethod
    def _moved(self, last: _E, dt: float) -> _E: ...

    def _checked(self, position: Array, deviation: float | Array) -> tuple[Array, Array]:
        """Return a measurement's position (n,) and covariance (n, n)."""
        n = self._n
        measured = np.asarray(position, dtype=np.float64)
        noise = np.asarray(deviation, dtype=np.float64)
        if noise.ndim == 0:
            if noise < 0.0:
                raise UsageError(f"deviation_m is {deviation!r} and must be 0 or more")
            noise = np.eye(n) * noise**2
        if measured.shape != (n,) or noise.shape != (n, n):
            raise UsageError(
                f"a position needs shape ({n},) and a covariance ({n}, {n}), got {measured.shape} and {noise.shape}"
            )
        if not (np.isfinite(measured).all() and np.isfinite(noise).all()):
            raise UsageError("a measured position and its deviation must be finite")
        return measured, noise


class ConstantVelocityFilter(_Filter[Estimate]):
    """A Kalman filter for a point that moves at constant velocity with random accelerations."""

    def __init__(
        self, dimensions: int = 3, *, intensity_m2_s3: float = 0.05, speed_m_s: float = 0.7, gate: float = 5.0
    ) -> None:
        """Initialise the filter.

        Args:
            dimensions: Number of dimensions of the position; 1 or more.
            intensity_m2_s3: Intensity of the acceleration's white noise; its root is the velocity change in 1 s.
            speed_m_s: Initial standard deviation of each velocity component.
            gate: Maximum Mahalanobis distance of a measurement, in standard deviations; ``math.inf`` accepts all.

        Raises:
            UsageError: An argument is out of range.
        """
        if isinstance(dimensions, bool) or not isinstance(dimensions, int) or dimensions < 1:
            raise UsageError(f"dimensions is {dimensions!r} and must be a whole number of at least 1")
        super().__init__(dimensions, gate, intensity_m2_s3=intensity_m2_s3, speed_m_s=speed_m_s)
        self._intensity, self._speed = intensity_m2_s3, speed_m_s

    def _started(self, measured: Array, noise: Array, at_ns: int) -> Estimate:
        n = self._n
        covariance = np.zeros((2 * n, 2 * n))
        covariance[:n, :n] = noise
        covariance[n:, n:] = np.eye(n) * self._speed**2
        return Estimate(at_ns, measured, np.zeros(n), covariance)

    def _corrected(self, before: Estimate, measured: Array, noise: Array, at_ns: int) -> Estimate | None:
        n, off = self._n, measured - before.position
        spread = before.covariance[:n, :n] + noise
        if not spread.any():
            raise UsageError("an exact measurement of an exactly known point adds no information")
        spread = (spread + spread.T) / 2 + np.eye(n) * max(_EXACT_M2, _ROUNDING * float(np.abs(spread).max()))
        if math.sqrt(max(0.0, float(off @ np.linalg.solve(spread, off)))) > self._gate:
            return None
        state = np.concatenate([before.position, before.velocity])
        state, covariance = corrected(state, before.covariance, off, np.eye(n, 2 * n), noise, spread)
        return Estimate(at_ns, state[:n], state[n:], (covariance + covariance.T) / 2)

    def _moved(self, last: Estimate, dt: float) -> Estimate:
        if dt == 0.0:
            return last
        move, wander = drift(dt, self._intensity, self._n)
        covariance = move @ last.covariance @ move.T + wander
        return Estimate(last.at_ns + round(dt * 1e9), last.position + last.velocity * dt, last.velocity, covariance)


class TurningTargetFilter(_Filter[TurnEstimate]):
    """Estimates a point's motion in levelled axes from measured positions (3,) with positive standard deviations."""

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
            intensity_m2_s3: Intensity of the white noise in addition to turn and extra acceleration.
            speed_m_s: Initial standard deviation of each velocity component.
            turn_rad_s: Initial standard deviation of the turn rate.
            turn_wander_rad_s: Typical change of the turn rate in one second.
            extra_m_s2: Standard deviation of each component of the extra acceleration.
            extra_s: Time constant with which the extra acceleration fades; greater than 0.
            gate: Mahalanobis distance, in standard deviations, above which positions are refused.

        Raises:
            UsageError: An argument is out of range.
        """
        super().__init__(
            3,
            gate,
            intensity_m2_s3=intensity_m2_s3,
            speed_m_s=speed_m_s,
            turn_rad_s=turn_rad_s,
            turn_wander_rad_s=turn_wander_rad_s,
            extra_m_s2=extra_m_s2,
        )
        require_positive(extra_s=extra_s)
        self._intensity = intensity_m2_s3
        first = [0.0, 0.0, speed_m_s, speed_m_s, turn_rad_s, extra_m_s2, extra_m_s2]
        self._first = np.diag(np.square(first))
        self._again = turn_rad_s**2 / 9  # variance added to a known turn rate on a restart
        self._wander = turn_wander_rad_s**2
        self._extra, self._fade_s = extra_m_s2**2, extra_s
        self._height = ConstantVelocityFilter(1, intensity_m2_s3=_HEIGHT_INTENSITY_M2_S3, speed_m_s=_CLIMB_M_S)

    def _started(self, measured: Array, noise: Array, at_ns: int) -> TurnEstimate:
        covariance = self._first + _SEEN.T @ noise[:2, :2] @ _SEEN
        rate = 0.0
        if self._estimate is not None:  # a restart: a target that turned is likely to keep turning
            rate, known = self._estimate.turn_rate, float(self._estimate.covariance[4, 4])
            covariance[4, 4] = min(covariance[4, 4], known + self._again)
        height = self._height.start(measured[2:], noise[2:, 2:], at_ns)
        return _combined(at_ns, np.array([*measured[:2], 0.0, 0.0, rate, 0.0, 0.0]), covariance, height)

    def _corrected(self, before: TurnEstimate, measured: Array, noise: Array, at_ns: int) -> TurnEstimate | None:
        seen, off = noise[:2, :2], measured[:2] - before.position[:2]
        if off @ np.linalg.solve(before.covariance[:2, :2] + seen, off) > self._gate**2:
            return None
        state = np.array([*before.position[:2], *before.velocity[:2], before.turn_rate, *before.extra])
        state, covariance = corrected(state, before.covariance, off, _SEEN, seen)
        # A height outside its gate does not refuse the measurement; it only restarts the height's filter.
        if not self._height.update(measured[2:], noise[2:, 2:], at_ns):
            self._height.start(measured[2:], noise[2:, 2:], at_ns)
        return _combined(at_ns, state, covariance, self._height.at(at_ns))

    def _moved(self, last: TurnEstimate, dt: float) -> TurnEstimate:
        steps = math.ceil(dt / _STEP_S)
        for _ in range(steps):
            last = self._stepped(last, dt / steps)
        return last

    def _stepped(self, last: TurnEstimate, dt: float) -> TurnEstimate:
        """Predict one step of ``dt`` [s]."""
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
        wander[:4, :4] = drift(dt, self._intensity, axes=2)[1]
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

    def _checked(self, position: Array, deviation: float | Array) -> tuple[Array, Array]:
        if not np.isfinite(position).all():
            raise UsageError(f"a measured position must be three finite numbers, got {position!r}")
        if isinstance(deviation, np.ndarray) or not 0.0 < deviation < math.inf:
            raise UsageError(f"deviation_m is {deviation!r} and must be a finite number above 0")
        return super()._checked(position, deviation)


def _turn(rate: float, dt: float) -> tuple[float, float, float, float]:
    """Return sin(ωt)/ω and (1 - cos(ωt))/ω [s] and their derivatives with respect to ω [s²]."""
    angle = rate * dt
    if abs(angle) < _STRAIGHT_RAD:
        return dt, angle * dt / 2, -angle * dt * dt / 3, dt * dt / 2
    along, aside = math.sin(angle) / rate, (1.0 - math.cos(angle)) / rate
    return along, aside, (dt * math.cos(angle) - along) / rate, (dt * math.sin(angle) - aside) / rate


def _combined(at_ns: int, state: Array, covariance: Array, height: Estimate) -> TurnEstimate:
    position = np.array([*state[:2], height.position[0]])
    velocity = np.array([*state[2:4], height.velocity[0]])
    return TurnEstimate(at_ns, position, velocity, float(state[4]), state[5:].copy(), covariance)
