"""A drone and its radio without sockets, threads or clocks, for tests of the pure session."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from skyloop.clock import NS_PER_S, ManualClock, nanoseconds
from skyloop.drivers.recording_sink import RecordingSink
from skyloop.vehicles.ardrone.configuration import own_ids
from skyloop.vehicles.ardrone.options import ArdroneOptions
from skyloop.vehicles.ardrone.protocol import ArdroneSession
from skyloop.vehicles.ardrone.wire.at import AtCommand, Ctrl, Ref, parse_commands
from skyloop.vehicles.ardrone.wire.configuration import DEFAULT_ID, Value, format_dump, keys_of, parse_value
from skyloop.vehicles.ardrone.wire.navdata import ControlState, Demo, Option, State, encode

STEP_S: Final = 0.01
NAVDATA_STEPS: Final = 2
IDS: Final = own_ids(0x5E5510A1)
_ID_KEYS: Final = ("custom:session_id", "custom:profile_id", "custom:application_id")


class ScriptedDrone:
    """Acknowledges, keeps its configuration, takes off and lands at once."""

    def __init__(self, version: int = 2) -> None:
        self.version = version
        self.values: dict[str, Value] = {}
        self.stubborn: set[str] = set()  # keys that it acknowledges but does not change
        self.deaf = False  # it ignores all commands
        self.refuses_takeoff = False
        self.commands: list[AtCommand] = []  # obeyed
        self.toggles = 0  # of its emergency
        self.stale = 0
        self.telemetry: list[Option] = []  # in addition to the demo option
        self.extra = State(0)  # bits that stay set
        self.restart()

    def restart(self) -> None:
        """Switch it off and on."""
        known = keys_of(self.version)
        self.values = {name: key.default for name, key in known.items()}
        self.values["general:num_version_soft"] = "2.4.8" if self.version == 2 else "1.7.4"
        self.state = State.BOOTSTRAP | State.COMMUNICATION_WATCHDOG
        self.control = ControlState.LANDED
        self.sequence = 0
        self.heard_sequence = 0
        self.dump_asked = False
        self._ids: tuple[str, ...] | None = None
        self._ref = Ref(0)

    @property
    def names(self) -> list[str]:
        """Names of the obeyed commands, in order."""
        return [command.name for command in self.commands]

    def take(self, datagram: bytes) -> None:
        """Handle a datagram of AT commands."""
        if self.deaf:
            return
        commands, malformed = parse_commands(datagram)
        assert not malformed, datagram
        for command in commands:
            if command.sequence != 1 and command.sequence <= self.heard_sequence:
                self.stale += 1
                continue
            self.heard_sequence = command.sequence
            self.commands.append(command)
            self._obey(command)

    def land(self) -> None:
        """Land without a command."""
        self.state &= ~State.FLYING
        self.control = ControlState.LANDED

    def hear_bit(self) -> None:
        """Simulate another program's emergency bit, which stayed set and is known to the drone."""
        self._ref = Ref.EMERGENCY

    def navdata(self) -> bytes:
        """Return its next datagram."""
        self.sequence += 1
        bits = self.state | self.extra
        if State.BOOTSTRAP in self.state:
            return encode(bits, self.sequence)
        altitude = 800 if State.FLYING in self.state else 0
        demo = Demo(ctrl_state=self.control << 16, battery=70, altitude=altitude)
        return encode(bits, self.sequence, [demo, *self.telemetry])

    def dump(self) -> bytes:
        """Return the output of its control port."""
        return format_dump(self.values)

    def _obey(self, command: AtCommand) -> None:
        arguments = command.arguments
        if command.name == "COMWDG":
            self.state &= ~State.COMMUNICATION_WATCHDOG
        elif command.name == "REF":
            self._refer(Ref(int(arguments[0])))
        elif command.name == "CTRL" and arguments[0] == Ctrl.CLEAR_ACK:
            self.state &= ~State.COMMAND_ACK
        elif command.name == "CTRL" and arguments[0] == Ctrl.GET_CONFIGURATION:
            self.dump_asked = True
        elif command.name == "CONFIG_IDS":
            self._ids = tuple(str(argument) for argument in arguments)
            return
        elif command.name == "CONFIG":
            self._configure(str(arguments[0]), str(arguments[1]))
        self._ids = None

    def _refer(self, bits: Ref) -> None:
        if bits & ~self._ref & Ref.EMERGENCY:
            self.state ^= State.EMERGENCY
            self.toggles += 1
        self._ref = bits
        if self.state & State.EMERGENCY or not bits & Ref.TAKEOFF:
            self.state &= ~State.FLYING
            self.control = ControlState.LANDED
        elif not self.refuses_takeoff:
            self.state |= State.FLYING
            self.control = ControlState.HOVERING

    def _configure(self, key: str, text: str) -> None:
        self.state |= State.COMMAND_ACK
        present = tuple(str(self.values.get(name, DEFAULT_ID)) for name in _ID_KEYS)
        shared = all(one == DEFAULT_ID for one in present)
        if key not in _ID_KEYS and not shared and self._ids != present:
            return
        if key in self.stubborn or key not in self.values:
            return
        self.values[key] = parse_value(text, self.values[key])
        if key == "general:navdata_demo":
            self.state = self.state & ~State.BOOTSTRAP & ~State.DEMO | (State.DEMO if self.values[key] else State(0))


