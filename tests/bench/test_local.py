"""``skyloop bench local``: that it measures what it says; how fast things are is no matter of a test."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from skyloop.bench.local import TARGETS, spread
from skyloop.bench.rounds import CHANNELS, paced
from skyloop.cli.app import build

SHORTEST_S = 4


@pytest.fixture(autouse=True)
def sockets(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with tempfile.TemporaryDirectory(prefix="skyloop-") as folder:
        monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", str(Path(folder) / "run"))
        yield


@pytest.mark.process
def test_every_channel_is_measured_against_the_floor(tmp_path: Path) -> None:
    file = tmp_path / "delays.json"
    ended = CliRunner().invoke(build(["bench"]), ["bench", "local", "--seconds", str(SHORTEST_S), "--json", str(file)])
    assert ended.exit_code == 0, ended.output
    rows = json.loads(file.read_text())["rows"]
    assert [row["channel"] for row in rows] == [channel.name for channel in CHANNELS]
    for row, channel in zip(rows, CHANNELS, strict=True):
        expected = round(1.0 / channel.period_s)
        assert row["floor"]["samples"] == expected
        assert 0.7 * expected <= row["skyloop"]["samples"] <= 1.3 * expected
        assert 0 < row["floor"]["median_us"] <= row["floor"]["p99_us"] < 1e6
        assert 0 < row["skyloop"]["median_us"] <= row["skyloop"]["p99_us"] < 1e6
        assert row["ratio"] == pytest.approx(row["skyloop"]["median_us"] / row["floor"]["median_us"])
        assert row["target"] == TARGETS[channel.name]
        assert channel.name.split()[0] in ended.output


def test_deadlines_are_absolute() -> None:
    slept: list[float] = []
    assert list(paced(3, 10.0, slept.append)) == [0, 1, 2]
    assert slept == pytest.approx([10.0, 20.0, 30.0], abs=1.0)


def test_a_channel_without_samples_is_no_figure() -> None:
    with pytest.raises(ValueError, match="not one sample"):
        spread([])
