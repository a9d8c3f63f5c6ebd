"""Drones on threads of this process, and their viewers."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest

from skyloop.client import Drone
from skyloop.client.drone import open_drone
from skyloop.drivers.base import Driver
from skyloop.proxy.proxy import Proxy
from skyloop.transport.memory import MemoryServer
from tests.recording.vehicle import Vehicle

WAIT_S = 10.0
Fly = Callable[..., Drone]


@pytest.fixture
def fly() -> Iterator[Fly]:
    """Creates proxies in this process, with a pilot each."""
    with ExitStack() as stack:

        def one(name: str = "alpha", vehicle: Driver | None = None) -> Drone:
            server = MemoryServer(name)
            stack.enter_context(Proxy(vehicle or Vehicle(), server, name=name))
            drone = open_drone(server.dial, app="me", timeout_s=WAIT_S)
            stack.callback(drone.close)
            return drone

        yield one
