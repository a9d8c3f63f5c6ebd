"""Tables, targets, figures and the page, from results that were made up."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import msgspec
import pytest

from skyloop.bench import delays, load, loop, tables
from skyloop.bench.delays import Delays
from skyloop.bench.load import (
    ALONE,
    FULL,
    KILLED,
    RECORDED,
    CaseResult,
    Load,
    cases_of,
    observers_name,
    pages_name,
)
from skyloop.bench.page import fill
from skyloop.bench.schedule import LARGE, MIDDLE, SMALL
from skyloop.bench.targets import judge_delays, judge_load
from skyloop.errors import UsageError
from tests.bench.conftest import summary_of

DOCS = Path(__file__).parents[2] / "docs"


def test_targets_compare_medians_and_percentiles(made_up: Delays) -> None:
    verdicts = {verdict.what: verdict for verdict in judge_delays(made_up)}
    assert len(verdicts) == 4 + 2 + 4
    to_floor = verdicts["command: median to the floor's"]
    assert to_floor.figure == pytest.approx(1.2)
    assert (to_floor.limit, to_floor.held) == (1.3, True)
    to_ros = verdicts["video 1920×1080: rclpy's median to ours"]
    assert to_ros.figure == pytest.approx(10.0)
    assert (to_ros.limit, to_ros.at_least, to_ros.held) == (30.0, True, False)
    without_ros = msgspec.structs.replace(made_up, cells=[c for c in made_up.cells if c.contender != "ros2"])
    assert len(judge_delays(without_ros)) == 6


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
    assert ["command: median to the floor's", "1.20", "≤ 1.3", "yes"] in [list(row) for row in verdicts]


def case(
    name: str,
    median_us: float,
    size: str = str(SMALL),
    lost: dict[str, int] | None = None,
    *,
    frames_per_s: float = 15.0,
    stopped: str = "",
) -> CaseResult:
    channels = {"command": summary_of(median_us), "feedback": summary_of(70), "video": summary_of(150)}
    if "observer" in name:
        channels |= {"feedback, observers": summary_of(median_us), "video, observers": summary_of(200)}
    return CaseResult(name, size, frames_per_s, 0, channels, {"proxy": 0.01, "pilot": 0.02}, lost, stopped)


def recorded(name: str, median_us: float, lost: dict[str, int] | None = None, stopped: str = "") -> CaseResult:
    return case(name, median_us, str(MIDDLE), lost, frames_per_s=30.0, stopped=stopped)


def test_the_targets_of_the_load(made_up: Delays) -> None:
    found = [
        case(ALONE, 100),
        case(observers_name(8), 110),
        case(observers_name(8, stuck=True), 132),
        case(observers_name(32), 250),
        case(ALONE, 80, str(MIDDLE)),
        case(pages_name(10), 160, str(MIDDLE)),
        recorded(ALONE, 100),
        recorded(RECORDED, 109, {"video": 2, "feedback": 0}),
        recorded(KILLED, 100),
        recorded(FULL, 120, {}, "No space left on device"),
    ]
    results = Load(made_up.machine, 5.0, found, {"zeppelin": "it is foggy"})
    held = {verdict.what: verdict.held for verdict in judge_load(results)}
    assert held == {
        "command: 99th percentile with 32 observers to none": False,
        "command: median with one observer stopped to none": False,
        "feedback, observers: median with one observer stopped to none": False,
        "video, observers: median with one observer stopped to none": True,
        "command: 99th percentile with 10 cockpit pages to none": False,
        "command: median with a recorder to none": True,
        "samples that the recorder lost": False,
        "command: median with a recorder, killed half-way to none": True,
        "command: median with a recorder, disk full to none": False,
    }
    assert judge_load(Load(made_up.machine, 5.0, [recorded(RECORDED, 100), case(ALONE, 1, str(MIDDLE))], {})) == []
    not_full = [recorded(ALONE, 100), recorded(FULL, 100, {})]
    assert judge_load(Load(made_up.machine, 5.0, not_full, {})) == []
    rows = tables.load_table(results).rows
    assert list(rows[1]) == ["8 observers", "320×240, 15/s", "110 (164)", "70 (104)", "150 (224)", "200 (298)"]
    assert rows[0][-1] == ""
    assert list(rows[-1]) == ["zeppelin", "left out: it is foggy", "", "", "", ""]
    assert list(tables.cpu_table(results).rows[0]) == [ALONE, "320×240, 15/s", "1.0", "2.0", *"––––"]


def test_the_cases_of_the_load() -> None:
    names = [case.name for case in cases_of([32, 1])]
    assert names[:5] == [ALONE, "1 observer", "8 observers", "8 observers, one of them stopped", "32 observers"]
    assert [one.name for one in cases_of([1]) if one.recorder] == [RECORDED, KILLED, FULL]
    assert {one.size for one in cases_of([1]) if one.recorder} == {MIDDLE}
    alone = cases_of([], slow_processor=False, stuck=False, recorder=False, disk_full=False)
    assert [one.name for one in alone] == [ALONE]
    paged = cases_of([], slow_processor=False, stuck=False, recorder=False, disk_full=False, pages=1)
    assert [(one.name, one.size) for one in paged[1:]] == [(ALONE, MIDDLE), ("1 cockpit page", MIDDLE)]
    assert paged[1].frame_period_s == paged[2].frame_period_s


def test_figures_are_written(made_up: Delays, tmp_path: Path) -> None:
    if importlib.util.find_spec("matplotlib") is None:
        pytest.skip("matplotlib is not installed")
    from skyloop.bench.figures import draw

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

    from skyloop.bench.figures import draw
    from skyloop.errors import MissingExtraError

    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(MissingExtraError, match=r"skyloop\[bench\]"):
        draw(made_up, tmp_path)


def test_a_page_is_filled_and_can_be_filled_again() -> None:
    page = "# A\n<!-- measured: x -->\n<!-- end -->\ntext\n<!-- measured: y -->\nold\n<!-- end -->\n"
    filled = fill(page, {"x": "new\n", "y": "newer"})
    assert filled == "# A\n<!-- measured: x -->\nnew\n<!-- end -->\ntext\n<!-- measured: y -->\nnewer\n<!-- end -->\n"
    assert fill(filled, {"x": "new", "y": "newer"}) == filled
    assert fill(filled, {"x": "other"}).count("newer") == 1
    with pytest.raises(UsageError, match="measured: z"):
        fill(page, {"z": ""})


def test_the_tables_of_the_page_are_those_of_its_results() -> None:
    page = (DOCS / "delays.md").read_text()
    results = delays.load(DOCS / "measured" / "delays.json")
    crowd = load.load(DOCS / "measured" / "load.json")
    made = {
        "paper": tables.paper_table(results).markdown(),
        "comparison": tables.comparison_table(results).markdown(),
        "load": tables.load_table(crowd).markdown(),
        "processor": tables.cpu_table(crowd).markdown(),
        "loop": tables.loop_table(loop.load(DOCS / "measured" / "loop.json")).markdown(),
        "targets": tables.verdict_table([*judge_delays(results), *judge_load(crowd)]).markdown(),
    }
    assert fill(page, made) == page, "run python scripts/delays.py"
    assert str(results.machine) in page
    assert results.summary("skyloop", str(SMALL), "command") is not None
    assert results.summary("skyloop", str(LARGE), "nothing") is None
