"""The network loses packets, the first ones most often: a node drops those that arrive before it knows the
subscription. Packets that must arrive are sent again."""

from __future__ import annotations

from typing import Any

import pytest

from skyloop.network import FabricServer, FabricSettings, dial
from skyloop.network.client import FabricClient
from skyloop.network.config import free_port
from skyloop.transport.base import FEEDBACK, Peer
from skyloop.transport.testing import ClientLog, ServerLog, wait_until


@pytest.fixture
def lost(monkeypatch: pytest.MonkeyPatch) -> set[tuple[str, bytes, int]]:
    """Each packet is lost when either end sends it for the first time; yields the lost ones."""
    lost: set[tuple[str, bytes, int]] = set()
    for end, put in ((FabricServer, FabricServer._put_to), (FabricClient, FabricClient._put)):

        def puts(self: Any, to: Any, packet: bytes, number: int, put: Any = put) -> bool:
            this = (type(self).__name__, packet, number)
            if this not in lost:
                lost.add(this)
                return True
            return bool(put(self, to, packet, number))

        monkeypatch.setattr(end, put.__name__, puts)
    return lost


def test_lost_packets_arrive_eventually_once_and_in_order(lost: set[tuple[str, bytes, int]]) -> None:
    place = f"127.0.0.1:{free_port('127.0.0.1')}"
    server, log, app_log = (
        FabricServer("alpha", FabricSettings(listen=(place,), multicast=False)),
        ServerLog(),
        ClientLog(),
    )

    def answer(peer: Peer, packet: bytes) -> None:
        server.send(peer, b"answer to " + packet)

    log.on_packet = answer
    server.start(log)
    client = dial("alpha", FabricSettings(connect=(place,), multicast=False))(app_log)
    try:
        questions = [b"question %d" % n for n in range(20)]
        for question in questions:
            assert client.send(question)
        client.subscribe(FEEDBACK)
        wait_until(lambda: len(app_log.packets) == len(questions), "all were answered")
        assert app_log.packets == [b"answer to " + question for question in questions]
        assert log.from_peer(log.joined[0]) == questions
        wait_until(lambda: server.subscribers(FEEDBACK) == 1, "its subscription arrived, too")
    finally:
        client.close()
        server.stop()
    assert {end for end, _, _ in lost} == {"FabricServer", "FabricClient"}