class Rig:
    """A session, its drone and the time. ``lost`` decides for each datagram, in either direction, whether to drop it.

    ``late`` returns the delay of a datagram [s], given whether it goes up.
    """

    def __init__(self, options: ArdroneOptions | None = None, drone: ScriptedDrone | None = None) -> None:
        self.clock = ManualClock(100 * NS_PER_S)
        self.session = ArdroneSession(options or ArdroneOptions("drone"), IDS, self.clock.now_ns)
        self.drone = drone or ScriptedDrone()
        self.sink = RecordingSink()
        self.on = True  # the drone is switched on
        self.port_open = True  # its control port
        self.lost: Callable[[], bool] = lambda: False
        self.late: Callable[[bool], float] = lambda _up: 0.0
        self._under_way: list[tuple[int, bool, bytes]] = []  # time of arrival, whether it goes up, and the datagram
        self.started = False  # navdata was requested
        self.sent: list[bytes] = []
        self.navdata_steps = NAVDATA_STEPS
        self._steps = 0
        self._dump = 0

    def run(self, seconds: float) -> None:
        """Advance the time."""
        for _ in range(round(seconds / STEP_S)):
            self.step()

    def until(self, condition: Callable[[], bool], within_s: float) -> float:
        """Return the time until the condition holds; fail after the limit."""
        for steps in range(round(within_s / STEP_S)):
            if condition():
                return steps * STEP_S
            self.step()
        raise AssertionError(f"not within {within_s} s; links reported: {self.sink.links}")

    def ready(self) -> None:
        """Run until the drone is set up."""
        self.until(lambda: self.session.ready, 3.0)

    def step(self) -> None:
        now_ns = self.clock.advance(STEP_S)
        self._steps += 1
        session = self.session
        if session.wants_start(now_ns) and self.on:
            self.started = True
        if now_ns >= session.due_ns:
            datagram = session.poll(now_ns)
            self.sent.append(datagram)
            self._send(datagram, up=True)
        self._deliver(up=True)
        self._serve_dump()
        if self.started and self._steps % self.navdata_steps == 0:
            self._send(self.drone.navdata(), up=False)
        self._deliver(up=False)
        for publish in session.drain():
            publish(self.sink)

    def _send(self, datagram: bytes, *, up: bool) -> None:
        now_ns = self.clock.now_ns
        if self.on and not self.lost():
            self._under_way.append((now_ns + nanoseconds(self.late(up)), up, datagram))

    def _deliver(self, *, up: bool) -> None:
        now_ns = self.clock.now_ns
        come = sorted(
            (each for each in self._under_way if each[0] <= now_ns and each[1] is up), key=lambda each: each[0]
        )
        for each in come[:1]:  # one per step, like delayed datagrams
            self._under_way.remove(each)
            if up:
                self.drone.take(each[2])
            else:
                self.session.on_navdata(each[2], now_ns)

    def switch_off(self) -> None:
        self.on = self.started = False

    def switch_on(self) -> None:
        self.on = True
        self.drone.restart()

    def _serve_dump(self) -> None:
        configurator = self.session.configurator
        if configurator.wants_dump != self._dump:
            self._dump = configurator.wants_dump
            if self._dump and self.on and self.port_open:
                self.drone.dump_asked = False
                configurator.dump_opened()
            elif self._dump:
                configurator.dump_failed("connection refused")
        if self._dump and self.drone.dump_asked and self.on:
            self.drone.dump_asked = False
            configurator.dump_received(self.drone.dump())

    @property
    def texts(self) -> list[str]:
        return [event.text for event in self.sink.events]


def ns(seconds: float) -> int:
    """Return nanoseconds; shorter in tables than the full name."""
    return nanoseconds(seconds)
