"""The published figures' derivation from measurements, with invented results."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks import codecs, compare
from benchmarks import tables as scale_tables
from benchmarks.measuring import delays, tables
from benchmarks.measuring.delays import Cell, Delays, Series
from benchmarks.measuring.loop import Trip
from benchmarks.measuring.schedule import CHANNELS, PACKET_PERIOD_S
from benchmarks.measuring.statistics import Summary, summarize
from benchmarks.measuring.targets import judge_delays
from benchmarks.network import Network, Wire
from benchmarks.pages.delays import MEASURED
from benchmarks.ros import _judged, table
from benchmarks.scale import OBSERVED, UNIT_CASES, Case, CaseResult, Scale, bends, cases_of
from benchmarks.swarm import WITHIN_S, Expected, judge, stops_of
from benchmarks.swarming import Step
from benchmarks.units import Fleet, Units, derive, needs
from skyloop.bench import Machine
from skyloop.errors import FileFormatError, UsageError
from skyloop.messages import Applied, Velocity
from skyloop.vehicles.ardrone.wire import navdata
from skyloop.vehicles.ardrone.wire.navdata import LAYOUTS

SIZES = ["320×240", "1920×1080"]
#: Median delays of the made-up results [µs], times 10 with the large frames.
MEDIANS = {"floor": 50, "skyloop": 60, "ros2": 600}
MACHINE = Machine("A processor", 2, "An OS", "Linux 6.1", "3.11.7", {}, 0.1)
#: Cores in use that result in round unit costs.
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
S = 1_000_000_000


def summary_of(median_us: float, *, sent: int = 102) -> Summary:
    """101 samples around a median, the longest of them twice as long."""
    delays = [median_us * 1e3 * (0.5 + index / 100) for index in range(100)] + [median_us * 2e3]
    return summarize(delays, sent=sent, period_s=PACKET_PERIOD_S)


@pytest.fixture
def made_up() -> Delays:
    series = [
        Series(channel, [0.03125 * n for n in range(200)], [50.0 + n for n in range(200)]) for channel in CHANNELS
    ]
    return Delays(
        machine=Machine("A processor", 2, "An OS x86_64", "Linux 6.1", "3.11.7", {"numpy": "2.0"}),
        seconds=5.0,
        sizes=SIZES,
        contenders={"floor": "bare hand-over", "skyloop": "Skyloop", "ros2": "ROS 2 (rclpy)"},
        versions={"ros2": "9.1"},
        skipped={"zenoh": "not installed"},
        cells=[
            Cell(name, size, channel, summary_of(median * (10 if size == SIZES[1] else 1)))
            for name, median in MEDIANS.items()
            for size in SIZES
            for channel in CHANNELS
        ],
        series=series,
    )


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


def test_the_comparison_names_every_contender(made_up: Delays) -> None:
    rows = tables.comparison_table(made_up).rows
    assert [row[1] for row in rows] == ["bare hand-over", "Skyloop", "ROS 2 (rclpy) 9.1"] * 2
    assert rows[1][2].endswith(" 1.2×")
    assert "×" not in rows[0][2]
    verdicts = tables.verdict_table(judge_delays(made_up)).rows
    assert ["command: median to the floor's", "1.20", "≤ 1.4", "yes"] in [list(row) for row in verdicts]


def test_the_stages_of_a_trip() -> None:
    stages = Trip(1000, 1010, 1110, 1200, 1240, 1300).stages_ns()
    assert stages == {"published": 10, "delivered": 100, "controller": 90, "sent": 40, "applied": 60, "total": 300}


def slower(folder: Path, factor: float, contender: str, share: float = 1.0) -> Path:
    """Return the page's run with some of its figures multiplied."""

    def changed(cell: delays.Cell) -> delays.Cell:
        by = share * (factor if cell.contender == contender else 1.0)
        summary = msgspec.structs.replace(
            cell.summary, median_us=cell.summary.median_us * by, p99_us=cell.summary.p99_us * by
        )
        return msgspec.structs.replace(cell, summary=summary)

    results = delays.load(MEASURED / "delays.json")
    cells = [changed(cell) for cell in results.cells]
    (folder / "delays.json").write_bytes(msgspec.json.encode(msgspec.structs.replace(results, cells=cells)))
    return folder


def test_a_machine_that_is_slower_in_all_changes_nothing(tmp_path: Path) -> None:
    changes = compare.compare(slower(tmp_path, 1.0, "skyloop", share=3.0), MEASURED)
    assert len(changes) >= 12
    assert all(change.ratio == pytest.approx(1.0) for change in changes)
    assert not any(change.worse for change in changes)


def test_a_regression_is_marked(tmp_path: Path) -> None:
    changes = compare.compare(slower(tmp_path, 1.3, "skyloop"), MEASURED)
    medians = [change for change in changes if change.what.endswith("median")]
    assert medians
    assert all(change.worse and change.ratio == pytest.approx(1.3) for change in medians)
    assert not any(change.worse for change in changes if "99th" in change.what)


