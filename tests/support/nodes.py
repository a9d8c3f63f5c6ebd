"""A proxy with a fake vehicle, over a network or in this process."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from skyloop.client import Drone, Frame
from skyloop.client.drone import open_drone
from skyloop.network import FabricServer, FabricSettings, dial
from skyloop.network.config import free_port
from skyloop.proxy.proxy import Proxy
from skyloop.transport.base import Dialer, TransportServer
from skyloop.transport.memory import MemoryServer
from tests.support.fake_vehicle import FakeVehicle

WAIT_S = 10.0


class Node:
    """A proxy with a fake vehicle, and how it is reached."""

    def __init__(self, server: TransportServer, dialer: Dialer) -> None:
        self.vehicle = FakeVehicle()
        self.dialer = dialer
        self.proxy = Proxy(self.vehicle, server, name="alpha")

    @contextmanager
    def connected(self, **options: Any) -> Iterator[Drone]:
        with open_drone(self.dialer, app="me", **options) as drone:
            yield drone


def far_node() -> Node:
    place = f"127.0.0.1:{free_port('127.0.0.1')}"
    server = FabricServer("alpha", FabricSettings(listen=(place,), multicast=False))
    return Node(server, dial("alpha", FabricSettings(connect=(place,), multicast=False)))


def near_node() -> Node:
    server = MemoryServer("alpha")
    return Node(server, server.dial)


@pytest.fixture(params=[far_node, near_node], ids=["network", "one process"])
def node(request: pytest.FixtureRequest) -> Iterator[Node]:
    """Code behaves alike wherever the proxy is."""
    made: Node = request.param()
    with made.proxy:
        yield made


@pytest.fixture
def far() -> Iterator[Node]:
    made = far_node()
    with made.proxy:
        yield made


def take(frames: Iterator[Frame], count: int) -> list[Frame]:
    return list(itertools.islice(frames, count))
