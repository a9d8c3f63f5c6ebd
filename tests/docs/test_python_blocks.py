"""Every Python example on the pages runs unchanged, except for shorter flights."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import skyloop
from skyloop.control.controller import Controller, RunSummary
from skyloop.messages import Feedback
from tests.support.pages import Block, blocks
from tests.support.recordings import recorded

LONGEST_RUN_S = 10.0  # of a controller, regardless of the example
BLOCKS = blocks("python")
FIRST = next(block for block in BLOCKS if block.page.name == "README.md")
Flight = tuple[RunSummary, Feedback]

#: What an example must have printed.
PRINTS = {"pictures, in order": "pictures, in order: True", "lost in {": "lost in 0 of 20 frames"}
#: Recordings of real vehicles that replace the reader's own files.
FILES = {"flight.pave": "ardrone2/video-8s.pave"}


@pytest.fixture
def flights(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[Flight]:
    """Shortens the runs of controllers, and keeps how each went and where it ended."""
    monkeypatch.chdir(tmp_path)  # some write files
    done: list[Flight] = []
    run = Controller.run

    def short(self: Controller, seconds: float | None = None, until: Callable[[], bool] | None = None) -> RunSummary:
        summary = run(self, min(seconds or LONGEST_RUN_S, LONGEST_RUN_S), until)
        done.append((summary, self.drone.feedback()))
        return summary

    monkeypatch.setattr(Controller, "run", short)
    return done


def execute(block: Block) -> None:
    code = block.code
    for name, recording in FILES.items():
        if name in code:
            code = code.replace(name, str(recorded(recording)))
    names: dict[str, Any] = {"__name__": "__main__"}
    exec(compile("\n" * (block.line - 1) + code, str(block.page), "exec", dont_inherit=True), names)


@pytest.mark.process
@pytest.mark.parametrize("block", [block for block in BLOCKS if block is not FIRST], ids=str)
def test_an_example_runs(block: Block, alpha: str, flights: list[Flight], capsys: pytest.CaptureFixture[str]) -> None:
    if block.skipped:
        pytest.skip(block.skipped)
    execute(block)
    printed = capsys.readouterr().out
    assert all(text in printed for words, text in PRINTS.items() if words in block.code)
    with skyloop.connect(alpha, access="observe") as drone:
        assert drone.wait("landed", timeout_s=15.0).owner is None  # left as it was found


@pytest.mark.process
def test_the_first_controller_follows_its_marker(flights: list[Flight], capsys: pytest.CaptureFixture[str]) -> None:
    for words in (
        "(skyloop.Controller)",
        "def on_frame(self, frame)",
        "self.drone.velocity(",
        'skyloop.connect("sim://")',
        "drone.takeoff()",
        ".run(seconds=30)",
        "drone.land()",
    ):
        assert words in FIRST.code
    execute(FIRST)
    [(summary, end)] = flights
    assert summary.reason == "time"
    assert f"{summary.frames} frames" in capsys.readouterr().out
    ahead, aside = marker_from(end)
    assert abs(math.atan2(aside, ahead)) < 0.4  # faces it: the picture is 1.2 rad wide
    assert math.hypot(ahead, aside) == pytest.approx(1.5, abs=0.7)


def marker_from(state: Feedback) -> tuple[float, float]:
    """Where the carried board truly is, seen from the drone: forward and left [m]."""
    native = state.native
    assert native is not None
    x, y = (float(native[f"truth.target.{axis}"]) - float(native[f"truth.{axis}"]) for axis in "xy")  # type: ignore[arg-type]
    yaw = float(native["truth.yaw"])  # type: ignore[arg-type]
    return x * math.cos(yaw) + y * math.sin(yaw), y * math.cos(yaw) - x * math.sin(yaw)
