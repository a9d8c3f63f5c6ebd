"""Fuzzy inference: linguistic rules over numbers. Pure.

Zero-order Takagi-Sugeno: each rule concludes a number, and the output is the mean of these, weighted by how true the
rules are; the truth of a rule is the product of its conditions' (Takagi and Sugeno, "Fuzzy identification of systems
and its applications to modeling and control", IEEE Trans. SMC 15(1), 1985).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from skyloop.errors import UnknownNameError, UsageError


@dataclass(frozen=True, slots=True)
class Trapezoid:
    """Membership function: 0 up to ``a``, rising to 1 at ``b``, 1 up to ``c``, falling to 0 at ``d``.

    Infinite ``a`` and ``b``, or ``c`` and ``d``, leave that side at 1.

    Raises:
        UsageError: The corners do not satisfy ``a`` ≤ ``b`` ≤ ``c`` ≤ ``d``.
    """

    a: float
    b: float
    c: float
    d: float

    def __post_init__(self) -> None:
        if not self.a <= self.b <= self.c <= self.d:
            raise UsageError(f"a trapezoid's corners must rise: {self.a}, {self.b}, {self.c}, {self.d}")

    def __call__(self, value: float) -> float:
        """Return the membership of a value, 0 to 1."""
        if self.b <= value <= self.c:
            return 1.0
        if value < self.b:
            return 0.0 if value <= self.a else (value - self.a) / (self.b - self.a)
        return 0.0 if value >= self.d else (self.d - value) / (self.d - self.c)


def triangles(peaks: Mapping[str, float]) -> dict[str, Trapezoid]:
    """Return triangular terms of one variable, each 1 at its peak and 0 at the next ones.

    All together add up to 1 everywhere; the outermost ones stay at 1 beyond their peaks.

    Args:
        peaks: Where each term is 1, by its name; at least two, in rising order.

    Raises:
        UsageError: There are fewer than two peaks, or they do not rise.
    """
    names, at = list(peaks), list(peaks.values())
    if len(at) < 2 or any(not low < high for low, high in itertools.pairwise(at)):
        raise UsageError(f"two peaks or more, each above the one before, not {dict(peaks)}")
    lows, highs = [-math.inf, *at[:-1]], [*at[1:], math.inf]
    return {
        name: Trapezoid(low, -math.inf if low == -math.inf else peak, math.inf if high == math.inf else peak, high)
        for name, low, peak, high in zip(names, lows, at, highs, strict=True)
    }


@dataclass(frozen=True, slots=True)
class Rule:
    """If every variable is as in ``when``, the output is ``then``."""

    when: Mapping[str, str]  #: term by variable; a variable that is not named may have any value
    then: float


class FuzzyController:
    """Rules over variables with linguistic terms."""

    def __init__(self, variables: Mapping[str, Mapping[str, Trapezoid]], rules: Sequence[Rule]) -> None:
        """Check and store the rules.

        Args:
            variables: Membership functions by variable and term.
            rules: At least one.

        Raises:
            UsageError: There is no rule.
            UnknownNameError: A rule names a variable or term that does not exist.
        """
        if not rules:
            raise UsageError("there is no rule")
        for rule in rules:
            for variable, term in rule.when.items():
                if variable not in variables:
                    raise UnknownNameError("fuzzy variable", variable, variables)
                if term not in variables[variable]:
                    raise UnknownNameError(f"term of {variable}", term, variables[variable])
        self._variables = {name: dict(terms) for name, terms in variables.items()}
        self._rules = tuple(rules)

    def step(self, **values: float) -> float:
        """Compute the output.

        Args:
            **values: One for each variable.

        Returns:
            The weighted mean of the rules' conclusions; 0 where no rule applies.

        Raises:
            UsageError: A variable has no value, or it is NaN.
        """
        missing = [name for name in self._variables if math.isnan(values.get(name, math.nan))]
        if missing:
            raise UsageError(f"no value of {', '.join(missing)}")
        weights = [
            math.prod(self._variables[name][term](values[name]) for name, term in rule.when.items())
            for rule in self._rules
        ]
        total = sum(weights)
        return sum(w * rule.then for w, rule in zip(weights, self._rules, strict=True)) / total if total > 0 else 0.0
