"""The constant-velocity filter: is its confidence justified?"""

from __future__ import annotations

import math

import numpy as np
import pytest

from skyloop.clock import nanoseconds
from skyloop.control.kalman import ConstantVelocityFilter
from skyloop.errors import UsageError


def test_errors_match_the_covariance() -> None:
    """Normalised estimation error squared over many runs of the model itself: its mean is the number of states."""
    rng = np.random.default_rng(3)
    intensity, dt, found = 0.2, 0.1, []
    step = np.linalg.cholesky(np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]) * intensity)
    for _ in range(60):
        state = np.array([[0.0, 0.0], rng.normal(0, 0.7, 2)])  # position, velocity; two axes
        filtered = ConstantVelocityFilter(2, intensity_m2_s3=intensity, gate=math.inf)
        for k in range(40):
            seen = state[0] + rng.normal(0, 0.05, 2)
            filtered.update(seen, 0.05, nanoseconds(k * dt))
            state = np.array([[1, dt], [0, 1]]) @ state + step @ rng.normal(size=(2, 2))
        estimate = filtered.at(nanoseconds(40 * dt))
        error = np.concatenate([state[0] - estimate.position, state[1] - estimate.velocity])
        found.append(error @ np.linalg.solve(estimate.covariance, error))
    assert np.mean(found) == pytest.approx(4.0, abs=1.1), "3 standard deviations of the mean of 60 with 4 states"


def test_two_predictions_equal_one() -> None:
    filtered = ConstantVelocityFilter(1, intensity_m2_s3=0.5)
    for k in range(5):
        filtered.update(np.array([0.3 * k]), 0.1, nanoseconds(0.5 * k))
    once = filtered.at(nanoseconds(4.0))
    move = np.array([[1.0, 1.0], [0.0, 1.0]])
    half = filtered.at(nanoseconds(3.0))
    noise = 0.5 * np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]])
    assert once.covariance == pytest.approx(move @ half.covariance @ move.T + noise)
    assert once.position == pytest.approx(half.position + half.velocity)
    assert once.at_ns == nanoseconds(4.0)
    assert filtered.at(nanoseconds(9.0), longest_s=0.5).at_ns == nanoseconds(2.5)
    assert filtered.at(0) is filtered.newest


def test_the_gate_refuses_outliers_and_a_restart_accepts_them() -> None:
    filtered = ConstantVelocityFilter(3, gate=4.0)
    for k in range(20):
        assert filtered.update(np.array([0.1 * k, 0.0, 1.0]), 0.02, nanoseconds(0.1 * k))
    before = filtered.newest
    assert not filtered.update(np.array([2.0, 5.0, 1.0]), 0.02, nanoseconds(2.0))
    assert filtered.newest is before
    assert filtered.refused == 1
    assert not filtered.update(np.array([1.9, 0.0, 1.0]), 0.02, nanoseconds(1.0)), "older than the last"
    assert filtered.refused == 1
    anew = filtered.start(np.array([2.0, 5.0, 1.0]), 0.02, nanoseconds(2.0))
    assert anew.velocity == pytest.approx([0, 0, 0])
    assert anew.deviation_m == pytest.approx(0.02 * math.sqrt(3))
    assert filtered.refused == 0


def test_a_covariance_counts_by_direction() -> None:
    filtered = ConstantVelocityFilter(2)
    filtered.update(np.zeros(2), 0.1, 0)
    filtered.update(np.array([0.2, 0.2]), np.diag([1e-4, 1.0]), 0)
    assert filtered.newest is not None
    assert filtered.newest.position == pytest.approx([0.2, 0.0], abs=0.01)


@pytest.mark.parametrize("deviation", [1e-4, 1e-7, 1e-9, 1e-12, 0.0])
def test_nearly_exact_measurements_are_accepted(deviation: float) -> None:
    """A simulator without noise, or such motion capture, made the filter raise."""
    filtered = ConstantVelocityFilter(3, gate=math.inf)
    for n in range(200):
        place = np.array([0.0005 * n, 0.0, 1.0]) + 1e-9 * math.sin(n)
        assert filtered.update(place, deviation, n * 1_000_000)
    assert filtered.newest is not None
    assert filtered.newest.position == pytest.approx([0.0995, 0.0, 1.0], abs=1e-4)
    assert np.isfinite(filtered.newest.covariance).all()
    axes = np.diag([1e-4, 0.0, 0.0])  # exact along two axes only
    for _ in range(3):
        filtered.update(np.array([0.0995, 0.0, 1.0]), axes, 200_000_000)
    assert np.isfinite(filtered.newest.covariance).all()


def test_invalid_arguments() -> None:
    filtered = ConstantVelocityFilter(2)
    with pytest.raises(UsageError, match="never seen"):
        filtered.at(0)
    with pytest.raises(UsageError, match="shape"):
        filtered.update(np.zeros(3), 0.1, 0)
    with pytest.raises(UsageError, match="finite"):
        filtered.update(np.array([math.nan, 0.0]), 0.1, 0)
    with pytest.raises(UsageError, match="0 or more"):
        filtered.update(np.zeros(2), -0.1, 0)
    filtered.update(np.zeros(2), 0.0, 0)
    with pytest.raises(UsageError, match="adds no information"):
        filtered.update(np.zeros(2), 0.0, 0)
    for wrong in ({"dimensions": 0}, {"intensity_m2_s3": -1.0}, {"speed_m_s": math.inf}, {"gate": 0.0}):
        with pytest.raises(UsageError, match=next(iter(wrong))):
            ConstantVelocityFilter(**wrong)
