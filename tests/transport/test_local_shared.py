"""The local transport with one receiving thread for many servers: the contract, and the effect of a blocked handler."""

from __future__ import annotations

import itertools
import os
import signal
import threading
from collections.abc import Iterator
from functools import partial

import pytest

from skyloop.transport.base import FEEDBACK, Dialer, Peer, TransportServer
from skyloop.transport.composite import CompositeServer
from skyloop.transport.conformance import TransportSuite
from skyloop.transport.local import LocalServer, dial, packets
from skyloop.transport.local.client import LocalClient
from skyloop.transport.local.reactor import Reactor, SharedLocalServer, Source
from skyloop.transport.priority import Lane
from skyloop.transport.testing import PATIENCE_S, ClientLog, ServerLog, wait_until
from tests.support.systems import only_on

pytestmark = pytest.mark.usefixtures("side")
_names = (f"shared-{number}" for number in itertools.count())


class TestShared(TransportSuite):
    @pytest.fixture(autouse=True)
    def reactor(self, side: str) -> Iterator[None]:
        self._reactor = Reactor()
        yield
        self._reactor.close()

    def make_server(self) -> TransportServer:
        return SharedLocalServer(next(_names), self._reactor)

    def dialer(self, server: TransportServer) -> Dialer:
        return dial(server.address.removeprefix("local:"))


class TestSharedInAComposite(TestShared):
    def make_server(self) -> TransportServer:
        return CompositeServer([SharedLocalServer(next(_names), self._reactor)])


class Served:
    """A server of a reactor, its handler's log, and one client."""

    def __init__(self, reactor: Reactor) -> None:
        self.name = next(_names)
        self.server = SharedLocalServer(self.name, reactor)
        self.log = ServerLog()
        self.server.start(self.log)
        self.heard = ClientLog()
        self.client = dial(self.name)(self.heard)
        wait_until(lambda: self.log.joined, "it joined")

    @property
    def packets(self) -> list[bytes]:
        return [packet for _, packet in self.log.packets]

    def got(self, *packets: bytes) -> bool:
        return self.packets == list(packets)

    def close(self) -> None:
        self.client.close()
        self.server.stop()


@pytest.fixture
def reactor(side: str) -> Iterator[Reactor]:
    made = Reactor()
    yield made
    made.close()


def test_a_split_leaves_the_blocked_server_its_thread_and_moves_the_others(reactor: Reactor) -> None:
    stuck, other = Served(reactor), Served(reactor)
    gate, entered, threads = threading.Event(), threading.Event(), set[int]()

    def block(_: Peer, packet: bytes) -> None:
        threads.add(threading.get_ident())
        if packet == b"block":
            entered.set()
            gate.wait(PATIENCE_S)

    stuck.log.on_packet = block
    assert stuck.client.send(b"block")
    assert entered.wait(PATIENCE_S)
    assert reactor.inside is stuck.server
    assert [other.client.send(bytes([number])) for number in range(1, 100)] == [True] * 99
    new = reactor.split(stuck.server)
    wait_until(lambda: other.packets == [bytes([number]) for number in range(1, 100)], "all arrived, in order")
    assert other.server.reactor is new
    assert stuck.server.reactor is reactor
    assert stuck.client.send(b"after")
    gate.set()
    wait_until(lambda: stuck.packets == [b"block", b"after"], "it continues when its handler returns")
    assert len(threads) == 1
    late = ClientLog()
    client = dial(other.name)(late)  # a caller of a moved server
    wait_until(lambda: len(other.log.joined) == 2, "it joined")
    client.close()
    for each in (stuck, other):
        each.close()
    new.close()


def test_packets_that_wait_behind_a_blocked_handler_are_handled_after_the_split(reactor: Reactor) -> None:
    """The blocked thread has received one packet from each connection in its turn, and handles none."""
    servers = [Served(reactor) for _ in range(4)]
    gate, first = threading.Event(), threading.Event()

    def hold(_: Peer, packet: bytes) -> None:
        first.set()
        gate.wait(PATIENCE_S)

    servers[0].log.on_packet = hold
    assert servers[0].client.send(b"hold")
    assert first.wait(PATIENCE_S)
    blocked, gate2 = threading.Event(), threading.Event()

    def block(_: Peer, packet: bytes) -> None:
        blocked.set()
        gate2.wait(PATIENCE_S)

    servers[1].log.on_packet = block
    for server in servers[1:]:  # all are ready in the next turn
        for number in range(3):
            assert server.client.send(bytes([number + 1]))
    gate.set()
    assert blocked.wait(PATIENCE_S)
    new = reactor.split(servers[1].server)
    for server in (servers[2], servers[3]):
        wait_until(partial(server.got, b"\1", b"\2", b"\3"), "in order, and once")
    gate2.set()
    wait_until(lambda: servers[1].packets == [b"\1", b"\2", b"\3"], "its own, too")
    for server in servers:
        server.close()
    new.close()


