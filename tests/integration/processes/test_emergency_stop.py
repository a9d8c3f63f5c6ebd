"""An emergency stop from the call to the motors: emulated firmware, proxy and pilot in separate processes."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable

import pytest

import skyloop
from skyloop.messages import FlightState
from tests.support.processes import Process, eventually
from tests.support.tello_addresses import Addresses

pytestmark = [pytest.mark.process, pytest.mark.timeout(180)]

ADDRESS = re.compile(r"mavlink://udpin:[0-9.]+:\d+")


@pytest.mark.parametrize("kind", ["arducopter", "px4", "tello"])
def test_a_stop_with_sticks_held_is_shown_reset_and_flown_again(
    start: Callable[..., Process], proxy: Callable[..., Process], kind: str
) -> None:
    proxy(address_of(kind, start))
    ended = threading.Event()
    with skyloop.connect("alpha") as drone:
        eventually(lambda: bool((drone.feedback().native or {}).get("mavlink.ready", True)), "it may be armed", 30.0)
        drone.takeoff()

        def hold() -> None:
            while not ended.wait(0.02):
                drone.velocity(forward=0.3)

        hand = threading.Thread(target=hold)
        hand.start()
        try:
            drone.wait("flying", 10.0)
            assert drone.emergency_stop()
            pressed_s = time.monotonic()
            drone.wait("emergency", 8.0)
            assert time.monotonic() - pressed_s < 4.0
        finally:
            ended.set()
            hand.join()
        assert drone.reset_emergency()
        drone.wait("landed", 8.0)
        # It has fallen by then: a take-off during the fall is accepted but does not lift it.
        drone.wait(lambda feedback: max(map(abs, feedback.velocity_m_s or (1.0,))) < 0.1, 10.0)
        drone.takeoff(timeout_s=30.0)
        assert drone.feedback().state in (FlightState.HOVERING, FlightState.FLYING)


def address_of(kind: str, start: Callable[..., Process]) -> str:
    """Start this firmware, and return the address to fly it by."""
    if kind == "tello":
        addresses = Addresses.free()
        start("-m", "skyloop", "sim", "--firmware", kind, "--bind", addresses.drone).until("commands udp")
        return addresses.uri()
    process = start("-m", "skyloop", "sim", "--firmware", kind, "--port-base", "0")
    process.until("ready")
    process.until("\n")
    found = ADDRESS.search(process.text)
    assert found is not None, process.text
    return found[0]
