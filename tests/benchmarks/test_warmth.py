"""``python -m benchmarks.warmth``: a short run gives every figure. How fast is not asked."""

from __future__ import annotations

import sys

import msgspec
import pytest

from benchmarks import warmth
from benchmarks.measuring.schedule import CHANNELS

pytestmark = [
    pytest.mark.process,
    pytest.mark.skipif(sys.platform != "linux", reason="needs the local transport"),
]


def test_each_interval_is_measured() -> None:
    told: list[float] = []
    results = warmth.measure(0.5, (0, 10), progress=lambda share, _what: told.append(share))
    assert told == [0.0, 0.5]
    assert [row.period_ms for row in results.rows] == [0, 10]
    for row in results.rows:
        assert set(row.channels) == set(CHANNELS)
        assert all(summary.median_us > 0.0 for summary in row.channels.values())
        assert set(row.cpu) == set(warmth.SIDES)
    assert msgspec.json.decode(msgspec.json.encode(results), type=warmth.Warmth) == results
    table = warmth.table(results)
    assert [row[0] for row in table.rows] == ["never", "10 ms"]
    assert {len(row) for row in table.rows} == {len(table.columns)}
