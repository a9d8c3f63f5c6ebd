"""A late proxy handles its whole backlog: the newest set-point, and everything else in order."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable, Iterator
from functools import partial

import pytest

from skyloop.messages import AnyAction, Command, EmergencyStop, Land, Ping, Request, Takeoff, Velocity, encode
from skyloop.transport.base import Dialer, Peer, TransportServer
from skyloop.transport.composite import CompositeServer
from skyloop.transport.local import LocalServer, dial
from skyloop.transport.local.reactor import Reactor, SharedLocalServer
from skyloop.transport.priority import SUPERSEDED, PacketBacklog
from skyloop.transport.testing import PATIENCE_S, ClientLog, ServerLog, wait_until
from tests.support.proxy_bench import Bench

FLY, LAND = Velocity(forward=1.0), Land()
BLOCK = encode(Request(1, Ping(1)))
pytestmark = pytest.mark.usefixtures("side")
_names = (f"late-{number}" for number in itertools.count())


def command(seq: int, action: AnyAction) -> bytes:
    return encode(Command(seq, 1, seq, seq, action))


@pytest.fixture
def reactor(side: str) -> Iterator[Reactor]:
    made = Reactor()
    yield made
    made.close()


class Late:
    """A server whose handler blocks at the first request until it is released."""

    def __init__(self, server: TransportServer, dialer: Dialer) -> None:
        self.server, self.log = server, ServerLog()
        self.log.on_packet = self._packet
        self.order: list[bytes] = []  #: packets of several servers, in order
        self.gate, self.entered = threading.Event(), threading.Event()
        server.start(self.log)
        self.client = dialer(ClientLog())
        wait_until(lambda: self.log.joined, "it joined")
        assert server.admit(self.log.joined[0], pilot=True) == ""

    def _packet(self, _: Peer, packet: bytes) -> None:
        self.order.append(packet)
        if packet == BLOCK:
            self.entered.set()
            assert self.gate.wait(PATIENCE_S)

    def stall(self) -> None:
        assert self.client.send(BLOCK)
        assert self.entered.wait(PATIENCE_S)

    @property
    def packets(self) -> list[bytes]:
        return [packet for _, packet in self.log.packets if packet != BLOCK]

    def took(self, commands: PacketBacklog, count: int) -> bool:
        return self.server.counters[SUPERSEDED] + len(commands) == count

    def close(self) -> None:
        self.client.close()
        self.server.stop()


def local(_: Reactor) -> Late:
    name = next(_names)
    return Late(LocalServer(name), dial(name))


def shared(reactor: Reactor) -> Late:
    name = next(_names)
    return Late(SharedLocalServer(name, reactor), dial(name))


def composite(_: Reactor) -> Late:
    name = next(_names)
    return Late(CompositeServer([LocalServer(name)]), dial(name))


EVERY = pytest.mark.parametrize("make", [local, shared, composite])


@EVERY
def test_after_a_stall_the_landing_and_the_newest_set_point_arrive(
    make: Callable[[Reactor], Late], reactor: Reactor
) -> None:
    late = make(reactor)
    late.stall()
    burst = [command(1, Takeoff()), *(command(seq, LAND if seq == 60 else FLY) for seq in range(2, 121))]
    for packet in burst:
        assert late.client.send(packet)
    asked = encode(Request(2, Ping(2)))
    assert late.client.send(asked)
    late.gate.set()
    wait_until(lambda: asked in late.packets, "all packets were handled")
    assert late.packets == [burst[0], burst[59], burst[-1], asked]
    assert late.server.counters[SUPERSEDED] == 117
    late.close()


@EVERY
def test_a_landing_that_does_not_fit_follows_and_arrives(make: Callable[[Reactor], Late], reactor: Reactor) -> None:
    """The packets in a full socket are read in one go."""
    late = make(reactor)
    late.stall()
    seq = next(seq for seq in itertools.count(1) if not late.client.send(command(seq, FLY)))
    late.gate.set()
    landing = command(seq + 1, LAND)
    wait_until(lambda: late.client.send(landing), "the packet is accepted")
    wait_until(lambda: landing in late.packets, "it came")
    assert len(late.packets) <= 4, "set-points were read in a few batches, not one by one"
    late.close()


@pytest.mark.parametrize("kind", ["a thread for each", "one for all"])
def test_a_stalled_proxy_lands_and_refuses_nothing_for_its_age(
    kind: str, reactor: Reactor, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The vehicle's driver blocks for eight seconds, while the pilot keeps flying and then lands."""
    name = next(_names)
    server = LocalServer(name) if kind == "a thread for each" else SharedLocalServer(name, reactor)
    gate, entered = threading.Event(), threading.Event()
    with Bench(transport=(server, dial(name))) as bench:
        pilot, driver = bench.airborne(), bench.driver
        apply = driver._apply

        def stall(action: AnyAction) -> AnyAction:
            entered.set()
            assert gate.wait(PATIENCE_S)
            return apply(action)

        monkeypatch.setattr(driver, "_apply", stall)
        pilot.command(Velocity(forward=0.0), sync=False)
        assert entered.wait(PATIENCE_S)
        for number in range(1, 101):
            bench.clock.advance(0.08)
            pilot.command(LAND if number == 99 else Velocity(forward=number / 1000), sync=False)
        gate.set()
        pilot.sync()
        assert driver.told == [Velocity(forward=0.0), LAND]  # the set-point after the landing does not abort it
        counters = bench.proxy.statistics()
        assert "commands.refused" not in counters
        assert counters[SUPERSEDED] == 98
        assert counters["commands.applied"] == 4  # the take-off and three more


