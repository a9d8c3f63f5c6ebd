"""Vehicles behind a Crazyradio's USB: in turns, with a safe link, through losses, and without anything stale."""

from __future__ import annotations

import errno
import random
import socket
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from skyloop.clock import nanoseconds
from skyloop.drivers.recording_sink import RecordingSink
from skyloop.drivers.uri import parse_uri
from skyloop.errors import MissingExtraError
from skyloop.sim.host import Report
from skyloop.vehicles.crazyflie import radio
from skyloop.vehicles.crazyflie.driver import CrazyflieDriver
from skyloop.vehicles.crazyflie.options import RadioAddress
from skyloop.vehicles.crazyflie.radio import SAFE_LINK, RadioVehicle, lease
from skyloop.vehicles.crazyflie.wire.commander import EmergencyStopMessage
from skyloop.vehicles.crazyflie.wire.crtp import CrtpPacket
from tests.vehicles.crazyflie.rig import Rig

ONE = RadioAddress(0, 80, "2M", b"\xe7\xe7\xe7\xe7\x01")
TWO = RadioAddress(0, 90, "1M", b"\xe7\xe7\xe7\xe7\x02")


class Peer:
    """A vehicle's radio with a safe link: it obeys each packet once, and repeats an answer until it is acknowledged."""

    def __init__(self, *, safe: bool = True) -> None:
        self.can_be_safe, self.safe = safe, False
        self.received: list[CrtpPacket] = []
        self.answers: deque[bytes] = deque()
        self._up = self._down = 0
        self._sent = False  # whether the first answer was sent

    def on_packet(self, packet: bytes) -> bytes:
        if packet == SAFE_LINK and self.can_be_safe:
            self.safe, self._up, self._down = True, 0, 0
            return SAFE_LINK
        if self.safe:
            if packet[0] >> 2 & 1 != self._down and self._sent:  # the last answer has arrived
                self.answers.popleft()
            self._down = packet[0] >> 2 & 1
            fresh, self._up = packet[0] >> 3 & 1 == self._up, self._up ^ (packet[0] >> 3 & 1 == self._up)
        else:
            fresh = True
        decoded = CrtpPacket.decode(packet)
        if fresh and not decoded.is_null:
            self.received.append(CrtpPacket(decoded.port, decoded.channel, decoded.data))
        if not self.safe:
            return self.answers.popleft() if self.answers else b""
        self._sent = bool(self.answers)
        head = self.answers[0] if self.answers else b"\xf3"
        return bytes((head[0] & 0xF3 | self._down << 2,)) + head[1:]


class FakeDongle:
    """The seam at USB: vehicles by address, and packets lost in both directions."""

    def __init__(self, peers: dict[RadioAddress, Peer], lost: float = 0.0) -> None:
        self.peers, self.lost = peers, lost
        self.closed = False
        self.broken = False
        self.turns: list[RadioAddress] = []
        self._now: RadioAddress | None = None
        self._chance = random.Random(3)

    def configure(self, address: RadioAddress) -> None:
        self._now = address

    def exchange(self, packet: bytes) -> bytes | None:
        if self.broken:
            raise OSError(errno.ENODEV, "unplugged")
        assert self._now is not None
        self.turns.append(self._now)
        peer = self.peers.get(self._now)
        if peer is None or self._chance.random() < self.lost:
            return None
        answer = peer.on_packet(packet)
        return None if self._chance.random() < self.lost else answer

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def pair() -> Iterator[tuple[socket.socket, RadioVehicle]]:
    ours, theirs = radio._pair()
    yield ours, RadioVehicle(ONE, theirs)
    ours.close()
    theirs.close()


class Unheard(Peer):
    """A vehicle that hears, but whose answers do not arrive."""

    def on_packet(self, packet: bytes) -> bytes | None:  # type: ignore[override]
        super().on_packet(packet)
        return None


