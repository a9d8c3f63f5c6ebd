"""Drones on the network are found in addition to those of this host, and flown as swarms by pattern."""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest

pytest.importorskip("zenoh", reason="needs Zenoh: skyloop install network")

import skyloop
from skyloop.cockpit.discovery import FoundProxy, LocalFinder, NetworkFinder
from skyloop.network import FabricServer, FabricSettings
from skyloop.network.config import free_port
from skyloop.transport.composite import CompositeServer
from skyloop.transport.local import LocalServer
from skyloop.transport.testing import ServerLog, wait_until
from tests.support.processes import Process


@pytest.fixture(autouse=True)
def sockets(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with tempfile.TemporaryDirectory(prefix="skyloop-") as folder:
        monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", str(Path(folder) / "run"))
        yield


def place() -> str:
    return f"127.0.0.1:{free_port('127.0.0.1')}"


def test_local_proxies_come_first_followed_by_remote_ones() -> None:
    here = place()
    listening = FabricSettings(listen=(here,), multicast=False)
    both = CompositeServer([LocalServer("alpha"), FabricServer("alpha", listening)])
    far = FabricServer("bravo", FabricSettings(listen=(place(),), connect=(here,), multicast=False))
    settings = FabricSettings(connect=(here,), multicast=False)
    finder, some = NetworkFinder(LocalFinder(), settings), NetworkFinder(LocalFinder(["x"]), settings, frozenset("x"))
    both.start(ServerLog())
    try:
        far.start(ServerLog())
        wait_until(
            lambda: [(one.name, one.transport) for one in finder()] == [("alpha", "local"), ("bravo", "network")],
            "both are found",
        )
        assert finder()[1] is finder()[1], "the same, so that it is connected to once"
        assert some() == []
        some.add_name("bravo")
        wait_until(lambda: [one.name for one in some()] == ["bravo"], "the other one is wanted now")
        far.stop()
        wait_until(lambda: [one.name for one in finder()] == ["alpha"], "it is gone")
    finally:
        for end in (finder, finder, some):
            end.close()
        far.stop()
        both.stop()


@pytest.mark.process
def test_a_swarm_by_pattern_over_the_network(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    here = place()
    monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", str(tmp_path / "far"))  # their sockets are out of sight
    arguments = ("--world", "empty", "--option", "cameras=none", "--network", "--no-multicast", "--listen", here)
    process = Process("-m", "skyloop", "sim", "--drones", "2", "--name", "far", *arguments)
    try:
        process.until("ready far2")
        monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", str(tmp_path / "near"))
        with skyloop.swarm("far*", access="observe", network=here) as drones:
            assert sorted(drones.names) == ["far1", "far2"]
    finally:
        process.end()


def test_two_searches_at_once_share_a_session(monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[object] = []
    both = threading.Barrier(2)

    def acquire(*_: object) -> object:
        with suppress(threading.BrokenBarrierError):
            both.wait(0.3)  # until the other thread opens one too
        opened.append(object())
        return opened[-1]

    released: list[object] = []
    monkeypatch.setattr("skyloop.network.session.acquire", acquire)
    monkeypatch.setattr("skyloop.network.session.release", released.append)
    monkeypatch.setattr("skyloop.network.discovery.runs", lambda session: [("bravo", "run")])
    finder = NetworkFinder(LocalFinder(), FabricSettings(multicast=False))
    found: list[FoundProxy] = []
    threads = [threading.Thread(target=lambda: found.extend(finder())) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    finder.close()
    finder.close()
    assert len(opened) == 1
    assert released == opened
    assert found[0] is found[1]
