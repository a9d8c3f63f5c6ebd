"""Fuzzy inference by table, properties of the see-and-avoid rules, and its law."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from see_and_avoid import FuzzyController, Rule, Trapezoid, avoidance, triangles

from skyloop.errors import UnknownNameError, UsageError


@pytest.mark.parametrize(("value", "truth"), [(-1, 0), (0, 0), (0.5, 0.5), (1, 1), (2, 1), (3, 0.5), (4, 0), (9, 0)])
def test_trapezoid(value: float, truth: float) -> None:
    assert Trapezoid(0, 1, 2, 4)(value) == truth


@given(st.floats(-10, 10))
def test_triangles_share_the_truth(value: float) -> None:
    terms = triangles({"low": -1.0, "middle": 0.5, "high": 2.0})
    assert sum(term(value) for term in terms.values()) == pytest.approx(1.0)


def test_output_is_between_the_rules_by_their_truth() -> None:
    terms = triangles({"cold": 0.0, "warm": 10.0})
    heater = FuzzyController({"t": terms}, [Rule({"t": "cold"}, 4.0), Rule({"t": "warm"}, 0.0)])
    assert heater.step(t=-5.0) == 4.0
    assert heater.step(t=2.5) == pytest.approx(3.0)
    assert heater.step(t=10.0) == 0.0


def test_conditions_multiply_and_without_rules_the_output_is_zero() -> None:
    terms = {"on": Trapezoid(0, 1, 1, 2)}
    both = FuzzyController({"a": terms, "b": terms}, [Rule({"a": "on", "b": "on"}, 2.0), Rule({"a": "on"}, 0.0)])
    assert both.step(a=1.0, b=0.5) == pytest.approx(2.0 * 0.5 / 1.5)
    assert both.step(a=5.0, b=1.0) == 0.0


def test_invalid_arguments_are_refused() -> None:
    terms = triangles({"low": 0.0, "high": 1.0})
    with pytest.raises(UnknownNameError, match="variable"):
        FuzzyController({"a": terms}, [Rule({"b": "low"}, 1.0)])
    with pytest.raises(UnknownNameError, match="term of a"):
        FuzzyController({"a": terms}, [Rule({"a": "medium"}, 1.0)])
    with pytest.raises(UsageError, match="no rule"):
        FuzzyController({"a": terms}, [])
    with pytest.raises(UsageError, match="no value of a"):
        FuzzyController({"a": terms}, [Rule({"a": "low"}, 1.0)]).step(a=math.nan)
    with pytest.raises(UsageError, match="rise"):
        Trapezoid(0, 2, 1, 3)
    with pytest.raises(UsageError, match="peaks"):
        triangles({"low": 1.0, "high": 0.0})


@given(st.floats(0.03, 1.5), st.floats(0.0, 1.5))
def test_moves_away_from_an_obstacle(bearing: float, width: float) -> None:
    rules = avoidance()
    right, left = rules.step(bearing=bearing, width=width), rules.step(bearing=-bearing, width=width)
    assert -1.0 <= right <= 1.0
    assert right <= 1e-9, "it never flies towards an obstacle on the left"
    if bearing > 0.2:
        assert left == pytest.approx(-right)


@given(st.floats(0.3, 1.0))
def test_a_near_obstacle_straight_ahead_is_passed_on_the_right(width: float) -> None:
    assert avoidance().step(bearing=0.0, width=width) < -0.5