def test_a_reactor_that_is_split_while_packets_flow_loses_none(reactor: Reactor) -> None:
    servers = [Served(reactor) for _ in range(5)]
    made = [reactor]
    count = 400
    for number in range(count):
        for server in servers:
            while not server.client.send(number.to_bytes(2, "little")):
                pass
        if number % 40 == 20:  # none is blocked: the thread left behind is in the middle of its turn
            made.append(servers[number % 5].server.reactor.split(servers[number % 5].server))
    for server in servers:
        wanted = [number.to_bytes(2, "little") for number in range(count)]
        wait_until(partial(server.got, *wanted), "all, in order, once")
    for server in servers:
        server.close()
    for each in made:
        each.close()


def test_a_silent_connection_is_closed(reactor: Reactor, monkeypatch: pytest.MonkeyPatch) -> None:
    from skyloop.transport.local.directory import find_directory

    monkeypatch.setattr("skyloop.transport.local.reactor.HELLO_S", 0.05)
    server = Served(reactor)
    silent = find_directory().connect(server.name)
    assert b"no Hello" in silent.recv(1000)
    assert silent.recv(1000) == b""
    assert server.client.send(b"here")
    wait_until(lambda: server.packets == [b"here"], "others are unaffected")
    server.close()


def test_without_descriptors_callers_wait_and_packets_do_not(reactor: Reactor, monkeypatch: pytest.MonkeyPatch) -> None:
    server = Served(reactor)
    source = server.server._listening
    assert source is not None
    real, failures = source.sock, []

    class Full:
        def accept(self) -> None:
            failures.append(1)
            raise OSError(24, "Too many open files")

    source.sock = Full()  # type: ignore[assignment]
    log = ClientLog()
    client = dial(server.name)(log)
    wait_until(lambda: failures, "accept was tried")
    assert server.client.send(b"x")
    wait_until(lambda: server.packets == [b"x"], "packets are still handled")
    source.sock = real
    wait_until(lambda: len(server.log.joined) == 2, "the caller is accepted on a retry")
    assert len(failures) < 10, "the thread must not spin"
    client.close()
    server.close()


def test_a_handler_may_stop_another_server_of_its_reactor(reactor: Reactor) -> None:
    one, two = Served(reactor), Served(reactor)
    one.log.on_packet = lambda _, __: two.server.stop()
    assert one.client.send(b"x")
    wait_until(lambda: two.log.left and two.heard.closings, "the other one ended")
    assert one.server.publish(FEEDBACK, b"y") == 0
    one.close()
    two.close()


@pytest.fixture
def served(reactor: Reactor) -> Iterator[Served]:
    made = Served(reactor)
    yield made
    made.close()


def test_a_connection_that_can_not_be_received_from_ends_with_the_reason(served: Served) -> None:
    (connection,) = served.server._served

    def fail(*_: object) -> bytes:
        raise OSError(5, "Input/output error")

    connection.receive = fail
    served.client.send(b"lost")
    wait_until(lambda: served.log.left, "it left")
    assert served.log.left[0][1] == "receiving failed: [Errno 5] Input/output error"
    assert served.packets == []


def test_a_wake_packet_is_ignored(served: Served) -> None:
    client = served.client
    assert isinstance(client, LocalClient)
    assert client._socket is not None
    client._socket.send(packets.WAKE)
    assert client.send(b"next")
    wait_until(lambda: served.packets, "the next packet")
    assert served.packets == [b"next"]


def test_a_socket_dropped_during_the_turn_is_left_alone(served: Served, reactor: Reactor) -> None:
    """A reactor's turn may include sockets that another thread has closed or moved."""
    (connection,) = served.server._served
    ended, empty = Source(served.server, connection=connection), Source(served.server, connection=connection)
    ended.ended = True
    assert not served.server.receive(reactor, ended, at_once=False)
    assert served.server.deliver(reactor, ended, Lane.STEERING) is None
    empty.lane = Lane.STEERING
    assert served.server.deliver(reactor, empty, Lane.STEERING) is None
    assert empty.lane is None
    served.server.end_silent(reactor, empty, empty.since_s)
    assert served.client.send(b"goes on")
    wait_until(lambda: served.packets, "a packet")
    assert served.got(b"goes on")


def test_a_server_stops_after_its_reactor_has_ended() -> None:
    """It waited forever for its connections, or raised because the reactor's epoll was closed."""
    reactor = Reactor()
    served = Served(reactor)
    reactor.close()
    served.server.stop()
    wait_until(lambda: bool(served.heard.closings), "the client is notified")
    assert served.log.left
    assert reactor.empty
    served.client.close()


@only_on("linux", "darwin", reason="no process forks")
@pytest.mark.parametrize("shared", [True, False])
def test_a_fork_that_stops_its_copy_leaves_the_server_to_its_parent(reactor: Reactor, shared: bool) -> None:
    import warnings

    server = SharedLocalServer("alpha", reactor) if shared else LocalServer("alpha")
    server.start(ServerLog())
    before = dial("alpha")(ClientLog())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # about forks beside threads, from Python 3.12
        child = os.fork()
    if child == 0:
        signal.alarm(20)  # ends it if it hangs
        server.stop()
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    before.send(packets.hello())
    client = dial("alpha")(ClientLog())
    client.close()
    before.close()
    server.stop()
