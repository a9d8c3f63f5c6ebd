"""A proxy and an application on one host whose monotonic clocks differ, as they run in different time namespaces."""

from __future__ import annotations

import functools
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

import skyloop
from skyloop.client.drone import open_drone
from skyloop.clock import clock_identity
from skyloop.proxy import Proxy, proxy
from skyloop.transport.memory import MemoryServer
from tests.support.fake_vehicle import FakeVehicle
from tests.support.processes import Process, eventually

AHEAD_S = 1000
UNSHARE = ("unshare", "--time", "--monotonic", str(AHEAD_S))


@functools.cache
def why_not() -> str:
    """Why no other time namespace can be made here; empty if it can."""
    if shutil.which("unshare") is None:
        return "there is no unshare (util-linux)"
    tried = subprocess.run([*UNSHARE, "true"], capture_output=True, text=True, check=False)
    return tried.stderr.strip() if tried.returncode else ""


@pytest.fixture
def far(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A proxy whose clock is ahead of ours."""
    monkeypatch.setenv("SKYLOOP_RUNTIME_DIR", str(tmp_path / "run"))
    if why_not():
        pytest.skip(f"needs a time namespace, as root may make: {why_not()}")
    process = Process("-m", "skyloop", "proxy", "sim://?world=empty&cameras=none", "--name", "alpha", prefix=UNSHARE)
    try:
        process.until("ready")
        yield "alpha"
    finally:
        process.end()


def test_a_drone_is_flown_from_another_time_namespace(far: str) -> None:
    with skyloop.connect(far, name="pilot") as drone:
        assert drone.clock_offset_ns == pytest.approx(AHEAD_S * 1e9, abs=1e8)
        assert 0 < drone.clock_uncertainty_ns < 1e8
        feedback = drone.next_feedback(timeout_s=30.0)
        assert abs(drone.now_ns - feedback.captured_ns) < 1e9
        drone.takeoff()
        drone.velocity(forward=0.2)
        eventually(lambda: drone.next_feedback(timeout_s=30.0).state == "flying", "it flies")
        delay = drone.stats["command"].delay_s
        refused = [event.text for event in drone.recent_events() if event.kind == "command_refused"]
        assert refused == []
        assert delay is None or abs(delay.median) < 0.5


def test_one_clock_is_not_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    for told, same in ((clock_identity(), True), ("", True), ("another/1", False)):
        monkeypatch.setattr(proxy, "clock_identity", lambda: told)  # noqa: B023
        server = MemoryServer("alpha")
        with ExitStack() as stack:
            stack.enter_context(Proxy(FakeVehicle(), server, name="alpha"))
            drone = open_drone(server.dial, app="me", access="observe", timeout_s=10.0)
            stack.callback(drone.close)
            assert (drone.clock_uncertainty_ns == 0) is same
            assert (drone.clock_offset_ns == 0) is same
            assert abs(drone.clock_offset_ns) < 1e9


def test_a_clock_has_an_identity() -> None:
    boot, _, namespace = clock_identity().partition("/")
    assert len(boot) == 36
    assert namespace.isdecimal()
