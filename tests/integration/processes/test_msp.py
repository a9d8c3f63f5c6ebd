"""Betaflight across processes (emulated firmware, proxy and pilot), and the failures between them."""

from __future__ import annotations

import signal
from collections.abc import Callable

import pytest

import skyloop
from skyloop.messages import Failsafe, FlightState, LinkState
from tests.support.processes import PILOTS, Process, eventually

pytestmark = [pytest.mark.process, pytest.mark.timeout(240)]


@pytest.fixture
def firmware(start: Callable[..., Process]) -> Callable[..., tuple[Process, str]]:
    """Start an emulated Betaflight; returns it with its address."""

    def begin(port: str = "0") -> tuple[Process, str]:
        process = start("-m", "skyloop", "sim", "--firmware", "betaflight", "--world", "empty", "--port-base", port)
        process.until("msp://")
        return process, next(line.split()[-1] for line in process.text.splitlines() if "msp://" in line)

    return begin


def test_a_killed_pilot_leaves_it_hovering_and_then_landing(
    firmware: Callable[..., tuple[Process, str]], proxy: Callable[..., Process], start: Callable[..., Process]
) -> None:
    _, address = firmware()
    proxy(address)
    with skyloop.connect("alpha", access="observe") as observer:
        observer.wait("landed", timeout_s=30.0)
        pilot = start(PILOTS, "fly", "alpha")
        pilot.until("flying", 40.0)
        observer.wait(lambda feedback: (feedback.velocity_m_s or (0.0,))[0] > 0.2, timeout_s=30.0)
        pilot.signal(signal.SIGKILL)
        observer.wait(lambda feedback: feedback.failsafe is Failsafe.HOVER, timeout_s=10.0)
        observer.wait("hovering", timeout_s=30.0)
        observer.wait(lambda feedback: feedback.failsafe is Failsafe.LAND, timeout_s=10.0)
        observer.wait("landed", timeout_s=40.0)
        observer.wait(lambda feedback: (feedback.native or {}).get("armed") is False, timeout_s=20.0)


def test_firmware_that_restarts_in_flight_is_found_again_and_can_be_flown(
    firmware: Callable[..., tuple[Process, str]], proxy: Callable[..., Process]
) -> None:
    first, address = firmware()
    proxy(address)
    with skyloop.connect("alpha") as drone:
        drone.wait("landed", timeout_s=30.0)
        drone.takeoff(timeout_s=40.0)
        first.signal(signal.SIGKILL)
        first.wait()
        eventually(lambda: drone.link.vehicle is LinkState.LOST, "the loss is told")
        firmware(address.rpartition(":")[2])
        eventually(lambda: drone.link.vehicle is LinkState.UP, "it is found again")
        eventually(lambda: drone.feedback().state is FlightState.LANDED, "a drone just switched on stands")
        drone.takeoff(timeout_s=40.0)
        drone.land(timeout_s=40.0)
