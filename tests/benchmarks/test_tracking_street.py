"""The calibration of the long-term tracker's confidence."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.tracking_street import KNOTS, fitted, reliability, scored, street
from skyloop.vision.appearance import confidence

PAIRS = st.lists(st.tuples(st.floats(0.45, 1.0), st.booleans()), max_size=60)


@given(PAIRS)
def test_the_fit_is_monotone_and_a_share(pairs: list[tuple[float, bool]]) -> None:
    shares = fitted(pairs)
    assert len(shares) == len(KNOTS)
    assert list(shares) == sorted(shares)
    assert all(0.0 < share < 1.0 for share in shares)


def test_the_table_counts_what_was_good_in_each_bin() -> None:
    rows = reliability([(0.95, True), (0.95, False), (0.45, False)], (0.1, 0.2, 0.3, 0.4, 0.5, 0.96))
    assert rows == [("0.00 to 0.50", 1, 0.1, 0.0), ("0.95 to 1.00", 2, 0.96, 0.5)]


def test_confidence_grows_with_the_score() -> None:
    shares = [confidence(float(score)) for score in np.linspace(0, 1, 41)]
    assert shares == sorted(shares)
    assert 0.0 < shares[0] <= shares[-1] < 1.0


@pytest.mark.parametrize("world", ["street", "yard"])
def test_a_sequence_begins_with_its_target_in_view_and_is_repeatable(world: str) -> None:
    first, again = (list(street(world, 3, 4).frames()) for _ in range(2))
    assert len(first) == 4
    assert first[0][1] is not None
    assert all((a[0] == b[0]).all() and a[1:] == b[1:] for a, b in zip(first, again, strict=True))
    assert all(0.45 <= score <= 1.0 for score, _ in scored([street(world, 3, 4)]))
