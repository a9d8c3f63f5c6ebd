"""A composite of transport servers keeps the contract and numbers the applications of all of them."""

from __future__ import annotations

import itertools

import pytest

from skyloop.errors import NameTakenError, UsageError
from skyloop.transport.base import FEEDBACK, Dialer, ServerHandler, TransportServer
from skyloop.transport.composite import CompositeServer
from skyloop.transport.conformance import TransportSuite
from skyloop.transport.memory import MemoryServer
from skyloop.transport.testing import ClientLog, ServerLog, wait_until


class TestCompositeBySecondEnd(TransportSuite):
    """One end works as if there were no other."""

    def make_server(self) -> TransportServer:
        self.end = MemoryServer("near")
        return CompositeServer([MemoryServer("no client connects here"), self.end])

    def dialer(self, server: TransportServer) -> Dialer:
        return self.end.dial


class TestCompositeByTurns(TransportSuite):
    """Applications connect to one server through different ends."""

    def make_server(self) -> TransportServer:
        self.ends = itertools.cycle(ends := [MemoryServer("one"), MemoryServer("two")])
        return CompositeServer(ends)

    def dialer(self, server: TransportServer) -> Dialer:
        return next(self.ends).dial


def test_peers_are_numbered_over_all_ends() -> None:
    ends = [MemoryServer("one"), MemoryServer("two")]
    server, log = CompositeServer(ends), ServerLog()
    server.start(log)
    clients = [end.dial(ClientLog()) for end in (*ends, *ends)]
    wait_until(lambda: len(log.joined) == 4, "all joined")
    assert sorted(peer.id for peer in log.joined) == [1, 2, 3, 4]
    clients[0].subscribe(FEEDBACK)
    clients[3].subscribe(FEEDBACK)
    assert server.subscribers(FEEDBACK) == 2
    server.stop()
    assert len(log.left) == 4
    assert server.address == "memory:one, memory:two"


class Taken(MemoryServer):
    def start(self, handler: ServerHandler) -> None:
        raise NameTakenError("the name is taken")


def test_an_end_that_cannot_start_stops_the_others() -> None:
    first = MemoryServer("first")
    with pytest.raises(NameTakenError):
        CompositeServer([first, Taken("second")]).start(ServerLog())
    first.start(ServerLog())  # it was stopped, so it can be started again
    first.stop()


def test_a_composite_without_ends_is_refused() -> None:
    with pytest.raises(UsageError, match="at least one"):
        CompositeServer([])