def test_the_same_over_the_network() -> None:
    from skyloop.network import FabricServer, FabricSettings, config
    from skyloop.network import dial as dial_fabric

    place = (f"127.0.0.1:{config.free_port('127.0.0.1')}",)
    server = FabricServer("late", FabricSettings(listen=place, multicast=False))
    late = Late(server, dial_fabric("late", FabricSettings(connect=place, multicast=False)))
    late.stall()
    (connection,) = server._registry.connections
    burst = [command(seq, LAND if seq == 60 else FLY) for seq in range(1, 121)]
    for count, packet in enumerate(burst, 1):  # one by one, as Zenoh may drop parts of a burst
        assert late.client.send(packet)
        wait_until(partial(late.took, connection.commands, count), "it came")
    late.gate.set()
    wait_until(lambda: late.packets == [burst[59], burst[-1]], "both were handled, and nothing else")
    assert server.counters[SUPERSEDED] == 118
    late.close()


def test_landings_and_stops_precede_set_points_of_other_vehicles(reactor: Reactor) -> None:
    order: list[bytes] = []
    late = [shared(reactor) for _ in range(6)]
    stalled, *steered, stopping, landing = late
    for each in late:
        each.order = order
    stalled.stall()
    for number, each in enumerate(steered):
        assert each.client.send(command(number, FLY))
    stop, land = command(10, EmergencyStop()), command(11, LAND)
    assert stopping.client.send(stop)
    assert landing.client.send(command(9, FLY))
    assert landing.client.send(land)
    stalled.gate.set()
    wait_until(lambda: len(order) == 7, "all packets were handled")
    assert order.index(stop) <= 2
    assert order.index(land) <= 4  # behind its own set-point
    assert set(order[-2:]) < {command(number, FLY) for number in range(3)}
    for each in late:
        each.close()


def test_a_flood_from_one_pilot_delays_no_other_vehicle(reactor: Reactor) -> None:
    """Two hundred requests on one connection, repeated landings on another: both get their turns."""
    order: list[bytes] = []
    stalled, flooding, asking, flying = late = [shared(reactor) for _ in range(4)]
    for each in late:
        each.order = order
    stalled.stall()
    landings = [command(seq, LAND) for seq in range(100)]
    questions = [encode(Request(seq, Ping(seq))) for seq in range(2, 102)]
    for landed, question in zip(landings, questions, strict=True):
        assert flooding.client.send(landed)
        assert asking.client.send(question)
    steer = command(1, FLY)
    assert flying.client.send(steer)
    stalled.gate.set()
    wait_until(lambda: len(order) == 202, "all packets were handled")
    assert order.index(steer) <= 5
    assert order.index(questions[20]) < order.index(landings[-1])
    assert [packet for packet in order if packet in landings] == landings
    assert [packet for packet in order if packet in questions] == questions
    for each in late:
        each.close()
