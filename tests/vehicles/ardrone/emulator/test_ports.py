"""The emulated drone's ports: slow and broken clients, datagrams with faults, and the loop that serves them."""

from __future__ import annotations

import itertools
import logging
import socket
import threading
from collections.abc import Iterator
from functools import partial

import pytest

from skyloop.clock import monotonic_ns
from skyloop.errors import LinkError
from skyloop.faults import Faults
from skyloop.transport.testing import wait_until
from skyloop.vehicles.ardrone.emulator import MOST_BACKLOG, MOST_CLIENTS, StreamPort
from skyloop.vehicles.emulation.emulator import Address, DatagramPort, Loop

HERE = "127.0.0.1"
KEY_EVERY = 15


@pytest.fixture
def loop() -> Iterator[Loop]:
    made = Loop("test")
    yield made
    made.stop()


@pytest.fixture
def stream(loop: Loop) -> Iterator[StreamPort]:
    made = StreamPort(loop, (HERE, 0), name="video")
    yield made
    loop.stop()
    made.close()


def done(loop: Loop) -> None:
    """Wait until the loop has run all earlier jobs."""
    passed = threading.Event()
    loop.post(passed.set)
    assert passed.wait(5)


# Loop ----------------------------------------------------------------------------------------------------------


def test_callbacks_run_in_the_order_of_their_times(loop: Loop) -> None:
    order: list[str] = []
    now_ns = monotonic_ns()
    loop.at(now_ns + 20_000_000, lambda: order.append("third"))
    loop.at(now_ns + 10_000_000, lambda: order.append("second"))
    loop.post(lambda: order.append("first"))
    loop.start()
    wait_until(lambda: len(order) == 3, "all is done")
    assert order == ["first", "second", "third"]
    assert monotonic_ns() >= now_ns + 20_000_000


def test_an_error_does_not_end_the_loop(loop: Loop, caplog: pytest.LogCaptureFixture) -> None:
    loop.start()
    with caplog.at_level(logging.ERROR):
        loop.post(lambda: 1 // 0)  # type: ignore[arg-type]
        done(loop)
    assert "ZeroDivisionError" in caplog.text


# Streams -------------------------------------------------------------------------------------------------------


def test_a_slow_client_stalls_no_other_and_continues_with_a_key_frame(loop: Loop, stream: StreamPort) -> None:
    loop.start()
    address = HERE, stream.port
    size, numbers = 20_000, itertools.count()
    with socket.create_connection(address, 5) as slow, socket.create_connection(address, 5) as fast:
        wait_until(lambda: len(stream.outlets) == 2, "both are connected")

        def send(count: int) -> None:
            for n in itertools.islice(numbers, count):
                piece = bytes([n % 256]) * size
                loop.post(partial(stream.broadcast, piece, starts=n % KEY_EVERY == 0))
                assert read(fast, size) == piece
            done(loop)

        many = 8 * MOST_BACKLOG // size
        send(many)
        kept = many - stream.outlets[0].dropped
        assert kept < many
        heard = [read(slow, size) for _ in range(kept)]
        send(2 * KEY_EVERY)
        heard += [read(slow, size) for _ in range(many + 2 * KEY_EVERY - stream.outlets[0].dropped - kept)]
    assert all(len(set(piece)) == 1 for piece in heard), "whole pieces only"
    gaps = [after[0] for before, after in itertools.pairwise(heard) if after[0] != before[0] + 1]
    assert gaps
    assert all(gap % KEY_EVERY == 0 for gap in gaps)
    assert len(heard) >= kept + KEY_EVERY


def read(client: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size:
        data += client.recv(size - len(data))
    return data


def test_clients_may_send_anything_and_leave(loop: Loop, stream: StreamPort) -> None:
    loop.start()
    with socket.create_connection((HERE, stream.port), 5) as client:
        wait_until(lambda: stream.outlets, "it is connected")
        client.sendall(bytes(range(256)) * 40)
        loop.post(lambda: stream.broadcast(b"hello"))
        assert read(client, 5) == b"hello"
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")  # leave with a reset
    wait_until(lambda: not stream.outlets, "it is gone")


def test_too_many_clients_are_turned_away(loop: Loop, stream: StreamPort) -> None:
    loop.start()
    clients = [socket.create_connection((HERE, stream.port), 5) for _ in range(MOST_CLIENTS)]
    try:
        wait_until(lambda: len(stream.outlets) == MOST_CLIENTS, "all are connected")
        with socket.create_connection((HERE, stream.port), 5) as extra:
            assert extra.recv(1) == b""
    finally:
        for client in clients:
            client.close()


def test_a_port_in_use_is_named(loop: Loop) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind((HERE, 0))
        port = other.getsockname()[1]
        with pytest.raises(LinkError, match=f"AT port, UDP {port} on 127.0.0.1"):
            DatagramPort(loop, (HERE, port), lambda *_: None, name="AT", faults=Faults(), delay_s=0.0)


# Datagrams -----------------------------------------------------------------------------------------------------


def echoed(faults: Faults, count: int, delay_s: float = 0.0) -> tuple[list[int], list[int]]:
    """Return what a port receives of this many datagrams, and what the sender receives of the answers."""
    loop, heard = Loop("test"), list[int]()

    def answer(datagram: bytes, sender: Address) -> None:
        heard.append(datagram[0])
        port.send(datagram, sender)

    port = DatagramPort(loop, (HERE, 0), answer, name="test", faults=faults, delay_s=delay_s)
    loop.start()
    answers = []
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
            client.settimeout(0.3)
            for n in range(count):
                client.sendto(bytes([n]), (HERE, port.port))
                done(loop)
            while True:
                try:
                    answers.append(client.recv(9)[0])
                except TimeoutError:
                    return heard, answers
    finally:
        loop.stop()
        port.close()


def test_without_faults_everything_arrives_unchanged() -> None:
    assert echoed(Faults(), 50) == (list(range(50)), list(range(50)))


def test_faults_affect_both_directions_and_depend_on_the_seed() -> None:
    faults = Faults(seed=3, drop=0.2, duplicate=0.2, reorder=0.2)
    heard, answers = echoed(faults, 100)
    assert echoed(faults, 100) == (heard, answers)
    assert set(heard) < set(range(100))
    assert len(heard) > len(set(heard))
    assert heard != sorted(heard)
    assert set(answers) < set(heard)


def test_delays_apply_in_both_directions() -> None:
    loop = Loop("test")
    port = DatagramPort(
        loop, (HERE, 0), lambda data, sender: port.send(data, sender), name="test", faults=Faults(), delay_s=0.03
    )
    loop.start()
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client:
            client.settimeout(5)
            sent_ns = monotonic_ns()
            client.sendto(b"x", (HERE, port.port))
            assert client.recv(9) == b"x"
            assert monotonic_ns() - sent_ns >= 60_000_000
    finally:
        loop.stop()
        port.close()
