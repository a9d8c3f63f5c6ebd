"""An emulated Crazyflie over a simulation stepped by the tests: no thread, no socket, no clock."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import replace
from typing import Final

from skyloop.clock import NS_PER_S
from skyloop.messages import FlightState
from skyloop.sim.dynamics import STEP_S
from skyloop.sim.host import Report
from skyloop.sim.parameters import with_ideal_sensors
from skyloop.sim.reports import VehicleTruth
from skyloop.sim.simulation import Simulation
from skyloop.sim.vehicles import CRAZYFLIE
from skyloop.sim.world_file import load_world
from skyloop.vehicles.crazyflie.emulator.logic import CrazyflieLogic
from skyloop.vehicles.crazyflie.wire.commander import HighLevelTakeoff, Message
from skyloop.vehicles.crazyflie.wire.crtp import CrtpPacket
from skyloop.vehicles.emulation.flight import SimulatedVehicle

TICK_S: Final = 0.008


class Bench:
    """A vehicle whose time passes in ticks of 8 ms. ``sent`` lists unsolicited packets."""

    def __init__(self, *, protocol: int = 12, auto_arm: bool = True) -> None:
        world = replace(load_world("empty", 0), targets=())
        self.simulation = Simulation(world, seed=1, parameters=with_ideal_sensors(CRAZYFLIE))
        self.protocol, self.auto_arm = protocol, auto_arm
        self.stored: dict[int, float] = {}
        self.ranges = {"front": 1.5, "up": 99.0}
        self.sent: list[CrtpPacket] = []
        self.restart()

    def restart(self) -> None:
        vehicle = SimulatedVehicle(self.simulation, 0)
        self.logic = CrazyflieLogic(
            vehicle, 0.575, lambda: self.ranges, self.stored, protocol=self.protocol, auto_arm=self.auto_arm
        )
        self._update()

    def _update(self) -> None:
        time_ns = round(self.simulation.time_s * NS_PER_S)
        self.sent += self.logic.update(Report(self.simulation.feedback(0), self.simulation.truth(0), (), time_ns))

    def tick(self) -> None:
        self.simulation.step(round(TICK_S / STEP_S))
        self._update()

    def run(self, seconds: float, message: Message | None = None, every_s: float = 0.05) -> None:
        """Let time pass; send a message at the start and then regularly."""
        for n in range(round(seconds / TICK_S)):
            if message is not None and n % round(every_s / TICK_S) == 0:
                self.send(message)
            self.tick()

    def until(self, condition: Callable[[], bool], within_s: float) -> float:
        """Return the time until the condition holds [s]."""
        for ticks in range(round(within_s / TICK_S)):
            if condition():
                return ticks * TICK_S
            self.tick()
        raise AssertionError(f"not within {within_s} s; {self.truth}, {self.logic.flight.supervisor:#x}")

    def send(self, message: Message) -> list[CrtpPacket]:
        return self.logic.receive(message.encode(self.protocol))

    def ask(self, port: int, channel: int, form: str, *values: float | bytes) -> bytes:
        """Return the data of the only answer to a packet."""
        (answer,) = self.logic.receive(CrtpPacket(port, channel, struct.pack("<" + form, *values)))
        assert (answer.port, answer.channel) == (port, channel)
        return answer.data

    def fly(self, height: float = 1.0) -> None:
        """Take off by the high-level commander, and wait."""
        self.send(HighLevelTakeoff(0, height, 0.0, True, 2.0))
        self.run(4.0)
        assert abs(self.place[2] - height) < 0.1

    @property
    def place(self) -> tuple[float, float, float, float]:
        return self.logic.flight.place

    @property
    def truth(self) -> VehicleTruth:
        return self.simulation.truth(0)

    @property
    def state(self) -> FlightState:
        return self.simulation.state(0)

    @property
    def turns(self) -> bool:
        """Whether the motors run."""
        return self.state not in (FlightState.LANDED, FlightState.EMERGENCY)
