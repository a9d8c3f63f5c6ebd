"""Editing a controller's file while it flies."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import skyloop
from skyloop.messages import Applied, Velocity
from tests.cli.conftest import Run
from tests.processes.conftest import Process

MINE = """
import skyloop

class Mine(skyloop.Controller):
    SPEED = 0.1
    calls = 0

    def on_reload(self, before):
        self.calls = before.calls

    def on_feedback(self, feedback):
        self.calls += 1
        self.drone.velocity(left=self.SPEED)
"""
FRAMES = """
import skyloop

class Mine(skyloop.Controller):
    def on_frame(self, frame):
        raise RuntimeError("in on_frame")
"""
AUTHORITY = """
import skyloop

class Mine(skyloop.Controller):
    def on_feedback(self, feedback):
        self.drone.velocity(left=0.1)

    def on_authority(self, status):
        raise RuntimeError("in on_authority")
"""


def save(path: Path, text: str) -> None:
    """As editors do: the new file takes the place of the old one."""
    new = path.with_suffix(".new")
    new.write_text(text)
    new.replace(path)


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    path = tmp_path / "mine.py"
    path.write_text(MINE)
    return path


@pytest.fixture
def looker(alpha: Process) -> Iterator[skyloop.Drone]:
    with skyloop.connect("alpha", access="observe") as drone:
        yield drone


def speeds(seen: list[Applied]) -> list[float | str]:
    """What the pilot wanted, in order: the speed to the left, or the name of another action."""
    wanted = [one.asked for one in list(seen)]
    return [action.left if isinstance(action, Velocity) else type(action).__name__ for action in wanted]


@pytest.mark.process
def test_a_saved_file_takes_over_without_a_command_being_missed(
    start: Callable[..., Process], looker: skyloop.Drone, mine: Path
) -> None:
    seen: list[Applied] = []
    with looker.on_command(seen.append, inline=True):
        process = start("fly", str(mine), "--drone", "alpha", "--reload")
        looker.wait(lambda _: 0.1 in speeds(seen), 20.0)
        save(mine, MINE.replace("0.1", "0.2"))
        process.until("reloaded Mine")
        looker.wait(lambda _: 0.2 in speeds(seen), 20.0)
        save(mine, "def (")
        process.until("the one before keeps flying")
        now = len(seen)
        looker.wait(lambda _: len(seen) > now + 10, 20.0)
        process.signal(signal.SIGINT)
        assert process.wait() == 0
    wanted = speeds(seen)
    flown = wanted[wanted.index(0.1) : len(wanted) - wanted[::-1].index(0.2)]
    assert flown == sorted(flown, key=str), "first the old one, then the new one, and nothing between or after"
    assert set(flown) == {0.1, 0.2}
    assert "line 1: invalid syntax" in process.text


@pytest.mark.process
def test_an_error_hovers_until_the_file_is_mended(
    start: Callable[..., Process], looker: skyloop.Drone, mine: Path
) -> None:
    process = start("fly", str(mine), "--drone", "alpha", "--reload")
    looker.wait("flying", timeout_s=30.0)
    save(mine, MINE.replace("self.drone.velocity(left=self.SPEED)", "raise RuntimeError('in on_feedback')"))
    process.until("the controller failed: hovering; save the file to continue")
    assert "RuntimeError: in on_feedback" in process.text
    looker.wait("hovering", timeout_s=30.0)
    save(mine, MINE.replace("before.calls", "before.nothing"))
    process.until("no attribute 'nothing'")
    assert looker.feedback().state == "hovering"
    save(mine, MINE)
    looker.wait("flying", timeout_s=30.0)
    process.signal(signal.SIGINT)
    assert process.wait() == 0
    looker.wait("landed", timeout_s=30.0)


@pytest.mark.process
def test_an_error_in_on_frame_hovers_too(start: Callable[..., Process], tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    path.write_text(FRAMES)
    process = start("fly", str(path), "--drone", "sim://?world=empty&speed=4&wind=0", "--reload", "--seconds", "8")
    process.until("RuntimeError: in on_frame")
    process.until("hovering; save the file to continue")
    process.until("landing")
    assert process.wait() == 1, "the time was over before it was mended"


@pytest.mark.process
def test_an_error_in_on_authority_is_told_and_the_drone_left_to_who_took_over(
    start: Callable[..., Process], looker: skyloop.Drone, tmp_path: Path
) -> None:
    path = tmp_path / "mine.py"
    path.write_text(AUTHORITY)
    process = start("fly", str(path), "--drone", "alpha", "--reload")
    looker.wait("flying", timeout_s=30.0)
    with skyloop.connect("alpha", authority=skyloop.Authority(priority=1), name="other") as other:
        process.until("RuntimeError: in on_authority")
        other.land()
    process.signal(signal.SIGINT)
    assert process.wait() == 0


@pytest.mark.process
def test_without_an_error_it_ends_after_its_time(run: Run, alpha: Process, mine: Path) -> None:
    ended = run("fly", str(mine), "--drone", "alpha", "--seconds", "0.3", "--reload")
    assert ended.code == 0, ended.err
    assert "until time" in ended.err
