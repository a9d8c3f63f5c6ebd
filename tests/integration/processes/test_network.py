"""Proxies and applications that reach each other only over the network: each host has its own runtime directory."""

from __future__ import annotations

import os
import re
import signal
import socket
import time
from collections.abc import Callable
from pathlib import Path

import pytest

import skyloop
from skyloop.cli.listing import running
from skyloop.errors import UnknownNameError
from skyloop.messages import EventKind, LinkState
from skyloop.network import FabricSettings
from skyloop.network.config import free_port
from tests.support.processes import Process, eventually

pytestmark = pytest.mark.process
LOCAL = "127.0.0.1"
#: The network promises this within a second; the tests allow more because the machine may be busy.
SOON_S = 3.0


@pytest.fixture
def place() -> str:
    return f"{LOCAL}:{free_port(LOCAL)}"


@pytest.fixture
def far(
    start: Callable[..., Process], place: str, sockets: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., Process]:
    """Start a proxy that this process can only reach over the network."""
    number = iter(range(100))

    def begin(*options: str, uri: str = "sim://?world=empty&cameras=front", until: str = "ready") -> Process:
        with monkeypatch.context() as elsewhere:
            elsewhere.setenv("SKYLOOP_RUNTIME_DIR", str(sockets.parent / f"host{next(number)}"))
            words = ("proxy", uri, "--name", "alpha", *(options or ("--network", "--no-multicast", "--listen", place)))
            process = start("-m", "skyloop", *words)
            process.until(until)
        return process

    return begin


