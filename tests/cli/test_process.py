"""``skyloop process``."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import pytest

import skyloop
from skyloop.processing import Status
from tests.support.commands import Run
from tests.support.processes import Process

pytestmark = pytest.mark.process

GOOD = "class Detector:\n    def process(self, frame):\n        return {'mean': float(frame.mean())}\n"


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "detector.py"
    path.write_text(GOOD)
    return path


@pytest.fixture(scope="module")
def bravo(sockets: Path) -> Iterator[str]:
    """A proxy of a drone with a camera."""
    process = Process("-m", "skyloop", "proxy", "sim://?world=empty&cameras=front&fps=30", "--name", "bravo")
    try:
        process.until("ready")
        yield "bravo"
    finally:
        process.end()


def test_the_help_shows_how(run: Run) -> None:
    ended = run("process", "--help")
    assert ended.code == 0
    assert "Example: skyloop process detector.py --drone alpha" in ended.out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("nowhere.py", "--drone", "bravo"), "there is no file nowhere.py"),
        (("detector", "--drone", "bravo"), "is not a processor"),
        (("{file}", "--drone", "brvo"), "did you mean 'bravo'"),
        (("{file}", "--drone", "bravo", "--camera", "frnt"), "no camera named 'frnt'"),
        (("{file}", "--drone", "bravo", "--name", "a b"), "the name of a processor must have 1 to 64 letters"),
        (("{file}", "--drone", "sim://", "--workers", "2"), "several workers need one proxy"),
    ],
)
def test_impossible_arguments_are_reported(
    run: Run, file: Path, bravo: str, arguments: tuple[str, ...], words: str
) -> None:
    ended = run("process", *(one.format(file=file) for one in arguments))
    assert ended.code == 2
    assert words in ended.err
    assert "Traceback" not in ended.err


def test_a_drone_without_a_camera(run: Run, file: Path, alpha: Process) -> None:
    ended = run("process", str(file), "--drone", "alpha")
    assert ended.code == 1
    assert "this vehicle has no camera" in ended.err


@pytest.mark.daily
def test_one_worker_in_this_process(run: Run, file: Path, bravo: str) -> None:
    ended = run("process", str(file), "--drone", bravo, "--seconds", "2.3")
    assert ended.code == 0
    lines = ended.out.splitlines()
    assert len(lines) == 2
    assert "detector front  part 1 of 1" in lines[1]


def test_several_workers_and_the_end_by_ctrl_c(start: Callable[..., Process], file: Path, bravo: str) -> None:
    leader = start(
        "process", str(file), "--drone", bravo, "--workers", "2", "--name", "pair", "--max-age", "5", "--json"
    )
    with skyloop.connect(bravo, access="observe") as drone:
        workers: set[int] = set()
        for result in drone.results("pair", timeout_s=20.0):
            assert set(result.value) == {"mean"}
            workers.add(result.worker)
            if len(workers) == 2:
                break
        leader.until('"parts":2')
        leader.signal(signal.SIGINT)
        assert leader.wait() == 0
        left = drone.wait(lambda _: states(drone).count("left") == 2, 5.0)
        assert left.owner is None
    line = next(one for one in leader.text.splitlines() if '"parts":2' in one)
    assert msgspec.json.decode(line, type=Status).processor == "pair"


def states(drone: skyloop.Drone) -> list[str]:
    return [str(event.data["state"]) for event in drone.recent_events() if event.kind == "processor"]


def test_other_code_under_the_same_name(start: Callable[..., Process], run: Run, file: Path, bravo: str) -> None:
    first = start("process", str(file), "--drone", bravo, "--name", "mine")
    first.until("mine front")
    other = file.with_name("other.py")
    other.write_text(GOOD + "# changed\n")
    ended = run("process", str(other), "--drone", bravo, "--name", "mine")
    assert ended.code == 2
    assert "runs other code under the name mine" in ended.err
    several = start("process", str(other), "--drone", bravo, "--name", "mine", "--workers", "2")
    several.until("runs other code under the name mine")
    assert several.wait(20.0) == 2
    first.signal(signal.SIGTERM)
    assert first.wait() == 0
