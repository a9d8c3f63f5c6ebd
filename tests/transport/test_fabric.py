"""The fabric transport keeps the contract of all transports, over TCP and UDP on the loopback interface."""

from __future__ import annotations

import itertools

from skyloop.messages import LogEntry, encode
from skyloop.transport.base import FEEDBACK, Dialer, TransportServer
from skyloop.transport.conformance import TransportSuite
from skyloop.transport.fabric import FabricServer, FabricSettings, dial, layout
from skyloop.transport.fabric.client import FabricClient
from skyloop.transport.fabric.config import free_port
from skyloop.transport.fabric.delivery import Outgoing
from skyloop.transport.fabric.session import Session
from skyloop.transport.testing import ClientLog, ServerLog, wait_until

_numbers = itertools.count(1)


class TestFabric(TransportSuite):
    def make_server(self) -> TransportServer:
        self.place = f"127.0.0.1:{free_port('127.0.0.1')}"
        self.name = f"proxy{next(_numbers)}"
        return FabricServer(self.name, FabricSettings(listen=(self.place,), multicast=False))

    def dialer(self, server: TransportServer) -> Dialer:
        return dial(self.name, FabricSettings(connect=(self.place,), multicast=False))


def test_after_an_end_that_nobody_announced_another_session_is_used() -> None:
    """The old one may be half forgotten at the other end, and then finds nobody or gets no answers."""
    settings = FabricSettings(listen=(f"127.0.0.1:{free_port('127.0.0.1')}",), multicast=False)
    dialer = dial("alpha", FabricSettings(connect=settings.listen, multicast=False))

    def serve_once(session: Session | None) -> Session:
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
            assert client.session is first, "an end that both know of is none"
            found = server._session
            assert found is not None
            found.close()  # as the network would
            wait_until(lambda: len(log.closings) == 2, "the connection has ended")
            return first
        finally:
            server.stop()

    serve_once(serve_once(None))


def test_a_subscription_arrives_where_much_waits_before_it() -> None:
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
        wait_until(lambda: server.subscribers(FEEDBACK) == 1, "the proxy knows of it")
        client._outgoing = Outgoing(depth=0)
        client.subscribe(FEEDBACK, False)
        wait_until(lambda: bool(log.closings), "a connection that can't tell the proxy has ended")
        assert "the subscription to 'feedback' can't be sent" in log.closings[0]
        client.close()
    finally:
        server.stop()
