"""A vehicle that accepts only velocities is landed in software while its link is out."""

from __future__ import annotations

import threading
import time
from contextlib import suppress

import pytest

from skyloop.client.drone import open_drone
from skyloop.drivers.registry import make_driver
from skyloop.errors import SkyloopError
from skyloop.proxy import Proxy
from skyloop.transport.memory import MemoryServer
from skyloop.transport.testing import wait_until

pytestmark = pytest.mark.slow

LONG_S = 30.0
OUT_S = 17.0  #: longer than any landing from one metre takes


def test_it_is_not_reported_as_landed_until_it_stands() -> None:
    server = MemoryServer("v")
    driver = make_driver("sim://?native=velocity&cameras=none&noise=0&wind=0&world=empty")
    with Proxy(driver, server, name="v") as proxy, open_drone(server.dial, app="me", on_exit="hover") as drone:
        states: list[str] = []
        drone.on_feedback(lambda feedback: states.append(feedback.state.value))
        drone.takeoff()

        def land() -> None:
            with suppress(SkyloopError):
                drone.land(timeout_s=LONG_S)

        landing = threading.Thread(target=land)
        landing.start()
        drone.wait("landing")
        driver.set_parameter("sim.link", False)
        deadline = time.monotonic() + OUT_S
        while time.monotonic() < deadline:
            states.clear()
            wait_until(lambda: len(states) > 1, "feedback goes on")
            assert "landed" not in states
            assert proxy.handler.airborne
        driver.set_parameter("sim.link", True)
        drone.wait("landed", timeout_s=LONG_S)
        altitude = drone.feedback().altitude_m
        assert altitude is not None
        assert altitude < 0.1
        landing.join(LONG_S)
