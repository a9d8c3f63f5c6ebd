"""A flight controller without a landing function lands beside the table from which it took off."""

from __future__ import annotations

import math
from contextlib import ExitStack
from pathlib import Path

import pytest

from skyloop.client.drone import open_drone
from skyloop.drivers.registry import make_driver
from skyloop.proxy import Proxy
from skyloop.sim.host import SimHost
from skyloop.sim.options import SimOptions
from skyloop.transport.memory import MemoryServer
from skyloop.vehicles.msp.emulator import BetaflightFirmware, with_racers

pytestmark = pytest.mark.slow

TABLE = """
room = { size = [12, 8, 6], floor = "concrete", walls = "plaster", ceiling = "plaster" }
spawn = [{ position = [0, 0, 1] }]
box = [{ name = "table", stands_at = [0, 0], size = [1.2, 1.2, 1], texture = "brick" }]
"""


def test_a_landing_over_lower_ground_ends_on_that_ground(tmp_path: Path) -> None:
    """Its altimeter measures from the table: it reads zero a metre above the floor, while the vehicle still flies."""
    (tmp_path / "table.toml").write_text(TABLE)
    world = SimHost(with_racers(SimOptions(world=str(tmp_path / "table.toml"), seed=4, wind=0.0)))
    with ExitStack() as stack:
        firmware = stack.enter_context(BetaflightFirmware(world, port=0))
        server = MemoryServer("v")
        stack.enter_context(Proxy(make_driver(firmware.address), server, name="v"))
        drone = stack.enter_context(open_drone(server.dial, app="me", timeout_s=10.0, on_exit="hover"))
        drone.wait(lambda feedback: feedback.vehicle_link == "up" and feedback.position_m is not None, 60.0)
        drone.takeoff(timeout_s=60.0)
        while world.simulation.truth(0).position_m[0] < 1.5:
            seen = drone.feedback()
            yaw = seen.yaw_rad or 0.0
            drone.velocity(forward=0.7 * math.cos(yaw), left=-0.7 * math.sin(yaw))
            drone.wait(lambda feedback, seen=seen: feedback.captured_ns > seen.captured_ns)  # type: ignore[misc]
        drone.hover()
        drone.land(timeout_s=60.0)
        assert world.simulation.truth(0).position_m[2] < 0.1
        assert drone.feedback().state == "landed"
