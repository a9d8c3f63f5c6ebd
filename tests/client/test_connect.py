"""Connecting by name and by address, with stand-ins for the proxies' processes."""

from __future__ import annotations

import os
import re
import select
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import skyloop
from skyloop.client.connect import PrivateProxy, _script_name, connect, network_settings
from skyloop.client.drone import open_drone
from skyloop.errors import LinkError, NoAnswerError, UnknownNameError, UsageError
from skyloop.messages import FlightState, LinkState
from skyloop.messages.feedback import WAKING_UP
from skyloop.network.config import FabricSettings
from skyloop.transport.local import LocalServer
from tests.support.scripted_proxy import ScriptedProxy

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the local transport needs Linux")
ROOT = Path(__file__).parents[2]
CONNECT = sys.modules["skyloop.client.connect"]  # the module: its function has the same name

#: A stand-in for ``skyloop proxy``: a scripted proxy on the local transport that ends with its parent.
CHILD = """
import os, sys
sys.path.insert(0, {root!r})
from skyloop.network.config import FabricSettings
from skyloop.transport.local import LocalServer
from tests.support.scripted_proxy import ScriptedProxy
name, descriptor = sys.argv[sys.argv.index("--name") + 1], int(sys.argv[-1])
proxy = ScriptedProxy()
proxy.server = LocalServer(name)
proxy.start()
print("ready", name, flush=True)
print("something is odd", file=sys.stderr, flush=True)
os.read(descriptor, 1)
proxy.stop()
"""


@pytest.fixture(autouse=True)
def directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", str(tmp_path / "run"))


@pytest.fixture
def alpha() -> Iterator[ScriptedProxy]:
    proxy = ScriptedProxy()
    proxy.server = LocalServer("alpha")  # type: ignore[assignment]  # another transport with the same contract
    proxy.start()
    yield proxy
    proxy.stop()


def command(code: str) -> list[str]:
    return [sys.executable, "-c", textwrap.dedent(code).format(root=str(ROOT))]


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_by_name(alpha: ScriptedProxy) -> None:
    with skyloop.connect("alpha", name="ada", authority=skyloop.Authority(priority=3)) as drone:
        assert drone.authority.state == "held"
        assert drone.authority.priority == 3
        assert drone.feedback().state is FlightState.LANDED
        drone.frame()
        drone.wait(lambda _: alpha.server.subscribers("video/front") == 1, 10.0)
        alpha.frame(2, value=9)
        frame = drone.next_frame(timeout_s=5.0)
        assert frame[0, 0, 0] == 9
    assert drone.closed


def test_wrong_name(alpha: ScriptedProxy) -> None:
    with pytest.raises(UnknownNameError, match="no proxy named 'alfa'; did you mean 'alpha'"):
        connect("alfa")


@pytest.mark.parametrize(
    "arguments",
    [
        {"target": ""},
        {"target": 3},
        {"target": "Not A Name"},
        {"target": "alpha", "authority": 4},
        {"target": "alpha", "timeout_s": float("nan")},
        {"target": "alpha", "rate_hz": 0.0},
        {"target": "alpha", "name": ""},
    ],
)
def test_unusable_arguments(arguments: dict[str, object]) -> None:
    with pytest.raises(UsageError):
        connect(**arguments)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "wish",
    [{"priority": 32}, {"wait_s": -1.0}, {"wait_s": "1"}, {"for_s": 0.0}, {"takeover": "grab"}],
)
def test_invalid_authority_options(wish: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match=next(iter(wish))):
        skyloop.Authority(**wish)


@pytest.mark.parametrize(
    ("old", "now"),
    [
        ({"priority": 4}, "authority=skyloop.Authority(priority=4)"),
        ({"takeover": "ask"}, "authority=skyloop.Authority(takeover='ask')"),
        ({"keys": "jane"}, "network=skyloop.Network(keys='jane')"),
    ],
)
@pytest.mark.parametrize("function", [skyloop.connect, skyloop.swarm])
def test_old_options_name_their_replacement(function: Any, old: dict[str, Any], now: str) -> None:
    with pytest.raises(UsageError, match=re.escape(now)):
        function("alpha", **old)


