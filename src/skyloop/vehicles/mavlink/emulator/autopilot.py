"""Behaviour shared by both autopilots, which fly a simulated vehicle on command. Pure except for the vehicle.

Times are on the autopilot's clock in simulated seconds, so that everything runs faster in a faster world.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable
from enum import IntEnum
from typing import ClassVar, Final

from skyloop.messages import FlightState
from skyloop.sim.host import Report
from skyloop.vehicles.emulation.flight import Vehicle
from skyloop.vehicles.mavlink.emulator.links import MAX_INTERVAL_US, Port
from skyloop.vehicles.mavlink.emulator.manoeuvres import ORIGIN, Manoeuvres, on_earth, place_of
from skyloop.vehicles.mavlink.emulator.services import ParameterTable, answers
from skyloop.vehicles.mavlink.emulator.telemetry import MAKERS, POSE_GAP_S, AutopilotState
from skyloop.vehicles.mavlink.wire.axes import Vector
from skyloop.vehicles.mavlink.wire.codec import Message, chunks_of
from skyloop.vehicles.mavlink.wire.codec import dialect as m

FORCE: Final = 21196  #: argument of the disarm command that means "even in flight"
# MAV_SEVERITY.
WARNING: Final = 4
CRITICAL: Final = 2
INFO: Final = 6
AFTER_LANDING_S: Final = 2.0  #: time on the ground after a flight until the vehicle disarms
_GCS: Final = 6  #: MAV_TYPE of a ground station
#: Messages unaffected by the old request for messages.
_ON_REQUEST: Final = (
    m.MAVLINK_MSG_ID_HEARTBEAT,
    m.MAVLINK_MSG_ID_TIMESYNC,
    m.MAVLINK_MSG_ID_HOME_POSITION,
    m.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN,
)
_NOT_GIVEN: Final = 0x7FFFFFFF  #: value that means "no position" in COMMAND_INT, like NaN in COMMAND_LONG

Arguments = tuple[float, ...]
Handler = Callable[[Arguments], int]
PlaceHandler = Callable[[Arguments, int], int]


class MavResult(IntEnum):
    """Values of ``MAV_RESULT``."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4


