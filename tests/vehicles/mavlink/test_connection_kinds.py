"""Connections to a vehicle: a listening port, one that sends first, TCP, and a serial line."""

from __future__ import annotations

import os
import select
import socket
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import replace

import pytest

from skyloop.drivers.uri import parse_uri
from skyloop.errors import MissingExtraError
from skyloop.transport.testing import wait_until
from skyloop.vehicles.mavlink.link import MavlinkConnection, SerialPort, open_connection
from skyloop.vehicles.mavlink.options import Address, ConnectionKind, options_of
from skyloop.vehicles.mavlink.protocol import Packet
from tests.support.systems import only_on

LOCAL = "127.0.0.1"


def came(connection: MavlinkConnection) -> bytes:
    """Return all bytes that arrive shortly, waiting for the first."""
    assert select.select([connection], [], [], 5.0)[0], "nothing arrives"
    return b"".join(data for data, _ in connection.receive())


@contextmanager
def by_tcp() -> Iterator[tuple[MavlinkConnection, socket.socket]]:
    """Our end, and the vehicle's."""
    with (
        socket.create_server((LOCAL, 0)) as server,
        closing(open_connection(Address(ConnectionKind.TCP, LOCAL, server.getsockname()[1]))) as ours,
        server.accept()[0] as vehicle,
    ):
        yield ours, vehicle


@pytest.fixture
def line() -> Iterator[tuple[int, str]]:
    """A serial line: its far end, and the local device."""
    import tty

    far, near = os.openpty()
    tty.setraw(near)
    yield far, os.ttyname(near)
    os.close(near)
    os.close(far)


@pytest.mark.skipif(not socket.has_ipv6, reason="there is no IPv6 here")
@pytest.mark.parametrize(("family", "local"), [(socket.AF_INET6, "::1"), (socket.AF_INET, LOCAL)])
def test_an_ipv6_port_receives_and_answers_both_kinds_of_vehicles(family: int, local: str) -> None:
    address = options_of(parse_uri("mavlink://udpin:[::]:14550")).address
    assert str(address) == "udpin:[::]:14550"
    try:
        ours = open_connection(replace(address, number=0))
    except OSError as error:
        pytest.skip(f"there is no IPv6 here: {error}")
    with closing(ours), socket.socket(family, socket.SOCK_DGRAM) as vehicle:
        with socket.socket(fileno=os.dup(ours.fileno())) as same:
            port = same.getsockname()[1]
        vehicle.bind((local, 0))
        vehicle.sendto(b"heartbeat", (local, port))
        assert select.select([ours], [], [], 5.0)[0]
        [(data, peer)] = ours.receive()
        assert (data, peer) == (b"heartbeat", (local, vehicle.getsockname()[1]))
        ours.send(Packet(b"answer", peer))
        vehicle.settimeout(5.0)
        assert vehicle.recv(100) == b"answer"


@pytest.mark.skipif(not socket.has_ipv6, reason="there is no IPv6 here")
def test_a_sender_reaches_an_ipv6_host() -> None:
    with socket.socket(socket.AF_INET6, socket.SOCK_DGRAM) as vehicle:
        try:
            vehicle.bind(("::1", 0))
        except OSError as error:
            pytest.skip(f"there is no IPv6 here: {error}")
        vehicle.settimeout(5.0)
        with closing(open_connection(Address(ConnectionKind.UDP_OUT, "::1", vehicle.getsockname()[1]))) as ours:
            ours.send(Packet(b"first", None))
            data, source = vehicle.recvfrom(100)
            assert data == b"first"
            vehicle.sendto(b"answer", source)
            assert came(ours) == b"answer"


