"""The coupling of a Crazyflie's firmware, with a stand-in for its program."""

from __future__ import annotations

import os
import signal
import socket
import struct
import time
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from skyloop.errors import DecodeError, UsageError
from skyloop.sim.parameters import GRAVITY_M_S2
from skyloop.vehicles.sim.firmware import crazyflie
from skyloop.vehicles.sim.firmware.crazyflie import (
    EMPTY,
    SWITCH_OFF,
    VARIABLE,
    Crazyflie,
    decode_motors,
    encode_air,
    encode_inertial,
    encode_magnetic,
    encode_pose,
)
from skyloop.vehicles.sim.firmware.ports import bound
from skyloop.vehicles.sim.firmware.program import STOPPED, FirmwareEventKind
from tests.vehicles.sim.firmware.rig import AT_REST, COMMANDS, LONG_S, Rig, flying, program

pytestmark = pytest.mark.process


@pytest.fixture(autouse=True)
def free_ports(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with bound(socket.SOCK_DGRAM) as probe:
        monkeypatch.setattr(crazyflie, "CLIENT_PORT", probe.getsockname()[1])
    monkeypatch.setattr(crazyflie, "MOST_INSTANCES", 2)
    monkeypatch.setenv(VARIABLE, str(program(tmp_path, "crazyflie")))


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    with flying(lambda on_event: Crazyflie(on_event, folder=tmp_path / "kept")) as rig:
        yield rig


@pytest.fixture
def client(rig: Rig) -> Iterator[socket.socket]:
    """A client of the firmware."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as made:
        made.setblocking(False)
        made.connect(("127.0.0.1", int(rig.firmware.address.rpartition(":")[2])))
        yield made


def packets(folder: Path) -> list[bytes]:
    return [bytes.fromhex(line) for line in (folder / "packets.txt").read_text().split()]


def answer(rig: Rig, client: socket.socket) -> bytes:
    """Return the next packet to the client, stepping meanwhile."""
    end_s = time.monotonic() + LONG_S
    while time.monotonic() < end_s:
        rig.step()
        try:
            return client.recv(64)
        except BlockingIOError:
            continue
    raise AssertionError("no packet")


def test_it_flies_by_its_instruments_and_its_place(rig: Rig, tmp_path: Path) -> None:
    assert rig.firmware.address == f"crazyflie://udp:127.0.0.1:{crazyflie.CLIENT_PORT}"
    rig.answered()
    rig.until(lambda commands: commands == pytest.approx(COMMANDS, abs=1e-4), "the motors")
    wanted = {encode_inertial(AT_REST), encode_magnetic(AT_REST), encode_air(AT_REST), encode_pose(AT_REST)}
    end_s = time.monotonic() + LONG_S
    while not wanted <= {*packets(tmp_path / "kept")} and time.monotonic() < end_s:
        rig.step()
    assert wanted <= {*packets(tmp_path / "kept")}


def test_it_can_be_flown_without_its_place(tmp_path: Path) -> None:
    with flying(lambda on_event: Crazyflie(on_event, folder=tmp_path / "kept", position=False)) as rig:
        rig.answered()
        for _ in range(100):
            rig.step()
        assert not any(packet[0] == 0x61 for packet in packets(tmp_path / "kept"))


def test_its_packets_have_its_units_and_axes() -> None:
    at_rest = msgspec.structs.replace(AT_REST, acceleration_m_s2=(0.0, -GRAVITY_M_S2, GRAVITY_M_S2))
    header, kind, *numbers = struct.unpack("<BB6h", encode_inertial(at_rest))
    assert (header, kind, numbers[:3]) == (0x90, 0, [0, -2048, 2048])
    assert numbers[3:] == [94, 188, 282]  # 0.1, 0.2 and 0.3 rad/s
    hard = msgspec.structs.replace(AT_REST, acceleration_m_s2=(1e4, -1e4, 0.0), gyro_rad_s=(-1e3, 1e3, 0.0))
    assert struct.unpack("<BB6h", encode_inertial(hard))[2:] == (32767, -32768, 0, -32768, 32767, 0)
    assert struct.unpack("<BB3h", encode_magnetic(AT_REST)) == (0x90, 1, 67, 133, -267)
    assert struct.unpack("<BB3f", encode_air(AT_REST)) == (0x90, 2, 950.0, 20.0, 491.0)
    assert struct.unpack("<BB7f", encode_pose(AT_REST)) == (0x61, 8, 1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0)
    with pytest.raises(DecodeError, match="has 9 bytes, got 3"):
        decode_motors(b"abc")


def test_it_exchanges_packets_with_its_client(rig: Rig, client: socket.socket, tmp_path: Path) -> None:
    rig.answered()
    client.send(b"\xe0all of it")
    assert answer(rig, client) == b"\xe0all of it"
    client.send(EMPTY)
    assert answer(rig, client) == EMPTY
    for packet in (b"", b"\x90\x02no reading of the simulator's", b"\x9c\x00nor this", b"\xe1the last"):
        client.send(packet)
    assert answer(rig, client) == b"\xe1the last"
    told = packets(tmp_path / "kept")
    assert EMPTY not in told
    assert not any(packet[2:4] in (b"no", b"or") for packet in told)


def test_nothing_of_a_burst_is_lost(rig: Rig, client: socket.socket) -> None:
    rig.answered()
    for n in range(100):
        client.send(bytes((0xE0, n)))
    assert [answer(rig, client)[1] for _ in range(100)] == [*range(100)]


def test_one_that_does_not_read_is_sent_little_that_it_would_lose(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    rig.answered()
    os.kill(rig.firmware.program.pid, signal.SIGSTOP)
    assert "does not answer" in rig.event(FirmwareEventKind.SILENT)
    assert rig.step() == STOPPED
    sent: list[bytes] = []
    with monkeypatch.context() as patch:
        patch.setattr(rig.firmware, "_send_to_firmware", sent.append)
        begun_s = time.monotonic()
        while time.monotonic() < begun_s + 0.5:
            rig.step()
        lasted_s = time.monotonic() - begun_s
    assert 1 < len(sent) <= lasted_s / crazyflie.RETRY_S + 1
    os.kill(rig.firmware.program.pid, signal.SIGCONT)
    assert "again" in rig.event(FirmwareEventKind.ANSWERS)
    rig.answered()


def test_its_death_stops_the_rotors_and_its_client_goes_on_with_the_next(rig: Rig, client: socket.socket) -> None:
    rig.answered()
    client.send(b"\xe0one")
    assert answer(rig, client) == b"\xe0one"
    os.kill(rig.firmware.program.pid, signal.SIGKILL)
    rig.until(lambda commands: commands == STOPPED, "the rotors' stop")
    assert "was killed by SIGKILL" in rig.event(FirmwareEventKind.DIED)
    rig.event(FirmwareEventKind.ANSWERS)
    client.send(b"\xe0two")
    assert answer(rig, client) == b"\xe0two"


def test_it_does_not_get_what_its_client_sent_while_it_was_off(rig: Rig, client: socket.socket) -> None:
    rig.answered()
    os.kill(rig.firmware.program.pid, signal.SIGKILL)
    rig.until(lambda commands: commands == STOPPED, "the rotors' stop")
    rig.event(FirmwareEventKind.DIED)
    client.send(b"\xe0a take-off")
    rig.event(FirmwareEventKind.ANSWERS)
    client.send(b"\xe0later")
    assert answer(rig, client) == b"\xe0later"


def test_its_client_can_switch_it_off_and_it_starts_again(rig: Rig, client: socket.socket) -> None:
    rig.answered()
    client.send(SWITCH_OFF)
    rig.event(FirmwareEventKind.DIED)
    rig.event(FirmwareEventKind.ANSWERS)


def test_a_deaf_start_is_ended_and_another_one_begins_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every other start of the real one hangs in its stabilizer's start."""
    deaf = tmp_path / "deaf"
    deaf.mkdir()
    for n in range(2):
        (deaf / str(n)).touch()
    monkeypatch.setenv("STANDIN_DEAF", str(deaf))
    rig = Rig()
    rig.firmware = Crazyflie(rig.events.put)
    rig.firmware.program._restart_s = 600.0  # it must not pause
    rig.firmware.start()
    try:
        text = rig.event(FirmwareEventKind.DEAF)
        assert text == "Crazyflie is started again: it did not answer within 1 s of its start"
        assert rig.event(FirmwareEventKind.DEAF).endswith("within 1.5 s of its start"), "the computer may be busy"
        rig.answered()
    finally:
        rig.firmware.close()


def test_several_fly_on_their_own_ports(rig: Rig) -> None:
    rig.answered()
    with flying(Crazyflie) as other:
        other.answered()
        assert other.firmware.address == f"crazyflie://udp:127.0.0.1:{crazyflie.CLIENT_PORT + 1}"
        with pytest.raises(UsageError, match="no ports are free for another Crazyflie: 2 at most"):
            Crazyflie(print).start()
    rig.answered()
