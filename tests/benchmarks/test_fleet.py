"""``python -m benchmarks.fleet``: a short run with few vehicles."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from benchmarks.command import build
from benchmarks.fleet import Case, cases_of


def test_cases_that_are_not_wanted_are_left_out() -> None:
    assert cases_of(100, 0, 0) == [Case(100)]
    assert [case.name for case in cases_of(100, 50, 50)] == [
        "100 vehicles, local",
        "100 vehicles, 50 observers of one, local",
        "50 vehicles, fabric",
    ]
    assert cases_of(100, 0, 0, 0.001)[0].name == "100 vehicles, 1 ms a command, local"


@pytest.mark.process
def test_the_command_measures_prints_and_writes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("zenoh")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    words = [
        "--seconds",
        "0.5",
        "--vehicles",
        "3",
        "--observers",
        "2",
        "--networked",
        "2",
        "--mavlink",
        "0",
        "--busy-ms",
        "0.1",
    ]
    ended = CliRunner().invoke(build("fleet"), [*words, "--output", str(tmp_path)], env={"COLUMNS": "200"})
    assert ended.exit_code == 0, ended.output
    assert "Many vehicles in one host" in ended.output
    results = json.loads((tmp_path / "fleet.json").read_bytes())
    assert results["what"] == "fleet"
    assert [(case["vehicles"], case["observers"], case["network"]) for case in results["cases"]] == [
        (3, 0, False),
        (3, 2, False),
        (2, 0, True),
    ]
    for case in results["cases"]:
        wanted = {"command", "feedback"} | ({"feedback, observers", "video, observers"} if case["observers"] else set())
        assert set(case["channels"]) == wanted
        assert case["cpu"].keys() >= {"host", "pilot"}
        assert all(summary["minimum_us"] > 0 for summary in case["channels"].values())


@pytest.mark.process
def test_emulated_vehicles_fly_in_formation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pymavlink")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    words = ["--seconds", "1", "--vehicles", "0", "--networked", "0", "--mavlink", "4", "--output"]
    ended = CliRunner().invoke(build("fleet"), [*words, str(tmp_path)], env={"COLUMNS": "200"})
    assert ended.exit_code == 0, ended.output
    assert "Emulated MAVLink vehicles in one host" in ended.output
    results = json.loads((tmp_path / "fleet.json").read_bytes())
    assert results["cases"] == []
    found = results["mavlink"]
    assert (found["vehicles"], found["up"], found["flown"], found["failed"]) == (4, 4, 2, {})
    assert 0.0 < found["share"] <= 1.2
    assert found["error_most_m"] >= found["error_p99_m"] >= 0.0
    assert found["cpu"].keys() == {"host", "pilot", "emulators"}
