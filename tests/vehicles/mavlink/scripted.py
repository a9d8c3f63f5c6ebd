"""A session on a manual clock, and a vehicle whose messages the tests choose."""

from __future__ import annotations

from typing import Any

from skyloop.clock import ManualClock, nanoseconds
from skyloop.drivers.recording_sink import RecordingSink
from skyloop.drivers.uri import parse_uri
from skyloop.messages import AnyAction, Feedback, FlightState, LinkState
from skyloop.vehicles.mavlink.options import MavlinkOptions, Peer, options_of
from skyloop.vehicles.mavlink.protocol import TICK_NS, MavlinkSession
from skyloop.vehicles.mavlink.wire.codec import COPTER_NUMBERS, Landed, MavlinkCodec, Message, px4_custom
from skyloop.vehicles.mavlink.wire.codec import dialect as m

PEER: Peer = ("127.0.0.1", 14580)
PX4 = 12
ARDUPILOT = 3


def options(text: str = "mavlink://udpin:127.0.0.1:14540?parameters=no") -> MavlinkOptions:
    return options_of(parse_uri(text))


class Vehicle:
    """A scripted autopilot. ``autopilot``: :data:`PX4` or :data:`ARDUPILOT`."""

    def __init__(self, autopilot: int, system: int = 1, *, version: int = 2) -> None:
        self.autopilot = autopilot
        self.codec = MavlinkCodec(system, 1)
        self.version = version
        self.mode = "STABILIZE" if autopilot == ARDUPILOT else "AUTO.LOITER"
        self.armed = False
        self.status = 3
        self.kind = 2
        self.landed = Landed.ON_GROUND
        self.ready = True
        self.remote = False  # it receives a remote control
        self.flags = 0x1F  #: of its estimator
        self.boot_ms = 10_000
        self.place = (0.0, 0.0, 0.0)
        self.knows_place = True
        self.velocity = (0.0, 0.0, 0.0)
        self.yaw = 0.0
        self.amsl_m = 488.0

    def heartbeat(self) -> Message:
        custom = COPTER_NUMBERS[self.mode] if self.autopilot == ARDUPILOT else px4_custom(self.mode)
        return m.MAVLink_heartbeat_message(self.kind, self.autopilot, 1 | self.armed << 7, custom, self.status, 3)

    def telemetry(self) -> list[Message]:
        """Return all streamed messages."""
        receiver = 0x10000 * self.remote
        present = receiver | 0x10000000 * (self.autopilot != PX4)  # a PX4 never reports that it has this check
        healthy = receiver | 0x10000000 * self.ready
        altitude = -self.place[2]
        local = m.MAVLink_local_position_ned_message(self.boot_ms, *self.place, *self.velocity)
        return [
            *([local] if self.knows_place else []),
            m.MAVLink_global_position_int_message(
                self.boot_ms, 0, 0, round((self.amsl_m + altitude) * 1000), round(altitude * 1000), 0, 0, 0, 0
            ),
            m.MAVLink_extended_sys_state_message(0, int(self.landed)),
            m.MAVLink_sys_status_message(present, present, healthy, 0, 12_000, 0, 80, 0, 0, 0, 0, 0, 0),
            m.MAVLink_estimator_status_message(0, self.flags, 0, 0, 0, 0, 0, 0, 0, 0)
            if self.autopilot == PX4
            else m.MAVLink_ekf_status_report_message(self.flags, 0, 0, 0, 0, 0),
            m.MAVLink_attitude_message(self.boot_ms, 0.1, 0.2, self.yaw, 0.0, 0.0, 0.0),
        ]


class Bench:
    """A session, its vehicle, and the traffic between them."""

    def __init__(self, vehicle: Vehicle, given: MavlinkOptions | None = None) -> None:
        self.vehicle = vehicle
        self.clock = ManualClock()
        self.session = MavlinkSession(given or options(), self.clock())
        self.sink = RecordingSink()
        self.said: list[Message] = []
        self.frames: list[bytes] = []
        self.peers: set[Peer] = set()  # receivers of packets
        self._ears = MavlinkCodec(1, 1)
        self.deliver()

    def hear(self, *messages: Message, peer: Peer = PEER, codec: MavlinkCodec | None = None) -> None:
        for message in messages:
            frame = (codec or self.vehicle.codec).encode(message, version=self.vehicle.version)
            self.session.receive(frame, peer, self.clock(), whole=True)
        self.deliver()

    def deliver(self) -> None:
        for publish in self.session.drain():
            publish(self.sink)

    def tick(self) -> None:
        for frame, peer, _ in self.session.poll(self.clock()):
            self.peers.add(peer)
            self.frames.append(frame)
            self.said += self._ears.decode(frame, whole=True)
        self.deliver()

    def go_on(self, seconds: float, *, silent: bool = False) -> None:
        """Advance the time; the vehicle sends all messages at 50 Hz, its heartbeat at 5 Hz."""
        for step in range(round(nanoseconds(seconds) / TICK_NS)):
            self.clock.advance(TICK_NS / 1e9)
            self.vehicle.boot_ms += 20
            if not silent:
                if step % 10 == 0:
                    self.hear(self.vehicle.heartbeat())
                self.hear(*self.vehicle.telemetry())
            self.tick()

    def found(self) -> Bench:
        """Connect, with all messages flowing."""
        self.hear(self.vehicle.heartbeat())
        self.go_on(0.5)
        self.said.clear()
        return self

    def flying(self, mode: str, height_m: float = 3.0) -> Bench:
        """Put it in the air, flown by another operator."""
        vehicle = self.vehicle
        vehicle.mode, vehicle.armed, vehicle.status, vehicle.landed = mode, True, 4, Landed.IN_AIR
        vehicle.place = (0.0, 0.0, -height_m)
        return self.found()

    def apply(self, action: AnyAction, *, alone: bool = False, new: bool = True) -> AnyAction:
        applied = self.session.command(action, self.clock(), alone=alone, new=new)
        self.tick()
        return applied

    def heard_of(self, kind: str) -> list[Message]:
        """Return messages of this kind to the vehicle since the last call."""
        found = [message for message in self.said if message.get_type() == kind]
        self.said = [message for message in self.said if message.get_type() != kind]
        return found

    def commands(self) -> list[tuple[Any, ...]]:
        """Return number and arguments of commands, without message requests."""
        asked = (m.MAV_CMD_SET_MESSAGE_INTERVAL, m.MAV_CMD_REQUEST_MESSAGE)
        return [
            (each.command, *(each.param1, each.param2, each.param3, each.param7))
            for each in self.heard_of("COMMAND_LONG")
            if each.command not in asked
        ]

    def answer(self, command: int, result: int = 0) -> None:
        self.hear(m.MAVLink_command_ack_message(command, result, 0, 0, 255, 190))

    @property
    def newest(self) -> Feedback:
        assert self.sink.newest is not None
        return self.sink.newest

    def state(self) -> FlightState:
        """As last reported."""
        return self.newest.state

    def link(self) -> LinkState | None:
        """As last reported."""
        return self.sink.link_state

    @property
    def texts(self) -> list[str]:
        return [event.text for event in self.sink.events]
