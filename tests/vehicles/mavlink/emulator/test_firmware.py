"""Creating, starting and stopping emulated autopilots, and the traffic on their ports."""

from __future__ import annotations

import math
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from skyloop.errors import LinkError, UsageError
from skyloop.sim.host import SimHost
from skyloop.sim.options import SimOptions
from skyloop.transport.testing import PATIENCE_S
from skyloop.vehicles.emulation.emulator import Loop
from skyloop.vehicles.mavlink.emulator import Kind, MavlinkFirmware, Ports, with_multirotors
from skyloop.vehicles.mavlink.emulator.links import LinkIntervals
from skyloop.vehicles.mavlink.wire.codec import MavlinkCodec, Message
from skyloop.vehicles.mavlink.wire.codec import dialect as m
from tests.vehicles.mavlink.emulator.rig import Rig

KINDS = pytest.mark.parametrize("kind", list(Kind))


def host() -> SimHost:
    return SimHost(with_multirotors(SimOptions(world="empty", seed=1, speed=3.0)))


@contextmanager
def listening(port: int) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as made:
        made.bind(("127.0.0.1", port))
        made.settimeout(PATIENCE_S)
        yield made


def heard(sock: socket.socket, kind: str) -> Message:
    codec = MavlinkCodec(255, 190)
    for _ in range(2000):
        for message in codec.decode(sock.recv(2048), whole=True):
            if message.get_type() == kind:
                return message
    raise AssertionError(f"no {kind} came")


@KINDS
def test_it_sends_to_its_remote_port_then_to_the_sender(kind: Kind) -> None:
    ports = Ports.free(kind)
    with listening(ports.remote) as first, MavlinkFirmware(host(), kind=kind, ports=ports) as firmware:
        assert heard(first, "HEARTBEAT").autopilot == firmware.autopilot.AUTOPILOT
        with listening(0) as other:
            program = MavlinkCodec(255, 190)
            other.sendto(program.encode(m.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)), ("127.0.0.1", ports.udp))
            assert heard(other, "HEARTBEAT").get_srcSystem() == 1


def test_a_fleet_shares_a_world_and_a_thread_at_a_lower_rate() -> None:
    options = with_multirotors(SimOptions(world="empty", seed=1, speed=3.0), rate_hz=20.0)
    assert options.rate_hz == 20.0
    world, loop = SimHost(options, 2), Loop("fleet")
    several = Ports.several(Kind.ARDUCOPTER, 0, 2)
    with ExitStack() as stack:
        socks = [stack.enter_context(listening(ports.remote)) for ports in several]
        for drone, ports in enumerate(several):
            stack.enter_context(MavlinkFirmware(world, drone, kind=Kind.ARDUCOPTER, ports=ports, loop=loop))
        loop.start()
        stack.callback(loop.stop)
        assert [heard(sock, "HEARTBEAT").get_srcSystem() for sock in socks] == [1, 2]


def test_ports_in_use_and_invalid_settings_are_refused() -> None:
    with listening(0) as taken:
        ports = Ports(taken.getsockname()[1], 1)
        with pytest.raises(LinkError, match="MAVLink port"):
            MavlinkFirmware(host(), kind=Kind.PX4, ports=ports).start()
    for wrong in ({"system": 0}, {"version": 3}, {"delay_s": -1.0}):
        with pytest.raises(UsageError):
            MavlinkFirmware(host(), kind=Kind.PX4, **wrong)
    firmware = MavlinkFirmware(host(), kind=Kind.PX4, ports=Ports.free(Kind.PX4))
    with pytest.raises(UsageError, match="call start"):
        _ = firmware.autopilot
    with firmware, pytest.raises(UsageError, match="already running"):
        firmware.start()
    firmware.stop()
    with pytest.raises(UsageError, match="no TCP port"):
        _ = firmware.tcp_address


def test_rates_are_kept_and_reported() -> None:
    streams = LinkIntervals({1: 10.0})
    assert [streams.due(at / 100) for at in (0, 5, 10, 11, 20)] == [[1], [], [1], [], [1]]
    streams.set_interval(1, -1)
    assert (streams.interval_us(1), streams.due(1.0)) == (-1, [])
    streams.set_interval(1, 0)
    streams.set_interval(2, 500_000)
    assert (streams.interval_us(1), streams.interval_us(2)) == (100_000, 500_000)
    streams.set_interval(2, 0)
    assert streams.interval_us(2) == -1


NUMBERS = st.floats(width=32)


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from(list(Kind)),
    st.sampled_from([16, 20, 21, 22, 176, 400, 510, 511, 512, 520, 192, 31000]),
    st.lists(NUMBERS, min_size=7, max_size=7),
)
@example(Kind.PX4, 510, [65536.0] + 6 * [0.0])  # a message number too large for its answer
@example(Kind.PX4, 511, [1.0, 1e30] + 5 * [0.0])  # an interval too large for its answer
@example(Kind.PX4, 511, [1.0, math.nan] + 5 * [0.0])
def test_commands_with_any_numbers_are_answered(kind: Kind, number: int, arguments: list[float]) -> None:
    it = Rig(kind)
    it.go_on(0.1)
    assert it.command(number, *arguments) in range(6)
    it.go_on(0.2)


@settings(max_examples=20, deadline=None)
@given(st.sampled_from(list(Kind)), st.lists(NUMBERS, min_size=11, max_size=11), st.integers(0, 0xFFFF))
@example(Kind.ARDUCOPTER, 10 * [0.0] + [math.inf], 1024)  # an infinite yaw rate
def test_set_points_with_any_numbers_do_no_harm(kind: Kind, numbers: list[float], mask: int) -> None:
    it = Rig(kind)
    it.up(1.0)
    if kind is Kind.PX4:
        it.offboard(it.velocity(0, 0, 0))
    it.say(m.MAVLink_set_position_target_local_ned_message(0, 1, 1, 1, mask, *numbers))
    it.go_on(0.3)
    it.say(m.MAVLink_set_attitude_target_message(0, 1, 1, mask & 0xFF, numbers[:4], *numbers[4:8]))
    it.go_on(0.3)
    assert all(abs(each) < 50 for each in it.speed)


@KINDS
def test_drones_on_free_ports_share_none(kind: Kind, monkeypatch: pytest.MonkeyPatch) -> None:
    bound: list[socket.socket] = []

    class Reused(socket.socket):
        """Gets the lowest port without an open socket, as a busy system sooner or later does."""

        def bind(self, address: object) -> None:
            taken = {sock.number for sock in bound if sock.fileno() >= 0}  # type: ignore[attr-defined]
            self.number = next(number for number in range(1000, 2000) if number not in taken)
            bound.append(self)

        def getsockname(self) -> tuple[str, int]:
            return "127.0.0.1", self.number

    monkeypatch.setattr("skyloop.vehicles.mavlink.emulator.links.socket.socket", Reused)
    several = Ports.several(kind, 0, 5)
    numbers = [port for ports in several for port in (ports.udp, ports.remote, ports.tcp) if port is not None]
    assert len(several) == 5
    assert len(set(numbers)) == len(numbers)
