"""The memory transport keeps the contract, and the same seed gives exactly the same faults."""

from __future__ import annotations

import pytest

from skyloop.errors import UsageError
from skyloop.transport.base import FEEDBACK, Dialer, TransportServer, video
from skyloop.transport.conformance import TransportSuite
from skyloop.transport.memory import DEPTH, Faults, MemoryServer
from skyloop.transport.testing import FRONT, ClientLog, ServerLog, header, picture, wait_until


class TestMemory(TransportSuite):
    def make_server(self) -> TransportServer:
        return MemoryServer("test")

    def dialer(self, server: TransportServer) -> Dialer:
        assert isinstance(server, MemoryServer)
        return server.dial


def received(faults: Faults, count: int = 200) -> tuple[list[bytes], list[bytes], list[int]]:
    """Return what arrives of ``count`` packets in each direction and frames."""
    server, log, client_log = MemoryServer(faults=faults), ServerLog(), ClientLog(keep=False)
    server.start(log)
    client = server.dial(client_log)
    client.subscribe(FEEDBACK)
    client.subscribe(video(FRONT))
    for number in range(count):
        packet = number.to_bytes(2, "little") + b"-" * 30
        client.send(packet)
        assert server.publish(FEEDBACK, packet) == 0
    for seq in range(4):
        server.publish_frame(header(seq), picture(header(seq)))
    wait_until(lambda: not client.outgoing, "the server got them")
    server.stop()
    wait_until(lambda: client_log.closings, "the client got them")
    return [packet for _, packet in log.packets], client_log.packets, client_log.seen


def test_without_faults_everything_arrives() -> None:
    up, down, frames = received(Faults(seed=1))
    assert [p[0] for p in down] == [n % 256 for n in range(200)]
    assert up == down
    assert frames == [0, 1, 2, 3]


def test_drop_loses_some_and_keeps_the_order() -> None:
    _, down, _ = received(Faults(seed=1, drop=0.3))
    assert 110 < len(down) < 170
    assert down == sorted(down)


def test_duplicate_repeats_some() -> None:
    _, down, _ = received(Faults(seed=1, duplicate=0.1))
    assert len(set(down)) == 200
    assert 205 < len(down) < 240


def test_reorder_swaps_some_and_loses_none() -> None:
    _, down, _ = received(Faults(seed=1, reorder=0.2))
    assert len(set(down)) == len(down) >= 199  # the last one may still be held back
    assert down != sorted(down)


def test_corrupt_flips_one_bit() -> None:
    _, down, _ = received(Faults(seed=1, corrupt=0.5))
    damaged = 0
    for number, packet in enumerate(down):
        whole = number.to_bytes(2, "little") + b"-" * 30
        difference = int.from_bytes(packet, "big") ^ int.from_bytes(whole, "big")
        assert difference.bit_count() <= 1
        damaged += difference != 0
    assert 70 < damaged < 130


def test_the_same_seed_gives_the_same_faults() -> None:
    faults = Faults(seed=5, drop=0.1, duplicate=0.1, reorder=0.1, corrupt=0.1)
    assert received(faults)[1] == received(faults)[1]
    assert received(faults)[1] != received(Faults(seed=6, drop=0.1, duplicate=0.1, reorder=0.1, corrupt=0.1))[1]


def test_a_probability_is_checked() -> None:
    with pytest.raises(UsageError, match=r"drop is 1\.5"):
        Faults(drop=1.5)


def test_the_queue_is_bounded() -> None:
    server, client_log = MemoryServer(), ClientLog()
    server.start(ServerLog())
    client_log.gate.clear()
    client = server.dial(client_log)
    client.subscribe(FEEDBACK)
    missed = sum(server.publish(FEEDBACK, b"x") for _ in range(DEPTH + 50))
    assert 49 <= missed <= 50  # one may already have been taken out
    client_log.gate.set()
    client.close()
    server.stop()


def test_the_server_can_be_restarted() -> None:
    server = MemoryServer()
    for _ in range(2):
        serve_once(server)


def serve_once(server: MemoryServer) -> None:
    log, client_log = ServerLog(), ClientLog()
    server.start(log)
    client = server.dial(client_log)
    assert client.same_clock
    client.send(b"x")
    wait_until(lambda: log.packets, "the packet arrived")
    server.stop()
    wait_until(lambda: client_log.closings, "the client was notified")
