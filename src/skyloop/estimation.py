"""Provide the steps shared by all Kalman filters, and the assignment of measurements. Pure.

Bar-Shalom, Li and Kirubarajan, "Estimation with Applications to Tracking and Navigation", Wiley 2001. A state has the
shape (n,), or (n, k) for k states that share one covariance (n, n).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from skyloop.errors import MissingExtraError

Array = NDArray[np.float64]


def drift(dt_s: float, intensity: float, axes: int = 1) -> tuple[Array, Array]:
    """Return the transition and the process noise over ``dt_s`` for positions, then velocities; each (2·axes, 2·axes).

    The model is continuous white-noise acceleration (section 6.2.2): two successive predictions equal one over the
    total time, and the standard deviation of the velocity after a second is the square root of ``intensity``.
    """
    move = np.eye(2 * axes) + np.eye(2 * axes, k=axes) * dt_s
    wander = np.array([[dt_s**3 / 3, dt_s**2 / 2], [dt_s**2 / 2, dt_s]]) * intensity
    return move, np.asarray(np.kron(wander, np.eye(axes)), np.float64)


def corrected(
    state: Array, covariance: Array, off: Array, seen: Array, noise: Array, spread: Array | None = None
) -> tuple[Array, Array]:
    """Return the state and the covariance after a measurement, using Joseph's form (section 5.2.6).

    This form keeps the covariance positive despite rounding. ``off`` is the measured value minus the expected value,
    (m,) or (m, k); ``seen`` is the derivative of the measurement with respect to the state, (m, n); ``noise`` is the
    covariance of the measurement, (m, m); and ``spread`` is the covariance of ``off``, unless it follows from the state
    and ``noise``.
    """
    if spread is None:
        spread = seen @ covariance @ seen.T + noise
    gain = np.linalg.solve(spread, seen @ covariance).T
    keep = np.eye(len(covariance)) - gain @ seen
    return state + gain @ off, keep @ covariance @ keep.T + gain @ noise @ gain.T


def assignment(what: str, extra: str) -> Callable[[Array], tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """Return SciPy's ``linear_sum_assignment``, which finds the pairs (rows, columns) with the least total cost.

    Raises :class:`MissingExtraError`, which names the feature and the extra, if SciPy is not installed.
    """
    try:
        from scipy.optimize import linear_sum_assignment
    except ImportError as error:
        raise MissingExtraError(what, extra, cause=str(error)) from error
    found: Callable[[Array], tuple[NDArray[np.intp], NDArray[np.intp]]] = linear_sum_assignment
    return found