def internet_sockets(pid: int) -> list[str]:
    """The sockets that a process has open to any network, including this host's own."""
    inodes = {str(entry.readlink()) for entry in Path(f"/proc/{pid}/fd").iterdir()}
    found = []
    for table in ("tcp", "tcp6", "udp", "udp6", "raw", "raw6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            if f"socket:[{line.split()[9]}]" in inodes:
                found.append(f"{table} {line}")
    return found


def test_by_default_nothing_leaves_the_host(proxy: Callable[..., Process]) -> None:
    alpha = proxy()
    with skyloop.connect("alpha", access="observe") as drone:
        assert drone.link.application is LinkState.UP
        assert internet_sockets(alpha.pid) == []
    with pytest.raises(UnknownNameError, match="only this host was searched"):
        skyloop.connect("bravo")


def test_a_proxy_on_the_network_says_that_anyone_can_fly_and_is_flown(far: Callable[..., Process], place: str) -> None:
    alpha = far()
    assert "WARNING: --network without keys: anyone on this network can watch and fly alpha" in alpha.text
    assert internet_sockets(alpha.pid) != []
    (row,) = running(FabricSettings(connect=(place,), multicast=False))
    assert (row.name, row.transport, row.host, row.pid) == ("alpha", "fabric", os.uname().nodename, alpha.pid)
    assert (row.vehicle, row.state, row.owner, row.problem) == ("sim", "landed", None, "")
    with skyloop.connect("alpha", network=place) as drone:
        assert f"(pid {alpha.pid})" in drone._connection.session.address  # type: ignore[union-attr]
        assert drone._reach is None, "a process without the network option does not find it"
        drone.takeoff()
        drone.velocity(forward=0.3)
        drone.wait("flying")
        assert drone.next_frame(timeout_s=30.0).shape == (240, 320, 3)
        drone.land()
    alpha.signal(signal.SIGINT)
    assert alpha.wait() == 0


def test_a_killed_proxy_is_reported_and_found_again_with_its_state_restored(
    far: Callable[..., Process], place: str
) -> None:
    first = far()
    with skyloop.connect("alpha", network=place, authority=skyloop.Authority(priority=5)) as drone:
        frames: list[int] = []
        drone.on_frame(lambda frame: frames.append(frame.seq), scale=0.5)
        eventually(lambda: bool(frames), "pictures come")
        first.signal(signal.SIGKILL)
        first.wait()
        eventually(lambda: drone.link.application is LinkState.LOST, "it is told of the loss", SOON_S)
        assert drone.velocity(forward=0.3) is False  # no vehicle to command, and no exception
        frames.clear()
        far()
        eventually(lambda: drone.link.application is LinkState.UP, "it is up again", SOON_S)
        eventually(lambda: drone.authority.state == "held", "it holds the authority again", SOON_S)
        eventually(lambda: bool(frames), "frames arrive again", SOON_S)


PILOT = """
import sys, skyloop
drone = skyloop.connect("alpha", network=sys.argv[1], name="the victim")
drone.takeoff()
print("flying", flush=True)
drone.wait(lambda feedback: False, 100)
"""


@pytest.mark.daily
@pytest.mark.parametrize("how", ["SIGKILL", "SIGSTOP"])
def test_a_dead_or_stopped_pilot_is_reported_and_the_vehicle_fails_safe(
    far: Callable[..., Process], start: Callable[..., Process], place: str, how: str
) -> None:
    far()
    pilot = start("-c", PILOT, place)
    pilot.until("flying")
    with skyloop.connect("alpha", network=place, access="observe") as drone:
        pilot.signal(signal.Signals[how])
        lost = [EventKind.APPLICATION_LINK]

        def told() -> bool:
            return any(event.kind in lost and event.app == "the victim" for event in drone.recent_events())

        eventually(told, "the proxy knows that the pilot is gone", SOON_S)
        drone.wait(lambda feedback: feedback.owner is None, SOON_S)
        drone.wait("landed", 20.0)


def test_a_name_already_used_on_the_network_is_refused_with_its_owner(far: Callable[..., Process], place: str) -> None:
    alpha = far()
    second = far("--network", "--no-multicast", "--connect", place, until="choose another")
    assert second.wait() == 2
    assert f"(pid {alpha.pid})" in second.text
    assert re.search(r"in use on the network by the proxy of sim://\S* on \S+", second.text)


def test_an_application_on_the_network_ends_with_its_script_and_on_ctrl_c(
    far: Callable[..., Process], start: Callable[..., Process], place: str
) -> None:
    far()
    script = (
        "import sys, skyloop\ndrone = skyloop.connect('alpha', network=sys.argv[1])\ndrone.next_frame(timeout_s=20.0)\n"
    )
    begin = time.monotonic()
    assert start("-c", script, place).wait(15.0) == 0
    assert time.monotonic() - begin < 15.0
    waiting = start("-c", PILOT, place)
    waiting.until("flying")
    waiting.signal(signal.SIGINT)
    assert waiting.wait(10.0) in (1, 130, -signal.SIGINT)


def test_a_stopped_proxy_is_lost_and_recovers_when_it_continues(far: Callable[..., Process], place: str) -> None:
    alpha = far()
    with skyloop.connect("alpha", network=place, access="observe") as drone:
        alpha.signal(signal.SIGSTOP)
        eventually(lambda: drone.link.application is LinkState.LOST, "silence is a loss", SOON_S)
        alpha.signal(signal.SIGCONT)
        eventually(lambda: drone.link.application is LinkState.UP, "up again", SOON_S)


def test_network_options_need_the_network(far: Callable[..., Process]) -> None:
    wrong = far("--listen", "127.0.0.1:0", until="--listen is for the network: give --network multicast as well")
    assert wrong.wait() == 2


def test_multicast_finds_a_proxy_on_this_host(far: Callable[..., Process]) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.sendto(b"", ("224.0.0.224", 7446))
        except OSError as error:
            pytest.skip(f"no multicast here: {error}")

    far("--network", "--listen", "127.0.0.1:0")
    with skyloop.connect("alpha", network=True, access="observe") as drone:
        assert drone.link.application is LinkState.UP


def test_a_router_joins_peers_that_know_only_it(
    far: Callable[..., Process], start: Callable[..., Process], place: str
) -> None:
    router = start("-m", "skyloop", "router", "--no-multicast", "--listen", place)
    router.until(f"ready: a router at {place}")
    assert "WARNING: a router without keys" in router.text
    far("--network", "--no-multicast", "--listen", f"{LOCAL}:0", "--connect", place)
    with skyloop.connect("alpha", network=place) as drone:
        drone.takeoff()
        drone.velocity(forward=0.2)
        drone.wait("flying")
        drone.next_frame(timeout_s=30.0)
    router.signal(signal.SIGTERM)
    assert router.wait() == 0
