"""Every benchmark runs, and writes JSON with the fields of its type. No test checks speed."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import pytest
from typer.testing import CliRunner

from benchmarks import codecs, fleet, learning, load, network, recordings, scale, swarm, tracking
from benchmarks.command import build
from benchmarks.compare import build as build_compare
from benchmarks.hosts.namespaces import problem as hosts_problem
from benchmarks.measuring import delays, loop
from benchmarks.measuring.statistics import Summary
from benchmarks.pages.delays import MEASURED
from benchmarks.ros import measure as measure_ros
from skyloop.errors import UnsupportedError, UsageError


class Run(NamedTuple):
    """A short run: its options, and the type of its output."""

    options: str
    kind: type[msgspec.Struct]
    needs: str = "numpy"  #: packages
    holds: Callable[[Any], bool] = bool  #: what shows that it measured something


RUNS = {
    "peers": Run("--peers all --seconds 0.5", delays.Delays, "matplotlib"),
    "loop": Run("--seconds 0.5 --sizes 320x240,1920x1080", loop.Loop),
    "load": Run("--seconds 0.5 --observers 2 --pages 2", load.Load),
    "codecs": Run("--seconds 0.5", codecs.CodecResults, "av"),
    "network": Run("--seconds 1 --losses 0.1", network.Network, "zenoh"),
    "swarm": Run("--seconds 3 --drones 2", swarm.Swarm, "zenoh cv2", lambda found: found.failsafe.missed == 0),
    "scale": Run("--seconds 0.5 --counts 1,2", scale.Scale, "zenoh matplotlib", lambda found: not found.skipped),
    "fleet": Run(
        "--seconds 1 --vehicles 3 --observers 2 --networked 2 --mavlink 4 --busy-ms 0.1",
        fleet.HostedFleet,
        "zenoh pymavlink",
        lambda found: (found.mavlink.up, found.mavlink.flown, found.mavlink.failed) == (4, 2, {}),
    ),
    "learning": Run("--seconds 0.5", learning.Learning, "gymnasium"),
    "recordings": Run("--seconds 1", recordings.Recordings, "mcap av"),
}


def summaries(results: Any) -> Iterator[Summary]:
    """Yield every distribution of delays in these results."""
    if isinstance(results, Summary):
        yield results
    elif isinstance(results, msgspec.Struct):
        yield from summaries(msgspec.structs.astuple(results))
    elif isinstance(results, dict):
        yield from summaries(list(results.values()))
    elif isinstance(results, list | tuple):
        for one in results:
            yield from summaries(one)


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Run few cases, and none with separate hosts."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.setattr(scale, "UNIT_CASES", (scale.Case(1, 0, video=False),))
    monkeypatch.setattr(swarm, "problem", lambda: "not today")


@pytest.mark.process
@pytest.mark.parametrize("name", list(RUNS))
def test_it_runs_and_writes_the_fields_of_its_type(name: str, small: None, tmp_path: Path) -> None:
    options, kind, needs, holds = RUNS[name]
    for package in needs.split():
        if importlib.util.find_spec(package) is None:
            pytest.skip(f"{package} is not installed")
    if name == "network" and (problem := hosts_problem()):
        pytest.skip(problem)
    words = [*options.split(), "--output", str(tmp_path)]
    ended = CliRunner().invoke(build(name), words, env={"COLUMNS": "200"})
    assert ended.exit_code == 0, ended.output
    written = tmp_path / f"{'delays' if name == 'peers' else name}.json"
    results = msgspec.json.decode(written.read_bytes(), type=kind)
    fields = {field.encode_name for field in msgspec.structs.fields(kind)}
    assert fields <= set(json.loads(written.read_bytes())), "the documented fields"
    assert holds(results)
    for one in summaries(results):
        assert 0 < one.minimum_us <= one.median_us <= one.p99_us <= one.p999_us <= one.maximum_us
    for cases in (getattr(results, name, None) for name in ("cells", "sizes", "cases", "rows")):
        assert cases is None or len(cases) > 0
    for drawn in tmp_path.glob("*.png"):
        assert drawn.stat().st_size > 5_000


def test_trackers_are_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("matplotlib")
    ours = {name: make for name, make in tracking.trackers().items() if "OpenCV" not in name}
    monkeypatch.setattr(tracking, "trackers", lambda: ours)
    tracking.main(["--quick", "--fixtures", str(tmp_path / "none"), "--output", str(tmp_path)])
    results = msgspec.json.decode((tmp_path / "tracking.json").read_bytes(), type=tracking.TrackingResults)
    assert [row.tracker for row in results.rows] == list(ours)
    assert "using only drawn images" in capsys.readouterr().out


@pytest.mark.parametrize("name", list(RUNS))
def test_usage_errors_come_before_anything_is_measured(name: str) -> None:
    with pytest.raises(UsageError, match="give one of them"):
        build(name)(["--seconds", "1", "--minutes", "1"], standalone_mode=False)


def test_without_rclpy_the_bridge_is_not_measured() -> None:
    with pytest.raises(UnsupportedError, match="skyloop install ros"):
        measure_ros(1.0, "/bin/false")


@pytest.mark.parametrize(("factor", "told"), [(1.0, 0), (1.3, 1)])
def test_two_runs_are_compared_and_a_loss_fails(factor: float, told: int, tmp_path: Path) -> None:
    results = delays.load(MEASURED / "delays.json")
    cells = [
        msgspec.structs.replace(
            cell, summary=msgspec.structs.replace(cell.summary, median_us=cell.summary.median_us * factor)
        )
        if cell.contender == "skyloop"
        else cell
        for cell in results.cells
    ]
    (tmp_path / "delays.json").write_bytes(msgspec.json.encode(msgspec.structs.replace(results, cells=cells)))
    ended = CliRunner().invoke(build_compare(), [str(tmp_path)])
    assert (ended.exit_code, "slower" in ended.output) == (told, bool(told))