@pytest.mark.parametrize("safe", [True, None])
@pytest.mark.parametrize("heard", [0, 1])
def test_an_emergency_stop_reaches_a_vehicle_that_is_not_heard(
    pair: tuple[socket.socket, RadioVehicle], safe: bool | None, heard: int
) -> None:
    ours, vehicle = pair
    peer = Unheard()
    dongle = FakeDongle({ONE: peer})
    dongle.configure(ONE)
    peer.safe, vehicle.safe, peer._up = True, safe, heard
    for packet in packets(3):
        ours.send(packet)
    for turn in range(10):
        vehicle.collect(nanoseconds(0.01 * turn))
        vehicle.take_turn(dongle, nanoseconds(0.01 * turn))
    stop = EmergencyStopMessage().encode(7)
    ours.send(stop.encode())
    for turn in range(10, 13):
        vehicle.collect(nanoseconds(0.01 * turn))
        vehicle.take_turn(dongle, nanoseconds(0.01 * turn))
    assert stop in peer.received


def packets(count: int) -> list[bytes]:
    return [CrtpPacket(5, 0, bytes((number,))).encode() for number in range(count)]


@pytest.mark.parametrize("lost", [0.0, 0.3])
def test_each_packet_arrives_once_and_in_order(pair: tuple[socket.socket, RadioVehicle], lost: float) -> None:
    ours, vehicle = pair
    peer = Peer()
    peer.answers.extend(packets(20))
    dongle = FakeDongle({ONE: peer}, lost)
    dongle.configure(ONE)
    for packet in packets(20):
        ours.send(packet)
    got = []
    for turn in range(400):
        vehicle.collect(nanoseconds(0.001))
        vehicle.take_turn(dongle, nanoseconds(0.001 * turn))
        try:
            got.append(CrtpPacket.decode(ours.recv(64)))
        except BlockingIOError:
            continue
    assert [packet.data for packet in peer.received] == [bytes((number,)) for number in range(20)]
    assert [packet.data for packet in got] == [bytes((number,)) for number in range(20)]


def test_a_vehicle_without_the_safe_link_is_served(pair: tuple[socket.socket, RadioVehicle]) -> None:
    ours, vehicle = pair
    peer = Peer(safe=False)
    dongle = FakeDongle({ONE: peer})
    dongle.configure(ONE)
    for _ in range(radio.SAFE_LINK_TRIES):
        vehicle.take_turn(dongle, 0)
    assert vehicle.safe is False
    peer.received.clear()
    ours.send(packets(1)[0])
    vehicle.collect(0)
    vehicle.take_turn(dongle, 0)
    assert [packet.data for packet in peer.received] == [b"\0"]


def test_nothing_from_before_an_interruption_is_sent_after_it(pair: tuple[socket.socket, RadioVehicle]) -> None:
    """A take-off that could not be sent for half a second is never sent."""
    ours, vehicle = pair
    peer = Peer()
    dongle = FakeDongle({ONE: peer})
    dongle.configure(ONE)
    vehicle.take_turn(dongle, 0)
    dongle.lost = 1.0
    ours.send(packets(1)[0])
    for turn in range(50):
        vehicle.collect(nanoseconds(0.01 * turn))
        vehicle.take_turn(dongle, nanoseconds(0.01 * turn))
    dongle.lost = 0.0
    for turn in range(50, 70):
        vehicle.collect(nanoseconds(0.01 * turn))
        vehicle.take_turn(dongle, nanoseconds(0.01 * turn))
    assert peer.received == []


def test_a_restarted_vehicle_gets_a_new_safe_link(pair: tuple[socket.socket, RadioVehicle]) -> None:
    ours, vehicle = pair
    peers = {ONE: Peer()}
    dongle = FakeDongle(peers)
    dongle.configure(ONE)
    vehicle.take_turn(dongle, 0)
    assert vehicle.safe
    absent = peers.pop(ONE)
    for _ in range(60):
        vehicle.take_turn(dongle, 0)
    assert vehicle.safe is None
    absent.safe = False
    peers[ONE] = absent
    vehicle.take_turn(dongle, 0)
    assert vehicle.safe
    ours.send(packets(1)[0])
    vehicle.collect(0)
    vehicle.take_turn(dongle, 0)
    assert len(absent.received) == 1


