"""``skyloop host`` as a process: its commands, shutdown, death in flight, and what its vehicles do then."""

from __future__ import annotations

import json
import os
import signal
import time
from collections.abc import Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path

import pytest

import skyloop
from skyloop.host.serve import Remove, StatusRequest, ask
from skyloop.host.vehicle import VehicleStatus
from skyloop.messages import EventKind, LinkState
from tests.integration.processes.firmware import ADDRESS, wait_until_ready
from tests.support.processes import Process, eventually, skyloop_command

pytestmark = pytest.mark.process

SIM = "sim://?world=empty&cameras=none&wind=0"


@pytest.fixture
def fleet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    return tmp_path / "fleet.toml"


@pytest.fixture
def processes() -> Iterator[list[Process]]:
    started: list[Process] = []
    yield started
    for process in started:
        process.end()


def host(processes: list[Process], fleet: Path, text: str) -> Process:
    fleet.write_text(text)
    return again(processes, fleet)


def again(processes: list[Process], fleet: Path) -> Process:
    process = Process("-m", "skyloop", "host", str(fleet))
    processes.append(process)
    process.until("hosting ", 40.0)
    return process


def vehicles(*names: str, **settings: str) -> str:
    more = "".join(f"{key} = {value}\n" for key, value in settings.items())
    return "".join(f'[[vehicle]]\nname = "{name}"\naddress = "{SIM}"\n{more}' for name in names)


def rows() -> dict[str, VehicleStatus]:
    return {row.name: row for row in ask("host", StatusRequest()).vehicles}


@pytest.mark.daily
def test_vehicles_are_shown_added_flown_and_removed(processes: list[Process], fleet: Path) -> None:
    process = host(processes, fleet, vehicles("alpha") + vehicles("spare", autostart="false"))
    assert "hosting 1 of 2 vehicles as host" in process.text
    assert "bravo" in skyloop_command("host", "add", "bravo", SIM)
    assert "spare" in skyloop_command("host", "add", "spare")
    shown = json.loads(skyloop_command("host", "status", "--json"))
    assert {row["name"]: row["condition"] for row in shown} == dict.fromkeys(("alpha", "spare", "bravo"), "running")
    with skyloop.connect("bravo") as drone:
        drone.takeoff()
        refused = skyloop_command("host", "remove", "bravo", code=1)
        assert "has the authority" in refused
        assert "--land" in refused
        assert drone.feedback().state.airborne
        skyloop_command("host", "remove", "bravo", "--land")
        assert "bravo" not in {row["name"] for row in json.loads(skyloop_command("list", "--json"))}
    assert rows()["bravo"].condition == "stopped"
    assert "alpha" in skyloop_command("host", "status")


def test_sigterm_lands_all_and_ends(processes: list[Process], fleet: Path) -> None:
    names = ["alpha", "bravo", "own"]
    text = vehicles("alpha", "bravo") + vehicles("own", process='"own"')
    process = host(processes, fleet, text)
    with ExitStack() as stack:
        drones = [stack.enter_context(skyloop.connect(name, on_exit="hover")) for name in names]
        for drone in drones:
            drone.takeoff(wait=False)
        for drone in drones:
            drone.wait("hovering", timeout_s=30.0)
        process.signal(signal.SIGTERM)
        assert process.wait(40.0) == 0
        for drone in drones:
            closing = [event for event in drone.recent_events() if event.kind is EventKind.PROXY_CLOSING]
            assert "SIGTERM" in closing[0].text
            assert drone.feedback(max_age_s=None).state == "landed"


def test_a_killed_host_is_back_with_all_its_vehicles(processes: list[Process], fleet: Path) -> None:
    """Simulated vehicles end with their process; a program that keeps running finds all of them again within 5 s."""
    names = [f"v{number}" for number in range(8)]
    text = vehicles(*names[:-1]) + vehicles(names[-1], process='"own"')
    first = host(processes, fleet, text)
    own = rows()[names[-1]].pid
    assert own is not None
    with ExitStack() as stack:
        drones = {name: stack.enter_context(skyloop.connect(name, on_exit="hover")) for name in names}
        drones[names[0]].takeoff()
        drones[names[-1]].takeoff()
        first.signal(signal.SIGKILL)
        first.wait()
        for name, drone in drones.items():
            eventually(partial(is_linked, drone, LinkState.LOST), f"{name} is lost")
        eventually(lambda: not Path(f"/proc/{own}").exists() or _is_zombie(own), "the vehicle's own process ends too")
        second = again(processes, fleet)
        began = time.monotonic()
        for name, drone in drones.items():
            eventually(partial(is_linked, drone, LinkState.UP), f"{name} is up again")
            eventually(partial(is_held, drone), f"{name} is held again")
        assert time.monotonic() - began < 5.0
        assert all(row.condition == "running" for row in rows().values())
        drones[names[0]].takeoff()
        drones[names[0]].land()
    second.signal(signal.SIGTERM)
    assert second.wait() == 0


def is_linked(drone: skyloop.Drone, state: LinkState) -> bool:
    return drone.link.application is state


def is_held(drone: skyloop.Drone) -> bool:
    return drone.authority.state == "held"


def _is_zombie(pid: int) -> bool:
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"


def test_a_vehicle_of_another_process_flies_on_without_its_host(processes: list[Process], fleet: Path) -> None:
    """Its own firmware decides what happens without a ground station; the restarted host finds it in the air."""
    board = Process("-m", "skyloop", "sim", "--firmware", "arducopter", "--port-base", "0")
    processes.append(board)
    board.until("ready")
    board.until("\n")
    address = ADDRESS.search(board.text)
    assert address is not None, board.text
    text = f'[[vehicle]]\nname = "alpha"\naddress = "{address[0]}"\n' + vehicles("bravo")
    first = host(processes, fleet, text)
    with skyloop.connect("alpha", on_exit="hover") as drone:
        wait_until_ready(drone)
        drone.takeoff(timeout_s=60.0)
        first.signal(signal.SIGKILL)
        first.wait()
        eventually(lambda: drone.link.application is LinkState.LOST, "it is lost")
        again(processes, fleet)
        eventually(lambda: drone.link.application is LinkState.UP, "it is up again")
        eventually(lambda: drone.link.vehicle is LinkState.UP, "the firmware answers again")
        eventually(lambda: drone.authority.state == "held", "its pilot has it again")
        assert drone.feedback().state.airborne, "it was landed, or it fell"
        drone.land(timeout_s=60.0)


def test_a_separate_process_that_dies_is_started_again(processes: list[Process], fleet: Path) -> None:
    process = host(processes, fleet, vehicles("alpha") + vehicles("own", process='"own"'))
    before = rows()["own"]
    assert before.pid not in (None, process.pid)
    assert before.pid is not None
    with skyloop.connect("alpha", on_exit="hover") as alpha, skyloop.connect("own", on_exit="hover") as own:
        os.kill(before.pid, signal.SIGKILL)
        process.until("was killed by signal 9")
        eventually(lambda: rows()["own"].restarts == 1 and rows()["own"].condition == "running", "it runs again")
        eventually(lambda: own.link.application is LinkState.UP, "its application is connected again")
        assert rows()["own"].pid != before.pid
        assert "killed by signal 9" in rows()["own"].failed
        assert not any(event.kind is EventKind.APPLICATION_LINK for event in alpha.recent_events()[1:])
    ask("host", Remove("own"))
    eventually(lambda: rows()["own"].condition == "stopped", "it is not started again")
