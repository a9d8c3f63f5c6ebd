"""ArduCopter's behaviour as observed with 4.7.0-dev and listed in ``docs/mavlink.md``."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import ClassVar, Final

from skyloop.messages.geometry import turned, wrap_angle
from skyloop.vehicles.emulation.flight import GO_M_S, SINK_M_S, Speeds, Vehicle
from skyloop.vehicles.mavlink.emulator import services
from skyloop.vehicles.mavlink.emulator.autopilot import CRITICAL, INFO, Arguments, EmulatedAutopilot, MavResult, whole
from skyloop.vehicles.mavlink.emulator.links import Port
from skyloop.vehicles.mavlink.emulator.manoeuvres import (
    BODY,
    BODY_OFFSET,
    WORLD,
    WORLD_OFFSET,
    AttitudeTarget,
    Target,
    Turn,
    attitude_target_of,
    geodetic,
    global_target_of,
    target_of,
)
from skyloop.vehicles.mavlink.emulator.services import Mission, MissionResult, ParameterTable, mission_ack
from skyloop.vehicles.mavlink.wire.axes import yaw_between
from skyloop.vehicles.mavlink.wire.codec import COPTER_MODES, COPTER_NUMBERS, MavAutopilot, Message
from skyloop.vehicles.mavlink.wire.codec import dialect as m

SINK_WITHOUT_STICKS_M_S: Final = -2.5  #: climb rate in stick modes if there is no remote control
STICK_TIMEOUT_S: Final = 3.0  #: time without input after which a remote control over MAVLink counts as lost
STICK_SPEED_M_S: Final = 6.0  #: speed at full stick
TURN_RAD_S: Final = math.radians(60)  #: maximum turn rate of CONDITION_YAW
RTL_LOWEST_M: Final = 0.3  #: lowest altitude above home for a return
RTL_LEAST_SLOPE: Final = 0.5  #: flatter RTL cones are ignored
_GUIDED_ITEM: Final = 2  #: value of "current" in a mission item that means "fly there now"
_ALTITUDE_ITEM: Final = 3  #: and the value that means "change the altitude now"
CHANNELS: Final = 16  #: number of channels reported
_OVERRIDDEN: Final = 8  #: number of channels that an override can set
_IGNORED: Final = 0xFFFF  #: value for a channel that an override leaves unchanged
_NOT_ARMABLE: Final = ("LAND", "BRAKE", "AUTO", "RTL")
_PILOT: Final = ("LOITER", "ALT_HOLD", "STABILIZE", "POSHOLD")


class EmulatedArduCopter(EmulatedAutopilot):
    """An emulated ArduCopter."""

    AUTOPILOT = MavAutopilot.ARDUPILOT
    CAPABILITIES = 0xFBEF & ~0xD200  # excluding fences, rally points, terrain and files, which are not emulated
    VERSION = 4 << 24 | 7 << 16
    RATES: ClassVar[dict[int, float]] = {m.MAVLINK_MSG_ID_HEARTBEAT: 1.0, m.MAVLINK_MSG_ID_TIMESYNC: 0.2}
    FRAMES = frozenset({WORLD, WORLD_OFFSET, BODY, BODY_OFFSET})
    ABOVE_SEA = frozenset({0, 5})
    ABOVE_HOME = frozenset({3, 6})
    LONG_FRAMES: ClassVar[dict[int, int]] = {m.MAV_CMD_DO_SET_HOME: 0}
    NOT_PROVIDED = MavResult.FAILED
    BYTEWISE = False
    DISARM_S = 10.2
    WORDS: ClassVar[dict[str, str]] = {
        "armed": "Arming motors",
        **dict.fromkeys(("disarmed", "auto_disarm", "landed"), "Disarming motors"),
    }

    def __init__(self, vehicle: Vehicle, system: int, boot_s: float, gps: bool) -> None:
        super().__init__(vehicle, system, boot_s, gps)
        self.parameters = ParameterTable(services.ARDUCOPTER, bytewise=False)
        self.mission = Mission()
        self.mode = "STABILIZE"
        self._rising = False
        self._paused = False
        self._turn: Turn | None = None
        self._speeds = self._usual_speeds()
        self._target: Target | AttitudeTarget | None = None
        self._target_s = 0.0
        self._stick: tuple[float, float, float, float] | None = None  # forward, left, up, yaw
        self._stick_s = -STICK_TIMEOUT_S
        self._overrides: dict[int, int] = {}  # pulse widths [µs] by channel, counted from 0
        self._commands |= {
            m.MAV_CMD_CONDITION_YAW: self._condition_yaw,
            m.MAV_CMD_DO_PAUSE_CONTINUE: self._pause_or_continue,
            m.MAV_CMD_DO_SEND_BANNER: self._send_banner,
            m.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN: self._reboot,
        }

    @property
    def custom_mode(self) -> int:
        return COPTER_NUMBERS[self.mode]

    def _counts(self, heartbeat: Message) -> bool:
        return bool(heartbeat.get_srcSystem() == round(self.parameters["MAV_GCS_SYSID"]))

    # Modes -----------------------------------------------------------------------------------------------------

    def _fly(self) -> None:
        if self.mode == "GUIDED":
            self._fly_guided()
        elif self.mode == "BRAKE":
            self.flight.hold()
        elif self.mode == "LAND":
            self.flight.land()
        elif self.mode == "RTL":
            self._manoeuvres.return_home(self._speeds)
        elif self.mode in _PILOT:
            self._fly_by_sticks()

    def _fly_guided(self) -> None:
        if self._paused:
            self.flight.hold()
            return
        if self._rising:
            self._rising = not self._manoeuvres.rise()
            return
        if not self.flight.airborne:
            return  # only a take-off command can start a take-off
        if self._target is not None and self.time_s - self._target_s > self.parameters["GUID_TIMEOUT"]:
            if isinstance(self._target, AttitudeTarget):
                self.flight.lean(0.0, 0.0, 0.0, 0.0)  # level attitude, so the vehicle continues to drift
                return
            if self._target.place is None:
                self._target = None
        turn = None if self._turn is None else self._turn.rate()
        self._manoeuvres.follow(self._target, self._lean, self._speeds, turn)

    def _lean(self, target: AttitudeTarget) -> None:
        assert target.thrust is not None
        roll, pitch = target.tilt
        share = (target.thrust - 0.5) * 2.0
        fastest = self.parameters["WPNAV_SPEED_UP" if share > 0 else "WPNAV_SPEED_DN"] / 100.0
        self.flight.lean(roll, pitch, share * fastest, target.turn(self.flight))

    def _fly_by_sticks(self) -> None:
        """Follow the remote control. Without MAVLink input, a simulated remote control with low throttle applies."""
        if self._stick is not None and self.time_s - self._stick_s < STICK_TIMEOUT_S:
            self.flight.move_body(*self._stick)
        elif self.flight.place[2] > 0.3:
            self.flight.move_body(0.0, 0.0, SINK_WITHOUT_STICKS_M_S, 0.0)
        else:
            self.flight.land()

    def _sticks(self, message: Message) -> None:
        if message.get_srcSystem() != round(self.parameters["MAV_GCS_SYSID"]):
            return
        if message.get_type() == "MANUAL_CONTROL":
            shares = (message.x / 1000, -message.y / 1000, (message.z - 500) / 500, -message.r / 1000)
        else:
            for n in range(_OVERRIDDEN):
                width = getattr(message, f"chan{n + 1}_raw", _IGNORED)
                if width == 0:
                    self._overrides.pop(n, None)
                elif width != _IGNORED:
                    self._overrides[n] = width
            raw = (message.chan2_raw, message.chan1_raw, message.chan3_raw, message.chan4_raw)
            forward, right, throttle, turn = ((each - 1500) / 500 if 900 < each < 2200 else 0.0 for each in raw)
            shares = (-forward, -right, throttle, -turn)
        self._stick_s = self.time_s
        self._stick = (shares[0] * STICK_SPEED_M_S, shares[1] * STICK_SPEED_M_S, shares[2] * 2.5, shares[3])

    def _set_mode(self, mode: str) -> None:
        if mode != self.mode:
            self.mode, self._target, self._rising = mode, None, False
            self._paused, self._turn, self._speeds = False, None, self._usual_speeds()
            if mode == "RTL":
                self._begin_return()
            self.send_heartbeat()

    def _usual_speeds(self) -> Speeds:
        across, up, down = (self.parameters[f"WPNAV_SPEED{which}"] / 100.0 for which in ("", "_UP", "_DN"))
        return Speeds(min(GO_M_S, across), min(SINK_M_S, up), min(SINK_M_S, down))

    def _begin_return(self) -> None:
        """Start to return at RTL_ALT, or lower near home, but never below the present height."""
        east, north, up = self.flight.place
        above, distance = up - self.home[2], math.hypot(east - self.home[0], north - self.home[1])
        lowest = max(RTL_LOWEST_M, above + max(0.0, self.parameters["RTL_CLIMB_MIN"] / 100.0))
        height = max(lowest, self.parameters["RTL_ALT"] / 100.0)
        slope = self.parameters["RTL_CONE_SLOPE"]
        if slope >= RTL_LEAST_SLOPE:
            height = min(height, max(lowest, distance * slope))
        final = self.parameters["RTL_ALT_FINAL"] / 100.0
        self._manoeuvres.begin_return(
            self.home,
            self.home[2] + height,
            wait_s=self.parameters["RTL_LOIT_TIME"] / 1000.0,
            final_m=self.home[2] + final if final > 0 else None,
        )

    def _split(self, custom_mode: int) -> Arguments:
        return (float(custom_mode),)

    def _change_mode(self, arguments: Arguments) -> int:
        number = whole(arguments[1])
        mode = COPTER_MODES.get(number)
        if mode is None:
            self.send_text(f"No such mode {number}")
            return MavResult.FAILED
        needs_place = mode in ("GUIDED", "LOITER", "RTL", "BRAKE", "POSHOLD")
        if mode == "AUTO" or (needs_place and not self.has_origin):
            why = "init failed" if mode == "AUTO" else "requires position"
            self.send_text(f"Mode change to {mode} failed: {why}")
            return MavResult.FAILED
        self._set_mode(mode)
        return MavResult.ACCEPTED

    def _go_by(self, manoeuvre: str) -> int:
        self._set_mode({"land": "LAND", "return": "RTL"}[manoeuvre])
        return MavResult.ACCEPTED

    def _disarmed(self) -> None:
        """Keep the mode, which is LAND after a landing and does not allow arming."""

    # Arming and taking off -------------------------------------------------------------------------------------

    def _refuse_arming(self) -> int | None:
        if self.time_s < self._boot_s:
            self.send_text("Arm: Gyros inconsistent", CRITICAL)
            self.send_text("Arm: Need Position Estimate", CRITICAL)
            return MavResult.FAILED
        if self.mode in _NOT_ARMABLE:
            self.send_text(f"Arm: {self.mode} mode not armable", CRITICAL)
            return MavResult.FAILED
        if self.mode == "GUIDED" and not self.has_origin:
            self.send_text("Arm: Need Position Estimate", CRITICAL)
            return MavResult.FAILED
        return None

    def _refuse_disarming(self) -> int:
        return MavResult.FAILED

    def _take_off(self, arguments: Arguments) -> int:
        height = arguments[6]
        if self.mode != "GUIDED" or not self.armed or not self.flight.standing or not height > 0:
            return MavResult.FAILED
        self._manoeuvres.begin_rise(self.home[2] + height)
        self._rising, self._target = True, None
        return MavResult.ACCEPTED

    # Set-points ------------------------------------------------------------------------------------------------

    def _set_point(self, message: Message) -> None:
        if self.mode != "GUIDED" or not self.armed:
            return  # drop it silently
        self.set_points += 1
        made: Target | AttitudeTarget | None
        if message.get_type() == "SET_ATTITUDE_TARGET":
            lean = attitude_target_of(message)
            made = lean if lean.thrust is not None and (lean.unit or lean.attitude is None) else None
        elif message.get_type() == "SET_POSITION_TARGET_GLOBAL_INT":
            made = self._finite(global_target_of(message, self._datum(message.coordinate_frame)))
        else:
            made = self._finite(self._from_here(message)) if message.coordinate_frame in self.FRAMES else None
        self._target, self._target_s, self._turn = made, self.time_s, None
        if not (isinstance(made, Target) and made.place is None and made.velocity is None):
            self._rising = False  # this also ends a take-off

    @staticmethod
    def _finite(target: Target | None) -> Target | None:
        """Return a target if its numbers are finite; any other target silently stops the vehicle."""
        numbers = () if target is None else (*(target.velocity or ()), *(target.place or ()))
        return target if all(map(math.isfinite, numbers)) else None

    def _from_here(self, message: Message) -> Target:
        """Return the target with its position made absolute: in all frames but one, it is relative to the vehicle."""
        target = target_of(message)
        if target.place is None or message.coordinate_frame == WORLD:
            return target
        place = target.place
        if target.in_body:
            place = (*turned(message.x, -message.y, self.flight.yaw), -message.z)
        east, north, up = (at + by for at, by in zip(self.flight.place, place, strict=True))
        return replace(target, place=(east, north, up))

    # Position and speed commands -------------------------------------------------------------------------------

    def _go_to(self, target: Target) -> None:
        self._target, self._target_s, self._turn, self._rising = target, self.time_s, None, False

    def _reposition(self, arguments: Arguments, frame: int) -> int:
        if self.mode != "GUIDED" and not whole(arguments[1]) & 1:
            return MavResult.DENIED
        place = self._place(arguments, frame)
        if place is None or not _given(arguments):
            return MavResult.DENIED
        if self.mode != "GUIDED" and self._change_mode((1, COPTER_NUMBERS["GUIDED"])) != MavResult.ACCEPTED:
            return MavResult.FAILED
        self._go_to(Target(place))
        return MavResult.ACCEPTED

    def _set_home(self, arguments: Arguments, frame: int) -> int:
        here = arguments[0] == 1 or not _given(arguments)
        if not self.has_origin or not (here or arguments[0] == 0):
            return MavResult.FAILED
        place = self.flight.place if here else self._place(arguments, frame)
        if place is None:
            return MavResult.DENIED
        self._home_at(place)
        for number in (m.MAVLINK_MSG_ID_HOME_POSITION, m.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN):
            made = self._requested(number)
            for port in self.ports:
                port.send(made)
        return MavResult.ACCEPTED

    def _change_speed(self, arguments: Arguments) -> int:
        which, speed = arguments[:2]
        if self.mode not in ("GUIDED", "RTL") or not 0 < speed < math.inf:
            return MavResult.FAILED
        changed = "down" if which > 2.9 else "up" if which > 1.9 else "across"
        self._speeds = replace(self._speeds, **{changed: speed})
        return MavResult.ACCEPTED

    def _condition_yaw(self, arguments: Arguments) -> int:
        angle, rate, way, relative = arguments[:4]
        if not 0 <= angle <= 360 or relative not in (0, 1):
            return MavResult.FAILED
        if relative:
            clockwise = math.radians(angle) * (1 if way >= 0 else -1)
        else:
            clockwise = wrap_angle(math.radians(angle) - yaw_between(self.flight.yaw))
            if way < 0 < clockwise:
                clockwise -= math.tau
            elif clockwise < 0 < way:
                clockwise += math.tau
        self._turn = Turn(self.flight, -clockwise, min(TURN_RAD_S, math.radians(rate)) if rate > 0 else TURN_RAD_S)
        return MavResult.ACCEPTED

    def _pause_or_continue(self, arguments: Arguments) -> int:
        order = whole(arguments[0])
        if order not in (0, 1):
            return MavResult.DENIED
        if self.mode != "GUIDED":
            self.send_text(f"Failed to {'resume' if order else 'pause'}", INFO)
            return MavResult.FAILED
        self._paused = not order
        return MavResult.ACCEPTED

    def _send_banner(self, arguments: Arguments) -> int:  # noqa: ARG002  the command has no arguments
        major, minor = self.VERSION >> 24, self.VERSION >> 16 & 0xFF
        for text in (f"ArduCopter V{major}.{minor}.0-dev (emulated by Skyloop)", "Frame: QUAD/X"):
            self.send_text(text, INFO)
        return MavResult.ACCEPTED

    def _reboot(self, arguments: Arguments) -> int:
        if self.armed or whole(arguments[0]) not in (1, 3):
            return MavResult.FAILED
        self._set_mode("STABILIZE")
        self._stick, self._overrides, self.failsafe = None, {}, False
        self._restart()  # keeps the mission and parameters
        return MavResult.ACCEPTED

    @property
    def channels(self) -> list[int] | None:
        """The remote control's pulse widths [µs]: sticks centred and throttle down, unless overridden."""
        fresh = self.time_s - self._stick_s < STICK_TIMEOUT_S
        usual = [1500, 1500, 1000, *[1500] * (CHANNELS - 3)]
        return [self._overrides.get(n, width) if fresh else width for n, width in enumerate(usual)]

    def _own(self, port: Port, message: Message) -> bool:
        """Handle mission messages, including a mission item that is a position to fly to."""
        item = message.get_type() in ("MISSION_ITEM", "MISSION_ITEM_INT") and message.mission_type == 0
        if item and message.current in (_GUIDED_ITEM, _ALTITUDE_ITEM):
            port.send(mission_ack(message, self._guided_item(message)))
            return True
        found = self.mission.answers(message, geodetic(self.home))
        for answer in found or ():
            port.send(answer)
        return found is not None

    def _guided_item(self, message: Message) -> int:
        scale = 1e7 if message.get_type() == "MISSION_ITEM_INT" else 1.0
        latitude, longitude = message.x / scale, message.y / scale
        if not abs(latitude) <= 90:
            return MissionResult.INVALID_X
        if not abs(longitude) <= 180:
            return MissionResult.INVALID_Y
        if not math.isfinite(message.z):
            return MissionResult.INVALID_Z
        place = self._place((0.0, 0.0, 0.0, 0.0, latitude, longitude, message.z), message.frame)
        if place is None:
            return MissionResult.UNSUPPORTED
        if message.current == _ALTITUDE_ITEM:
            return MissionResult.ACCEPTED  # accepted without any effect
        if self.mode != "GUIDED" or message.command != m.MAV_CMD_NAV_WAYPOINT:
            return MissionResult.ERROR
        self._go_to(Target(place))
        return MissionResult.ACCEPTED

    # Losing the ground station ---------------------------------------------------------------------------------

    @property
    def _gcs_patience_s(self) -> float:
        return self.parameters["FS_GCS_TIMEOUT"]

    def _ground_station(self, lost: bool) -> None:
        enabled = round(self.parameters["FS_GCS_ENABLE"])
        if not enabled or lost is self.failsafe:
            return
        self.failsafe = lost
        if not lost:
            self.send_text("GCS Failsafe Cleared")
            return
        self.send_text("GCS Failsafe")
        if self.armed and self.flight.standing:
            self._disarm("")
        elif self.armed:
            self._set_mode({5: "LAND", 7: "BRAKE"}.get(enabled, "RTL"))


def _given(arguments: Arguments) -> bool:
    """Return whether a command contains a position: 0° 0° and NaN mean "none"."""
    return any(each and not math.isnan(each) for each in arguments[4:6])
