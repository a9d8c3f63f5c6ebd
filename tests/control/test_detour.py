"""Ways around posts and gates: as short as possible, and never nearer than allowed."""

from __future__ import annotations

import itertools
import math

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from skyloop.control.gate_law import Point, Wall, detour

PLACES = st.tuples(st.floats(-5.0, 5.0), st.floats(-5.0, 5.0))


def length(start: Point, way: list[Point]) -> float:
    return sum(itertools.starmap(math.dist, itertools.pairwise([start, *way])))


def distance(wall: Wall, place: Point) -> float:
    (x, y), (u, v) = wall.begin, wall.end
    square = max((u - x) ** 2 + (v - y) ** 2, 1e-12)
    share = max(0.0, min(1.0, ((place[0] - x) * (u - x) + (place[1] - y) * (v - y)) / square))
    return math.dist(place, (x + share * (u - x), y + share * (v - y)))


def test_without_obstacles_the_way_is_straight() -> None:
    assert detour((0.0, 0.0), (3.0, 4.0), []) == [(3.0, 4.0)]
    assert detour((0.0, 0.0), (3.0, 4.0), [Wall((2.0, -2.0), (2.0, -2.0), 0.5)]) == [(3.0, 4.0)]


def test_a_post_is_passed_on_the_nearer_side() -> None:
    way = detour((0.0, 0.0), (4.0, 0.0), [Wall((2.0, 0.2), (2.0, 0.2), 0.5)])
    assert way is not None
    assert all(y < 0.0 for _, y in way[:-1])
    assert 4.0 < length((0.0, 0.0), way) < 4.2


def test_a_gate_is_passed_around_its_end() -> None:
    gate = Wall((2.0, -0.7), (2.0, 0.7), 0.5)
    way = detour((0.0, 0.3), (4.0, 0.3), [gate])
    assert way is not None
    assert max(y for _, y in way) > 1.1


def test_there_is_no_way_out_of_an_enclosure() -> None:
    corners = [(2.0, 2.0), (2.0, -2.0), (-2.0, -2.0), (-2.0, 2.0)]
    fence = [Wall(a, b, 0.3) for a, b in zip(corners, corners[1:] + corners[:1], strict=True)]
    assert detour((0.0, 0.0), (5.0, 0.0), fence) is None


def test_a_start_too_near_may_leave() -> None:
    post = Wall((0.0, 0.0), (0.0, 0.0), 0.6)
    way = detour((0.3, 0.0), (-2.0, 0.0), [post])
    assert way is not None
    assert min(distance(post, place) for place in way) > 0.27


@given(PLACES, PLACES, st.lists(st.tuples(PLACES, PLACES, st.floats(0.1, 0.8)), max_size=5))
def test_no_way_comes_nearer_than_allowed(start: Point, goal: Point, walls: list[tuple[Point, Point, float]]) -> None:
    all_walls = [Wall(*wall) for wall in walls]
    assume(all(distance(wall, place) > wall.reach_m + 0.03 for wall in all_walls for place in (start, goal)))
    way = detour(start, goal, all_walls)
    if way is None:
        return
    assert way[-1] == pytest.approx(goal)
    for one, other in itertools.pairwise([start, *way]):
        between = [(one[0] + k / 20 * (other[0] - one[0]), one[1] + k / 20 * (other[1] - one[1])) for k in range(21)]
        assert all(distance(wall, place) > wall.reach_m - 0.001 for wall in all_walls for place in between)
