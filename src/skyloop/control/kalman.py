"""A constant-velocity Kalman filter for points that are seen now and then, in any number of dimensions. Pure.

Bar-Shalom, Li and Kirubarajan, "Estimation with Applications to Tracking and Navigation", Wiley 2001: the model with
continuous white-noise acceleration (section 6.2.2), whose predictions over two steps are those over one; the gate by
the normalised innovation squared (section 5.4); the update in Joseph's form (section 5.2.6), which keeps the covariance
positive whatever the rounding.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import seconds
from skyloop.control.limiting import within
from skyloop.errors import UsageError

Array = NDArray[np.float64]
#: Added to the spread of an innovation, so that what is known all but exactly can be divided by.
_EXACT_M2, _ROUNDING = 1e-18, 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """Position and velocity of a point at one time, and their covariance."""

    at_ns: int
    position: Array  #: (n,) [m]
    velocity: Array  #: (n,) [m/s]
    covariance: Array  #: (2n, 2n) of position and velocity, in this order [m², m²/s, m²/s²]

    @property
    def deviation_m(self) -> float:
        """Standard deviation of the position: the root of the sum of its variances."""
        n = len(self.position)
        return math.sqrt(float(np.trace(self.covariance[:n, :n])))


class ConstantVelocityFilter:
    """A Kalman filter of a point with constant velocity and random accelerations. Times are nanoseconds on one clock.

    Attributes:
        refused: Measurements outside of the gate since the last one within it.
    """

    def __init__(
        self,
        dimensions: int = 3,
        *,
        intensity_m2_s3: float = 0.05,
        speed_m_s: float = 0.7,
        gate: float = 5.0,
    ) -> None:
        """Initialise the filter.

        Args:
            dimensions: Of the position; 1 or more.
            intensity_m2_s3: Of the acceleration's white noise: within a second the velocity wanders by the root of it.
            speed_m_s: Standard deviation of each component of the velocity at first.
            gate: Measurements farther off than so many standard deviations (Mahalanobis distance) are refused;
                ``math.inf`` refuses none.

        Raises:
            UsageError: An argument is out of its range.
        """
        if isinstance(dimensions, bool) or not isinstance(dimensions, int) or dimensions < 1:
            raise UsageError(f"dimensions is {dimensions!r} and must be a whole number of at least 1")
        for name, value in (("intensity_m2_s3", intensity_m2_s3), ("speed_m_s", speed_m_s)):
            if not 0.0 <= value < math.inf:
                raise UsageError(f"{name} is {value!r} and must be a finite number, 0 or more")
        if not gate > 0.0:
            raise UsageError(f"gate is {gate!r} and must be above 0")
        self._n = dimensions
        self._intensity = intensity_m2_s3
        self._speed = speed_m_s
        self._gate = gate
        self._estimate: Estimate | None = None
        self.refused = 0  #: measurements outside of the gate since the last one within it

    @property
    def newest(self) -> Estimate | None:
        """The estimate as of the last measurement; None before the first."""
        return self._estimate

    def start(self, position: Array, deviation_m: float | Array, at_ns: int) -> Estimate:
        """Restart at a measured position, with velocity 0.

        Args:
            position: As in :meth:`update`.
            deviation_m: As in :meth:`update`.
            at_ns: When it was measured.

        Raises:
            UsageError: A shape is wrong, or a number is not finite.
        """
        measured, noise = self._checked(position, deviation_m)
        n = self._n
        covariance = np.zeros((2 * n, 2 * n))
        covariance[:n, :n] = noise
        covariance[n:, n:] = np.eye(n) * self._speed**2
        self.refused = 0
        self._estimate = Estimate(at_ns, measured, np.zeros(n), covariance)
        return self._estimate

    def update(self, position: Array, deviation_m: float | Array, at_ns: int) -> bool:
        """Update with a measured position.

        Args:
            position: Shape (n,) [m].
            deviation_m: Its standard deviation [m], one for all axes, or its covariance (n, n) [m²].
            at_ns: When it was measured.

        Returns:
            Whether it was used; False outside of the gate (counted in :attr:`refused`), or if older than the last one.

        Raises:
            UsageError: A shape is wrong, a number is not finite, or both estimate and measurement are exact.
        """
        if self._estimate is None:
            self.start(position, deviation_m, at_ns)
            return True
        if at_ns < self._estimate.at_ns:
            return False
        measured, noise = self._checked(position, deviation_m)
        n, before = self._n, self.at(at_ns)
        innovation = measured - before.position
        spread = before.covariance[:n, :n] + noise
        if not spread.any():
            raise UsageError("a measurement without deviation, of a point that is known exactly, adds no information")
        spread = (spread + spread.T) / 2 + np.eye(n) * max(_EXACT_M2, _ROUNDING * float(np.abs(spread).max()))
        distance = math.sqrt(max(0.0, float(innovation @ np.linalg.solve(spread, innovation))))
        if distance > self._gate:
            self.refused += 1
            return False
        self.refused = 0
        share = np.linalg.solve(spread, before.covariance[:n]).T  # the gain, (2n, n)
        state = np.concatenate([before.position, before.velocity]) + share @ innovation
        keep = np.eye(2 * n)
        keep[:, :n] -= share
        covariance = keep @ before.covariance @ keep.T + share @ noise @ share.T
        self._estimate = Estimate(at_ns, state[:n], state[n:], (covariance + covariance.T) / 2)
        return True

    def at(self, at_ns: int, *, longest_s: float = math.inf) -> Estimate:
        """Predict the estimate for a time; before the last measurement it is the estimate as of that measurement.

        Args:
            at_ns: The time to predict for.
            longest_s: How far the last measurement is extrapolated at most.

        Raises:
            UsageError: There was no measurement.
        """
        last = self._estimate
        if last is None:
            raise UsageError("the target was never seen")
        dt = within(seconds(at_ns - last.at_ns), 0.0, longest_s)
        if dt == 0.0:
            return last
        n = self._n
        move = np.eye(2 * n)
        move[:n, n:] = np.eye(n) * dt
        wander = np.kron(np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]) * self._intensity, np.eye(n))
        covariance = move @ last.covariance @ move.T + wander
        return Estimate(last.at_ns + round(dt * 1e9), last.position + last.velocity * dt, last.velocity, covariance)

    def _checked(self, position: Array, deviation: float | Array) -> tuple[Array, Array]:
        """Return position (n,) and covariance (n, n) of a measurement."""
        n = self._n
        measured = np.asarray(position, dtype=np.float64)
        noise = np.asarray(deviation, dtype=np.float64)
        if noise.ndim == 0:
            if noise < 0.0:
                raise UsageError(f"deviation_m is {deviation!r} and must be 0 or more")
            noise = np.eye(n) * noise**2
        if measured.shape != (n,) or noise.shape != (n, n):
            raise UsageError(
                f"a position has shape ({n},) and a covariance ({n}, {n}), not {measured.shape} and {noise.shape}"
            )
        if not (np.isfinite(measured).all() and np.isfinite(noise).all()):
            raise UsageError("a measured position and its deviation must be finite")
        return measured, noise
