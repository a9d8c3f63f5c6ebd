"""The filter of a point in straight, turning or accelerated motion: how well it predicts each."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from skyloop.clock import nanoseconds
from skyloop.control.kalman import TurningTargetFilter
from skyloop.errors import UsageError

Path = Callable[[float], tuple[float, float]]
DT = 1 / 15
PATHS: dict[str, Path] = {
    "straight at 3 m/s": lambda t: (3 * t, 1.0),
    "a circle of 8 m at 2 m/s": lambda t: (8 * math.cos(t / 4), 8 * math.sin(t / 4)),
    "a circle of 8 m at 3 m/s, clockwise": lambda t: (8 * math.cos(3 * t / 8), -8 * math.sin(3 * t / 8)),
    "slowing down at 0.3 m/s²": lambda t: (1.5 * t - 0.15 * t * t, 0.0),
    "standing": lambda _: (1.0, -2.0),
}


def watched(path: Path, seconds: float = 4.0, deviation: float = 0.01) -> TurningTargetFilter:
    rng, watching = np.random.default_rng(1), TurningTargetFilter()
    for k in range(round(seconds / DT)):
        seen = np.array([*path(k * DT), 0.2]) + rng.normal(0, deviation, 3)
        watching.update(seen, deviation, nanoseconds(k * DT))
    return watching


@pytest.mark.parametrize("name", PATHS)
def test_prediction_of_most_of_a_second(name: str) -> None:
    expected = watched(PATHS[name]).at(nanoseconds(4.0 + 0.7))
    assert math.dist(expected.position[:2], PATHS[name](4.7)) < 0.1
    assert expected.position[2] == pytest.approx(0.2, abs=0.03)


def test_the_turn_rate_and_the_acceleration_of_a_circle() -> None:
    newest = watched(PATHS["a circle of 8 m at 3 m/s, clockwise"], 6.0).newest
    assert newest is not None
    assert newest.turn_rate == pytest.approx(-3 / 8, abs=0.08)
    assert newest.turning_rad_s == pytest.approx(3 / 8, abs=0.08)
    assert np.hypot(*newest.acceleration) == pytest.approx(9 / 8, abs=0.3)


def test_a_restart_remembers_that_it_turned() -> None:
    watching = watched(PATHS["a circle of 8 m at 2 m/s"])
    before = watching.newest
    assert before is not None
    anew = watching.start(np.array([8.0, 0.0, 0.2]), 0.01, nanoseconds(40.0))
    assert anew.turn_rate == before.turn_rate
    assert anew.velocity == pytest.approx([0, 0, 0])
    assert anew.speed_deviation_m_s > 1.0


def test_the_linearised_covariance_is_that_of_the_motion() -> None:
    """Differentiate a short prediction by each part of the state numerically."""
    watching = watched(PATHS["a circle of 8 m at 3 m/s, clockwise"])
    last = watching.newest
    assert last is not None
    sharp = np.linalg.cholesky(last.covariance)
    spread = np.zeros((2, 2))
    for column in sharp.T:
        moved = type(last)(
            last.at_ns,
            last.position + np.array([*column[:2], 0.0]),
            last.velocity + np.array([*column[2:4], 0.0]),
            last.turn_rate + column[4],
            last.extra + column[5:],
            last.covariance,
        )
        end_ns = last.at_ns + nanoseconds(0.1)
        change = (watching.predicted(moved, end_ns).position - watching.predicted(last, end_ns).position)[:2]
        spread += np.outer(change, change)
    end = watching.predicted(last, last.at_ns + nanoseconds(0.1)).covariance[:2, :2]
    assert end == pytest.approx(spread, rel=0.15, abs=1e-5)


def test_outliers_are_refused() -> None:
    watching = watched(PATHS["standing"])
    assert not watching.update(np.array([4.0, 4.0, 0.2]), 0.01, nanoseconds(4.0))
    assert watching.refused == 1
    assert not watching.update(np.array([1.0, -2.0, 0.2]), 0.01, nanoseconds(1.0)), "older than the last"
    assert watching.at(0) is watching.newest


@pytest.mark.parametrize(
    ("arguments", "message"),
    [({"gate": 0.0}, "gate"), ({"speed_m_s": -1.0}, "speed_m_s"), ({"extra_s": 0.0}, "extra_s")],
)
def test_settings_out_of_range_are_refused(arguments: dict[str, float], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        TurningTargetFilter(**arguments)


def test_invalid_measurements_are_refused() -> None:
    watching = TurningTargetFilter()
    with pytest.raises(UsageError, match="never seen"):
        watching.at(0)
    with pytest.raises(UsageError, match="three finite numbers"):
        watching.start(np.array([1.0, math.nan, 0.0]), 0.01, 0)
    with pytest.raises(UsageError, match="deviation_m"):
        watching.update(np.zeros(3), 0.01, 0) and watching.update(np.zeros(3), 0.0, 1)
