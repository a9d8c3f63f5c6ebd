"""``skyloop fly follow``: its messages before a flight, and a flight."""

from __future__ import annotations

import math
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

import skyloop
from skyloop.cli.app import build
from skyloop.cli.fly import SIDES
from skyloop.clock import nanoseconds
from skyloop.messages import Feedback
from tests.support.commands import Run
from tests.support.processes import Process


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "give --class CLASS, such as person, or --box X,Y,W,H"),
        (("--box", "1,2,3"), "must be X,Y,W,H"),
        (("--box", "1,2,x,4"), "must be X,Y,W,H"),
        (("--box", "1,2,nan,4"), "must consist of finite numbers"),
        (("--class", "person", "--mode", "folow"), "no mode named 'folow'; did you mean 'follow'?"),
        (("--class", "person", "--side", "behnd"), "no side named 'behnd'; did you mean 'behind'?"),
        (("--class", "person", "--distance", "1"), "must be above nearest_m, which is 2"),
        (("--class", "person", "--distance", "nan"), "must be a finite number"),
        (("--class", "person", "--detector", "none.onnx"), "there is no file none.onnx"),
    ],
)
def test_errors_are_reported_before_connecting(run: Run, words: tuple[str, ...], said: str) -> None:
    ended = run("fly", "follow", "--drone", "nobody", *words)
    assert ended.code == 2
    assert said in ended.err
    assert len(ended.err.splitlines()) == 1


def test_an_unknown_class_in_a_file_gets_suggestions(run: Run) -> None:
    pytest.importorskip("onnxruntime")
    from skyloop.vision.simulated import SIMULATED_WEIGHTS

    ended = run("fly", "follow", "nobody", "--class", "persn", "--detector", str(SIMULATED_WEIGHTS))
    assert ended.code == 2
    assert "named 'persn'; did you mean 'person'?" in ended.err


def test_a_file_named_follow_is_mentioned(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "follow").write_text("x = 1")
    assert "not the file of that name" in run("fly", "follow").err
    (tmp_path / "follow.py").write_text("x = 1")
    assert "follow.py has no controller" in run("fly", "follow.py").err


def test_the_word_decides_whose_options_they_are(run: Run) -> None:
    fly: Any = get_command(build(["fly"])).commands["fly"]  # type: ignore[attr-defined]
    assert fly.make_context("fly", ["follow", "--side", "left"]).params["side"] == "left"
    assert fly.make_context("fly", ["--drone", "follow", "mine.py"]).params["file"] == Path("mine.py")
    assert "skyloop fly follow [OPTIONS] [NAME]" in run("fly", "follow", "--help").out
    assert "skyloop fly follow --help" in " ".join(run("fly", "--help").out.split())


def test_sides_are_bearings_as_the_law_has_them() -> None:
    assert {"ahead": 0.0, "behind": math.pi, "left": math.pi / 2, "right": -math.pi / 2} == SIDES


@pytest.fixture(scope="module")
def delta(sockets: Path) -> Iterator[Process]:
    """A proxy of a simulated drone in the park."""
    process = Process("-m", "skyloop", "proxy", "sim://?world=park&cameras=front&fps=15&wind=0", "--name", "delta")
    try:
        process.until("ready")
        yield process
    finally:
        process.end()


@pytest.mark.process
def test_it_follows_a_person_and_lands(run: Run, delta: Process) -> None:
    for words, said in (
        (("--box", "900,10,50,50"), "at least half of it must be in the image"),
        (("--class", "persn"), "no class in Skyloop's detector named 'persn'; did you mean 'person'?"),
    ):
        assert said in run("fly", "follow", "delta", *words).err
    ended = run("fly", "follow", "delta", "--class", "person", "--seconds", "5")
    assert ended.code == 0, ended.err
    lines = ended.err.splitlines()
    assert lines[0] == "taking off with delta"
    assert lines[-1] == "landing"
    assert any("following" in line and "m away" in line and "confidence" in line for line in lines)
    with skyloop.connect("delta", access="observe") as drone:
        assert drone.feedback().state is skyloop.FlightState.LANDED


WALKER = """
[room]
size = [30, 20, 8]
floor = "grass"
enclosed = false

[[spawn]]
position = [-6, 0, 0]

[[target]]
name = "anna"
kind = "figure"
shape = "person"
path = { kind = "waypoints", points = [[0, -1.5, 0], [0, 1.5, 0]], speed = 0.6 }
"""


def away_m(feedback: Feedback) -> float:
    """Return the true distance from the drone to the person."""
    native = dict(feedback.native or {})
    return math.dist(*([float(native[f"truth.{one}{axis}"]) for axis in "xy"] for one in ("", "anna.")))  # type: ignore[arg-type]


@pytest.mark.process
@pytest.mark.flight
def test_a_running_processor_finds_the_target_to_follow(start: Callable[..., Process], tmp_path: Path) -> None:
    world = tmp_path / "walker.toml"
    world.write_text(WALKER)
    start("proxy", f"sim://?world={world}&cameras=front&fps=15&wind=0", "--name", "epsilon").until("ready")
    start("detect", "--on", "epsilon")
    with skyloop.connect("epsilon", access="observe") as drone:
        assert next(iter(drone.results("detections", timeout_s=20.0))).value["detections"]
        assert away_m(drone.feedback()) > 5.5
        flown = start("fly", "follow", "epsilon", "--class", "person", "--detector", "detections")
        flown.until("following")
        near = drone.wait(lambda feedback: abs(away_m(feedback) - 4.0) < 0.4, timeout_s=30.0)
        later_ns = near.captured_ns + nanoseconds(1.0)
        assert away_m(drone.wait(lambda feedback: feedback.captured_ns > later_ns)) == pytest.approx(4.0, abs=1.0)
        flown.signal(signal.SIGINT)
        assert flown.wait() == 0
        flown.until("landing")
        assert "lost" not in flown.text
        assert drone.feedback().state is skyloop.FlightState.LANDED


@pytest.mark.process
def test_a_class_on_a_vehicle_that_is_not_simulated_needs_a_detector(run: Run) -> None:
    from tests.support.recordings import recorded

    ended = run("fly", "follow", f"video://{recorded('ardrone2/video-8s.pave')}", "--class", "person")
    assert ended.code == 2
    assert "give --detector FILE.onnx, or the NAME of a running skyloop detect; or --box" in ended.err
