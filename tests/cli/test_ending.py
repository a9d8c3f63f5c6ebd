"""``skyloop land``, ``return`` and ``stop``, with real proxies: of your own drone, of others', and of all."""

from __future__ import annotations

import json
import math
from collections.abc import Callable

import pytest

import skyloop
from tests.support.commands import FAST_SIM, Run
from tests.support.processes import Process, eventually

pytestmark = [pytest.mark.process, pytest.mark.daily]


@pytest.fixture
def swarm(start: Callable[..., Process]) -> Process:
    """Two drones, b1 and b2."""
    options = [f"--option={word}" for word in ("cameras=none", "wind=0")]
    process = start("sim", "--drones", "2", "--name", "b", "--world", "empty", "--speed", "6", *options)
    process.until("ready")
    process.until("b2")
    return process


def state(name: str) -> str:
    with skyloop.connect(name, access="observe") as drone:
        return drone.feedback().state.value


@pytest.mark.usefixtures("alpha")
def test_a_drone_on_the_ground_has_landed_already(run: Run) -> None:
    assert run("land", "alpha") == (0, "alpha: landed already\n", "")
    ended = run("land", "--drone", "nobody")
    assert ended.code == 1
    assert ended.err.startswith("nobody: NOT landed: no proxy named 'nobody'")
    ended = run("land", "alpha", "nobody", "--json")
    assert (ended.code, ended.err) == (1, "")
    first, second = json.loads(ended.out)
    assert first == {"name": "alpha", "ok": True, "outcome": "landed already"}
    assert (second["name"], second["ok"]) == ("nobody", False)
    assert second["outcome"].startswith("NOT landed: no proxy named 'nobody'")


@pytest.mark.usefixtures("alpha")
def test_another_pilots_drone_is_not_touched_unless_the_priority_is_higher(run: Run) -> None:
    with skyloop.connect("alpha", name="the pilot", on_exit="hover") as drone:
        drone.takeoff()
        ended = run("land", "alpha")
        assert ended.code == 1
        assert "alpha: NOT landed: the pilot holds the authority over alpha: take over with --priority 0" in ended.err
        assert drone.feedback().state.airborne
        assert run("land", "alpha", "--priority", "0") == (0, "alpha: landed\n", "")
        assert not drone.feedback().state.airborne


@pytest.mark.usefixtures("alpha")
def test_a_drone_returns_to_its_start(run: Run) -> None:
    assert run("return", "alpha") == (0, "alpha: landed already\n", "")
    with skyloop.connect("alpha", name="the pilot", on_exit="hover") as drone:
        drone.takeoff()
        drone.go_to(x=1.5, y=0.0, z=1.0)
        ended = run("return", "alpha")
        assert (ended.code, "NOT returned: the pilot holds the authority over alpha" in ended.err) == (1, True)
        start, there = drone.start_position, drone.feedback().position_m
        assert start is not None
        assert there is not None
        assert math.dist(start[:2], there[:2]) > 1.0
        assert run("return", "alpha", "--height", "1.5", "--priority", "0") == (0, "alpha: landed at its start\n", "")
        there = drone.feedback().position_m
        assert there is not None
        assert math.dist(start[:2], there[:2]) < 0.6
        eventually(lambda: drone.authority.state == "held", "the authority comes back")
        drone.takeoff()
        drone.go_to(x=1.5, y=0.0, z=1.0)
        drone.config["safety.zones"] = "cylinder 0.8 0 0.2 0 3"
        drone.release_authority()
        ended = run("return", "alpha")
        assert ended.code == 1
        assert "alpha: NOT returned: skyloop return: return_to_start refused: a no-fly zone blocks" in ended.err
        drone.request_authority(wait_s=10.0)
        drone.config["safety.zones"] = ""
        drone.land()


def test_all_land_and_all_stop(run: Run, swarm: Process, alpha: Process) -> None:
    assert swarm.pid != alpha.pid
    with skyloop.connect("b1", name="one", on_exit="hover") as one, skyloop.connect("b2", on_exit="hover") as two:
        one.takeoff()
        two.takeoff()
        ended = run("land", "--all")
        assert (ended.code, ended.err) == (0, "")
        assert ended.out.splitlines() == ["alpha: landed already", "b1: landed", "b2: landed"]
        eventually(lambda: one.authority.state == "held", "the authority comes back")
        one.takeoff()
        refused = run("stop", "b1")
        assert (refused.code, refused.err) == (
            2,
            "skyloop: an emergency stop asks first: give --yes if there is no terminal to answer on\n",
        )
        assert one.feedback().state.airborne
        ended = run("stop", "--all", "--yes", "--json")
        assert ended.code == 0
        assert {"name": "b1", "ok": True, "outcome": "motors off"} in json.loads(ended.out)
        eventually(lambda: state("b1") == "emergency", "its motors are off")
    assert run("land", "--all", "b1").err == "skyloop: --all means every drone: give either --all or names\n"


def test_no_drone_found_is_reported(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("skyloop.transport.local.list_names", list)
    for command in (["land", "--all"], ["stop", "--all", "--yes"]):
        ended = run(*command)
        assert ended.code == 1
        assert ended.err.startswith("skyloop: no drone found")


def test_a_stop_asks_for_confirmation(run: Run, alpha: Process, monkeypatch: pytest.MonkeyPatch) -> None:
    assert FAST_SIM
    assert alpha.pid
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    monkeypatch.setattr("typer.confirm", lambda text, **_: asked.append(text))
    asked: list[str] = []
    ended = run("stop", "alpha")
    assert ended.code == 0
    assert ended.out.startswith("alpha: motors off")
    assert asked == ["Cut the motors of alpha? Flying drones FALL."]
