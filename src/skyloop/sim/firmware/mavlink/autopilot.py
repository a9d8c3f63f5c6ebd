"""What both autopilots have in common: messages in, a simulated vehicle flown, messages out. Pure but for the vehicle.

Times are the autopilot's, seconds of the simulation, so that everything goes faster in a faster world.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import ClassVar, Final

from skyloop.messages import FlightState
from skyloop.sim.firmware.mavlink.flyer import Flyer
from skyloop.sim.firmware.mavlink.links import Port
from skyloop.sim.firmware.mavlink.parameters import ParameterTable
from skyloop.sim.firmware.mavlink.streams import MAX_INTERVAL_US
from skyloop.sim.firmware.mavlink.targets import AttitudeTarget, Target
from skyloop.sim.firmware.mavlink.telemetry import HOME_ALTITUDE_M, MAKERS
from skyloop.sim.firmware.vehicle import Vehicle
from skyloop.sim.host import Report
from skyloop.wire.mavlink.codec import Message
from skyloop.wire.mavlink.codec import dialect as m
from skyloop.wire.mavlink.modes import ModeFlag, SystemState
from skyloop.wire.mavlink.texts import chunks_of

ACCEPTED: Final = 0
TEMPORARILY_REJECTED: Final = 1
DENIED: Final = 2
UNSUPPORTED: Final = 3
FAILED: Final = 4
FORCE: Final = 21196  #: "even in flight", of the command to disarm
WARNING: Final = 4
CRITICAL: Final = 2
INFO: Final = 6
AFTER_LANDING_S: Final = 2.0
POSES_S: Final = 1.0  #: poses from outside must come for so long, without GPS
POSE_GAP_S: Final = 0.5
_GCS: Final = 6  #: MAV_TYPE
_COPIES: Final = 1 << 32

Arguments = tuple[float, ...]
Handler = Callable[[Arguments], int]


class Autopilot(ABC):
    """One autopilot. ``ports`` are its links; all methods belong to one thread."""

    AUTOPILOT: ClassVar[int]  #: MAV_AUTOPILOT
    CAPABILITIES: ClassVar[int]
    VERSION: ClassVar[int]
    RATES: ClassVar[dict[int, float]]  #: what a fresh link gets unasked
    FRAMES: ClassVar[frozenset[int]]  #: of set-points
    BYTEWISE: ClassVar[bool]
    DISARM_S: ClassVar[float]  #: armed on the ground for so long, it disarms

    def __init__(self, vehicle: Vehicle, system: int, boot_s: float, gps: bool) -> None:
        self.flyer = Flyer(vehicle)
        self.system = system
        self.gps = gps
        self.ports: tuple[Port, ...] = ()
        self.parameters: ParameterTable
        self.report: Report
        self.armed = False
        self.mode = ""
        self.failsafe = False
        self.poses = 0  #: that came from outside
        self.set_points = 0  #: that were taken
        self._boot_s = boot_s
        self._begun_s: float | None = None
        self._captured_ns = 0
        self._armed_s = 0.0
        self._landed_s: float | None = None
        self._flown = False  # since it was armed
        self._gcs_s: float | None = None
        self._pose_s = -math.inf
        self._posing_s = math.inf
        self._text = 0
        self._commands: dict[int, Handler] = {
            m.MAV_CMD_COMPONENT_ARM_DISARM: self._arm_or_disarm,
            m.MAV_CMD_DO_SET_MODE: self._change_mode,
            m.MAV_CMD_NAV_TAKEOFF: self._take_off,
            m.MAV_CMD_NAV_LAND: lambda _: self._go_by("land"),
            m.MAV_CMD_NAV_RETURN_TO_LAUNCH: lambda _: self._go_by("return"),
        }

    # Time and state --------------------------------------------------------------------------------------------

    @property
    def time_s(self) -> float:
        """Since it was switched on."""
        return 0.0 if self._begun_s is None else self.report.believed.time_s - self._begun_s

    @property
    def boot_ms(self) -> int:
        return round(self.time_s * 1000) % _COPIES

    @property
    def boot_ns(self) -> int:
        return round(self.time_s * 1e9)

    @property
    def has_origin(self) -> bool:
        """Whether it knows where it is."""
        if self.gps:
            return self.time_s >= self._boot_s / 2
        return self.time_s - self._posing_s >= POSES_S and self.time_s - self._pose_s < POSE_GAP_S

    @property
    def ready(self) -> bool:
        """Whether it may be armed."""
        return self.time_s >= self._boot_s and self.has_origin and self.mode_allows_arming

    @property
    def mode_allows_arming(self) -> bool:
        return True

    @property
    def base_mode(self) -> int:
        return int(ModeFlag.CUSTOM | (ModeFlag.ARMED if self.armed else 0))

    @property
    def system_status(self) -> int:
        if self.failsafe:
            return SystemState.CRITICAL
        return SystemState.ACTIVE if self.armed else SystemState.STANDBY

    @property
    @abstractmethod
    def custom_mode(self) -> int: ...

    # Time passes -----------------------------------------------------------------------------------------------

    def tick(self, report: Report) -> None:
        """There is a new report."""
        self.report = report
        self._captured_ns = report.captured_ns
        if self._begun_s is None:
            self._begun_s = report.believed.time_s
        self.flyer.update(report)
        if self.armed:
            self._fly()
            self._look_at_ground()
        else:
            self.flyer.lie()
        self._look_at_ground_station()
        self._send_due()

    @abstractmethod
    def _fly(self) -> None:
        """What the mode does now; called at every tick while it is armed."""

    def _look_at_ground(self) -> None:
        if not self.flyer.standing:
            self._flown, self._landed_s = True, None
            return
        if self.flyer.state is FlightState.EMERGENCY:
            return
        if not self._flown:
            if self.time_s - self._armed_s > self.DISARM_S:
                self._disarm(self._words("auto_disarm"))
        elif self._landed_s is None:
            self._landed_s = self.time_s
        elif self.time_s - self._landed_s > AFTER_LANDING_S:
            self._disarm(self._words("landed"))

    def _look_at_ground_station(self) -> None:
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

    def say(self, text: str, severity: int = WARNING) -> None:
        """A text to everybody."""
        self._text = self._text % 0xFFFF + 1
        for port in self.ports:
            for chunk in chunks_of(text, severity, self._text):
                port.send(chunk)

    def tell_heartbeat(self) -> None:
        """One besides the usual ones."""
        for port in self.ports:
            port.send(MAKERS[m.MAVLINK_MSG_ID_HEARTBEAT](self))

    # Messages come -----------------------------------------------------------------------------------------------

    def heard(self, port: Port, message: Message, now_ns: int) -> None:
        """Whatever came. Before the first report it is not awake yet."""
        if self._begun_s is None or getattr(message, "target_system", 0) not in (0, self.system):
            return
        kind = message.get_type()
        if kind == "HEARTBEAT":
            if message.type == _GCS and self._counts(message):
                self._gcs_s = self.time_s
        elif kind == "COMMAND_LONG":
            self._command(port, message, tuple(getattr(message, f"param{n}") for n in range(1, 8)))
        elif kind == "COMMAND_INT":
            first = tuple(getattr(message, f"param{n}") for n in range(1, 5))
            self._command(port, message, (*first, message.x / 1e7, message.y / 1e7, message.z))
        elif kind == "SET_MODE":
            self._change_mode((message.base_mode, *self._split(message.custom_mode)))
        elif kind in ("SET_POSITION_TARGET_LOCAL_NED", "SET_ATTITUDE_TARGET"):
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
            for answer in self.parameters.heard(port, message):
                port.send(answer)
        elif kind == "MISSION_REQUEST_LIST":
            sender = message.get_srcSystem(), message.get_srcComponent()
            port.send(m.MAVLink_mission_count_message(*sender, 0, message.mission_type))

    @abstractmethod
    def _counts(self, heartbeat: Message) -> bool:
        """Whether this ground station's heartbeat counts."""

    @abstractmethod
    def _set_point(self, message: Message) -> None: ...

    @abstractmethod
    def _sticks(self, message: Message) -> None:
        """Of a remote control that comes over MAVLink."""

    def _pose(self) -> None:
        self.poses += 1
        if self.time_s - self._pose_s > POSE_GAP_S:
            self._posing_s = self.time_s
        self._pose_s = self.time_s

    def _data_stream(self, port: Port, message: Message) -> None:
        """The old way to ask for messages: all of them at one rate."""
        rate = min(50, message.req_message_rate) if message.start_stop else 0
        for number in MAKERS:
            if number not in (m.MAVLINK_MSG_ID_HEARTBEAT, m.MAVLINK_MSG_ID_TIMESYNC):
                port.streams.set_interval(number, 1e6 / rate if rate else -1)

    # Commands ----------------------------------------------------------------------------------------------------

    def _command(self, port: Port, message: Message, arguments: Arguments) -> None:
        number = message.command
        answer: Message | None = None
        if number == m.MAV_CMD_SET_MESSAGE_INTERVAL:
            result = self._set_interval(port, whole(arguments[0]), arguments[1])
        elif number == m.MAV_CMD_GET_MESSAGE_INTERVAL:
            answer = self._interval(port, whole(arguments[0]))
            result = ACCEPTED if answer is not None else FAILED
        elif number in (m.MAV_CMD_REQUEST_MESSAGE, m.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES):
            asked = m.MAVLINK_MSG_ID_AUTOPILOT_VERSION if number != m.MAV_CMD_REQUEST_MESSAGE else whole(arguments[0])
            answer = self._requested(asked)
            result = ACCEPTED if answer is not None else UNSUPPORTED
        else:
            handler = self._commands.get(number)
            result = UNSUPPORTED if handler is None else handler(arguments)
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
        if not 0 <= number <= 0xFFFF:  # the answer has no room for it
            return None
        return m.MAVLink_message_interval_message(number, port.streams.interval_us(number))

    def _set_interval(self, port: Port, number: int, interval_us: float) -> int:
        if number not in MAKERS or not interval_us <= MAX_INTERVAL_US:  # nor for NaN
            return FAILED
        port.streams.set_interval(number, interval_us)
        return ACCEPTED

    def _arm_or_disarm(self, arguments: Arguments) -> int:
        forced = whole(arguments[1]) == FORCE
        if arguments[0] >= 0.5:
            return ACCEPTED if self.armed else self._arm(forced)
        if not self.armed:
            return ACCEPTED
        if self.flyer.standing:
            self._disarm("")
            return ACCEPTED
        if forced:
            self.flyer.cut()
            self._disarm(self._words("forced"))
            return ACCEPTED
        return self._refuse_disarming()

    def _arm(self, forced: bool) -> int:
        refusal = None if forced else self._refuse_arming()
        if refusal is not None:
            return refusal
        self.armed, self._armed_s, self._flown, self._landed_s = True, self.time_s, False, None
        self.say(self._words("armed"), INFO)
        return ACCEPTED

    def _disarm(self, text: str) -> None:
        self.armed = False
        self.say(text or self._words("disarmed"), INFO)
        self._disarmed()

    def crashed(self, text: str) -> None:
        """The vehicle stopped its motors by itself."""
        if self.armed:
            self._disarm(f"Crash: Disarming ({text})")

    @abstractmethod
    def _disarmed(self) -> None:
        """What becomes of the mode."""

    @abstractmethod
    def _words(self, occasion: str) -> str:
        """Its text for an occasion: armed, disarmed, auto_disarm, landed, forced."""

    @abstractmethod
    def _refuse_arming(self) -> int | None:
        """The result that refuses, after its text was said; None where nothing is against it."""

    @abstractmethod
    def _refuse_disarming(self) -> int:
        """In flight."""

    @abstractmethod
    def _split(self, custom_mode: int) -> Arguments:
        """A heartbeat's custom mode as the arguments of the command that sets it."""

    @abstractmethod
    def _change_mode(self, arguments: Arguments) -> int: ...

    @abstractmethod
    def _take_off(self, arguments: Arguments) -> int: ...

    @abstractmethod
    def _go_by(self, manoeuvre: str) -> int:
        """Land or return, by the command that is no change of mode."""