def test_a_listening_port_answers_the_sender() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle:
        vehicle.bind((LOCAL, 0))
        ours = open_connection(Address(ConnectionKind.UDP_IN, LOCAL, 0))
        try:
            assert ours.receive() == []
            ours.send(Packet(b"to nobody yet", None))
            with socket.socket(fileno=os.dup(ours.fileno())) as same:
                port = same.getsockname()[1]
            vehicle.sendto(b"one", (LOCAL, port))
            assert select.select([ours], [], [], 5.0)[0]
            [(data, peer)] = ours.receive()
            assert (data, peer) == (b"one", vehicle.getsockname())
            ours.send(Packet(b"two", peer))
            vehicle.settimeout(5.0)
            assert vehicle.recv(100) == b"two", "a packet without a receiver is dropped"
            with pytest.raises(OSError, match="in use"):
                open_connection(Address(ConnectionKind.UDP_IN, LOCAL, port))
        finally:
            ours.close()


def test_a_port_that_sends_first_needs_no_peer() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle:
        vehicle.bind((LOCAL, 0))
        vehicle.settimeout(5.0)
        ours = open_connection(Address(ConnectionKind.UDP_OUT, LOCAL, vehicle.getsockname()[1]))
        try:
            ours.send(Packet(b"hello", None))
            data, peer = vehicle.recvfrom(100)
            assert data == b"hello"
            vehicle.sendto(b"who is it", peer)
            assert came(ours) == b"who is it"
        finally:
            ours.close()


def test_tcp_carries_bytes_and_reports_its_end() -> None:
    with by_tcp() as (ours, vehicle):
        assert ours.receive() == [], "nothing yet"
        ours.send(Packet(b"hello", None))
        assert vehicle.recv(100) == b"hello"
        vehicle.sendall(b"heartbeat")
        assert came(ours) == b"heartbeat"
        vehicle.close()
        assert select.select([ours], [], [], 5.0)[0]
        with pytest.raises(ConnectionError, match="the vehicle closed the connection"):
            ours.receive()


@only_on("linux", "darwin", reason="a small buffer to send from always drains into that of the other end")
def test_tcp_sends_half_a_frame_to_its_end_and_then_whole_ones() -> None:
    """The rest of half a frame would be noise to the vehicle; a whole frame without room is merely lost."""
    frame = bytes(32 << 20)
    with by_tcp() as (ours, vehicle):
        ours.send(Packet(frame, None))
        # Freed room may take a moment to show on both sides: here nothing is read, so none is freed.
        wait_until(lambda: not select.select([], [ours], [], 0.0)[1], "there is no room at all")
        ours.send(Packet(b"lost without a word", None))
        got = bytearray()
        vehicle.settimeout(0.05)
        deadline = time.monotonic() + 10.0
        while not got.endswith(b"next"):
            assert time.monotonic() < deadline
            ours.send(Packet(b"next", None))
            with suppress(TimeoutError):
                got += vehicle.recv(1 << 20)
        assert got[: len(frame)] == frame[:-1] + b"\xff"
        assert not got[len(frame) :].replace(b"next", b"")


def test_a_serial_line_carries_bytes_both_ways(line: tuple[int, str]) -> None:
    pytest.importorskip("serial")
    far, device = line
    ours = open_connection(Address(ConnectionKind.SERIAL, device, 57600))
    try:
        assert isinstance(ours, SerialPort)
        assert ours.receive() == []
        os.write(far, b"heartbeat")
        assert came(ours) == b"heartbeat"
        ours.send(Packet(b"hello", None))
        assert os.read(far, 100) == b"hello"
        with pytest.raises(OSError, match="exclusively lock"):
            open_connection(Address(ConnectionKind.SERIAL, device, 57600))
    finally:
        ours.close()


def test_a_missing_serial_line_and_missing_pyserial_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("serial")
    with pytest.raises(OSError, match="nowhere"):
        open_connection(Address(ConnectionKind.SERIAL, "/dev/nowhere", 57600))
    monkeypatch.setitem(sys.modules, "serial", None)
    with pytest.raises(MissingExtraError, match="mavlink"):
        open_connection(Address(ConnectionKind.SERIAL, "/dev/nowhere", 57600))
