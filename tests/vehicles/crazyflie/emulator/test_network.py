"""The emulated Crazyflie on the network: its client, the dialect with checksums, and its AI-deck."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import closing

import pytest

from skyloop.errors import UsageError
from skyloop.sim.host import SimHost
from skyloop.sim.options import SimOptions
from skyloop.vehicles.crazyflie.emulator import CrazyflieFirmware, DeckSettings, with_crazyflies
from skyloop.vehicles.crazyflie.wire import contents
from skyloop.vehicles.crazyflie.wire.contents import LogCommand, LogRequest, ValueType
from skyloop.vehicles.crazyflie.wire.crtp import CrtpPacket, CrtpPort, with_checksum

PATIENCE_S = 20.0


@pytest.fixture
def host() -> SimHost:
    return SimHost(with_crazyflies(SimOptions(world="empty", seed=1)))


@pytest.fixture
def client() -> Iterator[socket.socket]:
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as client:
        client.settimeout(PATIENCE_S)
        yield client


def test_a_search_for_vehicles_does_not_take_the_client_away(host: SimHost, client: socket.socket) -> None:
    with (
        CrazyflieFirmware(host, port=0) as firmware,
        closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as other,
    ):
        at = "127.0.0.1", firmware.port
        variable = ((0, ValueType.UINT16),)
        client.sendto(LogRequest(LogCommand.CREATE, 1, variable).encode().encode(), at)
        client.sendto(LogRequest(LogCommand.START, 1, period_ms=10).encode().encode(), at)
        other.settimeout(PATIENCE_S)
        other.sendto(b"\xff", at)
        assert other.recv(64) == b"\xff"
        ported = (CrtpPacket.decode(client.recv(64)) for _ in range(200))
        data = [packet for packet in ported if (packet.port, packet.channel) == (CrtpPort.LOG, 2)]
        assert len(data) > 100


def test_checksums(host: SimHost, client: socket.socket) -> None:
    with CrazyflieFirmware(host, port=0, checksum=True) as firmware:
        at = "127.0.0.1", firmware.port
        client.sendto(CrtpPacket(CrtpPort.LINK, 0, b"wrong").encode() + b"\0", at)
        echo = with_checksum(CrtpPacket(CrtpPort.LINK, 0, b"right").encode())
        client.sendto(echo, at)
        while (answer := client.recv(64))[0] >> 4 == CrtpPort.CONSOLE:
            pass
        assert answer == echo


def test_persistent_parameters_survive_switching_off(host: SimHost, client: socket.socket) -> None:
    firmware = CrazyflieFirmware(host, port=0)
    with firmware:
        port = firmware.port
        firmware.logic.receive(contents.set_by_name("ring", "effect", ValueType.UINT8, 9))
        number = next(n for n, value in enumerate(firmware.logic.parameters) if value == 9)
        firmware.logic.receive(contents.MiscMessage(contents.MiscCommand.STORE, number).encode())
    with firmware:
        assert firmware.port == port
        assert firmware.logic.parameter("ring.effect") == 9


def test_the_deck_sends_the_images_of_its_camera(host: SimHost) -> None:
    pytest.importorskip("numba")
    with CrazyflieFirmware(host, port=0, deck=DeckSettings(port=0)) as firmware:
        assert firmware.deck is not None
        assert "images tcp" in firmware.description
        with socket.create_connection(("127.0.0.1", firmware.deck.port), PATIENCE_S) as client:
            client.settimeout(PATIENCE_S)
            left = 2 * 324 * 244
            while left > 0:
                received = len(client.recv(65536))
                assert received
                left -= received


def test_protocols_that_are_not_known_are_refused(host: SimHost) -> None:
    with pytest.raises(UsageError, match="from 7 to 12, got 13"):
        CrazyflieFirmware(host, protocol=13)