class Manoeuvres:
    """What modes of both autopilots do with a flyer. The height of a take-off is above the place of the start."""

    def __init__(self, flyer: Flyer) -> None:
        self._flyer = flyer
        self._rise_m: float | None = None

    def begin_rise(self, height_m: float) -> None:
        self._rise_m = height_m

    def rise(self) -> bool:
        """Take off and climb; whether it is up."""
        flyer = self._flyer
        if self._rise_m is None:
            return True
        if not flyer.airborne:
            flyer.lift_off()
            return False
        east, north, up = flyer.place
        flyer.go((east, north, self._rise_m + 0.1))
        return up >= self._rise_m - 0.1

    def return_home(self) -> None:
        """At the present height, then down."""
        east, north, up = self._flyer.place
        if math.hypot(east, north) > 0.3 and self._flyer.airborne:
            self._flyer.go((0.0, 0.0, up))
        else:
            self._flyer.land()

    def follow(self, target: Target | AttitudeTarget | None, lean: Callable[[AttitudeTarget], None]) -> None:
        """A set-point, or hold the place without one."""
        if isinstance(target, Target):
            target.follow(self._flyer)
        elif target is not None:
            lean(target)
        else:
            self._flyer.hold()


def whole(argument: float) -> int:
    """An argument of a command that is a number of something; NaN stands for "not given"."""
    return round(argument) if math.isfinite(argument) else 0


def above_home(altitude_amsl_m: float) -> float:
    """Height of an altitude above mean sea level."""
    return altitude_amsl_m - HOME_ALTITUDE_M
