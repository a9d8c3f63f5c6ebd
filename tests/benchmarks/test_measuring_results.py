"""Tables, targets, figures and the page, from results that were made up."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import msgspec
import pytest

from benchmarks.measuring import tables
from benchmarks.measuring.delays import Delays
from benchmarks.measuring.targets import judge_delays

DOCS = Path(__file__).parents[2] / "docs"


def test_targets_compare_medians_and_percentiles(made_up: Delays) -> None:
    verdicts = {verdict.what: verdict for verdict in judge_delays(made_up)}
    assert len(verdicts) == 4 + 4 + 4
    to_floor = verdicts["command: median to the floor's"]
    assert to_floor.figure == pytest.approx(1.2)
    assert (to_floor.limit, to_floor.held) == (1.4, True)
    to_ros = verdicts["video 1920×1080: rclpy's median to ours"]
    assert to_ros.figure == pytest.approx(10.0)
    assert (to_ros.limit, to_ros.at_least, to_ros.held) == (30.0, True, False)
    without_ros = msgspec.structs.replace(made_up, cells=[c for c in made_up.cells if c.contender != "ros2"])
    assert len(judge_delays(without_ros)) == 8


def test_the_papers_table(made_up: Delays) -> None:
    table = tables.paper_table(made_up)
    rows = {row[0]: row[1:] for row in table.rows}
    assert table.columns == ["", "command", "feedback", "video 320×240"]
    assert [cell.split()[0] for cell in rows["the paper's mean"]] == ["0.091", "0.109", "1.038"]
    assert rows["median"] == ["0.060"] * 3
    assert rows["mean (of the period)"][0] == "0.060 (0.19%)"
    assert (rows["samples"][0], rows["lost"][0]) == ("101", "1")
    other_size = msgspec.structs.replace(made_up, sizes=["1920×1080"])
    rows = {row[0]: row[1:] for row in tables.paper_table(other_size).rows}
    assert rows["the paper's mean"][2] == tables.UNKNOWN  # the paper measured no such frames


def test_the_comparison_names_everybody(made_up: Delays) -> None:
    rows = tables.comparison_table(made_up).rows
    assert [row[1] for row in rows] == ["bare hand-over", "Skyloop", "ROS 2 (rclpy) 9.1"] * 2
    assert rows[1][2].endswith(" 1.2×")
    assert "×" not in rows[0][2]
    verdicts = tables.verdict_table(judge_delays(made_up)).rows
    assert ["command: median to the floor's", "1.20", "≤ 1.4", "yes"] in [list(row) for row in verdicts]


def test_figures_are_written(made_up: Delays, tmp_path: Path) -> None:
    if importlib.util.find_spec("matplotlib") is None:
        pytest.skip("matplotlib is not installed")
    from benchmarks.measuring.figures import draw

    files = draw(made_up, tmp_path)
    assert [file.name for file in files] == [
        f"delays-{name}.{ending}"
        for name in ("command", "video", "evolution", "comparison")
        for ending in ("png", "svg")
    ]
    for file in files:
        assert file.read_bytes().startswith(b"\x89PNG" if file.suffix == ".png" else b"<?xml")
        assert file.stat().st_size > 5_000
    assert "mean" in (tmp_path / "delays-command.svg").read_text()


def test_without_matplotlib_it_says_what_to_install(
    made_up: Delays, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import sys

    from benchmarks.measuring.figures import draw
    from skyloop.errors import MissingExtraError

    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(MissingExtraError, match="skyloop install bench"):
        draw(made_up, tmp_path)
