"""Short runs of what measures delays, with real processes; how fast things are is no matter of a test."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import pytest
from typer.testing import CliRunner

from benchmarks.command import build
from benchmarks.measuring import delays, loop
from benchmarks.measuring.loop import STAGES, TOTAL, Trip
from benchmarks.measuring.schedule import CHANNELS, LARGE, SMALL, Turn
from benchmarks.measuring.workers import Workers
from skyloop.bench import Machine
from skyloop.errors import LinkError, NoAnswerError
from tests.benchmarks import working
from tests.benchmarks.working import plausible

SHORT_S = 0.5
pytestmark = pytest.mark.process


def test_the_command_measures_prints_and_writes(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    ended = CliRunner().invoke(
        build("peers"), ["--peers", "none", "--seconds", str(SHORT_S), "--output", str(tmp_path)]
    )
    assert ended.exit_code == 0, ended.output
    for words in ("Table 1", "the paper's mean", "0.091", "Skyloop", "bare hand-over", "median to the floor's"):
        assert words in ended.output, words
    assert {file.suffix for file in tmp_path.iterdir()} == {".json", ".png", ".svg"}
    results = delays.load(tmp_path / "delays.json")
    assert json.loads((tmp_path / "delays.json").read_bytes())["what"] == "delays"
    assert (results.sizes, list(results.contenders)) == ([str(SMALL)], ["floor", "skyloop"])
    assert msgspec.structs.replace(Machine.here(), load=results.machine.load) == results.machine
    turn = Turn(0, SHORT_S)
    for name in results.contenders:
        for channel in CHANNELS:
            summary = results.summary(name, str(SMALL), channel)
            assert summary is not None
            plausible(summary, turn.count(channel))
    for series in results.series:
        assert len(series.at_s) == len(series.delay_us) >= 0.3 * turn.count(series.channel)
        assert series.at_s == sorted(series.at_s)
        assert 0.0 <= series.at_s[0] <= series.at_s[-1] <= SHORT_S + 0.1


def test_the_loop_by_stage() -> None:
    results = loop.measure(SHORT_S, [SMALL, LARGE])
    assert [one.size for one in results.sizes] == [str(SMALL), str(LARGE)]
    for one in results.sizes:
        assert list(one.stages) == [*STAGES, TOTAL]
        for summary in one.stages.values():
            plausible(summary, Turn(0, SHORT_S, frame_period_s=loop.FRAME_PERIOD_S).count("video"))
        parts = sum(one.stages[stage].mean_us for stage in STAGES)
        assert one.stages[TOTAL].mean_us == pytest.approx(parts)


def test_the_stages_of_a_trip() -> None:
    stages = Trip(1000, 1010, 1110, 1200, 1240, 1300).stages_ns()
    assert stages == {"published": 10, "delivered": 100, "controller": 90, "sent": 40, "applied": 60, "total": 300}


def test_a_worker_that_fails_or_is_silent_is_told(capfd: pytest.CaptureFixture[str]) -> None:
    with Workers() as workers:
        with pytest.raises(LinkError, match="fails"):
            workers.start(working.fails).answer(20.0)
        with pytest.raises(NoAnswerError, match="is_silent"):
            workers.start(working.is_silent).answer(0.2)
        echo = workers.start(working.echo, 3)
        assert echo.answer(20.0) == 3
        addresses = "127.0.0.1 " * 100
        talkative = workers.start(working.echo, addresses)
        assert talkative.answer(20.0) == addresses
        with pytest.raises(NoAnswerError) as caught:
            talkative.answer(0.0)
        assert len(str(caught.value)) < 150, "no list of all addresses"
    assert "RuntimeError: on purpose" in capfd.readouterr().err
