"""The emulated Tello on the network: its ports, and refused settings."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import pytest

from skyloop.drivers.h264 import parse_sequence, units
from skyloop.errors import LinkError, UsageError
from skyloop.sim.host import SimHost
from skyloop.sim.options import SimOptions
from skyloop.transport.testing import wait_until
from skyloop.vehicles.tello.emulator import FULL_KBPS, LEAST_KBPS, Faults, TelloFirmware, automatic_kbps, with_tellos
from skyloop.vehicles.tello.wire import PIECE, AccessUnit, Assembly, parse
from tests.support.tello_addresses import Addresses

pytest.importorskip("av")


class Client:
    """A client with a Tello's three ports."""

    def __init__(self, addresses: Addresses, port: int = 8889) -> None:
        self._open = ExitStack()
        self.commands = self._port(addresses.pilot, 0)
        self.commands.connect((addresses.drone, port))
        self.states = self._port(addresses.pilot, 8890)
        self.video = self._port(addresses.pilot, 11111)

    def _port(self, address: str, number: int) -> socket.socket:
        made = self._open.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        made.settimeout(20.0)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        made.bind((address, number))
        return made

    def ask(self, text: str) -> str:
        self.commands.send(text.encode())
        return self.commands.recv(1000).decode()

    def pictures(self, count: int) -> list[AccessUnit]:
        assembly = Assembly()
        got: list[AccessUnit] = []
        while len(got) < count:
            datagram = self.video.recv(3000)
            assert len(datagram) <= PIECE
            got += assembly.feed(datagram, 0)
        return got

    def close(self) -> None:
        self._open.close()


@contextmanager
def drone(**settings: Any) -> Iterator[tuple[TelloFirmware, Client]]:
    addresses = Addresses.free()
    host = SimHost(with_tellos(SimOptions(world="empty", seed=2)))
    with TelloFirmware(host, bind=addresses.drone, **settings) as firmware:
        client = Client(addresses, firmware.port)
        try:
            yield firmware, client
        finally:
            client.close()


def test_state_and_video_arrive_on_request() -> None:
    with drone() as (_, client):
        assert client.ask("command") == "ok"
        first = parse(client.states.recv(2000))
        assert first.battery_percent == 100
        assert client.ask("streamon") == "ok"
        key, *others = client.pictures(35)
        assert key.is_key
        assert key.whole
        assert [unit.is_key for unit in others] == [n == 29 for n in range(34)]
        assert not any(unit.after_gap for unit in others)


def test_separate_ports() -> None:
    with drone() as (firmware, client), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.settimeout(10.0)
        other.bind((client.commands.getsockname()[0], 0))
        assert client.ask("command") == "ok"
        assert client.ask(f"port {other.getsockname()[1]} 11111") == "ok"
        assert parse(other.recv(2000)).battery_percent == 100
        assert firmware.logic.state_port == other.getsockname()[1]


def test_faults_affect_states_and_answers() -> None:
    with drone(faults=Faults(seed=1, drop=0.5)) as (_, client):
        client.commands.settimeout(0.1)
        answered = 0
        for _ in range(40):
            try:
                answered += client.ask("command") == "ok"
            except TimeoutError:
                continue
        assert 1 <= answered <= 25


def test_it_sends_less_over_a_bad_link() -> None:
    assert automatic_kbps(0.0) == FULL_KBPS
    assert automatic_kbps(0.05) == 1375
    assert automatic_kbps(0.1) == automatic_kbps(1.0) == LEAST_KBPS


def test_a_port_in_use_is_named_and_reused_after_a_restart() -> None:
    with drone() as (firmware, _):
        host = SimHost(with_tellos(SimOptions(world="empty")))
        with pytest.raises(LinkError, match=r"the drone's command port, UDP 8889 on .* can't be opened"):
            TelloFirmware(host, bind=firmware.settings.bind).start()
        with pytest.raises(UsageError, match="already running"):
            firmware.start()
        firmware.stop()
        firmware.start()
        assert firmware.port == 8889


def test_a_free_port_is_kept_after_a_restart() -> None:
    host = SimHost(with_tellos(SimOptions(world="empty")))
    firmware = TelloFirmware(host, port=0)
    with pytest.raises(UsageError, match="not started"):
        _ = firmware.port
    with firmware:
        port = firmware.port
    with firmware:
        assert firmware.port == port


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"sdk": "4.0"}, "sdk must be one of 1.3, 2.0, 3.0"),
        ({"delay_s": 11.0}, "delay_s must be from 0 to 10 s"),
        ({"pads": {9: (0.0, 0.0)}}, "mission pads are numbered from 1 to 8"),
    ],
)
def test_invalid_settings_are_refused(settings: dict[str, Any], said: str) -> None:
    host = SimHost(with_tellos(SimOptions(world="empty")))
    with pytest.raises(UsageError, match=said):
        TelloFirmware(host, **settings)


def test_its_video_follows_the_configuration() -> None:
    with drone() as (_, client):
        for command in ("command", "setbitrate 1", "downvision 1", "setfps middle", "streamon"):
            assert client.ask(command) == "ok"
        (key,) = client.pictures(1)
        sequence = parse_sequence(units(key.data)[0])
        assert (sequence.width, sequence.height) == (320, 240)
        assert client.ask("streamoff") == "ok"
        client.video.settimeout(0.3)

        def silent() -> bool:
            try:
                client.video.recv(3000)
            except TimeoutError:
                return True
            return False

        wait_until(silent, "no more video arrives")
