"""The examples, each run as its first lines say, on simulated drones."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest

import skyloop
from tests.support.processes import Process, eventually, sockets, start

__all__ = ["sockets", "start"]  # fixtures

pytestmark = pytest.mark.process
FOLDER = Path(__file__).parents[2] / "examples"
MOST_LINES = 60
Start = Callable[..., Process]


@pytest.fixture
def sim(start: Start) -> Callable[..., Process]:
    """Starts ``skyloop sim`` and waits until it serves."""

    def begin(*arguments: str) -> Process:
        process = start("-m", "skyloop", "sim", *arguments)
        process.until("ready")
        return process

    return begin


def example(start: Start, name: str, *arguments: str) -> Process:
    return start(str(FOLDER / f"{name}.py"), *arguments)


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.py")), ids=lambda path: path.name)
def test_an_example_is_short_and_says_how_to_run_it(path: Path) -> None:
    text = path.read_text()
    assert len(text.splitlines()) < MOST_LINES
    assert f"python examples/{path.name}" in text.split('"""')[1]
    assert '__name__ == "__main__"' in text


def numbers(pattern: str, process: Process) -> list[float]:
    """Return the numbers in the process's output that match, in order."""
    return [float(found) for found in re.findall(pattern, process.text)]


@pytest.mark.daily
def test_a_first_flight(start: Start) -> None:
    process = example(start, "first_flight")
    assert process.wait(60.0) == 0
    process.until("bright")
    heights = numbers(r"([\d.]+) m up", process)
    assert heights
    assert all(0.5 < height < 2.0 for height in heights)


def test_following_a_marker(start: Start) -> None:
    process = example(start, "follow_marker", "sim://?cameras=front&seed=4", "8")
    process.until("since it was found", 60.0)
    assert process.wait(30.0) == 0
    assert "searching → following" in process.text
    [share] = numbers(r"in view in (\d+)%", process)
    assert share > 50


def test_paths(start: Start) -> None:
    process = example(start, "fly_a_path")
    process.until("helix: ", 60.0)
    assert process.wait(30.0) == 0
    errors = numbers(r"off by ([\d.]+) m RMS", process)
    assert len(errors) == 3
    assert max(errors) < 0.2  # 0.133, 0.096 and 0.099; the same each time, because time is simulated


def test_a_recording_distinguishes_two_controllers(start: Start, tmp_path: Path) -> None:
    process = example(start, "replay_and_compare", str(tmp_path / "flights"), "4")
    process.until("skyloop log compare", 90.0)
    assert process.wait(30.0) == 0
    assert numbers(r"forward: ([\d.]+) m/s RMS", process) == [0.0]  # that part is the same in both
    [turning] = numbers(r"yaw_rate: ([\d.]+) rad/s RMS", process)
    assert turning > 0.01


def test_one_program_and_a_swarm(start: Start, sim: Start) -> None:
    sim("--drones", "3", "--name", "drone", "--world", "empty", "--option", "cameras=none")
    process = example(start, "swarm_formation", "drone*")
    process.until("set-points left within", 80.0)
    assert process.wait(60.0) == 0
    assert process.text.count("from the places") == 2
    closest = re.search(r"never closer than ([\d.]+) m", process.text)
    assert closest is not None
    assert float(closest[1]) > 0.4
    for name in ("drone1", "drone2", "drone3"):
        with skyloop.connect(name, access="observe") as drone:
            assert drone.wait("landed", 10.0).owner is None


def test_three_routes_at_once(start: Start, sim: Start) -> None:
    sim("--drones", "3", "--name", "drone", "--option", "cameras=none", "--speed", "3")
    process = example(start, "three_routes", "drone*")
    process.until("drone3: square", 90.0)
    assert process.wait(60.0) == 0
    assert len(re.findall(r"drone\d: square at [\d.]+ m done", process.text)) == 3
    assert process.text.count("error") == 0


def test_several_people_and_one_drone(start: Start, sim: Start) -> None:
    sim("--name", "alpha", "--world", "empty", "--option", "cameras=none")
    look = example(start, "shared_drone", "alpha", "look", "60")
    look.until("nobody flies")
    pilot = example(start, "shared_drone", "alpha", "pilot", "60")
    look.until("pilot flies")
    with skyloop.connect("alpha", access="observe") as drone:
        drone.wait("flying", 30.0)
        turn = example(start, "shared_drone", "alpha", "turn", "1")
        turn.until("my turn", 30.0)
        look.until("colleague flies")
        pilot.until("waiting for colleague")
        assert turn.wait(20.0) == 0
        pilot.until("flying again")
        eventually(lambda: drone.feedback().owner == "pilot", "the pilot has it again", 20.0)
        told = [event.text for event in drone.recent_events()]
        assert any("handed the authority over to colleague" in text for text in told)
