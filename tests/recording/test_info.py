"""``skyloop log info``: the content of a recording."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from rich.console import Console

from skyloop.cli.log import info_parts
from skyloop.recording.reader import Recording
from skyloop.recording.review.summary import summarise
from tests.support.commands import Ended
from tests.support.recorded_flights import Plan, write_flight

Log = Callable[..., Ended]


def test_counts_rates_gaps_and_delays(flight: Path) -> None:
    summary = summarise(Recording.open(flight))
    rows = {row.topic: row for row in summary.rows}
    feedback = rows["/alpha/feedback"]
    assert feedback.count == 96
    assert feedback.rate_hz == pytest.approx(95 / 1.98, rel=0.01)
    assert feedback.missing == 4  # by sequence numbers
    assert feedback.gaps == 1
    assert feedback.longest_s == pytest.approx(0.1)
    delays = {delay.what: delay for delay in feedback.delays}
    assert delays["capture to proxy"].median_s == pytest.approx(0.004)
    assert delays["proxy to recorder"].median_s == pytest.approx(0.0002)
    frames = rows["/alpha/frames/front"]
    assert {delay.what: round(delay.p99_s, 4) for delay in frames.delays} == {
        "capture to proxy": 0.03,
        "proxy to recorder": 0.001,
    }
    commands = rows["/alpha/commands"]
    assert [(delay.what, delay.median_s) for delay in commands.delays] == [("sent to vehicle", 0.0005)]
    assert rows["/alpha/parameters"].gaps == 0
    assert summary.events == {"info": 5, "warning": 2}
    assert summary.notes == ()


def test_the_last_reported_drops_count(tmp_path: Path, flight: Path) -> None:
    told = summarise(Recording.open(write_flight(tmp_path / "open.mcap", Plan(closed=False))))
    assert told.dropped == {"alpha": {"video.front": 2}}
    assert told.missed == {"alpha": {"feedback": 4}}
    assert any("never closed" in note for note in told.notes)
    assert summarise(Recording.open(flight)).dropped == {}  # the recorder's final report


@pytest.mark.process
def test_nothing_is_cut_in_a_pipe(tmp_path: Path) -> None:
    name = "alpha-of-the-long-name-" * 3
    flight = write_flight(tmp_path / "flight.mcap", Plan(drone=name))
    command = [sys.executable, "-m", "skyloop", "log", "info", str(flight)]
    environment = {key: value for key, value in os.environ.items() if key != "COLUMNS"}
    shown = subprocess.run(command, capture_output=True, text=True, check=True, env=environment).stdout
    for topic in {one.topic for one in Recording.open(flight).series}:
        assert sum(topic in line.split() for line in shown.splitlines()) == 1, (
            "each row in one line, with its whole topic"
        )


def test_a_narrow_terminal_folds_the_distinguishing_columns(flight: Path) -> None:
    recording = Recording.open(flight)
    screen = Console(width=60, file=io.StringIO())
    for part in info_parts(recording, summarise(recording)):
        screen.print(part)
    assert isinstance(screen.file, io.StringIO)
    first = "".join(line[:20].strip() for line in screen.file.getvalue().splitlines())
    assert "…" not in first


def test_the_table(log: Log, flight: Path) -> None:
    ended = log("info", flight)
    assert ended.code == 0
    lines = ended.out.splitlines()
    row = next(line for line in lines if "/alpha/feedback" in line).split()
    assert row[:7] == ["/alpha/feedback", "96", "48", "Hz", "1", "0.1", "s"]
    assert "4.00 (4.00) capture to proxy" in ended.out
    assert any("alpha: sim, sim://; cameras: front 64×48" in line for line in lines)
    assert "5 info, 2 warning" in ended.out


def test_losses_and_problems_are_reported(log: Log, tmp_path: Path) -> None:
    path = write_flight(tmp_path / "open.mcap", Plan(closed=False))
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 3 // 4])
    ended = log("info", path)
    assert ended.code == 0
    assert "cut off: it ends within a record" in ended.out
    assert "skyloop log recover repairs it" in ended.out
    assert "alpha: 2 of video.front left out by the recorder" in ended.out


def test_for_programs(log: Log, flight: Path) -> None:
    found = json.loads(log("info", flight, "--json").out)
    assert found["drones"][0]["name"] == "alpha"
    rows = {row["topic"]: row for row in found["summary"]["rows"]}
    assert rows["/alpha/commands"]["count"] == 40


@pytest.mark.parametrize("command", ["info", "report", "export", "recover"])
def test_an_invalid_file_gives_one_clear_line(log: Log, tmp_path: Path, command: str) -> None:
    assert log(command, tmp_path / "none.mcap") == (
        2,
        "",
        f"skyloop: {tmp_path}/none.mcap: No such file or directory\n",
    )
    path = tmp_path / "video.mcap"
    path.write_bytes(b"RIFF....AVI ")
    ended = log(command, path)
    assert (ended.code, ended.out) == (2, "")
    assert "is not an MCAP file: it begins with b'RIFF....'" in ended.err


@pytest.mark.parametrize("command", ["info", "report", "export", "compare", "recover"])
def test_every_command_has_an_example(log: Log, command: str) -> None:
    ended = log(command, "--help")
    assert ended.code == 0
    assert f"Example: skyloop log {command} " in ended.out


def test_a_missing_extra_is_named(flight: Path) -> None:
    code = "import sys; sys.modules['mcap'] = None; from skyloop.cli import main; main(sys.argv[1:])"
    for words in (["log", "info", str(flight)], ["proxy", f"replay://{flight}"]):
        done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, timeout=30)
        assert done.returncode == 1
        assert "skyloop install record" in done.stderr
