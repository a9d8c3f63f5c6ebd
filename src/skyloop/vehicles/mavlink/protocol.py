"""The protocol with one vehicle from its first heartbeat onwards: bytes in, bytes and sink callbacks out. Pure."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from typing import Final, NamedTuple

from skyloop.clock import nanoseconds, seconds
from skyloop.drivers.byte_stream import Rank
from skyloop.drivers.vehicle_session import (
    LinkTimeouts,
    LinkTrouble,
    MotorStop,
    PacketOrder,
    VehicleEvent,
    VehicleSession,
    serial_trouble,
    trouble_of,
)
from skyloop.drivers.vehicle_session import message as event_of
from skyloop.errors import DriverError
from skyloop.messages import AnyAction, EmergencyStop, EventKind, FlightState, Idle, LinkState, Severity, Takeoff, Value
from skyloop.messages.feedback import WAKING_UP
from skyloop.vehicles.mavlink.autopilots import AutopilotProfile, profile_of
from skyloop.vehicles.mavlink.microservices import (
    MavlinkCommandSender,
    MessageIntervals,
    VehicleClock,
    VehicleCommand,
    VehicleIdentity,
    VehicleSelector,
    unsupported_reason,
)
from skyloop.vehicles.mavlink.options import ConnectionKind, MavlinkOptions, Peer, limits_text, takeoff_height
from skyloop.vehicles.mavlink.parameters import ParameterExchange
from skyloop.vehicles.mavlink.setpoints import CUT, MavlinkSetpoints
from skyloop.vehicles.mavlink.telemetry import HealthMonitor, MavlinkTelemetry, VehicleState, feedback_of
from skyloop.vehicles.mavlink.wire.axes import ORIGIN, ORIGIN_HZ, WorldAxes
from skyloop.vehicles.mavlink.wire.codec import BYTEWISE, MavlinkCodec, Message
from skyloop.vehicles.mavlink.wire.codec import dialect as m

TICK_NS: Final = nanoseconds(0.02)  #: poll interval while set-points or parameters are due
REST_NS: Final = nanoseconds(0.1)  #: poll interval of an idle session, for heartbeats, requests and silence checks
HEARTBEAT_NS: Final = nanoseconds(1.0)
SLOW_HEARTBEAT_NS: Final = nanoseconds(15.0)  #: longer than the failsafes wait (5 to 10 s)
QUIET_NS: Final = nanoseconds(0.5)  #: time without data until set-points are withheld: they might be followed late
OLD_POSE_NS: Final = nanoseconds(0.5)  #: age beyond which a pose no longer gives the vehicle's position
DEGRADED_NS: Final = nanoseconds(1.2)  #: time without data after which the link counts as degraded
LOST_NS: Final = nanoseconds(2.5)  #: time without data after which the link counts as lost
FIRST_WORD_NS: Final = nanoseconds(2.5)  #: time without any data after which a vehicle is reported as lost
PARAMETERS_NS: Final = nanoseconds(25.0)  #: time allowed for the parameter list, after which the link is up without it
WAKING_MS: Final = 60_000  #: time since boot during which a vehicle that can't be armed is still starting up
IDENTITY_NS: Final = nanoseconds(2.0)  #: time allowed for a rediscovered vehicle to prove that it is the same one
QUIET_ATTITUDE_S: Final = 0.5  #: time without attitude messages after which other messages trigger feedback
VERSION_PACE_S: Final = 1.0  #: time between requests for the version
_WAKING: Final = f"{WAKING_UP}: its pre-arm checks do not pass yet"
OWN_COMPONENT: Final = 190  #: MAV_COMP_ID_MISSIONPLANNER, a ground station
_ANSWERS: Final = ("COMMAND_ACK", "PARAM_VALUE", "TIMESYNC")
_STAMPED: Final = ("ATTITUDE", "LOCAL_POSITION_NED", "GLOBAL_POSITION_INT")  #: messages whose stamps reveal their order
_MODES: Final = ("HEARTBEAT", "CURRENT_MODE")  #: messages that carry the mode

#: Safety commands, which are sent before everything else.
_URGENT: Final = frozenset(
    {m.MAV_CMD_COMPONENT_ARM_DISARM, m.MAV_CMD_DO_SET_MODE, m.MAV_CMD_NAV_TAKEOFF, m.MAV_CMD_NAV_LAND}
)
_SETPOINTS: Final = frozenset({"SET_POSITION_TARGET_LOCAL_NED", "SET_ATTITUDE_TARGET", "HEARTBEAT"})
_POSES: Final = frozenset({"ODOMETRY", "VISION_POSITION_ESTIMATE"})


class Packet(NamedTuple):
    """One frame to send."""

    data: bytes
    peer: Peer  #: where to send a datagram; None for the configured address
    rank: Rank = Rank.SETPOINT


def rank_of(message: Message) -> Rank:
    """Return the priority of a message on a slow link."""
    kind = message.get_type()
    if kind == "COMMAND_LONG" and message.command in _URGENT:
        stops = (message.command, (message.param1, message.param2)) == (CUT.number, CUT.arguments)
        return Rank.STOP if stops else Rank.COMMAND
    if kind in _SETPOINTS:
        return Rank.SETPOINT
    return Rank.POSE if kind in _POSES else Rank.QUERY


_ASK_VERSION: Final = VehicleCommand(m.MAV_CMD_REQUEST_MESSAGE, (float(m.MAVLINK_MSG_ID_AUTOPILOT_VERSION),))


class MavlinkSession(VehicleSession):
    """The protocol between an open driver and its vehicle. Not thread-safe."""

    TIMEOUTS = LinkTimeouts(DEGRADED_NS, LOST_NS, FIRST_WORD_NS)

    def __init__(
        self, options: MavlinkOptions, now_ns: int, *, extra: Callable[[], Mapping[str, Value]] = dict
    ) -> None:
        super().__init__(now_ns)
        self.options = options
        self.codec = MavlinkCodec(options.own_system, OWN_COMPONENT, key=options.key)
        self.telemetry = MavlinkTelemetry()
        self.parameters = ParameterExchange()
        self.commands = MavlinkCommandSender((options.system or 1, options.component))
        self.clock = VehicleClock()
        self.autopilot: AutopilotProfile | None = None  #: None if unknown or not recognised yet
        self.setpoints: MavlinkSetpoints | None = None  #: None until the autopilot is known, or if it can't be flown
        self.version: Message | None = None  #: the vehicle's AUTOPILOT_VERSION
        self.limits = options.limits  #: the driver's own limits
        self.dropped = 0  #: number of packets that the connection dropped
        self._axes = WorldAxes(options.world_origin)
        self._extra = extra
        self._selector = VehicleSelector(options.system, options.peer, options.component)
        self._health = HealthMonitor()
        self._intervals = MessageIntervals({})
        self._out: list[Message] = []
        self._found_ns = 0
        self._heartbeat_ns = -HEARTBEAT_NS
        self._peer = options.peer  # the chosen vehicle's address, kept while the link is lost
        self._slow_heartbeat = False  # True if lost while armed: regular heartbeats would hold off its own failsafe
        self._old = False  # whether the vehicle uses MAVLink 1
        self._signed = 0
        self._unencodable: set[str] = set()  # message types already reported as not encodable
        self._kind: tuple[int, int] | None = None  # autopilot and vehicle type, from the heartbeat
        self._known_as: Message | None = None  # version from before the link loss, kept until a new one arrives
        self._receives_us = True  # False until there is a sign that the vehicle receives our messages
        self._last_report: tuple[int | None, bool, int] | None = None  # mode, armed and MAV_STATE when last checked
        self._waking = False  # whether the vehicle has just booted and can't be armed yet
        self._prearm = ""  # the vehicle's latest reason for refusing to arm
        self._unsupported_reason = "no data from it"
        #: It acts on whichever vehicle answers, because an emergency stop must survive the loss of the vehicle's state.
        self._stop = MotorStop(lambda event: self._publish_event(event))
        self._set_link_state(LinkState.CONNECTING, f"waiting for a heartbeat on {options.address}")

    @property
    def identity(self) -> VehicleIdentity | None:
        """The chosen vehicle; None until one has been found."""
        return self._selector.chosen

    @property
    def description(self) -> str:
        """A readable summary: autopilot, version and system."""
        if self.autopilot is None:
            return "an unknown autopilot"
        system = self._selector.system
        version = self.version.flight_sw_version if self.version is not None else 0
        number = f" {version >> 24}.{version >> 16 & 0xFF}.{version >> 8 & 0xFF}" if version else ""
        old = ", MAVLink 1" if self._old else ""
        return f"{self.autopilot.NAME}{number}, system {system}{old}"

    # From the driver ---------------------------------------------------------------------------------------------

    def command(self, action: AnyAction, now_ns: int, *, alone: bool = False, new: bool = True) -> AnyAction:
        """Accept an action; see :meth:`MavlinkSetpoints.apply`. Raises an error if the vehicle can't be flown."""
        if isinstance(action, EmergencyStop) and self._kind is None:  # a flying vehicle may be found at any moment
            self._stop.press(now_ns)
            self.due_ns = now_ns
            return action
        if self.setpoints is None:
            raise DriverError(f"the vehicle can't be flown: {self._unsupported_reason}")
        if isinstance(action, Idle):
            return action  # this action has no effect, and pilots send it continuously on the ground
        vehicle = self.vehicle_state(now_ns)
        if isinstance(action, Takeoff) and self._wakes_up(vehicle, now_ns):
            raise DriverError(f"the vehicle is {_WAKING}" + (f" ({self._prearm})" if self._prearm else ""))
        applied = self.setpoints.apply(action, vehicle, now_ns, alone=alone, new=new)
        self._keep(action, now_ns)
        due_ns = self.setpoints.due_ns(now_ns)
        self.due_ns = min(self.due_ns, now_ns if due_ns is None else max(now_ns, due_ns))
        return applied

    def pose_problem(self, captured_ns: int, now_ns: int) -> str:
        """Return why an external pose can't be sent now; empty if the pose can be sent.

        While the vehicle is silent, a pose might wait in a buffer. Once the vehicle resumes reading, an autopilot that
        timestamps poses on arrival would mistake the delayed pose for a new one.
        """
        if self._received_ns is None:
            return "no data from the vehicle: an external pose can't be sent until the link is up"
        if not self._is_read(now_ns):
            return "the vehicle is silent just now: an external pose would arrive late"
        age_ns = now_ns - captured_ns
        return f"an external pose is {seconds(age_ns):.2g} s old, at most 0.5 s" if age_ns > OLD_POSE_NS else ""

    def send(self, message: Message) -> None:
        """Send a message to the vehicle in the next tick."""
        self._out.append(message)
        self.due_ns = 0

    def _new_events(self) -> list[VehicleEvent]:
        return self.setpoints.pop_events() if self.setpoints is not None else []

    def _forget_landing(self) -> bool:
        return self.setpoints is not None and self.setpoints.forget_landing()

    def close(self) -> None:
        """End the session and fail pending parameter writes."""
        self.parameters.fail_writes("the driver was closed")

    def vehicle_state(self, now_ns: int) -> VehicleState | None:
        """Return the vehicle's state; None while nothing is being received."""
        custom_mode = self.telemetry.custom_mode()
        if self._received_ns is None or self.autopilot is None or custom_mode is None:
            return None
        ready = self.autopilot.ready(self.telemetry, now_ns)
        return self.telemetry.state(self.autopilot.mode_of(custom_mode), ready, now_ns)

    # From the connection -----------------------------------------------------------------------------------------

    def receive(self, data: bytes, peer: Peer, now_ns: int, *, whole: bool) -> None:
        """Handle bytes from a peer; ``whole`` is True if they are one datagram. Never raises, whatever the content."""
        for message in self.codec.decode(data, whole=whole, source=peer):
            self._on_message(message, peer, now_ns)
        if self.codec.signed > self._signed:
            first, self._signed = not self._signed, self.codec.signed
            if first:
                text = "the vehicle signs its messages, which are ignored without its key: give ?signing_key=FILE"
                self._unreachable = text
                self._publish_event(VehicleEvent(EventKind.DRIVER_ERROR, text, Severity.ERROR, {"where": "signing"}))

    def connected(self) -> None:
        """Handle a new connection, whose vehicle is not known yet."""
        self._unreachable = ""

    def _on_message(self, message: Message, peer: Peer, now_ns: int) -> None:
        kind = message.get_type()
        if kind == "HEARTBEAT" and self._is_another(message, peer):
            self._lose(f"another autopilot answers as system {message.get_srcSystem()}", now_ns)
        for event in self._selector.on_message(message, peer, now_ns):
            self._publish_event(event)
        if not self._selector.is_chosen(message, peer):
            return
        if self._received_ns is None:
            if kind != "HEARTBEAT":
                return
            self._find(message, now_ns)
        self._received_ns = now_ns
        self._old = message.get_msgbuf()[0] == m.PROTOCOL_MARKER_V1
        if self.autopilot is not None and not self._axes.received(message, self.autopilot.EARTH_RADIUS_M):
            return
        if kind in _STAMPED:
            arrival = self.clock.on_stamp(kind, message.time_boot_ms, now_ns)
            if arrival is PacketOrder.RESTARTED:
                self.version = None  # a different vehicle with other parameters may be answering
                self.telemetry = MavlinkTelemetry()
                self._lose("the vehicle rebooted", now_ns)
            if arrival is not PacketOrder.NEW:
                return
        if kind not in _ANSWERS:
            self.telemetry.on_message(message, now_ns)
        self._dispatch(kind, message, now_ns)

    def _is_another(self, heartbeat: Message, peer: Peer) -> bool:
        """Return whether a different autopilot now answers at the chosen vehicle's address."""
        if self._received_ns is None or self._kind is None or not self._selector.is_chosen(heartbeat, peer):
            return False
        return bool(heartbeat.autopilot != self._kind[0])

    def _dispatch(self, kind: str, message: Message, now_ns: int) -> None:
        if kind == "ATTITUDE":
            self._publish(self.clock.captured_ns(message.time_boot_ms, now_ns), now_ns)
        elif kind == "COMMAND_ACK":
            if message.target_system in (0, self.options.own_system):
                self.commands.on_ack(message, now_ns)
                self._receives_us = True
                self.due_ns = 0
        elif kind == "PARAM_VALUE":
            self.parameters.on_value(message, now_ns)
        elif kind == "TIMESYNC":
            answers = self.clock.on_timesync(message, now_ns)
            if answers:
                self._out += answers
                self.due_ns = 0  # a late reply would shift the clock by which the vehicle timestamps external poses
        elif kind == "STATUSTEXT":
            for event in self._health.on_text(message, quiet=self._waking):
                self._publish_event(event)
                if event.data["reason"] == "prearm":
                    self._prearm = event.text
                if self.setpoints is not None and event.data["reason"] == "prearm":
                    self.setpoints.on_prearm_reason(event.text)
        elif kind == "AUTOPILOT_VERSION":
            self._on_version(message, now_ns)
        elif kind in ("HEARTBEAT", "LOCAL_POSITION_NED", "EXTENDED_SYS_STATE"):
            age_s = self.telemetry.age_s("ATTITUDE", now_ns)
            if age_s is None or age_s > QUIET_ATTITUDE_S:
                self._publish(self.clock.now(now_ns), now_ns)
        if kind in _MODES:
            report = self.telemetry.custom_mode(), self.telemetry.armed(), self.telemetry.status()
            if report != self._last_report:
                self._last_report = report
                self.due_ns = 0  # wake callers that are waiting for a mode

    def _publish(self, captured_ns: int, now_ns: int) -> None:
        vehicle = self.vehicle_state(now_ns)
        native: dict[str, Value] = dict(self._extra())
        native["link.frames"], native["link.damaged"] = self.codec.frames, self.codec.damaged
        native["link.dropped"] = self.dropped
        if vehicle is not None:
            native["mavlink.mode"], native["mavlink.armed"] = vehicle.mode, vehicle.armed
            if vehicle.ready is not None:
                native["mavlink.ready"] = vehicle.ready
        if self.clock.round_trip_s is not None:
            native["link.round_trip_s"] = self.clock.round_trip_s
        origin = None if self.autopilot is None else self.telemetry.origin(self.autopilot.EARTH_RADIUS_M, now_ns)
        if origin is not None:
            native.update(origin.native())
        state = self.setpoints.state(vehicle) if self.setpoints is not None else observed_state(vehicle)
        feedback = feedback_of(self.telemetry, state, captured_ns, now_ns, native)
        self._pending.append(lambda sink: sink.feedback(feedback))

    # Time --------------------------------------------------------------------------------------------------------

    def poll(self, now_ns: int) -> list[Packet]:
        """Return the packets to send now."""
        self._check_silence(now_ns)
        if self.identity is not None:
            self._peer = self.identity.peer
        peer = self._peer
        packets = self._heartbeats(peer, now_ns)
        out, self._out = self._out, []
        if self._received_ns is not None:
            out += self.clock.poll(now_ns)
            vehicle = self.vehicle_state(now_ns)
            out += self._fly(vehicle, now_ns)
            self._check_health(vehicle, now_ns)
        elif self.setpoints is not None:
            stops = self.setpoints.step_stop(None, now_ns)
            if stops or self.setpoints.step_blind(now_ns):
                out += self.commands.pop_messages()
        elif self._stop.step(None, now_ns):
            self.commands.request(CUT, now_ns, 0.0)
            out += self.commands.pop_messages()
        packets += [packet for message in out if (packet := self._packet(message, peer)) is not None]
        self.due_ns = self._next_ns(now_ns)
        return packets

    def _next_ns(self, now_ns: int) -> int:
        """Return when to poll next. An idle session polls rarely to save CPU time with a fleet on the ground."""
        tick_ns, next_ns = now_ns + TICK_NS, self._silence_seen_ns(now_ns + REST_NS)
        if self.parameters.busy:
            return min(tick_ns, next_ns)
        due_ns = self.setpoints.due_ns(now_ns) if self.setpoints is not None else None
        if due_ns is None or self._received_ns is None:
            return next_ns
        return min(max(due_ns, tick_ns), next_ns)

    def _fly(self, vehicle: VehicleState | None, now_ns: int) -> list[Message]:
        if self.version is None or not self._receives_us:
            self.commands.request(_ASK_VERSION, now_ns, VERSION_PACE_S)
        self._intervals.request_missing(self.telemetry, self.commands, now_ns)
        messages: list[Message] = []
        if self.setpoints is not None and vehicle is not None:
            messages = self.setpoints.messages(vehicle, now_ns, read=self._is_read(now_ns))
        if not self._receives_us:
            messages = []  # there is no sign yet that the vehicle receives our messages
        return self.commands.pop_messages() + messages + self.parameters.poll(now_ns)

    def _is_read(self, now_ns: int) -> bool:
        """Return whether the vehicle seems to read promptly, judging by the messages it sends."""
        return self._receives_us and now_ns - (self._received_ns or 0) < QUIET_NS

    def _heartbeats(self, peer: Peer, now_ns: int) -> list[Packet]:
        """Return the heartbeat if it is due.

        A vehicle that uses MAVLink 1 gets both versions, because some autopilots switch to MAVLink 2 on receiving it.
        """
        if now_ns - self._heartbeat_ns < (SLOW_HEARTBEAT_NS if self._slow_heartbeat else HEARTBEAT_NS):
            return []
        self._heartbeat_ns = now_ns
        versions = (1, 2) if self._old and self.options.key is None else (2,)
        return [Packet(self.codec.encode(_heartbeat(), version=version), peer) for version in versions]

    def _packet(self, message: Message, peer: Peer) -> Packet | None:
        """Encode a message; return None if that fails, so that a bad message can't block others, such as a stop."""
        if not self._axes.sent(message):
            return None
        try:
            data = self.codec.encode(message, version=1 if self._old and message.id < 256 else 2)
        except (struct.error, OverflowError) as error:
            if (kind := message.get_type()) not in self._unencodable:
                self._unencodable.add(kind)
                text = f"{kind} was not sent: a number does not fit its MAVLink field ({error})"
                self._publish_event(VehicleEvent(EventKind.DRIVER_ERROR, text, Severity.ERROR, {"where": "encoding"}))
            return None
        return Packet(data, peer, rank_of(message))

    def _check_health(self, vehicle: VehicleState | None, now_ns: int) -> None:
        for event in self._health.update(self.telemetry, vehicle, now_ns):
            self._publish_event(event)
        exchange = self.parameters
        was_waking, self._waking = self._waking, self._wakes_up(vehicle, now_ns)
        if self._waking is not was_waking and self.link_state is LinkState.UP:
            self._report_link(LinkState.UP, _WAKING if self._waking else "")
        if self._known_as is not None and now_ns - self._found_ns > IDENTITY_NS:
            self._read_again(now_ns)  # the vehicle does not identify itself
        if self.link_state is not LinkState.DEGRADED or self._silent(now_ns):
            return
        if self._known_as is not None or not self._receives_us:
            return
        waited = now_ns - self._found_ns > PARAMETERS_NS
        if not self.options.parameters or exchange.complete or exchange.given_up or waited:
            self._set_link_state(LinkState.UP, _WAKING if self._waking else "")

    def _wakes_up(self, vehicle: VehicleState | None, now_ns: int) -> bool:
        """Return whether the vehicle has just booted and has not been ready since."""
        attitude = self.telemetry.newest("ATTITUDE", now_ns, QUIET_ATTITUDE_S)
        if vehicle is None or attitude is None:
            return self._waking
        soon = attitude.time_boot_ms < WAKING_MS and not self._health.was_ready
        return vehicle.ready is False and not vehicle.armed and soon

    def _silent(self, now_ns: int) -> bool:
        return self._received_ns is None or now_ns - self._received_ns >= DEGRADED_NS

    def _describe_silence(self, since: str, why: str) -> str:
        system = f" of system {self._selector.system}" if self._selector.system is not None else ""
        return f"no message{system}{since} on {self.options.address}{why}"

    def _advice(self) -> str:
        address = self.options.address
        if address.kind is ConnectionKind.UDP_IN:
            return f"point the vehicle at UDP port {address.number} of this computer and open the port in the firewall"
        if address.kind is ConnectionKind.SERIAL:
            return f"check the vehicle's power, cable and speed (the address says {address.number} bits/s)"
        return f"join the vehicle's network, or start it at {address.place}, and check host and port in the address"

    def _trouble(self, error: OSError) -> LinkTrouble:
        address = self.options.address
        if address.kind is ConnectionKind.SERIAL:
            return serial_trouble(error, address.place, self._advice())
        return trouble_of(error, self._advice())

    # Losing and finding ------------------------------------------------------------------------------------------

    def _lose(self, reason: str, now_ns: int) -> None:
        self._received_ns = self._last_report = None
        self._waking, self._prearm = False, ""
        self._slow_heartbeat = self.telemetry.armed()
        self._selector.forget()
        self._axes.forget()
        self.parameters.fail_writes(reason)
        self.commands.reset()
        self._out.clear()
        if self.setpoints is not None:
            self.setpoints.on_link_lost()
        self.clock = VehicleClock()
        self._publish(self.clock.now(now_ns), now_ns)  # report that the vehicle's present state is unknown
        self._set_link_state(LinkState.LOST, reason)

    def _find(self, heartbeat: Message, now_ns: int) -> None:
        self._found_ns, self._unreachable, self._slow_heartbeat = now_ns, "", False
        target = heartbeat.get_srcSystem(), heartbeat.get_srcComponent()
        self.commands.target = self.parameters.target = target
        kind = heartbeat.autopilot, heartbeat.type
        if kind != self._kind:
            self._identify(heartbeat)
        self._known_as, self.version = self.version, None
        if self.autopilot is not None:
            rates = self.autopilot.message_rates(self.options.rate_hz)
            if self._axes.begin is not None:
                rates = {ORIGIN: ORIGIN_HZ, **rates}
            self._intervals = MessageIntervals(rates)
        if self.options.origin is not None:
            self._out.append(_origin(target[0], self.options.origin))
        if self._known_as is None:
            self._read_again(now_ns)
        text = "reading its parameters" if self.parameters.busy else ""
        if not self._receives_us:
            text = "it has not answered since sending failed"
        self._set_link_state(LinkState.DEGRADED, text)

    def _identify(self, heartbeat: Message) -> None:
        """Set up a new vehicle, discarding everything known about any other vehicle."""
        if self._kind is not None:
            text = f"another vehicle answers as system {heartbeat.get_srcSystem()}: setting it up"
            self._publish_event(event_of(text, "another", Severity.WARNING, system=heartbeat.get_srcSystem()))
        self._kind = heartbeat.autopilot, heartbeat.type
        self.telemetry, self.parameters, self._health = MavlinkTelemetry(), ParameterExchange(), HealthMonitor()
        self.parameters.target = self.commands.target
        self.version = self._known_as = self.setpoints = None
        self._axes.forget()
        self.autopilot = found = profile_of(heartbeat.autopilot)
        self._unsupported_reason = unsupported_reason(heartbeat)
        if self._unsupported_reason:
            text = f"the vehicle answers but can't be flown: {self._unsupported_reason}"
            self._publish_event(VehicleEvent(EventKind.DRIVER_ERROR, text, Severity.ERROR, {"where": "autopilot"}))
        if found is None:
            return
        self.parameters.bytewise = found.BYTEWISE
        if not self._unsupported_reason:
            height_m = takeoff_height(self.limits)
            self.setpoints = MavlinkSetpoints(
                found, self.commands, height_m, lambda: found.thrust_model(self.parameters.values), self._stop
            )
            self._publish_event(event_of(limits_text(self.limits), "limits"))

    def _on_version(self, version: Message, now_ns: int) -> None:
        """Handle the vehicle's version. A rediscovered vehicle is the same one only if its version matches."""
        before, self._known_as, self.version = self._known_as, None, version
        same = True if before is None else _is_same(before, version)
        heartbeat = self.telemetry.newest("HEARTBEAT", now_ns)
        if same is False and heartbeat is not None:
            self._identify(heartbeat)
            self.telemetry.on_message(heartbeat, now_ns)
            self.version = version
        if not same:
            self._read_again(now_ns)
        self.parameters.bytewise = bool(version.capabilities & BYTEWISE)

    def _read_again(self, now_ns: int) -> None:
        """Read the parameters again, because the vehicle may not be the same as before."""
        self._known_as = None
        if self.options.parameters:
            self.parameters.request_all(now_ns)

    def broken(self, error: OSError, now_ns: int) -> None:
        """See :meth:`VehicleSession.broken`. The link is not up again until the vehicle replies to a request."""
        super().broken(error, now_ns)
        self._receives_us = False

    def limit(self, limits: Mapping[str, float]) -> None:
        """Set the driver's own limits."""
        self.limits = limits
        if self.setpoints is not None:
            self.setpoints.takeoff_m = takeoff_height(limits)


def _is_same(one: Message, other: Message) -> bool | None:
    """Return whether two version messages are from the same vehicle; None if no serial number can be compared."""
    if any(one.uid2) and any(other.uid2):  # MAVLink 1 does not transmit ``uid2``
        return list(one.uid2) == list(other.uid2)
    return bool(one.uid == other.uid) if one.uid and other.uid else None


def observed_state(vehicle: VehicleState | None) -> FlightState:
    """Return the flight state of a vehicle that Skyloop can't fly."""
    if vehicle is None or vehicle.airborne is None:
        return FlightState.UNKNOWN
    return FlightState.FLYING if vehicle.airborne else FlightState.LANDED


def _heartbeat() -> Message:
    active = m.MAV_STATE_ACTIVE
    return m.MAVLink_heartbeat_message(m.MAV_TYPE_GCS, m.MAV_AUTOPILOT_INVALID, 0, 0, active, 3)


def _origin(system: int, origin: tuple[float, float, float]) -> Message:
    latitude, longitude, altitude = origin
    return m.MAVLink_set_gps_global_origin_message(
        system, round(latitude * 1e7), round(longitude * 1e7), round(altitude * 1000)
    )
