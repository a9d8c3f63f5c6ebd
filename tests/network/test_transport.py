"""The transport contract, checked for the fabric transport over TCP and UDP on the loopback interface."""

from __future__ import annotations

import itertools
import threading
from types import SimpleNamespace

import pytest

from skyloop.errors import LinkError
from skyloop.messages import LogEntry, encode
from skyloop.network import FabricServer, FabricSettings, dial, layout, packets
from skyloop.network import server as fabric_server
from skyloop.network.client import FabricClient
from skyloop.network.config import free_port
from skyloop.network.connection import Publisher
from skyloop.network.delivery import Outgoing
from skyloop.network.sealing import PLAIN
from skyloop.network.session import FabricSession, release
from skyloop.transport.base import FEEDBACK, Dialer, TransportServer
from skyloop.transport.conformance import TransportSuite
from skyloop.transport.testing import ClientLog, ServerLog, wait_until

_numbers = itertools.count(1)


class TestFabric(TransportSuite):
    def make_server(self) -> TransportServer:
        self.place = f"127.0.0.1:{free_port('127.0.0.1')}"
        self.name = f"proxy{next(_numbers)}"
        return FabricServer(self.name, FabricSettings(listen=(self.place,), multicast=False))

    def dialer(self, server: TransportServer) -> Dialer:
        return dial(self.name, FabricSettings(connect=(self.place,), multicast=False))


def test_after_an_unannounced_end_another_session_is_used() -> None:
    """The old one may be half forgotten at the other end, and then finds no proxy or gets no answers."""
    settings = FabricSettings(listen=(f"127.0.0.1:{free_port('127.0.0.1')}",), multicast=False)
    dialer = dial("alpha", FabricSettings(connect=settings.listen, multicast=False))

    def serve_once(session: FabricSession | None) -> FabricSession:
        server, log = FabricServer("alpha", settings), ClientLog()
        server.start(ServerLog())
        try:
            client = dialer(log)
            assert isinstance(client, FabricClient)
            assert session is None or client.session is not session
            first = client.session
            client.close()
            client = dialer(log)
            assert isinstance(client, FabricClient)
            assert client.session is first, "an announced end does not count"
            found = server._session
            assert found is not None
            found.close()  # as the network would
            wait_until(lambda: len(log.closings) == 2, "the connection has ended")
            return first
        finally:
            server.stop()

    serve_once(serve_once(None))


def test_a_failed_start_leaves_neither_session_nor_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """The network refused a declaration, and the session stayed open with its threads."""
    settings = FabricSettings(listen=(f"127.0.0.1:{free_port('127.0.0.1')}",), multicast=False)
    released: list[FabricSession] = []

    def counted(session: FabricSession, *, linger: bool) -> None:
        released.append(session)
        release(session, linger=linger)

    monkeypatch.setattr(fabric_server, "release", counted)
    real = layout.join

    def refuse(*where: str) -> str:
        if where[1:] == ("*", "*"):
            raise LinkError("no declaration is taken")
        return real(*where)

    with monkeypatch.context() as refusing:
        refusing.setattr(layout, "join", refuse)
        server = FabricServer("leaky", settings)
        with pytest.raises(LinkError, match="no declaration"):
            server.start(ServerLog())
    assert len(released) == 1
    assert not [thread.name for thread in threading.enumerate() if "leaky" in thread.name]
    assert server._session is None
    assert server._declared == []
    again = FabricServer("leaky", settings)  # port and name are free
    again.start(ServerLog())
    again.stop()


def test_form_names_are_forgotten_with_their_last_reader() -> None:
    """Each new size of a camera's images left a topic behind for the life of the proxy."""
    publisher = Publisher("alpha", "0" * 16, PLAIN)
    publisher.video.topic_problem = lambda _: ""
    connection = SimpleNamespace(
        id=1, lock=threading.Lock(), ended=False, left=False, topics=dict[str, int](), paces=dict[str, object]()
    )
    for scale in range(100, 150):
        topic = f"video/front?scale=0.{scale}"
        for on in (True, False):
            assert publisher.subscribe(connection, packets.Subscribe(topic, on))  # type: ignore[arg-type]
    assert publisher._numbers == {}
    assert publisher._subscribed == {}
    publisher.video.end()


def test_a_subscription_arrives_despite_a_backlog() -> None:
    settings = FabricSettings(listen=(f"127.0.0.1:{free_port('127.0.0.1')}",), multicast=False)
    server = FabricServer("alpha", settings)
    server.start(ServerLog())
    try:
        client = dial("alpha", FabricSettings(connect=settings.listen, multicast=False))(log := ClientLog())
        assert isinstance(client, FabricClient)
        with client._lock:
            while client._outgoing.put(encode(LogEntry("app", "height", 0, number=1.0)), layout.ASK):
                pass
        client.subscribe(FEEDBACK)
        wait_until(lambda: server.subscribers(FEEDBACK) == 1, "the proxy has it")
        client._outgoing = Outgoing(depth=0)
        client.subscribe(FEEDBACK, False)
        wait_until(lambda: bool(log.closings), "a connection that can't send it has ended")
        assert "the subscription to 'feedback' can't be sent" in log.closings[0]
        client.close()
    finally:
        server.stop()
