"""The steps that all Kalman filters here are made of, and which measurement belongs to what. Pure.

Bar-Shalom, Li and Kirubarajan, "Estimation with Applications to Tracking and Navigation", Wiley 2001. A state has the
shape (n,), or (n, k) for k things of one covariance, (n, n).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import MissingExtraError

Array = NDArray[np.float64]


def drift(dt_s: float, intensity: float, axes: int = 1) -> tuple[Array, Array]:
    """Return how positions and velocities, in this order, go on, and how they wander, each (2·axes, 2·axes).

    Continuous white-noise acceleration (section 6.2.2): two predictions are one over both times.

    Args:
        dt_s: The time.
        intensity: Of the noise: within a second the velocity wanders by the root of it.
        axes: Number of positions.
    """
    move = np.eye(2 * axes) + np.eye(2 * axes, k=axes) * dt_s
    wander = np.array([[dt_s**3 / 3, dt_s**2 / 2], [dt_s**2 / 2, dt_s]]) * intensity
    return move, np.asarray(np.kron(wander, np.eye(axes)), np.float64)


def corrected(
    state: Array, covariance: Array, off: Array, seen: Array, noise: Array, spread: Array | None = None
) -> tuple[Array, Array]:
    """Return state and covariance after a measurement, the latter in Joseph's form (section 5.2.6).

    It stays positive whatever the rounding.

    Args:
        state: Before.
        covariance: Before.
        off: Measured minus expected, (m,) or (m, k).
        seen: Derivative by the state of what is measured, (m, n).
        noise: Covariance of the measurement, (m, m).
        spread: Covariance of ``off``, if it is to be another one than that of state and noise.
    """
    if spread is None:
        spread = seen @ covariance @ seen.T + noise
    gain = np.linalg.solve(spread, seen @ covariance).T
    keep = np.eye(len(covariance)) - gain @ seen
    return state + gain @ off, keep @ covariance @ keep.T + gain @ noise @ gain.T


def assignment(what: str, extra: str) -> Callable[[Array], tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """Return SciPy's ``linear_sum_assignment``: from costs (rows, columns), the pairs that cost least altogether.

    Args:
        what: Needs it.
        extra: Brings it.

    Raises:
        MissingExtraError: SciPy is not installed.
    """
    try:
        from scipy.optimize import linear_sum_assignment
    except ImportError as error:
        raise MissingExtraError(what, extra, cause=str(error)) from error
    found: Callable[[Array], tuple[NDArray[np.intp], NDArray[np.intp]]] = linear_sum_assignment
    return found
