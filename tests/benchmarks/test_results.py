"""Tables and targets of the load, and the pages, from results that were made up or are on the pages."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import load
from benchmarks import tables as load_tables
from benchmarks.load import (
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
from benchmarks.measuring import delays, loop, tables
from benchmarks.measuring.delays import Delays
from benchmarks.measuring.schedule import LARGE, MIDDLE, SMALL
from benchmarks.measuring.targets import judge_delays
from benchmarks.pages.fill import fill
from benchmarks.targets import judge_load
from skyloop.errors import UsageError
from tests.benchmarks.conftest import summary_of

DOCS = Path(__file__).parents[2] / "docs"


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
    rows = load_tables.load_table(results).rows
    assert list(rows[1]) == ["8 observers", "320×240, 15/s", "110 (164)", "70 (104)", "150 (224)", "200 (298)"]
    assert rows[0][-1] == ""
    assert list(rows[-1]) == ["zeppelin", "left out: it is foggy", "", "", "", ""]
    assert list(load_tables.cpu_table(results).rows[0]) == [ALONE, "320×240, 15/s", "1.0", "2.0", *"–––––"]


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
        "load": load_tables.load_table(crowd).markdown(),
        "processor": load_tables.cpu_table(crowd).markdown(),
        "loop": tables.loop_table(loop.load(DOCS / "measured" / "loop.json")).markdown(),
        "targets": tables.verdict_table([*judge_delays(results), *judge_load(crowd)]).markdown(),
    }
    assert fill(page, made) == page, "run python -m benchmarks.pages.delays"
    assert str(results.machine) in page
    assert results.summary("skyloop", str(SMALL), "command") is not None
    assert results.summary("skyloop", str(LARGE), "nothing") is None
