"""The demo: its figures, and the whole of it with real processes."""

from __future__ import annotations

import io
import json
import signal
import subprocess
import urllib.request

import pytest
from rich.console import Console

from skyloop.cli.demo import DemoReport, Spread, true_range
from skyloop.client import ChannelStats, Distribution
from tests.support.commands import DEMO, Running


def shown(report: DemoReport) -> str:
    text = io.StringIO()
    Console(file=text, width=160).print(report.table())
    return text.getvalue()


def test_spread() -> None:
    spread = Spread.of([0.3, -0.4])
    assert spread is not None
    assert spread.rms == pytest.approx(0.3536, abs=1e-4)
    assert spread.mean == pytest.approx(-0.05)
    assert spread.worst == pytest.approx(0.4)
    assert Spread.of([]) is None


@pytest.mark.parametrize(
    ("share", "good", "word"), [(None, False, "never seen"), (0.95, True, ""), (0.9, True, ""), (0.62, False, "62.0%")]
)
def test_verdict(share: float | None, good: bool, word: str) -> None:
    report = DemoReport(share_in_view=share)
    assert report.good(0.9) is good
    if not good:
        assert word in report.verdict(0.9)


def test_the_table_shows_known_and_unknown_figures() -> None:
    delay = Distribution(0.0002, 0.0011, 0.002, 0.0003, 500)
    report = DemoReport(
        first_picture_s=1.23,
        frames=400,
        share_in_view=0.975,
        estimated=Spread(0.1, 0.05, 0.3, 390),
        channels={
            "command": ChannelStats(count=640, delay_s=delay),
            "video/front": ChannelStats(count=450, lost=2, dropped=3, delay_s=delay),
            "video/bottom": ChannelStats(),
        },
        page={"frames_sent": 440, "frames_skipped": 7},
    )
    text = shown(report)
    for word in (
        "97.5% of 400 frames",
        "RMS 0.100 m",
        "1.2 s",
        "640 sent",
        "2 lost, 3 dropped",
        "0.20 ms, p99 1.10 ms",
    ):
        assert word in text
    assert "440 frames sent, 7 skipped" in text
    assert "unknown" in text, "there was no ground truth"
    assert "bottom" not in text
    assert "never seen" in shown(DemoReport())


def test_true_range() -> None:
    assert true_range(None) is None
    assert true_range({"truth.x": 3.0}) is None
    own = {"truth.x": 1.0, "truth.y": 2.0, "truth.z": 3.0}
    board = {"truth.target.x": 4.0, "truth.target.y": 6.0, "truth.target.z": 3}
    assert true_range({**own, **board, "sim.time_s": 1.0}) == pytest.approx(5.0)


def run(*options: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*DEMO, *options], capture_output=True, text=True, timeout=60, check=False)


@pytest.mark.daily
@pytest.mark.process
def test_headless_flight_is_good() -> None:
    done = run("--headless", "--seconds", "2.5", "--seed", "7", "--json")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "looking for marker 7" in done.stderr
    assert "watch it at" not in done.stderr
    figures = json.loads(done.stdout)
    assert figures["share_in_view"] >= 0.9
    assert figures["first_picture_s"] < 30.0
    assert figures["channels"]["command"]["count"] > 0


@pytest.mark.process
def test_headless_flight_without_a_marker_fails() -> None:
    done = run("--headless", "--seconds", "0.3", "--world", "empty")
    assert done.returncode == 1, done.stdout + done.stderr
    assert "never seen" in done.stdout


@pytest.mark.process
def test_ctrl_c_lands_reports_and_leaves_nothing_running() -> None:
    with Running("--seed", "7") as demo:
        page = demo.until(r"watch it at (http://127\.0\.0\.1:\d+/)", 30)[1]
        with urllib.request.urlopen(page, timeout=5) as answer:
            assert b"Skyloop" in answer.read()
        demo.until("looking for marker 7", 30)
        demo.process.send_signal(signal.SIGINT)
        demo.until("(?s)landing.*marker in view since first seen", 30)
        assert demo.process.wait(20) == 0
        with pytest.raises(OSError, match="refused"):
            urllib.request.urlopen(page, timeout=2)