def test_two_vehicles_take_turns_at_one_radio() -> None:
    peers = {ONE: Peer(), TWO: Peer()}
    dongle = FakeDongle(peers)
    opened: list[int] = []

    def open_dongle(number: int) -> FakeDongle:
        opened.append(number)
        return dongle

    first, second = lease(ONE, open_dongle), lease(TWO, open_dongle)
    try:
        end = time.monotonic() + 10.0
        while not (peers[ONE].received and peers[TWO].received) and time.monotonic() < end:
            first.socket.send(packets(1)[0])
            second.socket.send(packets(2)[1])
            time.sleep(0.01)
        assert {packet.data for packet in peers[ONE].received} == {b"\0"}
        assert {packet.data for packet in peers[TWO].received} == {b"\x01"}
        assert opened == [0]
    finally:
        first.socket.close()
        first.close()
        assert not dongle.closed
        second.socket.close()
        second.close()
    assert dongle.closed
    assert not [thread for thread in threading.enumerate() if thread.name.startswith("skyloop-radio")]


def test_an_unplugged_radio_is_opened_again() -> None:
    broken, whole = FakeDongle({}), FakeDongle({})
    broken.broken = True
    first = lease(ONE, lambda _: broken)
    first.radio._thread.join(10.0)
    assert broken.closed
    assert first.radio.error is not None
    first.socket.close()
    first.close()
    second = lease(ONE, lambda _: whole)
    second.socket.close()
    second.close()
    assert whole.closed


class EmulatedPeer(Peer):
    """An emulated Crazyflie behind a radio. It stands on the ground, and only its time passes."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._rig = Rig(folder)

    def on_packet(self, packet: bytes) -> bytes:
        rig, before = self._rig, len(self.received)
        answer = super().on_packet(packet)
        for received in self.received[before:]:
            self.answers.extend(each.encode() for each in rig.logic.receive(received))
        if len(self.answers) < 10:
            report = rig._report()
            believed = replace(report.believed, time_s=time.monotonic())
            report = Report(believed, report.truth, (), time.monotonic_ns())
            self.answers.extend(each.encode() for each in rig.logic.update(report))
        return answer


def _fed(sink: RecordingSink) -> bool:
    return sink.feedback_count > 20


def test_drivers_share_a_radio(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    dongle = FakeDongle({ONE: EmulatedPeer(tmp_path), TWO: EmulatedPeer(tmp_path)}, lost=0.05)
    monkeypatch.setattr(radio, "UsbDongle", lambda number: dongle)
    monkeypatch.setattr("skyloop.vehicles.crazyflie.driver.require_usb", lambda: None)
    drivers, sinks = [], []
    for address in ("0/80/2M/E7E7E7E701", "0/90/1M/E7E7E7E702"):
        drivers.append(CrazyflieDriver(parse_uri(f"crazyflie://radio:{address}")))
        sinks.append(RecordingSink())
        drivers[-1].open(sinks[-1])
    try:
        for sink in sinks:
            assert sink.wait(partial(_fed, sink), 60.0), sink.links
            assert sink.newest is not None
            assert sink.newest.position_m is not None
            assert not sink.problems
    finally:
        for driver in drivers:
            driver.close()
    assert dongle.closed


def test_without_pyusb_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "usb", None)
    monkeypatch.setitem(sys.modules, "usb.core", None)
    driver = CrazyflieDriver(parse_uri("crazyflie://radio:0/80/2M/E7E7E7E7E7"))
    with pytest.raises(MissingExtraError, match="skyloop install crazyflie"):
        driver.open(RecordingSink())
