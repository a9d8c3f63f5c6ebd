"""Drones that appear, vanish, return and are forgotten."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from skyloop.clock import ManualClock
from skyloop.cockpit.discovery import FoundProxy, LocalFinder
from skyloop.cockpit.fleet import FORGET_S, CockpitFleet, FleetOverview
from skyloop.cockpit.recordings import Recordings
from skyloop.errors import LinkError, NoAnswerError
from skyloop.messages import LinkState
from skyloop.transport.base import FEEDBACK, ClientHandler, TransportClient
from skyloop.transport.local import LocalServer
from skyloop.transport.testing import ServerLog
from tests.support.cockpit import FakeDrone, Node, Nodes, cockpit, open_socket, until
from tests.support.testclient import TestClient


def dial(_: ClientHandler) -> TransportClient:
    raise LinkError("nobody is there")


class Hangar:
    """Drones that are found, and those that answer."""

    def __init__(self, *names: str) -> None:
        self.found = list(names)
        self.drones = {name: FakeDrone() for name in names}
        self.fails: set[str] = set()
        self.connected: list[str] = []

    def __call__(self) -> list[FoundProxy]:
        return [FoundProxy(name, "memory", dial) for name in self.found]

    def add_name(self, name: str) -> None: ...

    def close(self) -> None: ...

    def connect(self, found: FoundProxy) -> Any:
        self.connected.append(found.name)
        if found.name in self.fails:
            raise NoAnswerError(f"{found.name} is stopped")
        return self.drones[found.name]


def run(work: Callable[[], Awaitable[None]]) -> None:
    async def main() -> None:
        await work()

    asyncio.run(main())


async def settle(fleet: CockpitFleet) -> None:
    """Search, and wait until the found ones are connected."""
    await fleet.search()
    while fleet._connecting:
        await asyncio.gather(*fleet._connecting.values())


def test_one_connection_per_drone() -> None:
    hangar = Hangar("alpha", "beta")

    async def work() -> None:
        fleet = CockpitFleet(hangar, hangar.connect)
        await fleet.start()
        for _ in range(3):
            await settle(fleet)
        assert sorted(fleet.stations) == ["alpha", "beta"]
        assert sorted(hangar.connected) == ["alpha", "beta"]
        await fleet.close()

    run(work)
    assert all(drone.closed for drone in hangar.drones.values())


def test_an_unresponsive_proxy_is_reported_and_retried() -> None:
    hangar = Hangar("alpha")
    hangar.fails.add("alpha")

    async def work() -> None:
        fleet = CockpitFleet(hangar, hangar.connect)
        await settle(fleet)
        assert fleet.problems == {"alpha": "alpha is stopped"}
        (row,) = FleetOverview(fleet, Recordings(Path("nowhere"))).rows()
        assert (row["name"], row["state"]) == ("alpha", "unknown")
        assert [alarm.text for alarm in row["alarms"]] == ["alpha is stopped"]
        assert row["links"]["application"] == "lost"
        hangar.fails.clear()
        await settle(fleet)
        assert not fleet.problems
        (known,) = FleetOverview(fleet, Recordings(Path("nowhere"))).rows()
        assert set(known) == set(row), "a row has the same parts whatever is known"
        hangar.fails.add("alpha")
        await fleet.close()

    run(work)


def test_one_that_is_ending_is_not_joined_again_before_it_is_gone() -> None:
    """The proxy of a replay that was ended is found for another second."""
    hangar = Hangar("alpha")

    async def work() -> None:
        fleet = CockpitFleet(hangar, hangar.connect)
        await settle(fleet)
        fleet.let_go("alpha", ending=True)
        for _ in range(2):
            await settle(fleet)
            assert not fleet.stations
        hangar.found.clear()
        await settle(fleet)
        hangar.found.append("alpha")
        await settle(fleet)
        assert list(fleet.stations) == ["alpha"], "another one of that name"
        await fleet.close()

    run(work)


def test_one_that_was_never_there_leaves_no_trace() -> None:
    hangar = Hangar("alpha")
    hangar.fails.add("alpha")

    async def work() -> None:
        fleet = CockpitFleet(hangar, hangar.connect)
        await settle(fleet)
        hangar.found.clear()
        await settle(fleet)
        assert not fleet.problems
        await fleet.close()

    run(work)


@pytest.mark.parametrize("kept", [(), ("alpha",)])
def test_a_lost_drone_is_shown_for_a_while(kept: tuple[str, ...]) -> None:
    hangar, clock = Hangar("alpha", "beta"), ManualClock()

    async def work() -> None:
        fleet = CockpitFleet(hangar, hangar.connect, kept=kept, clock=clock)
        await settle(fleet)
        hangar.found.remove("alpha")
        hangar.drones["alpha"].link.application = LinkState.LOST
        clock.advance(FORGET_S - 1)
        await settle(fleet)
        assert "alpha" in fleet.stations
        clock.advance(2)
        await settle(fleet)
        assert ("alpha" in fleet.stations) is bool(kept)
        assert "beta" in fleet.stations
        await fleet.close()

    run(work)
    assert hangar.drones["alpha"].closed


def test_a_lost_drone_on_a_page_is_not_forgotten_and_one_that_is_back_neither() -> None:
    hangar, clock = Hangar("alpha"), ManualClock()

    async def work() -> None:
        fleet = CockpitFleet(hangar, hangar.connect, clock=clock)
        await settle(fleet)
        station = fleet.stations["alpha"]
        wake = asyncio.Event()
        station.broadcast.subscribe(wake.set)
        hangar.found.clear()
        hangar.drones["alpha"].link.application = LinkState.LOST
        clock.advance(FORGET_S + 1)
        await settle(fleet)
        assert "alpha" in fleet.stations, "a page shows it"
        station.broadcast.unsubscribe(wake.set)
        hangar.drones["alpha"].link.application = LinkState.UP
        await settle(fleet)
        hangar.drones["alpha"].link.application = LinkState.LOST
        await settle(fleet)
        assert "alpha" in fleet.stations, "it was here a moment ago"
        clock.advance(FORGET_S + 1)
        await settle(fleet)
        assert not fleet.stations
        await fleet.close()

    run(work)


def test_a_failing_finder_is_retried() -> None:
    hangar = Hangar("alpha")
    asked = 0

    class Failing(Hangar):
        def __call__(self) -> list[FoundProxy]:
            nonlocal asked
            asked += 1
            if asked in (2, 3):
                raise LinkError("the directory can't be read")
            return hangar()

    async def work() -> None:
        fleet = CockpitFleet(Failing(), hangar.connect, search_s=0.005)
        await fleet.start()
        while asked < 5:
            await asyncio.sleep(0.005)
        assert "alpha" in fleet.stations
        await fleet.close()

    run(work)


# Through the page -------------------------------------------------------------------------------------------------


@pytest.fixture
def nodes() -> Iterator[Nodes]:
    nodes = Nodes(Node("alpha"), Node("beta"))
    yield nodes
    for node in nodes.nodes:
        node.stop()


def rows(client: TestClient) -> list[dict[str, Any]]:
    with open_socket(client, "overview") as socket:
        found: list[dict[str, Any]] = socket.receive_json()["drones"]
        return found


def test_drones_come_and_go_in_the_overview(nodes: Nodes) -> None:
    gamma = Node("gamma")
    try:
        with cockpit(CockpitFleet(nodes, search_s=0.02)) as client:
            assert [row["name"] for row in rows(client)] == ["alpha", "beta"]
            assert all(row["transport"] == "memory" and row["can_fly"] for row in rows(client))
            nodes.nodes.append(gamma)
            until(lambda: len(rows(client)) == 3, "the new one is there")
            gamma.stop()
            until(lambda: rows(client)[2]["links"]["application"] == "lost")
            assert rows(client)[2]["alarms"][0]["text"].startswith("link to the proxy lost")
            gamma.restart()
            until(lambda: rows(client)[2]["links"]["application"] == "up", "it came back by itself")
            assert rows(client)[2]["alarms"] == []
    finally:
        gamma.stop()


def test_a_drone_that_moves_to_another_host_under_its_name_is_joined_there() -> None:
    before, after = Node("alpha"), Node("alpha")
    here = {"local": before}

    class Moving(Nodes):
        def __call__(self) -> list[FoundProxy]:
            return [FoundProxy("alpha", where, node.dial) for where, node in here.items() if node.up]

    try:
        with (
            cockpit(CockpitFleet(Moving(), search_s=0.02)) as client,
            open_socket(client, "drones/alpha/telemetry") as page,
        ):
            until(lambda: rows(client)[0]["links"]["application"] == "up")
            before.stop()
            here.clear()
            here["network"] = after
            until(lambda: rows(client)[0]["transport"] == "network", "it is seen where it is now")
            until(lambda: rows(client)[0]["links"]["application"] == "up", "its connection leads there")
            assert [(row["name"], row["transport"]) for row in rows(client)] == [("alpha", "network")]
            while (state := page.receive_json())["type"] != "state" or state["links"]["application"] != "up":
                pass  # its page stays connected
    finally:
        before.stop()
        after.stop()


def test_the_overview_shows_the_holder_of_control(nodes: Nodes) -> None:
    with cockpit(CockpitFleet(nodes, search_s=0.02)) as client, open_socket(client, "drones/alpha/control") as control:
        control.send_json({"do": "take", "priority": 3, "at_s": time.monotonic()})
        until(lambda: rows(client)[0]["me"])
        first, second = rows(client)
        assert first["owner"].startswith("cockpit ")
        assert (second["owner"], second["me"]) == (None, False)


# The finder -------------------------------------------------------------------------------------------------------


def test_sockets_are_found_without_being_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", str(tmp_path / "run"))
    assert LocalFinder()() == []
    log = ServerLog()
    servers = [LocalServer(name) for name in ("alpha", "beta")]
    for server in servers:
        server.start(log)
    try:
        (tmp_path / "run" / "Not-a-name.sock").touch()
        (tmp_path / "run" / "killed.sock").touch()
        finder = LocalFinder()
        assert [(found.name, found.transport) for found in finder()] == [("alpha", "local"), ("beta", "local")]
        assert finder()[0] is finder()[0], "the same, so that it is connected to once"
        some = LocalFinder(["beta", "gone"])
        assert [found.name for found in some()] == ["beta"]
        some.add_name("alpha")
        assert [found.name for found in some()] == ["alpha", "beta"]
        assert not log.joined
    finally:
        for server in servers:
            server.stop()
    assert finder() == []


def test_a_row_needs_little_feedback_and_the_whole_drone_all_of_it() -> None:
    node = Node()
    server, slow = node._server, "feedback?max_hz=2"
    try:
        with cockpit(CockpitFleet(Nodes(node))) as client:
            until(lambda: server.subscribers(slow) == 1 and not server.subscribers(FEEDBACK))
            with open_socket(client, "drones/alpha/telemetry") as socket:
                socket.receive_json()
                until(lambda: server.subscribers(FEEDBACK) == 1 and not server.subscribers(slow))
            until(lambda: server.subscribers(slow) == 1 and not server.subscribers(FEEDBACK))
    finally:
        node.stop()
