"""``benchmarks.tracking``: a short run gives every figure. How good and how fast is not asked."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import msgspec
import pytest

from benchmarks import tracking
from benchmarks.pages.fill import fill
from benchmarks.pages.tracking import MEASURED, PAGE, blocks
from benchmarks.tracking import TrackingResults
from benchmarks.tracking_scenes import Sequence, scene


def test_the_command_measures_everything_prints_and_writes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("matplotlib")
    ours = {name: make for name, make in tracking.trackers().items() if "OpenCV" not in name}
    monkeypatch.setattr(tracking, "trackers", lambda: ours)
    tracking.main(["--quick", "--fixtures", str(tmp_path / "none"), "--output", str(tmp_path)])
    printed = capsys.readouterr().out
    assert "only drawn images are used" in printed
    results = msgspec.json.decode((tmp_path / "tracking.json").read_bytes(), type=TrackingResults)
    assert [row.tracker for row in results.rows] == ["LongTermTracker", "CorrelationTracker", "MedianFlowTracker"]
    for row in results.rows:
        assert f"| drawn | {row.tracker} | {row.successes:.1%} |" in printed
        assert row.success == sorted(row.success, reverse=True)
        assert row.precision == sorted(row.precision)
        assert row.hidden > 0
        assert 0 < row.update.median_us <= row.update.p99_us
    assert (tmp_path / "tracking.png").stat().st_size > 1000


def test_opencvs_trackers_fit_the_interface() -> None:
    found = tracking.trackers()
    assert "OpenCV MIL" in found
    begin = Sequence("begin", lambda: islice(scene("plain", 1, 90).frames(), 3))
    results = tracking.measure({"one": [begin]}, {"OpenCV MIL": found["OpenCV MIL"]}, lambda what: None)
    assert results.rows[0].successes == 1.0


def test_the_tables_of_the_page_are_those_of_its_results() -> None:
    results = msgspec.json.decode(MEASURED.read_bytes(), type=TrackingResults)
    page = PAGE.read_text()
    assert fill(page, blocks(results)) == page, "run python -m benchmarks.pages.tracking"
