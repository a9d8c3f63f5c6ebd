"""The paper's test flight: one short flight by the command, and the evaluation of its recording."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

import skyloop
from benchmarks.measuring.contenders import OURS
from benchmarks.measuring.schedule import CHANNELS, COMMAND, FEEDBACK, VIDEO
from benchmarks.paper import evaluation, report
from benchmarks.paper.evaluation import RECORDER, Experiment, distances_to_round, evaluate, numbered
from benchmarks.paper.flight import PaperFlight
from benchmarks.paper.marks import CORNERS
from skyloop.control.waypoint import Fix, fix_of
from skyloop.errors import FileFormatError
from skyloop.transport.testing import wait_until
from tests.support.commands import Running

MINUTES = 0.1
PAPER = [sys.executable, "-m", "benchmarks.paper"]


def paper(*options: str) -> subprocess.CompletedProcess[str]:
    command = [*PAPER, *options]
    return subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory, sockets: None) -> Path:
    """The folder of one flight."""
    pytest.importorskip("matplotlib", reason="needs matplotlib: skyloop install bench")
    folder = tmp_path_factory.mktemp("paper") / "out"
    done = paper("--minutes", str(MINUTES), "--headless", "--seed", "3", "--output", str(folder))
    assert done.returncode == 0, done.stdout + done.stderr
    for words in ("spread", "taking off", "landing", "the paper's mean", "standard deviation", "report.html"):
        assert words in done.stdout
    assert "watch it at" not in done.stdout
    return folder


@pytest.mark.process
def test_everything_lies_in_the_folder(flown: Path) -> None:
    names = {file.name for file in flown.iterdir()}
    pictures = {f"{name}.png" for name in report.PICTURES}
    assert names == {"flight.mcap", "results.json", "report.html", *pictures}
    page = (flown / "report.html").read_text()
    for name in (*pictures, "Off the path", "1.038", "standard deviation"):
        assert name in page
    with_recording = paper("--output", str(flown))
    assert with_recording.returncode == 2
    assert "already holds a recording" in with_recording.stderr


@pytest.mark.process
def test_the_figures_are_of_the_recording_alone(flown: Path) -> None:
    results = evaluation.load(flown / "results.json")
    again = evaluate(flown / "flight.mcap", results.delays.machine, results.load)
    assert again == results


@pytest.mark.process
def test_delays_and_path_are_those_of_a_flight(flown: Path) -> None:
    results: Experiment = evaluation.load(flown / "results.json")
    assert "vehicle=ardrone" in results.vehicle
    assert 1.0 < results.seconds < 60.0 * MINUTES + 5.0
    assert results.delays.sizes == ["320×240"]
    for channel in CHANNELS:
        found = results.delays.summary(OURS.name, "320×240", channel)
        assert found is not None, channel
        assert 0.0 < found.minimum_us <= found.median_us <= found.maximum_us
        [series] = [one for one in results.delays.series if one.channel == channel]
        assert len(series.delay_us) == found.samples
        assert results.deviation_us[channel] == pytest.approx(np.std(series.delay_us))
    assert results.delays.summary(RECORDER, "320×240", FEEDBACK) is not None
    assert results.delays.summary(RECORDER, "320×240", VIDEO) is not None
    assert results.tracking is not None
    assert 0.0 < results.tracking.rms_m <= results.tracking.largest_m
    assert results.takeovers == 0
    assert len(results.way.x) == len(results.way.y) == len(results.way.at_s) > 10
    assert results.way.off_at_s == sorted(results.way.off_at_s)


@pytest.mark.process
def test_a_landed_drone_takes_off_again_and_ctrl_c_ends_normally(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="needs matplotlib: skyloop install bench")
    with Running("--minutes", "1", "--headless", "--output", str(tmp_path / "out"), command=PAPER) as demo:
        name = demo.until(r"is\s+up\s+as\s+(\S+)\s", 40)[1]
        demo.until("flying through", 40)
        with skyloop.connect(name, authority=skyloop.Authority(priority=2), name="page", on_exit="hover") as other:
            other.land()
        with skyloop.connect(name, access="observe") as onlooker:
            onlooker.wait(lambda feedback: feedback.owner == "paper" and feedback.state.airborne, timeout_s=20.0)
            seen: list[str] = []
            with onlooker.on_log(lambda entry: seen.append(entry.name)):
                wait_until(lambda: "paper.target" in seen, "it was on its way again")
        demo.process.send_signal(signal.SIGINT)
        demo.until("(?s)landing.*report", 60)
        assert demo.process.wait(20) == 0, demo.text
    results = evaluation.load(tmp_path / "out" / "results.json")
    assert results.takeovers >= 1
    assert results.seconds < 60.0


@pytest.mark.process
def test_another_recording_is_refused(tmp_path: Path) -> None:
    with skyloop.connect("sim://?cameras=none") as drone, skyloop.record(drone, tmp_path / "a.mcap"):
        drone.next_feedback()
    with pytest.raises(FileFormatError, match="not a recording of the paper's experiment"):
        evaluate(tmp_path / "a.mcap")


def test_distance_to_the_round() -> None:
    places = np.array([*CORNERS, (0.0, 1.0, 1.2), (0.0, 1.3, 1.2), (1.5, 1.0, 1.0)])
    assert distances_to_round(places) == pytest.approx([0, 0, 0, 0, 0, 0.3, 0.5], abs=0.03)


def test_lost_samples_are_counted_by_their_numbers() -> None:
    assert numbered([4, 5, 7], FEEDBACK) == 4
    assert numbered([4, 5, 9], COMMAND) == 3, "what only keeps the connection alive has numbers too"


@pytest.mark.process
def test_it_pauses_while_another_application_flies_and_resumes_afterwards() -> None:
    with skyloop.connect("sim://?vehicle=ardrone&position=1&cameras=none&speed=2") as drone:

        def where() -> Fix | None:
            return fix_of(drone.feedback())

        targets: list[float] = []
        drone.on_log(lambda entry: targets.append(entry.at_ns) if entry.name == "paper.target" else None)
        drone.takeoff()
        flight = PaperFlight(drone, where, 60.0)
        runner = threading.Thread(target=flight.run)
        runner.start()
        try:
            wait_until(lambda: targets, "it was on its way")
            with skyloop.connect(
                drone.name, authority=skyloop.Authority(priority=2), name="page", on_exit="hover"
            ) as other:
                wait_until(lambda: flight.away, "it let go")
                assert flight.off_m is None
                told = len(targets)
                other.velocity(up=0.3)
                seq = flight.drone.feedback().seq
                wait_until(lambda: flight.drone.feedback().seq > seq + 10, "time went on")
                assert len(targets) <= told + 1, "nothing is logged of where it should be"
            wait_until(lambda: not flight.away, "it is back")
            wait_until(lambda: len(targets) > told + 1, "it goes on")
        finally:
            flight.stop()
            runner.join()
        assert flight.takeovers == 1