def test_folders_with_nothing_in_common_and_damaged_files_are_errors(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="nothing to compare"):
        compare.compare(tmp_path, MEASURED)
    (tmp_path / "delays.json").write_text("{}")
    with pytest.raises(FileFormatError):
        compare.compare(tmp_path, MEASURED)


def test_missed_and_needless_failsafes_are_distinguished() -> None:
    expected = [Expected("one", 10 * S), Expected("two", 10 * S), Expected("one", 20 * S)]
    steps = [Step("one", 10 * S + S // 2), Step("one", 15 * S), Step("two", 9 * S), Step("one", 20 * S)]
    verdict = judge(expected, steps)
    assert (verdict.expected, verdict.missed, verdict.needless) == (3, 1, 2)
    assert verdict.delay is not None
    assert (verdict.delay.samples, verdict.delay.median_us) == (2, 0.25e6)
    assert judge([], []).delay is None


def test_a_step_that_comes_too_late_does_not_count() -> None:
    verdict = judge([Expected("one", 0)], [Step("one", round(WITHIN_S * S) + 1)])
    assert (verdict.missed, verdict.needless) == (1, 1)


@given(st.integers(1, 10), st.floats(1.0, 600.0))
def test_users_stop_one_at_a_time_within_the_run(users: int, seconds: float) -> None:
    stops = stops_of(users, seconds)
    assert len(stops) == users
    assert stops == sorted(stops)
    assert stops[0] > 0.0
    assert stops[-1] < seconds


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


def scale_of(*cases: CaseResult) -> Scale:
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
        text = scale_tables.bend_text(scale_of(*good, worse), "proxies")
        assert text.startswith("With proxies it bends at 10: ")
    assert scale_tables.bend_text(scale_of(*good), "proxies") == "Up to 5 proxies nothing bends."


def test_a_channel_of_which_nothing_arrived_bends() -> None:
    silent = msgspec.structs.replace(case_of(Case(9, 9), {"proxies": 1.0}), channels={}, shares={"command": 0.0})
    results = scale_of(case_of(Case(1, 1), {"proxies": 0.1}), silent)
    assert scale_tables.bend_text(results, "proxies") == "With proxies it bends at 9: 0.0% of command arrived."
    assert scale_tables.scale_table(results, "proxies").rows[1][1] == "–"


def test_the_series_are_distinguished() -> None:
    results = scale_of(*(case_of(case, {"proxies": 0.1}) for case in cases_of([1, 2, 5])))
    assert [(case.proxies, case.observers) for case in results.series("proxies")] == [(1, 1), (2, 2), (5, 5)]
    assert [(case.proxies, case.observers) for case in results.series("observers")] == [(1, 1), (1, 2), (1, 5), (1, 10)]
    table = scale_tables.scale_table(results, "proxies")
    assert [row[0] for row in table.rows] == ["1", "2", "5"]
    assert len(table.columns) == len(table.rows[0])


def test_costs_of_one_are_differences_between_cases() -> None:
    found = derive(scale_of(*(case_of(case, cpu) for case, cpu in CPU.items())), weighed())
    for name in msgspec.structs.fields(Units):
        assert getattr(found, name.name) == pytest.approx(getattr(UNITS, name.name)), name.name
    assert len(scale_tables.units_table(found).rows[0]) == 3


def test_a_case_that_is_missing_is_named() -> None:
    with pytest.raises(UsageError, match=r"the case .1 proxy, 10 observers. was not measured: it is missing"):
        derive(scale_of(), weighed())
    with pytest.raises(UsageError, match=r"benchmarks\.network"):
        derive(scale_of(), msgspec.structs.replace(weighed(), wire=None))


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
        list(row) for row in scale_tables.needs_table(Fleet(), found).rows
    ]


@given(st.integers(1, 2000), st.integers(1, 50), st.integers(0, 10))
def test_twice_the_drones_need_twice_as_much(drones: int, sites: int, observers: int) -> None:
    one, two = (needs(Fleet(count, sites, observers, min(1, observers)), UNITS) for count in (drones, 2 * drones))
    for name in ("proxy_cores", "router_cores", "site_link", "tokens", "observer_memory_gb"):
        assert getattr(two, name) == pytest.approx(2 * getattr(one, name))


def test_delays_are_counted_from_the_publisher_and_from_the_bridge() -> None:
    published_ns = [0, 1_000_000, 2_000_000, 3_000_000]
    echoes = {
        number: Applied(number, 1, 1, at + 400_000, at + 700_000, Velocity(), Velocity())
        for number, at in enumerate(published_ns)
        if number != 2  # lost on its way
    }
    results = _judged(Machine.here(), 0.1, published_ns, [5_000_000] * 3, echoes, [4_000_000] * 3)
    assert (results.command.median_us, results.command_own.median_us) == (700.0, 300.0)
    assert (results.image.median_us, results.image_own.median_us) == (5000.0, 4000.0)
    assert results.command.samples == 2
    assert [row[-1] for row in table(results).rows] == ["400", "1000"]


def test_the_datagram_is_full() -> None:
    decoded = navdata.decode(codecs.full_navdata())
    assert set(decoded.options) == set(LAYOUTS)
    assert not decoded.unknown
