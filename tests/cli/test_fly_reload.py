"""Editing a controller's file while it flies."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import skyloop
from skyloop.cli.fly import ControllerFlight
from skyloop.client import Drone
from skyloop.control import Controller
from skyloop.messages import Applied, Feedback, FlightState, Hover, Velocity
from tests.support.commands import Run
from tests.support.processes import Process
from tests.support.scripted_proxy import WAIT_S, background, flown, scripted

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
    """Save like an editor: the new file replaces the old one."""
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
    """Return the pilot's requests in order: the speed to the left, or the name of another action."""
    wanted = [one.asked for one in list(seen)]
    return [action.left if isinstance(action, Velocity) else type(action).__name__ for action in wanted]


class Loaded:
    """A stand-in for a reloader: the loaded classes, in turn."""

    age_s = 0.0

    def __init__(self) -> None:
        self.found: list[type[Controller]] = []

    @property
    def waiting(self) -> bool:
        return bool(self.found)

    def take(self) -> type[Controller]:
        return self.found.pop(0)


class Listening(Controller):
    """Sends commands from a callback it registered itself."""

    speed = 0.1

    def __init__(self, drone: Drone) -> None:
        super().__init__(drone)
        drone.on_feedback(lambda _: drone.velocity(forward=self.speed))


class Second(Listening):
    speed = 0.2


class Broken(Listening):
    speed = 0.3

    def on_reload(self, before: Controller) -> None:
        raise RuntimeError("not ready")


class Failing(Listening):
    speed = 0.4

    def on_feedback(self, feedback: Feedback) -> None:
        raise RuntimeError("in on_feedback")


def test_the_callbacks_of_a_controller_that_was_replaced_or_failed_command_no_more() -> None:
    with scripted() as proxy, flown(proxy) as drone:
        proxy.state = FlightState.FLYING
        drone.wait("flying", WAIT_S)
        loaded, said = Loaded(), list[str]()
        flight = ControllerFlight(drone, Listening(drone), said.append)
        flying = background(lambda: flight.run_reloading(None, loaded, lambda found: found(drone)))  # type: ignore[arg-type]

        def load(found: type[Controller], told: str, speed: float | None) -> None:
            """Check that after the reported change, this many commands all have this speed."""
            loaded.found.append(found)
            proxy.until(lambda: any(told in line for line in said), told)
            count = len(proxy.commands)
            action = Hover() if speed is None else Velocity(speed)
            proxy.until(lambda: proxy.actions()[count:].count(action) > 12, f"{action} is repeated")
            after = proxy.actions()[count:]
            assert set(after[after.index(action) :]) == {action}

        load(Second, "reloaded Second", 0.2)
        load(Broken, "the previous one keeps flying", 0.2)
        load(Failing, "the controller failed: hovering", None)
        load(Listening, "reloaded Listening", 0.1)
        drone.close()
        flying.join(WAIT_S)


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
        process.until("the previous one keeps flying")
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
def test_an_error_in_on_authority_is_reported_and_the_drone_left_to_its_new_pilot(
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
