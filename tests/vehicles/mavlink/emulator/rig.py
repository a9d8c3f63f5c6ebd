"""An emulated autopilot without threads or sockets: messages in, messages out, time step by step."""

from __future__ import annotations

import math
from collections.abc import Callable

from skyloop.sim.dynamics import STEP_S
from skyloop.sim.host import Report
from skyloop.sim.parameters import VehicleParameters, with_ideal_sensors
from skyloop.sim.simulation import Simulation
from skyloop.sim.world_file import load_world
from skyloop.vehicles.emulation.flight import SimulatedVehicle
from skyloop.vehicles.mavlink.emulator import Kind
from skyloop.vehicles.mavlink.emulator.arducopter import EmulatedArduCopter
from skyloop.vehicles.mavlink.emulator.links import LinkIntervals
from skyloop.vehicles.mavlink.emulator.manoeuvres import geodetic
from skyloop.vehicles.mavlink.emulator.px4 import EmulatedPx4
from skyloop.vehicles.mavlink.wire.codec import MavlinkCodec, Message, Texts
from skyloop.vehicles.mavlink.wire.codec import dialect as m

TICK_STEPS = 4
HOME_M = 488.0


class Wire:
    """A link that records sent messages."""

    def __init__(self, streams: LinkIntervals) -> None:
        self.streams = streams
        self.sent: list[Message] = []
        self._out, self._in = MavlinkCodec(1, 1), MavlinkCodec(255, 190)

    def send(self, message: Message) -> None:
        self.sent += self._in.decode(self._out.encode(message), whole=True)

    def close(self) -> None: ...


class Rig:
    """One autopilot, and a program with a ground station's default ids."""

    def __init__(self, kind: Kind, *, boot_s: float = 1.0, gps: bool = True) -> None:
        vehicle = with_ideal_sensors(VehicleParameters())
        self.simulation = Simulation(load_world("empty"), 1, seed=1, parameters=vehicle)
        made = EmulatedArduCopter if kind is Kind.ARDUCOPTER else EmulatedPx4
        self.autopilot = made(SimulatedVehicle(self.simulation, 0), 1, boot_s, gps)
        self.wire = Wire(LinkIntervals(made.RATES))
        self.autopilot.ports = (self.wire,)
        self.kind = kind
        self._program = MavlinkCodec(255, 190)
        self._ears = MavlinkCodec(1, 1)
        self._texts = Texts()
        self._now_ns = 0
        self.heartbeats = True
        self._beaten_s = -1.0

    def go_on(self, seconds: float, *set_points: Message, rate_hz: float = 20.0) -> None:
        """Advance the time, with a heartbeat per second and any given set-points."""
        due_s = 0.0
        for _ in range(round(seconds / (TICK_STEPS * STEP_S))):
            self.simulation.step(TICK_STEPS)
            self._now_ns = round(self.simulation.time_s * 1e9)
            self.autopilot.tick(
                Report(self.simulation.feedback(0), self.simulation.truth(0), (), captured_ns=self._now_ns)
            )
            if self.heartbeats and self.simulation.time_s - self._beaten_s >= 1.0:
                self._beaten_s = self.simulation.time_s
                self.say(m.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
            if set_points and self.simulation.time_s >= due_s:
                due_s = self.simulation.time_s + 1.0 / rate_hz
                for each in set_points:
                    self.say(each)

    def until(self, done: Callable[[], bool], within_s: float) -> float:
        """Advance the time until ``done``, or fail. Return the maximum height on the way."""
        highest, end_s = self.height, self.simulation.time_s + within_s
        while not done():
            assert self.simulation.time_s < end_s
            self.go_on(0.1)
            highest = max(highest, self.height)
        return highest

    def say(self, message: Message, codec: MavlinkCodec | None = None) -> None:
        (came,) = self._ears.decode((codec or self._program).encode(message), whole=True)
        self.autopilot.on_message(self.wire, came, self._now_ns)

    def command(self, number: int, *arguments: float) -> int | None:
        """Return the command's result; None without an acknowledgement."""
        self.wire.sent.clear()
        padded = (*arguments, *[0.0] * (7 - len(arguments)))
        self.say(m.MAVLink_command_long_message(1, 1, number, 0, *padded))
        results = [each.result for each in self.wire.sent if each.get_type() == "COMMAND_ACK"]
        return results[0] if results else None

    def command_at(
        self, number: int, frame: int, first: tuple[float, ...], east: float, north: float, altitude: float
    ) -> int | None:
        """Return the result of a command with a position in COMMAND_INT."""
        self.wire.sent.clear()
        latitude, longitude, _ = geodetic((east, north, 0.0))
        self.say(m.MAVLink_command_int_message(1, 1, frame, number, 0, 0, *first, latitude, longitude, altitude))
        return int(self.of("COMMAND_ACK")[0].result)

    def place_at(self, east: float, north: float, altitude: float, *, frame: int = 6) -> Message:
        """Return a set-point with a position on the Earth."""
        latitude, longitude, _ = geodetic((east, north, 0.0))
        return m.MAVLink_set_position_target_global_int_message(
            0, 1, 1, frame, 0xDF8, latitude, longitude, altitude, *[0.0] * 8
        )

    def mode(self, main: float, sub: float = 0.0) -> int | None:
        return self.command(m.MAV_CMD_DO_SET_MODE, 1, main, sub)

    def arm(self) -> int | None:
        return self.command(m.MAV_CMD_COMPONENT_ARM_DISARM, 1)

    def velocity(self, north: float, east: float, down: float, *, frame: int = 1, yaw_rate: float = 0.0) -> Message:
        return m.MAVLink_set_position_target_local_ned_message(
            0, 1, 1, frame, 0x5C7, 0, 0, 0, north, east, down, 0, 0, 0, 0, yaw_rate
        )

    def up(self, height_m: float = 3.0) -> None:
        """Get it ready, armed and flying."""
        self.go_on(1.5)
        if self.kind is Kind.ARDUCOPTER:
            assert (self.mode(4), self.arm()) == (0, 0)
            assert self.command(m.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, height_m) == 0
        else:
            nan = math.nan
            assert self.arm() == 0
            assert self.command(m.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, nan, nan, nan, HOME_M + height_m) == 0
        self.go_on(6.0)
        assert self.height > height_m - 0.4

    def offboard(self, set_point: Message) -> None:
        self.go_on(1.2, set_point)
        assert self.mode(6) == 0

    @property
    def height(self) -> float:
        return self.simulation.truth(0).position_m[2]

    @property
    def place(self) -> tuple[float, float]:
        east, north, _ = self.simulation.truth(0).position_m
        return east, north

    @property
    def speed(self) -> tuple[float, float, float]:
        """East, north, up."""
        return self.simulation.truth(0).velocity_m_s

    def texts(self) -> list[str]:
        """Return its texts since the last call."""
        said = [text for each in self.of("STATUSTEXT") for _, text in self._texts.on_message(each)]
        self.wire.sent.clear()
        return said

    def of(self, kind: str) -> list[Message]:
        return [each for each in self.wire.sent if each.get_type() == kind]
