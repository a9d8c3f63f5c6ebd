"""``scripts/demo_follow.py``: its figures, and flights with real processes."""

from __future__ import annotations

import io
import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import demo_follow
import pytest
from follow_truth import FollowReport, FrameTruth, TargetTruth
from rich.console import Console

from skyloop.control.chase_law import LOSSES, TargetPhase
from skyloop.sim import load_world
from skyloop.sim.labels import TargetBox
from skyloop.stepping.rehearsal import rehearse
from tests.support.processes import Process

SECOND_NS = 1_000_000_000
SCRIPT = str(Path(__file__).parents[2] / "scripts" / "demo_follow.py")


def truth(**visible: float | None) -> FrameTruth:
    """Visible share of people by name; None: not in the image."""
    boxes = {
        name: TargetBox(name, "person", (100 * number, 50, 30, 80), share, False)
        for number, (name, share) in enumerate(visible.items())
        if share is not None
    }
    return FrameTruth(boxes, dict.fromkeys(visible, 4.5), dict.fromkeys(visible, 0.0), frozenset(boxes))


def test_what_counts() -> None:
    report = FollowReport("looks", 4.0, target="anna")
    report.count(truth(anna=1.0, bert=1.0), "anna", 0)
    report.count(truth(anna=1.0, bert=1.0), "bert", 2 * SECOND_NS)
    report.count(truth(anna=0.1, bert=1.0), None, 3 * SECOND_NS)  # hidden: does not count
    report.count(truth(anna=None, bert=1.0), None, 4 * SECOND_NS)
    report.count(truth(anna=1.0), "anna", 6 * SECOND_NS)
    assert (report.frames, report.in_view, report.found, report.others) == (4, 3, 2, 1)
    assert report.errors_m == [0.5]
    assert not report.good(0.9)
    assert "75.0%" in report.verdict(0.9)
    figures = report.figures()
    assert (figures["distance_median_m"], figures["distance_error_p95_m"]) == (4.5, 0.5)


def test_a_loss_counts_once_even_with_several_phases() -> None:
    report = FollowReport("looks", 4.0)
    for phase in (
        TargetPhase.LOOKING,
        TargetPhase.FOLLOWING,
        TargetPhase.PREDICTING,
        TargetPhase.HOVERING,
        TargetPhase.FOLLOWING,
        TargetPhase.PREDICTING,
    ):
        report.enter(phase, LOSSES)
    assert report.times_lost == 2


def test_the_table_shows_known_and_unknown_figures() -> None:
    def shown(report: FollowReport) -> str:
        text = io.StringIO()
        Console(file=text, width=160).print(report.table())
        return text.getvalue()

    assert "no one was found" in shown(FollowReport("detector", 4.0))
    report = FollowReport("detector", 4.0, target="anna", frames=10, in_view=10, found=9, errors_m=[0.1, -0.3, 0.1])
    for words in ("anna, by detector", "100.0% of 10 frames", "90.0%", "median 4.10 m, desired 4 m; off by 0.10 m"):
        assert words in shown(report)


def test_a_box_identifies_its_person() -> None:
    true = truth(anna=1.0, bert=0.5)
    assert true.shown_in((2.0, 50.0, 30.0, 80.0)) == "anna"
    assert true.shown_in((200.0, 50.0, 30.0, 80.0)) is None
    nearest = true.nearest_person()
    assert nearest is not None
    assert nearest.name == "anna", "bert is half hidden"


@pytest.mark.slow
@pytest.mark.parametrize("looks", [False, True])
def test_a_person_in_the_park_is_followed(looks: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    if not looks:
        pytest.importorskip("onnxruntime")
    demo: Any = demo_follow._Demo(Console(file=io.StringIO()), "demo", 20.0, "park", 1)
    report = FollowReport("", 4.0)
    with rehearse("sim://?world=park&seed=1&cameras=front&fps=15") as drone:
        drone.takeoff()
        demo._follow(
            drone, None if looks else demo_follow.packaged_detector(), TargetTruth(load_world("park", 1)), report
        )
    assert report.target == "walker"
    assert report.good(0.95)
    assert report.others == 0
    assert report.figures()["distance_error_p95_m"] < 0.8  # type: ignore[operator]


def test_without_scipy_or_onnx_runtime_there_is_no_detector(monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(demo_follow, "find_spec", lambda name: None)
        assert demo_follow.packaged_detector() is None
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    assert demo_follow.packaged_detector() is None


@pytest.mark.process
def test_errors_are_reported_before_take_off() -> None:
    for words, said in (
        (("--world", "empty"), "no one walks in the world 'empty'"),
        (("--world", "prak"), "did you mean 'park'"),
        (("--distance", "1"), "must be above nearest_m"),
    ):
        ended = subprocess.run(
            [sys.executable, SCRIPT, *words], capture_output=True, text=True, timeout=60, check=False
        )
        assert ended.returncode == 2
        assert said in ended.stderr


@pytest.mark.process
def test_ctrl_c_lands_and_prints_the_figures() -> None:
    process = Process(SCRIPT, "--headless", "--json")
    try:
        process.until("following at 4 m until Ctrl-C", 30.0)
        process.until("m away", 30.0)  # its first line of progress
        process.signal(signal.SIGINT)
        process.until('"collisions":', 30.0)
        assert process.wait() == 0, process.text
        figures = json.loads(process.text[process.text.index('{"way"') :])
        assert figures["target"] == "walker"
        assert figures["share_in_view"] >= 0.9
        assert "landing" in process.text
    finally:
        process.end()
