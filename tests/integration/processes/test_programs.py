"""Programs that end in flight without landing: killed with their private proxy, or at the end of their script."""

from __future__ import annotations

import signal
from collections.abc import Callable

import pytest

import skyloop
from skyloop.errors import UnknownNameError
from tests.support.processes import Process, eventually

pytestmark = pytest.mark.process

SIM = "sim://?world=empty&cameras=none&speed=3&wind=0"
BEGINS = """
import atexit, signal, sys, threading, time
import skyloop

signal.signal(signal.SIGHUP, signal.SIG_DFL)  # where the tests run under nohup, it would be ignored
drone = skyloop.connect(sys.argv[1], name="program")
drone.takeoff()

def fly():
    while True:
        drone.velocity(forward=0.2)
        time.sleep(0.05)

threading.Thread(target=fly, daemon=True).start()
drone.wait("flying")
print("flying", drone.name, "end", flush=True)
"""
STAYS = BEGINS + "time.sleep(60)"
LEAVES = BEGINS
LANDS_AT_EXIT = BEGINS.replace("drone.takeoff()", "drone.takeoff()\natexit.register(drone.__exit__, None, None, None)")


@pytest.mark.parametrize("number", ["SIGKILL", "SIGHUP"])
def test_a_program_that_is_killed_over_its_own_proxy_leaves_a_drone_that_lands(
    start: Callable[..., Process], number: str
) -> None:
    program = start("-c", STAYS, SIM)
    program.until("end")
    name = program.text.split()[1]
    with skyloop.connect(name, access="observe") as observer:
        states: list[str] = []
        observer.on_feedback(lambda feedback: states.append(feedback.state.value), inline=True)
        program.signal(signal.Signals[number])
        eventually(lambda: "landed" in states, "it lands")
        assert "landing" in states
        eventually(lambda: observer.link.application.value == "lost", "its proxy ends")
    with pytest.raises(UnknownNameError):
        skyloop.connect(name, access="observe")


@pytest.mark.parametrize(("program", "last"), [(LEAVES, "none"), (LANDS_AT_EXIT, "program")])
def test_a_script_that_ends_in_flight_leaves_a_drone_that_lands(
    start: Callable[..., Process], proxy: Callable[..., Process], program: str, last: str
) -> None:
    """Its daemon thread keeps commanding; either the end of the interpreter stops it, or the exit handler lands."""
    proxy()
    with skyloop.connect("alpha", access="observe") as observer:
        owners: list[str] = []
        observer.on_feedback(
            lambda feedback: owners.append(feedback.owner or "none") if feedback.state == "landing" else None,
            inline=True,
        )
        script = start("-c", program, "alpha")
        assert script.wait(60.0) == 0, script.text
        observer.wait("landed", timeout_s=30.0)
        assert (last == "program") is (owners[0] == "program")


def test_a_take_off_does_not_raise_refusals_of_a_callbacks_commands() -> None:
    """A callback that flies is registered before take-off: on the ground only its velocities are refused."""
    refused: list[str] = []
    with skyloop.connect(SIM, name="program") as drone:
        drone.on_event(lambda event: refused.append(event.text) if "velocity refused" in event.text else None)
        drone.on_feedback(lambda _: drone.velocity(forward=0.2))
        eventually(lambda: bool(refused), "one is refused")
        drone.takeoff()
        drone.wait("flying", timeout_s=20.0)
