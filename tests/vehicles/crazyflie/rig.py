"""A session and an emulated Crazyflie in one simulated time: no sockets, no threads; datagrams are lost on request."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from skyloop.clock import NS_PER_S, ManualClock
from skyloop.drivers.recording_sink import RecordingSink
from skyloop.drivers.vehicle_session import deliver
from skyloop.messages import AnyAction, Feedback, FlightState, LinkState, Takeoff
from skyloop.sim.dynamics import STEP_S
from skyloop.sim.host import Report
from skyloop.sim.parameters import with_ideal_sensors
from skyloop.sim.simulation import Simulation
from skyloop.sim.vehicles import CRAZYFLIE
from skyloop.sim.world_file import load_world
from skyloop.vehicles.crazyflie.cache import ContentsCache
from skyloop.vehicles.crazyflie.emulator.logic import CrazyflieLogic
from skyloop.vehicles.crazyflie.options import CrazyflieOptions, LinkKind
from skyloop.vehicles.crazyflie.protocol import CrazyflieSession
from skyloop.vehicles.crazyflie.wire.commander import EmergencyStopMessage, Message, decode_message
from skyloop.vehicles.crazyflie.wire.crtp import HELLO, CrtpPacket
from skyloop.vehicles.emulation.flight import SimulatedVehicle

TICK_S = 0.01
OPTIONS = CrazyflieOptions(LinkKind.UDP, "127.0.0.1", 19850)


class Rig:
    """``lost``: the share of datagrams lost in each direction. ``on``: the vehicle is switched on."""

    def __init__(
        self, folder: Path, options: CrazyflieOptions = OPTIONS, *, protocol: int = 12, lost: float = 0.0
    ) -> None:
        self.clock = ManualClock(100 * NS_PER_S)
        world = replace(load_world("empty", 0), targets=())
        self.simulation = Simulation(world, seed=1, parameters=with_ideal_sensors(CRAZYFLIE))
        self.protocol = protocol
        self.logic = self._booted()
        self.session = CrazyflieSession(options, self.clock.now_ns, cache=ContentsCache(folder))
        self.sink = RecordingSink()
        self.on = True
        self.deaf = False  # it receives nothing, but sends
        self.mute = False  # it receives, but sends nothing
        self.loses: tuple[str, ...] = ()  # kinds of messages that are lost on their way to the vehicle
        self.sent: list[tuple[float, Message]] = []  # what the driver sent to fly or stop the vehicle, with its time
        self.stops: set[int] = set()  # ports that an emergency stop was sent to
        self.passes: Callable[[Message | None], bool] = lambda _: True  # whether the vehicle receives it
        self.keeps: Callable[[CrtpPacket], bool] = lambda _: True  # whether the driver receives it
        self.asked = 0  # number of datagrams sent
        self.waiting: list[bytes] = []
        self._chance = random.Random(7)
        self._lost = lost

    def _booted(self) -> CrazyflieLogic:
        vehicle = SimulatedVehicle(self.simulation, 0)
        logic = CrazyflieLogic(vehicle, 0.5, dict, {}, protocol=self.protocol)
        logic.update(self._report())
        return logic

    def restart(self) -> None:
        self.logic = self._booted()

    @property
    def now_ns(self) -> int:
        return self.clock.now_ns

    def _report(self) -> Report:
        return Report(self.simulation.feedback(0), self.simulation.truth(0), (), self.clock.now_ns)

    def step(self) -> None:
        self.clock.advance(TICK_S)
        self.simulation.step(round(TICK_S / STEP_S))
        arrived = [packet.encode() for packet in self.logic.update(self._report())] + self.waiting
        self.waiting = []
        for datagram in arrived:
            heard = self.on and not self.mute and self.keeps(CrtpPacket.decode(datagram))
            if heard and self._chance.random() >= self._lost:
                self.session.on_datagram(datagram, self.now_ns)
        if self.now_ns >= self.session.due_ns:
            self.send()
        deliver(self.sink, self.session.drain())

    def send(self) -> None:
        for datagram in self.session.poll(self.now_ns):
            self.asked += 1
            packet = CrtpPacket.decode(datagram)
            message = decode_message(packet)
            if isinstance(message, EmergencyStopMessage):
                self.stops.add(packet.port)
            if message is not None:
                self.sent.append((self.now_ns / NS_PER_S, message))
            if type(message).__name__ in self.loses:
                continue
            if self.on and not self.deaf and self.passes(message) and self._chance.random() >= self._lost:
                self.waiting += [HELLO] if datagram == HELLO else [a.encode() for a in self.logic.receive(packet)]

    def apply(self, action: AnyAction, *, new: bool = True) -> AnyAction:
        applied = self.session.command(action, self.now_ns, new=new)
        if self.session.due_ns <= self.now_ns:
            self.send()
        return applied

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / TICK_S)):
            self.step()

    def until(self, condition: Callable[[], object], within_s: float) -> float:
        """Return the time until the condition holds [s]."""
        for steps in range(round(within_s / TICK_S)):
            if condition():
                return steps * TICK_S
            self.step()
        raise AssertionError(f"not within {within_s} s: {self.sink.links[-3:]}, {self.newest}, {self.sent[-10:]}")

    @property
    def newest(self) -> Feedback:
        assert self.sink.newest is not None
        return self.sink.newest

    @property
    def state(self) -> FlightState:
        return self.newest.state

    def ready(self) -> None:
        self.until(lambda: self.sink.link_state is LinkState.UP, 20.0)

    def kinds(self, since_s: float = 0.0) -> list[str]:
        """Return the names of the messages sent since a time."""
        return [type(message).__name__ for at, message in self.sent if at >= since_s]


def flying(folder: Path, **arguments: object) -> Rig:
    rig = Rig(folder, **arguments)  # type: ignore[arg-type]
    rig.ready()
    rig.run(0.3)
    rig.apply(Takeoff())
    rig.until(lambda: rig.state is FlightState.HOVERING, 8.0)
    return rig
