"""``python -m benchmarks.scale``: where things bend, what one costs, what a fleet needs; and short runs."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from benchmarks import scale, tables, units
from benchmarks.command import build
from benchmarks.network import Network, Wire
from benchmarks.scale import OBSERVED, UNIT_CASES, Case, CaseResult, Scale, bends, cases_of
from benchmarks.units import Fleet, Units, derive, needs
from skyloop.bench import Machine
from skyloop.errors import UsageError
from tests.benchmarks import working
from tests.benchmarks.conftest import summary_of

MACHINE = Machine("A processor", 2, "An OS", "Linux 6.1", "3.11.7", {}, 0.1)
#: Cores in use that make the costs of one come out as round numbers.
CPU = {
    Case(1, 0, video=False): {"proxies": 0.010, "pilot": 0.005},
    Case(1, OBSERVED, video=False): {"proxies": 0.010 + 0.0032, "observers": 0.032},
    Case(1, OBSERVED): {"proxies": 0.0132 + 0.007, "observers": 0.062},
    Case(1, OBSERVED, video=False, router=True): {"router": 0.0064},
    Case(1, OBSERVED, router=True): {"router": 0.0104},
}
UNITS = Units(
    proxy_us_per_s=10_000,
    pilot_us_per_s=5_000,
    feedback_sent_us=10,
    feedback_received_us=100,
    jpeg_us=500,
    frame_sent_us=20,
    frame_received_us=300,
    feedback_routed_us=20,
    frame_routed_us=40,
    proxy_mb=30,
    observer_mb=30,
    router_mb=30,
    command_bytes=200,
    feedback_bytes=350,
    frame_bytes=15_000,
)


def case_of(wanted: Case, cpu: dict[str, float], median_us: float = 1000.0, share: float = 1.0) -> CaseResult:
    names = ["command", "feedback", *(["feedback, observers", "video, observers"] if wanted.observers else [])]
    return CaseResult(
        *wanted,
        channels={name: summary_of(median_us) for name in names},
        shares=dict.fromkeys(names, share),
        cpu=cpu,
        memory_mb=dict.fromkeys(("proxies", "observers", "router"), 30.0),
        opened_s=0.5,
    )


def made_up(*cases: CaseResult) -> Scale:
    return Scale(MACHINE, 5.0, list(cases), {}, jpeg_us=500.0)


def weighed() -> Network:
    return Network(MACHINE, 5.0, "a path", [], Wire(200.0, 350.0, 15_000.0, 180.0), 100.0)


def test_the_cases_are_those_of_both_series_and_of_the_costs() -> None:
    cases = cases_of([1, 5, 5, 0])
    assert cases[:4] == [Case(1, 1), Case(5, 5), Case(1, 5), UNIT_CASES[0]]
    assert set(UNIT_CASES) < set(cases)
    assert [case.name for case in cases[:2]] == ["1 proxy, 1 observer", "5 proxies, 5 observers"]
    assert Case(1, 2, video=False, router=True).name == "1 proxy, 2 observers, no video, through a router"


def test_it_bends_where_samples_are_missing_late_or_no_processor_is_left() -> None:
    good = [case_of(Case(n, n), {"proxies": 0.1 * n}) for n in (1, 2, 5)]
    assert bends(good, 2) is None
    for worse, why in (
        (case_of(Case(10, 10), {"proxies": 1.0}, share=0.9), "90.0% of command arrived"),
        (case_of(Case(10, 10), {"proxies": 1.0}, median_us=9000.0), "the 99th percentile of command is 9 times"),
        (case_of(Case(10, 10), {"proxies": 1.5, "pilot": 0.4}), "1.9 of 2 cores are in use"),
    ):
        found = bends([*good, worse], 2)
        assert found is not None
        assert (found[0], found[1].startswith(why)) == (worse, True)
        text = tables.bend_text(made_up(*good, worse), "proxies")
        assert text.startswith("With proxies it bends at 10: ")
    assert tables.bend_text(made_up(*good), "proxies") == "Up to 5 proxies nothing bends."


def test_a_channel_of_which_nothing_arrived_bends() -> None:
    silent = msgspec.structs.replace(case_of(Case(9, 9), {"proxies": 1.0}), channels={}, shares={"command": 0.0})
    results = made_up(case_of(Case(1, 1), {"proxies": 0.1}), silent)
    assert tables.bend_text(results, "proxies") == "With proxies it bends at 9: 0.0% of command arrived."
    assert tables.scale_table(results, "proxies").rows[1][1] == "–"


def test_the_series_are_told_apart() -> None:
    results = made_up(*(case_of(case, {"proxies": 0.1}) for case in cases_of([1, 2, 5])))
    assert [(case.proxies, case.observers) for case in results.series("proxies")] == [(1, 1), (2, 2), (5, 5)]
    assert [(case.proxies, case.observers) for case in results.series("observers")] == [(1, 1), (1, 2), (1, 5), (1, 10)]
    table = tables.scale_table(results, "proxies")
    assert [row[0] for row in table.rows] == ["1", "2", "5"]
    assert len(table.columns) == len(table.rows[0])


def test_costs_of_one_are_differences_between_cases() -> None:
    found = derive(made_up(*(case_of(case, cpu) for case, cpu in CPU.items())), weighed())
    for name in msgspec.structs.fields(Units):
        assert getattr(found, name.name) == pytest.approx(getattr(UNITS, name.name)), name.name
    assert len(tables.units_table(found).rows[0]) == 3


def test_a_case_that_is_missing_is_named() -> None:
    with pytest.raises(UsageError, match=r"the case .1 proxy, 10 observers. was not measured: it is missing"):
        derive(made_up(), weighed())
    with pytest.raises(UsageError, match=r"benchmarks\.network"):
        derive(made_up(), msgspec.structs.replace(weighed(), wire=None))


def test_needs_of_a_fleet_by_hand() -> None:
    found = needs(Fleet(drones=100, sites=4, observers=2, viewers=1, frames_per_s=10.0, busy=0.5), UNITS)
    assert found.proxy_cores == pytest.approx(100 * (0.010 + 10 * 520e-6))
    assert found.pilot_cores == pytest.approx(100 * 0.005)
    assert found.observer_cores == pytest.approx(100 * (2 * 32 * 100e-6 + 10 * 300e-6))
    passed = 32 * 20e-6 + 5 * 40e-6
    assert found.middle_cores == pytest.approx(100 * passed)
    assert found.router_cores == pytest.approx(25 * (32 * 20e-6 * 4 + 10 * 40e-6 + passed))
    assert found.drone_uplink == pytest.approx(8 * (32 * 350 + 10 * 15_000) / 1e6)
    assert found.site_link == pytest.approx(25 * 8 * (32 * 350 + 5 * 15_000) / 1e6)
    assert found.tokens == 400
    assert found.mesh_links == 400 * 399 // 2
    assert ["liveliness tokens", "400", "one a proxy, one a connection"] in [
        list(row) for row in tables.needs_table(Fleet(), found).rows
    ]


@given(st.integers(1, 2000), st.integers(1, 50), st.integers(0, 10))
def test_twice_the_drones_need_twice_as_much(drones: int, sites: int, observers: int) -> None:
    one, two = (needs(Fleet(count, sites, observers, min(1, observers)), UNITS) for count in (drones, 2 * drones))
    for name in ("proxy_cores", "router_cores", "site_link", "tokens", "observer_memory_gb"):
        assert getattr(two, name) == pytest.approx(2 * getattr(one, name))


@pytest.mark.process
def test_the_command_measures_prints_draws_and_writes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("zenoh")
    pytest.importorskip("matplotlib")
    monkeypatch.setattr(scale, "UNIT_CASES", (Case(1, 0, video=False),))
    arguments = ["--seconds", "0.5", "--counts", "1,2", "--output", str(tmp_path)]
    ended = CliRunner().invoke(build("scale"), arguments, env={"COLUMNS": "200"})
    assert ended.exit_code == 0, ended.output
    assert (tmp_path / "scale.png").stat().st_size > 10_000
    results = scale.load(tmp_path / "scale.json")
    assert json.loads((tmp_path / "scale.json").read_bytes())["what"] == "scale"
    assert [(case.proxies, case.observers) for case in results.cases] == [(1, 1), (2, 2), (1, 2), (1, 0)]
    for case in results.cases:
        wanted = {"command", "feedback"} | ({"feedback, observers", "video, observers"} if case.observers else set())
        assert set(case.channels) == wanted
        assert all(summary.minimum_us > 0 for summary in case.channels.values())
        assert case.memory_mb["proxies"] > 1.0
    assert "More and more proxies" in ended.output
    assert results.jpeg_us > 0


@pytest.mark.process
def test_a_case_that_fails_is_left_out_and_the_others_are_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("zenoh")
    monkeypatch.setattr(scale, "observe", working.fails)
    results = scale.measure(0.3, [Case(1, 1), Case(1, 0, video=False)])
    assert [case.observers for case in results.cases] == [0]
    [(name, told)] = results.skipped.items()
    assert name == "1 proxy, 1 observer"
    assert told.startswith("the measuring process of fails [")
    assert told.endswith("ended; its error stands above")


@pytest.mark.process
def test_without_root_what_needs_a_router_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scale, "problem", lambda: "not today")
    results = scale.measure(0.5, [Case(1, 1, router=True)])
    assert results.cases == []
    assert results.skipped == {"1 proxy, 1 observer, through a router": "not today"}
    assert units.Fleet().drones == 1000