class EmulatedAutopilot(AutopilotState):
    """One autopilot. Call all its methods on one thread. Set ``ports`` (its links) before the first report."""

    CAPABILITIES: ClassVar[int]
    VERSION: ClassVar[int]
    RATES: ClassVar[dict[int, float]]  #: rates of the messages sent on a new link without being requested [1/s]
    FRAMES: ClassVar[frozenset[int]]  #: frames accepted in set-points
    ABOVE_SEA: ClassVar[frozenset[int]]  #: frames of global positions with altitudes above mean sea level
    ABOVE_HOME: ClassVar[frozenset[int]]  #: frames of global positions with altitudes above home
    LONG_FRAMES: ClassVar[dict[int, int]]  #: frame of the position in COMMAND_LONG, for each command that accepts one
    NOT_PROVIDED: ClassVar[int]  #: result of a request for a message that it does not provide
    BYTEWISE: ClassVar[bool]
    DISARM_S: ClassVar[float]  #: time after which a vehicle armed on the ground disarms
    WORDS: ClassVar[dict[str, str]]  #: texts for the events armed, disarmed, auto_disarm (on the ground) and landed

    def __init__(self, vehicle: Vehicle, system: int, boot_s: float, gps: bool) -> None:
        super().__init__(vehicle, boot_s, gps)
        self.system = system
        self.ports: tuple[Port, ...] = ()
        self.parameters: ParameterTable
        self.mode = ""
        self.poses = 0  #: number of external poses received
        self.set_points = 0  #: number of set-points accepted
        self._home_given = False  # whether home was set by a command, so that arming leaves it unchanged
        self._manoeuvres = Manoeuvres(self.flight)
        self._captured_ns = 0
        self._armed_s = 0.0
        self._landed_s: float | None = None
        self._flown = False  # whether the vehicle has flown since it was armed
        self._gcs_s: float | None = None
        self._text = 0
        self._commands: dict[int, Handler] = {
            m.MAV_CMD_COMPONENT_ARM_DISARM: self._arm_or_disarm,
            m.MAV_CMD_DO_SET_MODE: self._change_mode,
            m.MAV_CMD_NAV_TAKEOFF: self._take_off,
            m.MAV_CMD_NAV_LAND: lambda _: self._go_by("land"),
            m.MAV_CMD_NAV_RETURN_TO_LAUNCH: lambda _: self._go_by("return"),
            m.MAV_CMD_DO_CHANGE_SPEED: self._change_speed,
        }
        self._placed_commands: dict[int, PlaceHandler] = {
            m.MAV_CMD_DO_REPOSITION: self._reposition,
            m.MAV_CMD_DO_SET_HOME: self._set_home,
        }

    # Simulation steps ------------------------------------------------------------------------------------------

    def tick(self, report: Report) -> None:
        """Handle a new report: fly, and send the messages that are due."""
        self.report = report
        self._captured_ns = report.captured_ns
        if self._begun_s is None:
            self._begun_s = report.believed.time_s
        self.flight.update(report)
        if self.armed:
            self._fly()
            self._check_ground()
        else:
            self.flight.lie()
        self._check_ground_station()
        self._send_due()

    @abstractmethod
    def _fly(self) -> None:
        """Fly according to the mode. Called on every tick while armed."""

    def _check_ground(self) -> None:
        if not self.flight.standing:
            self._flown, self._landed_s = True, None
            return
        if self.flight.state is FlightState.EMERGENCY:
            return
        if not self._flown:
            if self.time_s - self._armed_s > self.DISARM_S:
                self._disarm(self.WORDS["auto_disarm"])
        elif self._landed_s is None:
            self._landed_s = self.time_s
        elif self.time_s - self._landed_s > AFTER_LANDING_S:
            self._disarm(self.WORDS["landed"])

    def _check_ground_station(self) -> None:
        lost = self._gcs_s is not None and self.time_s - self._gcs_s > self._gcs_patience_s
        self._ground_station(lost)

    @property
    @abstractmethod
    def _gcs_patience_s(self) -> float: ...

    @abstractmethod
    def _ground_station(self, lost: bool) -> None: ...

    def _send_due(self) -> None:
        for port in self.ports:
            for number in port.streams.due(self.time_s):
                made = MAKERS[number](self)
                if made is not None:
                    port.send(made)
            for parameter in self.parameters.pending(port):
                port.send(parameter)

    def send_text(self, text: str, severity: int = WARNING) -> None:
        """Send a text message on all links, in chunks if the message is long."""
        self._text = self._text % 0xFFFF + 1
        for port in self.ports:
            for chunk in chunks_of(text, severity, self._text):
                port.send(chunk)

    def send_heartbeat(self) -> None:
        """Send a heartbeat outside the regular schedule."""
        for port in self.ports:
            port.send(MAKERS[m.MAVLINK_MSG_ID_HEARTBEAT](self))

    # Incoming messages -------------------------------------------------------------------------------------------

    def on_message(self, port: Port, message: Message, now_ns: int) -> None:
        """Handle a message and send replies to its port. All messages before the first report are ignored."""
        if self._begun_s is None or getattr(message, "target_system", 0) not in (0, self.system):
            return
        kind = message.get_type()
        if kind == "HEARTBEAT":
            if message.type == _GCS and self._counts(message):
                self._gcs_s = self.time_s
        elif kind == "COMMAND_LONG":
            frame = self.LONG_FRAMES.get(message.command)
            self._command(port, message, tuple(getattr(message, f"param{n}") for n in range(1, 8)), frame)
        elif kind == "COMMAND_INT":
            first = tuple(getattr(message, f"param{n}") for n in range(1, 5))
            place = (math.nan if each == _NOT_GIVEN else each / 1e7 for each in (message.x, message.y))
            self._command(port, message, (*first, *place, message.z), message.frame)
        elif kind == "SET_MODE":
            self._change_mode((message.base_mode, *self._split(message.custom_mode)))
        elif kind in ("SET_POSITION_TARGET_LOCAL_NED", "SET_POSITION_TARGET_GLOBAL_INT", "SET_ATTITUDE_TARGET"):
            self._set_point(message)
        elif kind in ("ODOMETRY", "VISION_POSITION_ESTIMATE", "ATT_POS_MOCAP"):
            self._pose()
        elif kind == "TIMESYNC":
            if message.tc1 == 0:
                drift_ns = max(0, now_ns - self._captured_ns)
                port.send(m.MAVLink_timesync_message(self.boot_ns + drift_ns, message.ts1))
        elif kind == "REQUEST_DATA_STREAM":
            self._data_stream(port, message)
        elif kind in ("RC_CHANNELS_OVERRIDE", "MANUAL_CONTROL"):
            self._sticks(message)
        elif kind.startswith("PARAM_"):
            for answer in self.parameters.on_message(port, message):
                port.send(answer)
        elif not self._own(port, message):
            for answer in answers(message):
                port.send(answer)

    def _restart(self) -> None:
        """Boot again, as if just switched on."""
        self._begun_s = self._gcs_s = None
        self.home, self._home_given = (0.0, 0.0, 0.0), False
        self._pose_s, self._posing_s = -math.inf, math.inf
        for port in self.ports:
            port.streams.reset()

    def _own(self, port: Port, message: Message) -> bool:  # noqa: ARG002
        """Handle a message that only one of the two autopilots supports; return whether it was handled."""
        return False

    @abstractmethod
    def _counts(self, heartbeat: Message) -> bool:
        """Return whether this ground station's heartbeats are monitored."""

    @abstractmethod
    def _set_point(self, message: Message) -> None: ...

    @abstractmethod
    def _sticks(self, message: Message) -> None:
        """Handle a remote control's input over MAVLink."""

    def _pose(self) -> None:
        self.poses += 1
        if self.time_s - self._pose_s > POSE_GAP_S:
            self._posing_s = self.time_s
        self._pose_s = self.time_s

    def _data_stream(self, port: Port, message: Message) -> None:
        """Handle the old request for messages, which sets a single rate for all of them."""
        rate = min(50, message.req_message_rate) if message.start_stop else 0
        for number in MAKERS:
            if number not in _ON_REQUEST:
                port.streams.set_interval(number, 1e6 / rate if rate else -1)

    # Commands ----------------------------------------------------------------------------------------------------

    def _command(self, port: Port, message: Message, arguments: Arguments, frame: int | None) -> None:
        number = message.command
        answer: Message | None = None
        if number == m.MAV_CMD_SET_MESSAGE_INTERVAL:
            result = self._set_interval(port, whole(arguments[0]), arguments[1])
        elif number == m.MAV_CMD_GET_MESSAGE_INTERVAL:
            answer = self._interval(port, whole(arguments[0]))
            result = MavResult.ACCEPTED if answer is not None else MavResult.FAILED
        elif number in (m.MAV_CMD_REQUEST_MESSAGE, m.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES):
            asked = m.MAVLINK_MSG_ID_AUTOPILOT_VERSION if number != m.MAV_CMD_REQUEST_MESSAGE else whole(arguments[0])
            answer = self._requested(asked)
            result = MavResult.ACCEPTED if answer is not None else self.NOT_PROVIDED
        elif number == m.MAV_CMD_GET_HOME_POSITION:
            answer = self._requested(m.MAVLINK_MSG_ID_HOME_POSITION)
            result = MavResult.ACCEPTED if answer is not None else self.NOT_PROVIDED
        elif number in self._placed_commands:
            result = MavResult.UNSUPPORTED if frame is None else self._placed_commands[number](arguments, frame)
        else:
            handler = self._commands.get(number)
            result = MavResult.UNSUPPORTED if handler is None else handler(arguments)
        sender = message.get_srcSystem(), message.get_srcComponent()
        port.send(m.MAVLink_command_ack_message(number, result, 0, 0, *sender))
        if answer is not None:
            port.send(answer)

    def _requested(self, number: int) -> Message | None:
        if number == m.MAVLINK_MSG_ID_AUTOPILOT_VERSION:
            none = [0] * 8
            uid = 1000 + self.system
            return m.MAVLink_autopilot_version_message(
                self.CAPABILITIES, self.VERSION, 0, 0, 0, none, none, none, 0, 0, uid
            )
        maker = MAKERS.get(number)
        return maker(self) if maker is not None else None

    def _interval(self, port: Port, number: int) -> Message | None:
        if not 0 <= number <= 0xFFFF:  # the number does not fit in the reply
            return None
        return m.MAVLink_message_interval_message(number, port.streams.interval_us(number))

    def _set_interval(self, port: Port, number: int, interval_us: float) -> int:
        if number not in MAKERS or not interval_us <= MAX_INTERVAL_US:  # the comparison is also false for NaN
            return MavResult.FAILED
        port.streams.set_interval(number, interval_us)
        return MavResult.ACCEPTED

    def _arm_or_disarm(self, arguments: Arguments) -> int:
        forced = whole(arguments[1]) == FORCE
        if arguments[0] >= 0.5:
            return MavResult.ACCEPTED if self.armed else self._arm(forced)
        if not self.armed:
            return MavResult.ACCEPTED
        if self.flight.standing:
            self._disarm("")
            return MavResult.ACCEPTED
        if forced:
            self.flight.cut()
            self._disarm("")
            return MavResult.ACCEPTED
        return self._refuse_disarming()

    def _arm(self, forced: bool) -> int:
        refusal = None if forced else self._refuse_arming()
        if refusal is not None:
            return refusal
        self.armed, self._armed_s, self._flown, self._landed_s = True, self.time_s, False, None
        if not self._home_given:
            self.home = self.flight.place
        self.send_text(self.WORDS["armed"], INFO)
        return MavResult.ACCEPTED

    def _disarm(self, text: str) -> None:
        self.armed = False
        self.send_text(text or self.WORDS["disarmed"], INFO)
        self._disarmed()

    def crashed(self, text: str) -> None:
        """Disarm because the vehicle stopped its motors; ``text`` gives the reason."""
        if self.armed:
            self._disarm(f"Crash: Disarming ({text})")

    @abstractmethod
    def _disarmed(self) -> None:
        """Change the mode after disarming."""

    @abstractmethod
    def _refuse_arming(self) -> int | None:
        """Return the result code for refusing to arm, after sending the reason as a text; None if arming is allowed."""

    @abstractmethod
    def _refuse_disarming(self) -> int:
        """Return the result code for refusing to disarm in flight."""

    def _datum(self, frame: int) -> float | None:
        """Return the height [m] above the flight's origin where a frame's altitude is 0; None for an unknown frame."""
        if frame in self.ABOVE_SEA:
            return -ORIGIN.altitude_m
        return self.home[2] if frame in self.ABOVE_HOME else None

    def _place(self, arguments: Arguments, frame: int) -> Vector | None:
        """Return the position contained in a command; None if there is none."""
        latitude, longitude, altitude = arguments[4:7]
        datum = self._datum(frame)
        if datum is None or not on_earth(latitude, longitude) or not math.isfinite(altitude):
            return None
        return place_of(latitude, longitude, datum + altitude)

    def _home_at(self, place: Vector) -> None:
        self.home, self._home_given = place, True

    @abstractmethod
    def _change_speed(self, arguments: Arguments) -> int: ...

    @abstractmethod
    def _reposition(self, arguments: Arguments, frame: int) -> int: ...

    @abstractmethod
    def _set_home(self, arguments: Arguments, frame: int) -> int: ...

    @abstractmethod
    def _split(self, custom_mode: int) -> Arguments:
        """Return a heartbeat's custom mode as arguments of the command that sets the mode."""

    @abstractmethod
    def _change_mode(self, arguments: Arguments) -> int: ...

    @abstractmethod
    def _take_off(self, arguments: Arguments) -> int: ...

    @abstractmethod
    def _go_by(self, manoeuvre: str) -> int:
        """Handle the command that lands or returns without changing the mode."""


def whole(argument: float) -> int:
    """Return a command's argument as a whole number; 0 for NaN, which means "not given"."""
    return round(argument) if math.isfinite(argument) else 0
