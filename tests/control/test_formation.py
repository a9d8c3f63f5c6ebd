"""Shapes, assignment and separation, by table and by property."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from skyloop.control.formation import (
    MOST,
    Places,
    assign,
    circle,
    closest_approach,
    column,
    grid,
    kept_apart,
    line,
    placed,
    places,
    vee,
)
from skyloop.errors import UsageError

SHAPES: list[Callable[[int, float], Places]] = [line, column, circle, vee, grid]


def nearest(points: Places) -> float:
    return closest_approach(points, points).distance_m


@pytest.mark.parametrize("shape", SHAPES)
@given(n=st.integers(1, 30), spacing=st.floats(0.1, 10.0))
def test_every_shape_has_a_place_for_each_and_keeps_the_spacing(
    shape: Callable[[int, float], Places], n: int, spacing: float
) -> None:
    points = shape(n, spacing)
    assert points.shape == (n, 3)
    assert (points[:, 2] == 0.0).all()
    if n > 1:
        assert nearest(points) >= spacing * (1 - 1e-9)
        assert nearest(points) <= spacing * (math.sqrt(2) + 1e-9)
    if shape is not circle:
        assert np.allclose(points.max(axis=0), -points.min(axis=0))


def test_the_shapes() -> None:
    assert np.allclose(line(3, 1.0), [(0, 1, 0), (0, 0, 0), (0, -1, 0)])
    assert np.allclose(column(2, 2.0), [(1, 0, 0), (-1, 0, 0)])
    assert np.allclose(circle(4, math.sqrt(2)), [(1, 0, 0), (0, 1, 0), (-1, 0, 0), (0, -1, 0)])
    assert np.allclose(vee(3, math.sqrt(2)), [(0.5, 0, 0), (-0.5, 1, 0), (-0.5, -1, 0)])
    assert np.allclose(grid(4, 1.0), [(0.5, 0.5, 0), (0.5, -0.5, 0), (-0.5, 0.5, 0), (-0.5, -0.5, 0)])
    assert np.allclose(grid(3, 1.0, columns=1), column(3, 1.0))
    assert np.allclose(circle(1, 1.0), [(0, 0, 0)])


def test_a_shape_is_turned_and_moved() -> None:
    there = placed(column(2, 2.0), at=(5.0, 6.0, 1.0), yaw=math.pi / 2)
    assert np.allclose(there, [(5, 7, 1), (5, 5, 1)])


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (lambda: line(0, 1.0), "at least one position"),
        (lambda: line(2.5, 1.0), "at least one position"),  # type: ignore[arg-type]
        (lambda: line(2, 0.0), "spacing_m is 0.0"),
        (lambda: circle(2, math.nan), "spacing_m is nan"),
        (lambda: vee(2, 1.0, angle=0.5), "angle is 0.5"),
        (lambda: grid(2, 1.0, columns=0), "columns is 0"),
        (lambda: placed(line(2, 1.0), at=(0, 0)), "three finite coordinates"),
        (lambda: placed(line(2, 1.0), at=(0, 0, math.inf)), "three finite coordinates"),
        (lambda: places([(1, 2)]), r"shape \(n, 3\)"),
        (lambda: places([(1, 2, math.nan)]), "finite"),
        (lambda: places("here"), "not an array of positions"),
        (lambda: assign(line(3, 1.0), line(2, 1.0)), "3 drones have only 2 places"),
        (lambda: assign(line(2, 1.0), line(MOST + 1, 1.0)), "at most 200"),
    ],
)
def test_invalid_formations_are_refused(wrong: Callable[[], object], words: str) -> None:
    with pytest.raises(UsageError, match=words):
        wrong()


COORDINATES = st.floats(-10, 10).map(lambda x: round(x, 3))


def points(least: int, most: int) -> st.SearchStrategy[Places]:
    return st.integers(least, most).flatmap(lambda n: arrays.arrays(np.float64, (n, 3), elements=COORDINATES))


PAIRS = st.integers(1, 4).flatmap(lambda n: st.tuples(points(n, n), points(n, n + 1)))


def cost(starts: Places, slots: Places, order: tuple[int, ...] | list[int]) -> float:
    return float(((starts - slots[list(order)]) ** 2).sum())


@settings(deadline=None)
@given(PAIRS)
def test_no_other_assignment_is_cheaper(pair: tuple[Places, Places]) -> None:
    starts, slots = pair
    order = assign(starts, slots)
    assert len(set(order)) == len(starts)
    best = min(cost(starts, slots, other) for other in itertools.permutations(range(len(slots)), len(starts)))
    assert cost(starts, slots, order) == pytest.approx(best, rel=1e-9, abs=1e-9)


def test_it_agrees_with_scipy() -> None:
    optimize = pytest.importorskip("scipy.optimize", reason="SciPy is not installed")
    random = np.random.default_rng(7)
    for n in (1, 2, 10, 60):
        starts, slots = random.uniform(-5, 5, (n, 3)), random.uniform(-5, 5, (n + 3, 3))
        costs = ((starts[:, None] - slots[None]) ** 2).sum(axis=2)
        rows, columns = optimize.linear_sum_assignment(costs)
        assert cost(starts, slots, assign(starts, slots)) == pytest.approx(costs[rows, columns].sum())


@settings(deadline=None)
@given(st.integers(2, 6).flatmap(lambda n: st.tuples(points(n, n), points(n, n))))
def test_assigned_paths_stay_apart_as_far_as_the_paper_proves(pair: tuple[Places, Places]) -> None:
    starts, slots = pair
    least = min(nearest(starts), nearest(slots))
    way = closest_approach(starts, slots[assign(starts, slots)])
    assert way.distance_m >= least / math.sqrt(2) - 1e-6


def test_crossing_paths_are_detected() -> None:
    starts, goals = [(0, 0, 0), (2, 0, 0), (9, 9, 0)], [(2, 0, 0), (0, 0, 0), (9, 9, 0)]
    assert closest_approach(starts, goals) == pytest.approx((0.0, 0, 1))
    assert closest_approach(starts, starts) == pytest.approx((2.0, 0, 1))
    assert closest_approach([(0, 0, 0)], [(1, 0, 0)]).distance_m == math.inf


def test_two_drones_too_close_separate_and_others_are_left_alone() -> None:
    positions = [(0.0, 0.0, 1.0), (0.5, 0.0, 1.0), (5.0, 0.0, 1.0)]
    velocities = [(0.4, 0.3, 0.0), (-0.4, 0.0, 0.1), (1.0, 0.0, 0.0)]
    changed = kept_apart(velocities, positions, 1.0)
    assert np.allclose(changed, [(-0.25, 0.3, 0.0), (0.25, 0.0, 0.1), (1.0, 0.0, 0.0)])
    assert np.allclose(kept_apart(velocities, positions, 0.4), velocities)
    parting = [(-1.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 0.0)]
    assert np.allclose(kept_apart(parting, positions, 1.0), parting)
    same_place = kept_apart(np.zeros((2, 3)), np.zeros((2, 3)), 1.0)
    assert np.allclose(same_place, [(0.5, 0, 0), (-0.5, 0, 0)])


def test_a_drone_that_meets_one_that_does_not_yield_yields_fully() -> None:
    """It yielded half and flew through its leader."""
    positions = [(0.5, 0.0, 1.0), (0.0, 0.0, 1.0)]
    changed = kept_apart([(-1.0, 0.3, 0.0), (0.4, 0.0, 0.0)], positions, 1.0, fixed=1)
    assert np.allclose(changed, [(0.9, 0.3, 0.0), (0.4, 0.0, 0.0)])
    near = kept_apart([(-1.0, 0.3, 0.0), (0.0, 0.0, 0.0)], [(1.2, 0.0, 1.0), (0.0, 0.0, 1.0)], 1.0, fixed=1)
    assert np.allclose(near, [(-0.2, 0.3, 0.0), (0.0, 0.0, 0.0)]), "it slows down first"
    assert np.allclose(kept_apart([(1.0, 0.0, 0.0)] * 2, positions, 1.0, fixed=2), [(1.0, 0.0, 0.0)] * 2)


@settings(deadline=None)
@given(points(2, 5), st.integers(1, 4), st.floats(0.1, 3.0))
def test_no_drone_comes_nearer_to_one_that_does_not_yield(positions: Places, fixed: int, apart: float) -> None:
    fixed = min(fixed, len(positions))
    changed = kept_apart(-positions, positions, apart, fixed=fixed)
    assert np.array_equal(changed[len(positions) - fixed :], -positions[len(positions) - fixed :])
    for one in range(len(positions) - fixed):
        between = positions[one] - positions[-1]
        distance = float(np.linalg.norm(between))
        if distance > 1e-6:
            growing = float((changed[one] - changed[-1]) @ between) / distance
            assert growing >= apart - distance - 1e-6


@settings(deadline=None)
@given(points(2, 2), st.floats(0.1, 20.0))
def test_separation_never_makes_two_close_drones_approach(positions: Places, apart: float) -> None:
    velocities = -positions  # all fly to the same place
    changed = kept_apart(velocities, positions, apart)
    between = positions[0] - positions[1]
    growing = float((changed[0] - changed[1]) @ between)
    if np.linalg.norm(between) < apart:
        assert growing >= -1e-9
    else:
        assert np.array_equal(changed, velocities)
