"""The control port from the driver's side: refusing, slow, interrupted, and working."""

from __future__ import annotations

import selectors
import socket
from collections.abc import Iterator

import pytest

from skyloop.clock import NS_PER_S
from skyloop.vehicles.ardrone.configuration import Configurator, Exchange, Read
from skyloop.vehicles.ardrone.link import RETRY_NS, DumpClient

DUMP = b"control:outdoor = TRUE\n\0"


class Bench:
    """A client with its server loop, and the drone's end of the connection."""

    def __init__(self, *, listening: bool = True) -> None:
        self.server = socket.create_server(("127.0.0.1", 0))
        port = self.server.getsockname()[1]
        if not listening:
            self.server.close()
        self.selector = selectors.DefaultSelector()
        self.client = DumpClient(port, self.selector, lambda: None)
        self.client.address = "127.0.0.1"
        self.configurator = Configurator()
        self.results: list[str | None] = []
        self.now_ns = 10 * NS_PER_S
        self.read()

    def read(self) -> None:
        self.configurator.submit(Exchange(iter((Read(),)), 99 * NS_PER_S, self.results.append))
        self.configurator.messages(self.now_ns)

    def follow(self) -> None:
        self.client.follow(self.configurator, self.now_ns)

    def serve(self) -> None:
        """Wait until the connection is ready, and serve it."""
        assert self.selector.select(5.0)
        self.client.serve(self.configurator)

    def connected(self) -> socket.socket:
        self.follow()
        connection, _ = self.server.accept()
        self.serve()
        assert self.configurator.messages(self.now_ns) == [("CTRL", (4, 0))]
        return connection

    def close(self) -> None:
        self.client.close()
        self.selector.close()
        self.server.close()


@pytest.fixture
def bench() -> Iterator[Bench]:
    made = Bench()
    yield made
    made.close()


def test_a_dump_in_pieces(bench: Bench) -> None:
    with bench.connected() as drone:
        drone.sendall(DUMP[:10])
        bench.serve()
        assert bench.results == []
        drone.sendall(DUMP[10:])
        bench.serve()
        assert bench.results == [None]
        assert bench.configurator.values == {"control:outdoor": "TRUE"}
        assert drone.recv(1) == b"", "the connection is closed"


def test_a_connection_that_ends_early_is_retried(bench: Bench) -> None:
    bench.connected().close()
    bench.serve()
    assert "the connection ended early" in bench.configurator.trouble
    bench.follow()
    assert not bench.selector.get_map(), "not immediately"
    bench.now_ns += RETRY_NS
    with bench.connected() as drone:
        drone.sendall(DUMP)
        bench.serve()
    assert bench.results == [None]
    assert bench.configurator.trouble == ""


def test_a_port_that_refuses() -> None:
    bench = Bench(listening=False)
    bench.follow()
    if not bench.configurator.trouble:  # the refusal may show at once or a moment later
        bench.serve()
    assert "Connection refused" in bench.configurator.trouble
    assert f"TCP port {bench.client._port}" in bench.configurator.trouble
    bench.close()


def test_a_drone_without_an_address_yet(bench: Bench) -> None:
    bench.client.address = "no address at all"
    bench.follow()
    assert bench.configurator.trouble
    assert not bench.selector.get_map()


def test_a_connection_is_closed_when_no_longer_needed(bench: Bench) -> None:
    with bench.connected() as drone:
        bench.configurator.abandon("gone")
        bench.follow()
        assert drone.recv(1) == b""
    bench.client.serve(bench.configurator)  # a late event has no effect


def test_a_later_dump_gets_a_new_connection(bench: Bench) -> None:
    with bench.connected() as old:
        bench.configurator.abandon("gone")
        bench.read()
        with bench.connected() as new:
            assert old.recv(1) == b""
            new.sendall(DUMP)
            bench.serve()
    assert bench.results == ["gone", None]


def test_a_connection_that_is_reset(bench: Bench) -> None:
    drone = bench.connected()
    drone.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\x01\x00\x00\x00\x00\x00\x00\x00")
    drone.close()
    bench.serve()
    assert "reset" in bench.configurator.trouble
