"""The driver's session connected directly to the emulated board, in simulated time: no thread, no socket."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import replace
from typing import Final

from skyloop.clock import NS_PER_S, ManualClock
from skyloop.drivers.base import ExternalPose
from skyloop.drivers.recording_sink import RecordingSink
from skyloop.drivers.uri import parse_uri
from skyloop.messages import Attitude, Feedback
from skyloop.sim.dynamics import STEP_S
from skyloop.sim.host import Report
from skyloop.sim.parameters import with_ideal_sensors
from skyloop.sim.simulation import Simulation
from skyloop.sim.world_file import load_world
from skyloop.vehicles.emulation.flight import SimulatedVehicle
from skyloop.vehicles.msp.emulator import RACER, BoardSettings, EmulatedBoard
from skyloop.vehicles.msp.parameters import MspOptions, options_of
from skyloop.vehicles.msp.protocol import MspSession
from skyloop.vehicles.msp.wire.frames import Direction, MspFrame, Parser, encode

TICK_S: Final = 0.008
POSE_TICKS: Final = 2
BATTERY_FREE: Final = with_ideal_sensors(RACER)


def options(text: str = "msp://tcp:127.0.0.1:5761") -> MspOptions:
    return options_of(parse_uri(text))


class Bench:
    """A drone on the ground, seen by cameras if ``poses``; ``cut``: nothing passes; ``deaf``: no reply passes.

    ``world_speed``: speed of the simulated world relative to board and driver. ``noise_m``: noise of the poses' height.
    ``unanswered``: functions whose replies are lost. ``refused``: functions that it does not know.
    ``seed``: seed of the noise.
    """

    def __init__(
        self,
        settings: BoardSettings | None = None,
        text: str = "msp://tcp:127.0.0.1:5761",
        *,
        poses: bool = True,
        seed: int = 3,
    ) -> None:
        world = replace(load_world("empty", 0), targets=())
        self.simulation = Simulation(world, seed=1, parameters=BATTERY_FREE)
        self.clock = ManualClock(100 * NS_PER_S)
        self.board = EmulatedBoard(SimulatedVehicle(self.simulation, 0), settings or BoardSettings(), self.clock.now_ns)
        self.sink = RecordingSink()
        self.poses = poses
        self.cut = self.deaf = False
        self.unanswered: set[int] = set()
        self.refused: set[int] = set()
        self.world_speed = 1.0
        self.noise_m = 0.0
        self._random = random.Random(seed)
        self._behind_s = 0.0
        self.sent: list[MspFrame] = []
        self._parser = Parser()
        self._ticks = 0
        self._look()
        self.session = MspSession(options(text), self.clock.now_ns)

    @property
    def height_m(self) -> float:
        return self.simulation.truth(0).position_m[2]

    @property
    def climb_m_s(self) -> float:
        return self.simulation.truth(0).velocity_m_s[2]

    @property
    def feedback(self) -> Feedback:
        assert self.sink.newest is not None
        return self.sink.newest

    def reconnect(self, text: str = "msp://tcp:127.0.0.1:5761") -> None:
        """Start a new session, as when another proxy takes over."""
        self.session = MspSession(options(text), self.clock.now_ns)
        self._parser.reset()

    def fly(self, roll: float = 0.0, pitch: float = 0.0, climb: float = 0.0, yaw_rate: float = 0.0) -> None:
        """Steer it; a climb from the ground is a requested take-off."""
        if climb > 0:
            self.session.ask_takeoff(self.clock.now_ns)
        self.session.command(Attitude(roll, pitch, climb, yaw_rate), self.clock.now_ns)

    def tick(self) -> None:
        self.clock.advance(TICK_S)
        self._behind_s += TICK_S * self.world_speed
        steps = int(self._behind_s / STEP_S + 1e-9)
        self._behind_s -= steps * STEP_S
        if steps:
            self.simulation.step(steps)
        self._ticks += 1
        self._look()
        now_ns = self.clock.now_ns
        if self.poses and self._ticks % POSE_TICKS == 0:
            truth = self.simulation.truth(0)
            x, y, z = truth.position_m
            seen = x, y, z + self._random.gauss(0.0, self.noise_m)
            self.session.on_pose(ExternalPose(seen, truth.quaternion, now_ns), now_ns)
        if now_ns >= self.session.due_ns:
            self._exchange(self.session.poll(now_ns))
        for publish in self.session.drain():
            publish(self.sink)

    def _exchange(self, data: bytes) -> None:
        if self.cut:
            return
        for frame in self._parser.feed(data):
            self.sent.append(frame)
            reply = self.board.answer(frame, self.clock.now_ns)
            if frame.function in self.refused:
                reply = MspFrame(frame.function, b"", Direction.ERROR)
            if reply is not None and not self.deaf and frame.function not in self.unanswered:
                self.session.receive(encode(reply), self.clock.now_ns)

    def _look(self) -> None:
        now_ns = self.clock.now_ns
        self.board.tick(Report(self.simulation.feedback(0), self.simulation.truth(0), (), now_ns), now_ns)

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / TICK_S)):
            self.tick()

    def until(self, condition: Callable[[], bool], within_s: float) -> float:
        """Return how long it took [s]."""
        for ticks in range(round(within_s / TICK_S)):
            if condition():
                return ticks * TICK_S
            self.tick()
        raise AssertionError(f"not within {within_s} s: {self.simulation.truth(0)}, {self.sink.events}")

    def ready(self) -> None:
        """Wait until it can be armed."""
        self.until(lambda: self.sink.newest is not None and not self.session.setpoints.report.hindrances, 5.0)

    def take_off(self, hover: float | None = 0.32) -> None:
        """Rise to a metre and hold there; ``hover``: the throttle learnt in an earlier flight."""
        self.ready()
        self.session.setpoints.hover = hover
        self.fly(climb=0.7)
        self.until(lambda: self.height_m > 1.0, 20.0)
        self.fly()
        self.run(1.0)

    def texts(self, reason: str) -> list[str]:
        """Return the texts of events with this reason."""
        return [event.text for event in self.sink.events if event.data.get("reason") == reason]
