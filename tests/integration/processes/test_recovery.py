"""Links that recover: proxies that are killed, stopped and started again."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable

import pytest

import skyloop
from skyloop.client import LinkStatus
from skyloop.messages import LinkState
from tests.support.processes import Process, eventually

pytestmark = pytest.mark.process


@pytest.mark.daily
def test_a_killed_and_restarted_proxy_is_back_within_a_second_with_its_state_restored(
    proxy: Callable[..., Process],
) -> None:
    first = proxy("sim://?world=empty&cameras=front")
    with skyloop.connect("alpha", authority=skyloop.Authority(priority=5)) as drone:
        told: list[tuple[float, LinkStatus]] = []
        drone.on_link(lambda status: told.append((time.monotonic(), status)))
        frames: list[int] = []
        drone.on_frame(lambda frame: frames.append(frame.seq))
        drone.config["limits.tilt"] = 0.21
        eventually(lambda: bool(frames), "pictures come")

        first.signal(signal.SIGKILL)
        first.wait()
        eventually(lambda: any(s.application is LinkState.LOST for _, s in told), "it is told of the loss")
        assert drone.velocity(forward=0.3) is False  # no vehicle to command, and no exception
        frames.clear()
        proxy("sim://?world=empty&cameras=front")
        ready = time.monotonic()
        eventually(lambda: drone.link.application is LinkState.UP, "it is up again")
        assert time.monotonic() - ready < 5.0
        eventually(lambda: drone.authority.state == "held", "it holds the authority again")
        assert drone.authority.priority == 5
        eventually(lambda: bool(frames), "frames arrive again")
        eventually(lambda: drone.config["limits.tilt"] == pytest.approx(0.21), "its settings are put back")
        states = [status.application for _, status in told]
        assert states.index(LinkState.LOST) < len(states) - 1 - states[::-1].index(LinkState.UP)
        drone.takeoff()
        drone.land()


def test_a_stopped_proxy_is_reported_lost_and_recovers_when_it_continues(proxy: Callable[..., Process]) -> None:
    process = proxy()
    with skyloop.connect("alpha") as drone:
        process.signal(signal.SIGSTOP)
        eventually(lambda: drone.link.application is LinkState.LOST, "silence is a loss")
        process.signal(signal.SIGCONT)
        eventually(lambda: drone.link.application is LinkState.UP, "up again")
        eventually(lambda: drone.authority.state == "held", "the authority is back")


def test_a_lost_vehicle_is_reported_and_only_new_commands_fly_it_again(proxy: Callable[..., Process]) -> None:
    proxy("sim://?world=empty&cameras=none")
    with skyloop.connect("alpha") as drone:
        drone.takeoff()
        drone.velocity(forward=0.3)
        drone.wait("flying", timeout_s=30.0)
        drone.config["sim.link"] = False
        eventually(lambda: drone.link.vehicle is LinkState.LOST, "the loss of the vehicle is told")
        drone.velocity(forward=0.3)
        eventually(
            lambda: any(e.data.get("reason") == "vehicle_link_lost" for e in drone.recent_events()),
            "commands are refused",
        )
        drone.config["sim.link"] = True
        eventually(lambda: drone.link.vehicle is LinkState.UP, "it is told that it is back")
        eventually(lambda: drone.velocity(left=0.2) and drone.feedback().state == "flying", "a fresh command flies it")
        drone.land()


@pytest.mark.daily
def test_a_private_proxy_ends_with_its_block_and_with_its_parent(start: Callable[..., Process]) -> None:
    from skyloop.transport.local import list_names

    parent = start(
        "-c",
        "import skyloop, time\n"
        "with skyloop.connect('sim://?cameras=none') as drone: print('up', flush=True); time.sleep(60)",
    )
    parent.until("up")
    assert len(list_names()) == 1
    parent.signal(signal.SIGKILL)
    eventually(lambda: not list_names(), "the child is gone with its parent")
    with skyloop.connect("sim://?cameras=none"):
        assert len(list_names()) == 1
    assert not list_names()