def test_search_options_of_the_network(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("zenoh")
    monkeypatch.delenv("SKYLOOP_NETWORK", raising=False)
    for off in (None, False, skyloop.Network(False)):
        assert network_settings(off) is None
    for everywhere in (True, skyloop.Network(), skyloop.Network(True)):
        assert network_settings(everywhere) == FabricSettings()
    there = FabricSettings(connect=("10.0.0.5:7447",), multicast=False)
    for address in ("10.0.0.5:7447", skyloop.Network("10.0.0.5:7447"), there):
        assert network_settings(address) == there
    monkeypatch.setenv("SKYLOOP_NETWORK", "10.0.0.5:7447")
    assert network_settings(skyloop.Network()) == network_settings() == there


def test_script_name(monkeypatch: pytest.MonkeyPatch) -> None:
    for given, name in (
        ("/home/me/follow.py", "follow"),
        ("/x/pkg/__main__.py", "pkg"),
        ("", "python"),
        ("-c", "c"),
        ("a" * 99, "a" * 64),
    ):
        monkeypatch.setattr(sys, "argv", [given])
        assert _script_name() == name


def test_a_collector_of_frames_never_starves(alpha: ScriptedProxy) -> None:
    """Frames are in the transport's memory; beyond a few of them, they are copies."""
    with skyloop.connect("alpha", access="observe") as drone:
        drone.frame()
        drone.wait(lambda _: alpha.server.subscribers("video/front") == 1, 10.0)
        kept = []
        for seq in range(1, 21):
            alpha.frame(seq, value=seq)
            kept.append(drone.next_frame(timeout_s=5.0))
        assert [int(frame[0, 0, 0]) for frame in kept] == list(range(1, 21))


@pytest.mark.process
def test_a_private_proxy_ends_with_the_drone() -> None:
    proxy = PrivateProxy("fake://", command(CHILD))
    assert proxy.name.startswith(f"fake-{os.getpid()}-")
    drone = open_drone(proxy.dialer(time.monotonic() + 20.0), app="me", on_close=proxy.close, timeout_s=20.0)
    assert drone.name == "scripted"
    assert alive(proxy.pid)
    drone.close()
    assert not alive(proxy.pid)
    proxy.close()


@pytest.mark.process
def test_a_private_proxy_may_finish_its_landing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Closing a drone in the air waits only for a moment, and does not terminate its proxy."""
    monkeypatch.setattr(CONNECT, "GRACE_S", 0.1)
    lands = CHILD.replace("os.read(descriptor, 1)", "os.read(descriptor, 1); import time; time.sleep(1.0)")
    proxy = PrivateProxy("fake://", command(lands))
    drone = open_drone(proxy.dialer(time.monotonic() + 20.0), app="me", on_close=proxy.close, timeout_s=20.0)
    drone.close()
    assert alive(proxy.pid)
    assert proxy._process.wait(20.0) == 0, "it ended without help"


def test_connect_waits_for_a_waking_vehicle(
    alpha: ScriptedProxy, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``connect()`` returned while the firmware could not arm, without saying what it waited for."""
    asleep = {"link_reason": f"{WAKING_UP}: the checks before arming do not pass yet"}
    alpha.more |= asleep
    after_s = 0.0

    def wakes_up() -> None:
        deadline_s = time.monotonic() + 30.0
        while not caplog.records and time.monotonic() < deadline_s:
            time.sleep(0.01)
        time.sleep(after_s)
        for key in asleep:
            del alpha.more[key]

    waking = threading.Thread(target=wakes_up)
    waking.start()
    with connect("alpha", timeout_s=30.0) as drone:
        assert not drone.feedback().waking_up
    waking.join()
    assert [record.getMessage() for record in caplog.records] == [
        "scripted is still waking up: the checks before arming do not pass yet; waiting for it"
    ]
    caplog.clear()
    monkeypatch.setattr(CONNECT, "NAME_TIMEOUT_S", 1.5)  # real ones take 42 s: a program without a time-out waits
    alpha.more |= asleep
    after_s = 1.5
    waking = threading.Thread(target=wakes_up)
    waking.start()
    begun_s = time.monotonic()
    with connect("alpha") as drone:
        assert not drone.feedback().waking_up
    assert time.monotonic() - begun_s > 2.0
    waking.join()
    caplog.clear()
    alpha.more |= asleep
    with connect("alpha", timeout_s=1.5) as drone:
        assert drone.feedback().waking_up, "it is connected nevertheless"
    assert caplog.records[-1].getMessage().endswith("do not pass yet: it can't take off yet")
    with connect("alpha", access="observe") as drone:
        pass  # at once


@pytest.mark.process
def test_by_address(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(CONNECT, "PrivateProxy", lambda uri: PrivateProxy(uri, command(CHILD)))
    with connect("fake://here") as drone:
        assert drone.authority.state == "held"
    with pytest.raises(UsageError, match="rate_hz"):
        connect("fake://here", rate_hz=-1.0)


@pytest.mark.process
def test_a_private_proxy_that_dies_is_reported_with_its_output() -> None:
    proxy = PrivateProxy("fake://", command(CHILD))
    drone = open_drone(proxy.dialer(time.monotonic() + 20.0), app="me", on_close=proxy.close, timeout_s=20.0)
    try:
        os.kill(proxy.pid, signal.SIGKILL)
        deadline = time.monotonic() + 10.0
        while "killed by signal 9" not in drone.link.reason:
            assert time.monotonic() < deadline, drone.link
            with pytest.raises(NoAnswerError):
                drone.wait("flying", 0.02)
        assert drone.link.application is LinkState.LOST
        assert "something is odd" in drone.link.reason
    finally:
        drone.close()


@pytest.mark.process
def test_a_private_proxy_that_cannot_start() -> None:
    code = "import sys; sys.exit('no such vehicle: unobtainium')"
    proxy = PrivateProxy("fake://", [sys.executable, "-c", code])
    try:
        with pytest.raises(LinkError, match=r"(?s)ended with exit code 1; its output:\nno such vehicle: unobtainium"):
            open_drone(proxy.dialer(time.monotonic() + 20.0), app="me")
    finally:
        proxy.close()


@pytest.mark.process
def test_a_private_proxy_that_takes_too_long_and_does_not_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(CONNECT, "GRACE_S", 0.2)
    code = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('x', flush=True); time.sleep(60)"
    proxy = PrivateProxy("fake://", [sys.executable, "-c", code])
    try:
        assert proxy._process.stdout is not None
        select.select([proxy._process.stdout], [], [], 10.0)
        with pytest.raises(NoAnswerError, match="did not start in time"):
            open_drone(proxy.dialer(time.monotonic() + 0.1), app="me", timeout_s=0.1)
    finally:
        proxy.close()
    assert not alive(proxy.pid)


@pytest.mark.process
def test_a_private_proxy_ends_when_its_parent_is_killed(tmp_path: Path) -> None:
    parent = textwrap.dedent(
        """
        import sys, time
        sys.path.insert(0, {root!r})
        from skyloop.client.connect import PrivateProxy
        proxy = PrivateProxy("fake://", {command!r})
        print(proxy.pid, flush=True)
        time.sleep(60)
        """
    ).format(root=str(ROOT), command=[sys.executable, "-c", "import os, sys; os.read(int(sys.argv[-1]), 1)"])
    process = subprocess.Popen([sys.executable, "-c", parent], stdout=subprocess.PIPE)
    assert process.stdout is not None
    child = int(process.stdout.readline())
    descriptor = os.pidfd_open(child)
    try:
        process.kill()
        process.wait(10.0)
        ended, _, _ = select.select([descriptor], [], [], 10.0)
        assert ended, "the child is still running"
    finally:
        os.close(descriptor)
        process.stdout.close()
