"""The protocol with one drone from the first datagram onwards: navdata in, AT commands out. No sockets, no clock."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import partial
from typing import Final

from skyloop.clock import nanoseconds
from skyloop.drivers.vehicle_session import LinkTimeouts, VehicleEvent, VehicleSession, message
from skyloop.messages import AnyAction, EmergencyStop, EventKind, LinkState, Severity, Value
from skyloop.vehicles.ardrone.configuration import ArdroneSetup, Configurator, Exchange, Ids
from skyloop.vehicles.ardrone.options import ArdroneOptions
from skyloop.vehicles.ardrone.setpoints import ArdroneSetpoints, Condition, limits_of
from skyloop.vehicles.ardrone.telemetry import (
    ArdroneHealth,
    ClimbMeter,
    NavdataClock,
    Reception,
    control_state,
    feedback_of,
    native_of,
)
from skyloop.vehicles.ardrone.wire.at import AtMessage, format_command
from skyloop.vehicles.ardrone.wire.navdata import Demo, Navdata, State

#: Number of datagrams that begin at sequence 1 after a restart: one may be lost, and only a 1 resets the drone's count.
FRESH_DATAGRAMS: Final = 3


class Sequencer:
    """Numbers the commands. A command is executed only if its number exceeds the last one; 1 restarts the count."""

    def __init__(self) -> None:
        self._sequence = 0
        self._fresh = FRESH_DATAGRAMS

    def restart(self) -> None:
        """Begin at 1 again after a link loss in either direction."""
        self._fresh = FRESH_DATAGRAMS

    def datagram(self, messages: Iterable[AtMessage]) -> bytes:
        """Return the messages as one datagram, which is empty if there are none."""
        messages = tuple(messages)
        if messages and self._fresh:
            self._fresh -= 1
            self._sequence = 0
        lines = []
        for name, arguments in messages:
            self._sequence += 1
            lines.append(format_command(name, self._sequence, *arguments))
        return b"".join(lines)


TICK_NS: Final = nanoseconds(0.03)  #: time between AT commands, as recommended in the drone's guide
#: Minimum time after a datagram before a new set-point is sent without waiting for its tick.
HURRY_NS: Final = nanoseconds(0.01)
DEGRADED_NS: Final = nanoseconds(0.25)  #: time without data after which the link is DEGRADED
LOST_NS: Final = nanoseconds(1.0)  #: time without data after which the link is LOST
FIRST_WORD_NS: Final = nanoseconds(2.0)  #: time after which a drone that has sent nothing is reported as lost
START_NS: Final = nanoseconds(0.25)  #: time between requests for navdata while none arrives
SETUP_NS: Final = nanoseconds(6.0)  #: time allowed for setting up the drone before another attempt
SETUP_PATIENCE_NS: Final = nanoseconds(3.0)  #: time until the link is DEGRADED and the drone may fly without set-up
DEAF_NS: Final = nanoseconds(1.0)  #: time after which a set watchdog bit means that the drone ignores our commands
REPEATS: Final = 3  #: number of times an unacknowledged command is sent
START_NAVDATA: Final = b"\x01\x00\x00\x00"

_WATCHDOG: Final[AtMessage] = ("COMWDG", ())


class ArdroneSession(VehicleSession):
    """The protocol between an open driver and its drone. Not thread-safe."""

    TIMEOUTS = LinkTimeouts(DEGRADED_NS, LOST_NS, FIRST_WORD_NS)

    def __init__(
        self, options: ArdroneOptions, ids: Ids, now_ns: int, *, extra: Callable[[], Mapping[str, Value]] = dict
    ) -> None:
        super().__init__(now_ns)
        self.options = options
        self.version = options.version  #: from the address, or None until the drone's configuration has been read
        self.setpoints = ArdroneSetpoints()
        self.configurator = Configurator()
        self.reception = Reception()
        self.ready = False  #: whether the drone is set up and its configuration known
        self.remembered: dict[str, str] = {}  #: keys that were written, with their values in the drone's notation
        self._ids = ids
        self._extra = extra
        self._sequencer = Sequencer()
        self._clock = NavdataClock()
        self._climb = ClimbMeter()
        self._health = ArdroneHealth()
        self._setup_ns: int | None = None
        self._setups_failed = 0
        self._state = self._earlier = State(0)  # state bits in the newest datagram and the previous one
        self._sent_ns = 0
        self._started_ns = 0
        self._published_ns = 0
        self._deaf_since_ns: int | None = None
        self._once: list[list[AtMessage]] = []  # additional commands for each of the next ticks
        self._place = f"{options.host}, UDP port {options.ports.navdata}"
        self._set_link_state(LinkState.CONNECTING, f"waiting for navdata from {self._place}")

    # From the driver -------------------------------------------------------------------------------------------

    def command(self, action: AnyAction, now_ns: int) -> AnyAction:
        """Accept an action and send it as soon as allowed; see :meth:`ArdroneSetpoints.apply`."""
        before = self.setpoints.intent
        applied = self.setpoints.apply(action, now_ns)
        self._keep(action, now_ns)
        if isinstance(action, EmergencyStop):
            self._once.clear()
            self.due_ns = now_ns
        elif self.setpoints.intent != before:
            self.due_ns = min(self.due_ns, max(now_ns, self._sent_ns + HURRY_NS))
        return applied

    def send(self, message: AtMessage, times: int = REPEATS) -> None:
        """Send an unacknowledged command in each of the next ``times`` ticks."""
        while len(self._once) < times:
            self._once.append([])
        for at in range(times):
            self._once[at].append(message)

    def submit(self, exchange: Exchange) -> None:
        """Queue a configuration exchange."""
        self.configurator.submit(exchange)
        self.due_ns = 0

    def _new_events(self) -> list[VehicleEvent]:
        return self.setpoints.pop_events()

    def _forget_landing(self) -> bool:
        return self.setpoints.forget_landing()

    def close(self) -> None:
        """End the session and fail unfinished exchanges."""
        self.configurator.abandon("the driver was closed")

    @property
    def state(self) -> State | None:
        """The drone's newest state bits; None before the first navdata."""
        return None if self._received_ns is None else self._state

    # From the sockets ------------------------------------------------------------------------------------------

    def on_navdata(self, datagram: bytes, now_ns: int) -> None:
        """Handle a datagram from the navdata port. Never raises, regardless of content."""
        navdata = self.reception.receive(datagram, now_ns)
        if navdata is None:
            return
        state = navdata.state
        demo = navdata.get(Demo)
        self._detect_break(state, now_ns)
        self._state, self._received_ns = state, now_ns
        condition = Condition(state) if demo is None else Condition(state, control_state(demo), demo.altitude / 1000)
        self.setpoints.on_condition(condition, now_ns, self.reception.passed_ns)
        if self.configurator.on_acknowledge(bool(state & State.COMMAND_ACK)):
            self.due_ns = 0
        for event in self._health.changes(state):
            self._publish_event(event)
        if self._setup_ns is None:
            self._begin_setup(now_ns)
        elif self.link_state is LinkState.DEGRADED and self.ready:
            self._set_link_state(LinkState.UP)
        if demo is not None:
            self._publish(navdata, demo, now_ns)

    def _detect_break(self, state: State, now_ns: int) -> None:
        """Detect that the drone restarted or lost contact with us, even if the gap was too short to be a lost link.

        The drone may have lost its set-up in the process. Two consecutive datagrams must report the change.
        """
        both, begins = state & self._state, ~self._earlier
        self._earlier = self._state
        if not self.ready:
            return
        if both & State.BOOTSTRAP:
            self._lose("the drone rebooted", now_ns)
        elif both & begins & State.COMMUNICATION_LOST:
            self._lose("the drone reports that it lost its link to us", now_ns)

    def _publish(self, navdata: Navdata, demo: Demo, now_ns: int) -> None:
        captured_ns = self._clock.captured_ns(navdata, now_ns)
        climb = self._climb.climb(demo.altitude / 1000, captured_ns)
        # 10 % early counts as due: otherwise, jitter would make feedback wait for yet another datagram.
        if self.options.full and now_ns - self._published_ns < 0.9e9 / self.options.rate_hz:
            return
        self._published_ns = now_ns
        native = native_of(navdata, everything=self.options.full)
        native.update(self.reception.telemetry())
        native.update(self._extra())
        feedback = feedback_of(navdata, demo, captured_ns, climb, native)
        self._pending.append(lambda sink: sink.feedback(feedback))

    # Time ------------------------------------------------------------------------------------------------------

    def poll(self, now_ns: int) -> bytes:
        """Return the datagram to send from the AT port now; empty if none is due."""
        self._check_silence(now_ns)
        self.due_ns, self._sent_ns = now_ns + TICK_NS, now_ns
        messages: list[AtMessage] = []
        if self._state & State.COMMUNICATION_WATCHDOG and self._received_ns is not None:
            messages.append(_WATCHDOG)
            self._check_deafness(now_ns)
        else:
            self._deaf_since_ns = None
        messages += self.setpoints.messages(now_ns)
        messages += self._once.pop(0) if self._once else []
        messages += self.configurator.messages(now_ns)
        return self._sequencer.datagram(messages)

    def wants_start(self, now_ns: int) -> bool:
        """Return whether to request navdata now because none is arriving. True once per :data:`START_NS`."""
        silent_ns = now_ns - (self._received_ns if self._received_ns is not None else 0)
        if silent_ns < DEGRADED_NS or now_ns - self._started_ns < START_NS:
            return False
        self._started_ns = now_ns
        return True

    def _check_silence(self, now_ns: int) -> None:
        super()._check_silence(now_ns)
        if not self.ready and self._setup_ns is not None and now_ns - self._setup_ns >= SETUP_PATIENCE_NS:
            why = self.configurator.trouble or "the drone does not acknowledge"
            self._set_link_state(LinkState.DEGRADED, f"the drone's configuration is unknown: {why}")

    def _describe_silence(self, since: str, why: str) -> str:
        return f"no navdata{since} from {self._place}{why}"

    def _advice(self) -> str:
        if self.options.host.startswith("127."):
            return "start the emulated drone: skyloop sim --firmware ardrone2"
        return "switch the AR.Drone on and join its Wi-Fi network, ardrone…; or correct the host in the address"

    def _check_deafness(self, now_ns: int) -> None:
        """Restart the sequence if the watchdog bit stays set.

        The drone clears the bit when it accepts commands. If the bit stays set, the drone's count may be ahead of ours.
        """
        if self._deaf_since_ns is None:
            self._deaf_since_ns = now_ns
        elif now_ns - self._deaf_since_ns >= DEAF_NS:
            self._deaf_since_ns = now_ns
            self._sequencer.restart()

    # Link loss and recovery ------------------------------------------------------------------------------------

    def _lose(self, reason: str, _now_ns: int) -> None:
        self._received_ns = self._setup_ns = None
        self.ready = False
        self._once.clear()
        self.configurator.abandon(reason)
        self.setpoints.lost()
        self.setpoints.limits = None
        self.reception.expect_restart()
        self._sequencer.restart()
        self._set_link_state(LinkState.LOST, reason)

    def _begin_setup(self, now_ns: int) -> None:
        self._setup_ns = now_ns
        self._unreachable = ""
        self._sequencer.restart()
        self._submit_setup(now_ns)

    def _submit_setup(self, now_ns: int) -> None:
        failed = self._setups_failed
        options = replace(self.options, ids=False) if failed > 1 else self.options
        # A drone that kept our ids ignores commands without them; a drone that lost our ids ignores commands with them.
        self.configurator.ids = self._ids if failed % 2 else None
        setup = ArdroneSetup(options, self.configurator, self._ids, self.remembered)
        done = partial(self._setup_done, setup)
        self.configurator.submit(Exchange(setup.steps(self._state), now_ns + SETUP_NS, done))
        self.due_ns = 0

    def _setup_done(self, setup: ArdroneSetup, failure: str | None) -> None:
        if self._setup_ns is None or self._received_ns is None:
            return  # the link has been lost
        if failure is not None:
            self._setups_failed += 1
            self.configurator.trouble = failure
            self._submit_setup(self._received_ns)
            return
        self._setups_failed = 0
        self.version = setup.version or self.version
        if setup.refused_ids:
            text = "the drone keeps no settings of our own: its settings are shared with everyone who connects to it"
            self._publish_event(message(text, "ids_refused", Severity.WARNING))
        self.ready = True
        self.read_limits()
        if self.setpoints.limits is None:
            text = "the drone's configuration has no limits: set-points are refused"
            self._publish_event(VehicleEvent(EventKind.DRIVER_ERROR, text, Severity.ERROR, {"where": "configuration"}))
        self._set_link_state(LinkState.UP)

    def read_limits(self) -> None:
        """Read the limits for set-points from the configuration."""
        self.setpoints.limits = limits_of(self.configurator.values)
