"""A Tello's board over a simulation stepped by the tests: no thread, no socket, no clock."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Final

from skyloop.clock import NS_PER_S, ManualClock
from skyloop.messages import FlightState
from skyloop.sim.dynamics import STEP_S
from skyloop.sim.host import Report
from skyloop.sim.parameters import with_ideal_sensors
from skyloop.sim.reports import VehicleTruth
from skyloop.sim.simulation import Simulation
from skyloop.sim.world_file import load_world
from skyloop.vehicles.emulation.emulator import Address
from skyloop.vehicles.emulation.flight import SimulatedVehicle
from skyloop.vehicles.tello.emulator import LIMITS, TELLO
from skyloop.vehicles.tello.emulator.logic import TelloLogic
from skyloop.vehicles.tello.wire import Sdk, TelloState, parse

TICK_S: Final = 0.02
PILOT: Final = ("10.0.0.2", 9000)


class Bench:
    """A board whose time passes in ticks of 20 ms. ``answers`` lists the answers with their recipients."""

    def __init__(self, sdk: Sdk = Sdk.V3_0, pads: Mapping[int, tuple[float, float]] | None = None) -> None:
        world = replace(load_world("empty", 0), targets=())
        self.simulation = Simulation(world, seed=1, parameters=with_ideal_sensors(TELLO))
        self.simulation.set_limits(0, LIMITS)
        self.clock = ManualClock(100 * NS_PER_S)
        self.answers: list[tuple[str, Address]] = []
        vehicle = SimulatedVehicle(self.simulation, 0)
        self.logic = TelloLogic(
            vehicle, lambda text, to: self.answers.append((text, to)), self.clock, sdk=sdk, pads=pads or {}
        )
        self._look()

    def tick(self) -> None:
        self.clock.advance(TICK_S)
        self.simulation.step(round(TICK_S / STEP_S))
        self._look()

    def _look(self) -> None:
        report = Report(self.simulation.feedback(0), self.simulation.truth(0), (), self.clock.now_ns)
        self.logic.supervise(report)

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / TICK_S)):
            self.tick()

    def until(self, condition: Callable[[], bool], within_s: float) -> float:
        """Return the time until the condition holds [s]."""
        for ticks in range(round(within_s / TICK_S)):
            if condition():
                return ticks * TICK_S
            self.tick()
        raise AssertionError(f"not within {within_s} s; {self.truth}")

    def say(self, text: str) -> None:
        self.logic.receive(text.encode(), PILOT)

    def ask(self, text: str, within_s: float = 0.0) -> str:
        """Return the answer to a command, at once or within a time."""
        before = len(self.answers)
        self.say(text)
        self.until(lambda: len(self.answers) > before, within_s + TICK_S)
        answer, to = self.answers[-1]
        assert to == PILOT
        return answer

    def fly(self) -> None:
        """Take off and wait for the answer."""
        assert self.ask("command") == "ok"
        assert self.ask("takeoff", 12.0) == "ok"

    @property
    def truth(self) -> VehicleTruth:
        return self.simulation.truth(0)

    @property
    def flight(self) -> FlightState:
        return self.truth.state

    @property
    def state(self) -> TelloState:
        datagram = self.logic.state_string()
        assert datagram is not None
        return parse(datagram)
