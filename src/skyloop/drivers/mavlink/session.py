"""One vehicle, from its first heartbeat on: who it is, what it says, and what it is told. Pure."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final, TypeAlias

from skyloop.clock import nanoseconds
from skyloop.drivers.mavlink.commander import Commander, Order
from skyloop.drivers.mavlink.connections import Peer
from skyloop.drivers.mavlink.dialects import Dialect, dialect_of
from skyloop.drivers.mavlink.feedback import feedback_of
from skyloop.drivers.mavlink.health import Health
from skyloop.drivers.mavlink.identity import Identities, Identity, why_not
from skyloop.drivers.mavlink.options import MavlinkOptions
from skyloop.drivers.mavlink.parameter_exchange import ParameterExchange
from skyloop.drivers.mavlink.pilot import Pilot
from skyloop.drivers.mavlink.requests import Requests
from skyloop.drivers.mavlink.telemetry import Telemetry, View
from skyloop.drivers.mavlink.times import VehicleClock
from skyloop.drivers.notices import Notice
from skyloop.drivers.vehicle_session import Patience, VehicleSession
from skyloop.errors import DriverError
from skyloop.messages import AnyAction, EventKind, FlightState, LinkState, Severity, Value
from skyloop.wire.mavlink.codec import Codec, Message
from skyloop.wire.mavlink.codec import dialect as m
from skyloop.wire.mavlink.parameter_values import BYTEWISE

TICK_NS: Final = nanoseconds(0.02)
HEARTBEAT_NS: Final = nanoseconds(1.0)
DEGRADED_NS: Final = nanoseconds(1.2)  #: of silence
LOST_NS: Final = nanoseconds(2.5)
FIRST_WORD_NS: Final = nanoseconds(3.0)  #: a vehicle that was never heard by then is told as lost
PARAMETERS_NS: Final = nanoseconds(25.0)  #: the list may take so long, then the link is up without it
QUIET_ATTITUDE_S: Final = 0.5  #: without it, other messages make feedback
VERSION_PACE_S: Final = 1.0
OWN_COMPONENT: Final = 190  #: MAV_COMP_ID_MISSIONPLANNER, a ground station
_ANSWERS: Final = ("COMMAND_ACK", "PARAM_VALUE", "TIMESYNC")

Packet: TypeAlias = tuple[bytes, Peer]
_ASK_VERSION: Final = Order(m.MAV_CMD_REQUEST_MESSAGE, (float(m.MAVLINK_MSG_ID_AUTOPILOT_VERSION),))


class Session(VehicleSession):
    """The vehicle of one opened driver. Not thread-safe.

    ``extra`` gives telemetry of others for feedback's ``native``.
    """

    PATIENCE = Patience(DEGRADED_NS, LOST_NS, FIRST_WORD_NS)
    pilot: Pilot | None

    def __init__(
        self, options: MavlinkOptions, now_ns: int, *, extra: Callable[[], Mapping[str, Value]] = dict
    ) -> None:
        super().__init__(now_ns)
        self.options = options
        self.codec = Codec(options.own_system, OWN_COMPONENT, key=options.key)
        self.telemetry = Telemetry()
        self.parameters = ParameterExchange()
        self.commander = Commander()
        self.clock = VehicleClock()
        self.dialect: Dialect | None = None  #: None until its autopilot is known, and for one that can't be flown
        self.pilot = None
        self.version: Message | None = None  #: its AUTOPILOT_VERSION
        self.takeoff_m = options.takeoff_altitude_m
        self._extra = extra
        self._identities = Identities(options.system, options.peer)
        self._health = Health()
        self._requests = Requests({})
        self._out: list[Message] = []
        self._found_ns = 0
        self._beaten_ns = -HEARTBEAT_NS
        self._old = False  # it speaks MAVLink 1
        self._signed = 0
        self._why_not = "it is not heard"
        self._tell_link(LinkState.CONNECTING, f"waiting for a heartbeat on {options.address}")

    @property
    def identity(self) -> Identity | None:
        """The vehicle that was chosen."""
        return self._identities.chosen

    @property
    def description(self) -> str:
        """Who it is, for people."""
        if self.dialect is None:
            return "an autopilot that is not known here"
        system = self._identities.system
        version = self.version.flight_sw_version if self.version is not None else 0
        number = f" {version >> 24}.{version >> 16 & 0xFF}.{version >> 8 & 0xFF}" if version else ""
        old = ", MAVLink 1" if self._old else ""
        return f"{self.dialect.NAME}{number}, system {system}{old}"

    # From the driver ---------------------------------------------------------------------------------------------

    def command(self, action: AnyAction, now_ns: int, *, alone: bool = False) -> AnyAction:
        """Decide. Raises what :meth:`Pilot.take` raises, and :class:`DriverError` for a vehicle that can't be flown."""
        if self.pilot is None:
            raise DriverError(f"the vehicle can't be flown: {self._why_not}")
        applied = self.pilot.take(action, self.view(now_ns), now_ns, alone=alone)
        self.due_ns = now_ns
        return applied

    def say(self, message: Message) -> None:
        """A message for the vehicle, with the next tick."""
        self._out.append(message)
        self.due_ns = 0

    def close(self) -> None:
        self.parameters.abandon("the driver was closed")

    def view(self, now_ns: int) -> View | None:
        """The vehicle as the pilot looks at it; None while it is not heard."""
        custom_mode = self.telemetry.custom_mode()
        if self._heard_ns is None or self.dialect is None or custom_mode is None:
            return None
        ready = self.dialect.ready(self.telemetry, now_ns)
        return self.telemetry.view(self.dialect.mode_of(custom_mode), ready, now_ns)

    # From the connection -----------------------------------------------------------------------------------------

    def heard(self, data: bytes, peer: Peer, now_ns: int, *, whole: bool) -> None:
        """Bytes that came, whatever they hold. Never raises."""
        for message in self.codec.decode(data, whole=whole):
            self._heard_message(message, peer, now_ns)
        if self.codec.signed > self._signed:
            first, self._signed = not self._signed, self.codec.signed
            if first:
                text = "the vehicle signs its messages: give its key with ?signing_key=FILE; nothing is taken without"
                self._unreachable = text
                self._notice(Notice(EventKind.DRIVER_ERROR, text, Severity.ERROR, {"where": "signing"}))

    def connected(self) -> None:
        """There is a new connection: nothing is known of what it will bring."""
        self._unreachable = ""

    def _heard_message(self, message: Message, peer: Peer, now_ns: int) -> None:
        for notice in self._identities.hear(message, peer):
            self._notice(notice)
        if not self._identities.is_chosen(message, peer):
            return
        kind = message.get_type()
        if self._heard_ns is None:
            if kind != "HEARTBEAT":
                return
            self._find(message, now_ns)
        self._heard_ns = now_ns
        self._old = message.get_msgbuf()[0] == m.PROTOCOL_MARKER_V1
        if kind not in _ANSWERS:
            self.telemetry.heard(message, now_ns)
        self._act(kind, message, now_ns)

    def _act(self, kind: str, message: Message, now_ns: int) -> None:
        if kind == "ATTITUDE":
            captured_ns = self.clock.captured_ns(message.time_boot_ms, now_ns)
            if self.clock.restarted:
                self.parameters.complete = False
                self._lose("the vehicle was started anew", now_ns)
                return
            self._publish(captured_ns, now_ns)
        elif kind == "COMMAND_ACK":
            if message.target_system in (0, self.options.own_system):
                self.commander.heard(message, now_ns)
                self.due_ns = 0
        elif kind == "PARAM_VALUE":
            self.parameters.heard(message, now_ns)
        elif kind == "TIMESYNC":
            self._out += self.clock.heard(message, now_ns)
        elif kind == "STATUSTEXT":
            for notice in self._health.text(message):
                self._notice(notice)
                if self.pilot is not None and notice.data["reason"] == "prearm":
                    self.pilot.told(notice.text)
        elif kind == "AUTOPILOT_VERSION":
            self.version = message
            self.parameters.bytewise = bool(message.capabilities & BYTEWISE)
        elif kind in ("HEARTBEAT", "LOCAL_POSITION_NED", "EXTENDED_SYS_STATE"):
            age_s = self.telemetry.age_s("ATTITUDE", now_ns)
            if age_s is None or age_s > QUIET_ATTITUDE_S:
                self._publish(self.clock.now(now_ns), now_ns)
            if kind == "HEARTBEAT":
                self.due_ns = 0  # whoever waits for a mode can go on

    def _publish(self, captured_ns: int, now_ns: int) -> None:
        view = self.view(now_ns)
        native: dict[str, Value] = dict(self._extra())
        native["link.frames"], native["link.damaged"] = self.codec.frames, self.codec.damaged
        if view is not None:
            native["mavlink.mode"], native["mavlink.armed"] = view.mode, view.armed
            if view.ready is not None:
                native["mavlink.ready"] = view.ready
        if self.clock.round_trip_s is not None:
            native["link.round_trip_s"] = self.clock.round_trip_s
        state = self.pilot.state(view) if self.pilot is not None else observed_state(view)
        feedback = feedback_of(self.telemetry, state, captured_ns, now_ns, native)
        self._tellings.append(lambda sink: sink.feedback(feedback))

    # Time --------------------------------------------------------------------------------------------------------

    def tick(self, now_ns: int) -> list[Packet]:
        """What is to be sent now."""
        self.due_ns = now_ns + TICK_NS
        self._look_at_silence(now_ns)
        identity = self.identity
        peer = identity.peer if identity is not None else self.options.peer
        packets = self._heartbeats(peer, now_ns)
        out, self._out = self._out, []
        if self._heard_ns is not None:
            out += self.clock.step(now_ns)
            out += self._fly(now_ns)
            self._look_at_health(now_ns)
        packets += [(self._encoded(message), peer) for message in out]
        return packets

    def _fly(self, now_ns: int) -> list[Message]:
        view = self.view(now_ns)
        if self.version is None:
            self.commander.say(_ASK_VERSION, now_ns, VERSION_PACE_S)
        self._requests.step(self.telemetry, self.commander, now_ns)
        messages = self.pilot.step(view, now_ns) if self.pilot is not None and view is not None else []
        return self.commander.take() + messages + self.parameters.step(now_ns)

    def _heartbeats(self, peer: Peer, now_ns: int) -> list[Packet]:
        """In both versions where the old one is heard: some autopilots change over once they hear the new one."""
        if now_ns - self._beaten_ns < HEARTBEAT_NS:
            return []
        self._beaten_ns = now_ns
        versions = (1, 2) if self._old and self.options.key is None else (2,)
        return [(self.codec.encode(_heartbeat(), version=version), peer) for version in versions]

    def _encoded(self, message: Message) -> bytes:
        return self.codec.encode(message, version=1 if self._old and message.id < 256 else 2)

    def _look_at_health(self, now_ns: int) -> None:
        view = self.view(now_ns)
        for notice in self._health.look(self.telemetry, view.ready if view is not None else None, now_ns):
            self._notice(notice)
        exchange = self.parameters
        if self.link_state is not LinkState.DEGRADED or self._silent(now_ns):
            return
        waited = now_ns - self._found_ns > PARAMETERS_NS
        if not self.options.parameters or exchange.complete or exchange.given_up or waited:
            self._tell_link(LinkState.UP)

    def _silent(self, now_ns: int) -> bool:
        return self._heard_ns is None or now_ns - self._heard_ns >= DEGRADED_NS

    def _silence(self, since: str, why: str) -> str:
        system = f" of system {self._identities.system}" if self._identities.system is not None else ""
        return f"no message{system}{since} on {self.options.address}{why}"

    # Losing and finding ------------------------------------------------------------------------------------------

    def _lose(self, reason: str, now_ns: int) -> None:
        self._heard_ns = None
        self._identities.lose()
        self.parameters.abandon(reason)
        self.commander.forget()
        self._out.clear()
        if self.pilot is not None:
            self.pilot.lost()
        self.clock = VehicleClock()
        self._publish(self.clock.now(now_ns), now_ns)  # what it does now is not known
        self._tell_link(LinkState.LOST, reason)

    def _find(self, heartbeat: Message, now_ns: int) -> None:
        self._found_ns, self._unreachable = now_ns, ""
        target = heartbeat.get_srcSystem(), heartbeat.get_srcComponent()
        self.commander.target = self.parameters.target = target
        if self.dialect is None:
            self._recognise(heartbeat)
        if self.dialect is not None:
            self._requests = Requests(self.dialect.rates(self.options.rate_hz))
        if self.options.origin is not None:
            self._out.append(_origin(target[0], self.options.origin))
        if self.options.parameters and not self.parameters.complete:
            self.parameters.begin(now_ns)
        text = "its parameters are being read" if self.options.parameters else ""
        self._tell_link(LinkState.DEGRADED, text)

    def _recognise(self, heartbeat: Message) -> None:
        found = dialect_of(heartbeat.autopilot)
        self._why_not = why_not(heartbeat)
        if self._why_not:
            text = f"the vehicle is heard and can't be flown: {self._why_not}"
            self._notice(Notice(EventKind.DRIVER_ERROR, text, Severity.ERROR, {"where": "autopilot"}))
        self.dialect = found
        if found is None:
            return
        self.parameters.bytewise = found.BYTEWISE
        if not self._why_not:
            self.pilot = Pilot(found, self.commander, self.takeoff_m, lambda: found.lift(self.parameters.values))


def observed_state(view: View | None) -> FlightState:
    """Of a vehicle that is not flown from here."""
    if view is None or view.airborne is None:
        return FlightState.UNKNOWN
    return FlightState.FLYING if view.airborne else FlightState.LANDED


def _heartbeat() -> Message:
    active = m.MAV_STATE_ACTIVE
    return m.MAVLink_heartbeat_message(m.MAV_TYPE_GCS, m.MAV_AUTOPILOT_INVALID, 0, 0, active, 3)


def _origin(system: int, origin: tuple[float, float, float]) -> Message:
    latitude, longitude, altitude = origin
    return m.MAVLink_set_gps_global_origin_message(
        system, round(latitude * 1e7), round(longitude * 1e7), round(altitude * 1000)
    )
