"""PX4's behaviour as observed with 1.17-alpha and listed in ``docs/mavlink.md``."""

from __future__ import annotations

import math
from typing import ClassVar, Final

from skyloop.vehicles.emulation.flight import USUAL, Speeds, Vehicle
from skyloop.vehicles.mavlink.emulator import services
from skyloop.vehicles.mavlink.emulator.autopilot import CRITICAL, INFO, Arguments, EmulatedAutopilot, MavResult, whole
from skyloop.vehicles.mavlink.emulator.links import Port
from skyloop.vehicles.mavlink.emulator.manoeuvres import (
    BODY,
    ORIGIN,
    WORLD,
    AttitudeTarget,
    Target,
    attitude_target_of,
    global_target_of,
    place_of,
    target_of,
)
from skyloop.vehicles.mavlink.emulator.services import ParameterTable
from skyloop.vehicles.mavlink.wire.axes import yaw_between
from skyloop.vehicles.mavlink.wire.codec import PX4_MODES, MavAutopilot, Message, px4_custom
from skyloop.vehicles.mavlink.wire.codec import dialect as m

SINK_IN_POSCTL_M_S: Final = -0.7  #: climb rate in stick modes if there is no remote control
STICK_SPEED_M_S: Final = 10.0  #: speed at full stick (MPC_VEL_MANUAL)
STICK_EXPO: Final = 0.6  #: how much a stick's response is flattened near its centre (MPC_XY_MAN_EXPO, MPC_Z_MAN_EXPO)
STICK_FILTER_S: Final = 0.1  #: time constant of the filter for a stick's speed
LIFTS_OFF_AT: Final = 0.2  #: throttle at which the vehicle lifts off, as a fraction of the stick's travel upwards
_STICKS: Final = ("POSCTL", "ALTCTL", "MANUAL", "STABILIZED", "ACRO")


class EmulatedPx4(EmulatedAutopilot):
    """An emulated PX4."""

    AUTOPILOT = MavAutopilot.PX4
    CAPABILITIES = 0xE8FF & ~0xC025  # excluding files, missions, fences and rally points, which are not emulated
    VERSION = 1 << 24 | 17 << 16
    RATES: ClassVar[dict[int, float]] = {
        m.MAVLINK_MSG_ID_HEARTBEAT: 1.0,
        m.MAVLINK_MSG_ID_TIMESYNC: 10.0,
        m.MAVLINK_MSG_ID_ATTITUDE: 50.0,
        m.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: 50.0,
        m.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 30.0,
        m.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 50.0,
        m.MAVLINK_MSG_ID_HIGHRES_IMU: 50.0,
        m.MAVLINK_MSG_ID_VFR_HUD: 10.0,
        m.MAVLINK_MSG_ID_ALTITUDE: 10.0,
        m.MAVLINK_MSG_ID_SYS_STATUS: 5.0,
        m.MAVLINK_MSG_ID_GPS_RAW_INT: 5.0,
        m.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: 5.0,
        m.MAVLINK_MSG_ID_ESTIMATOR_STATUS: 1.0,
        m.MAVLINK_MSG_ID_SYSTEM_TIME: 1.0,
        m.MAVLINK_MSG_ID_BATTERY_STATUS: 0.5,
        m.MAVLINK_MSG_ID_HOME_POSITION: 0.5,
        m.MAVLINK_MSG_ID_CURRENT_MODE: 0.5,
    }
    FRAMES = frozenset({WORLD, BODY})
    ABOVE_SEA = frozenset({5})
    ABOVE_HOME = frozenset({6})
    LONG_FRAMES: ClassVar[dict[int, int]] = {m.MAV_CMD_DO_REPOSITION: 5, m.MAV_CMD_DO_SET_HOME: 5}
    NOT_PROVIDED = MavResult.DENIED
    BYTEWISE = True
    DISARM_S = 11.1
    REPORTS_PREARM = False
    WORDS: ClassVar[dict[str, str]] = {
        "armed": "Armed by external command",
        "disarmed": "Disarmed by external command",
        "auto_disarm": "Disarmed by auto preflight disarming",
        "landed": "Disarmed by landing",
    }

    def __init__(self, vehicle: Vehicle, system: int, boot_s: float, gps: bool) -> None:
        super().__init__(vehicle, system, boot_s, gps)
        self.parameters = ParameterTable(services.PX4, bytewise=True)
        self.mode = "AUTO.LOITER"
        self._intended = self.mode  # the mode that the user chose, which failsafes don't change
        self._before = self.mode  # the mode in use before a manoeuvre
        self._waiting_at: Target | None = None  # position at which HOLD is to wait
        self._speeds = USUAL
        self._target: Target | AttitudeTarget | None = None
        self._target_s = -math.inf
        self._lost_gcs = False
        self._stick = (0.0, 0.0, 0.0, 0.0)  # stick positions forward, left, up and left turn, each 1 at full stick
        self._stick_moves = (0.0, 0.0, 0.0, 0.0)  # filtered speed of each stick [1/s]
        self._stick_s = -math.inf
        self._lost_stick_s: float | None = None  # when the remote control in use was lost

    @property
    def custom_mode(self) -> int:
        return px4_custom(self.mode)

    @property
    def mode_allows_arming(self) -> bool:
        """Whether the autopilot can be armed in its present mode."""
        return self.mode != "OFFBOARD" or self._fresh

    def _counts(self, heartbeat: Message) -> bool:  # noqa: ARG002  every ground station counts
        return True

    @property
    def _fresh(self) -> bool:
        """Return whether set-points are arriving."""
        return self.time_s - self._target_s <= self.parameters["COM_OF_LOSS_T"]

    # Modes -----------------------------------------------------------------------------------------------------

    @property
    def remote(self) -> bool:
        """Whether the autopilot receives a remote control, which may be a ground station's joystick."""
        return self.time_s - self._stick_s <= self.parameters["COM_RC_LOSS_T"]

    def _fly(self) -> None:
        self._check_sticks()
        self._check_set_points()
        if self.mode == "OFFBOARD":
            self._fly_offboard()
        elif self.mode == "AUTO.TAKEOFF":
            if self._manoeuvres.rise():
                self._set_mode("AUTO.LOITER")
        elif self.mode == "AUTO.LAND":
            self.flight.land()
        elif self.mode == "AUTO.RTL":
            self._manoeuvres.return_home(self._speeds)
        elif self.mode in _STICKS and self.remote:
            self._fly_by_sticks()
        elif self.mode in _STICKS:
            self.flight.move_body(0.0, 0.0, SINK_IN_POSCTL_M_S, 0.0)
            if self.flight.place[2] < 0.1:
                self.flight.land()
        elif self.flight.airborne:
            self._manoeuvres.follow(self._waiting_at, self._lean, self._speeds)

    def _check_set_points(self) -> None:
        if self.mode == "OFFBOARD" and not self._fresh:
            self.failsafe = True
            self.send_text("Failsafe activated", CRITICAL)
            self._enter("AUTO.LOITER" if round(self.parameters["COM_OBL_RC_ACT"]) == 5 else "POSCTL")
        elif self.failsafe and self._intended == "OFFBOARD" and self._fresh and not self._lost:
            self.failsafe = False  # recovered: return to the mode that the user had chosen
            self._enter("OFFBOARD")

    @property
    def _lost(self) -> bool:
        """Return whether a ground station or remote control has gone silent, which prevents a return to OFFBOARD."""
        return self._lost_gcs or self._lost_stick_s is not None

    def _fly_offboard(self) -> None:
        target = self._target
        if not self.flight.airborne:
            climbs = isinstance(target, Target) and target.velocity is not None and target.velocity[2] > 0
            rises = isinstance(target, Target) and target.place is not None and target.place[2] > 0.3
            if climbs or rises:
                self.flight.lift_off()
            return
        self._manoeuvres.follow(target, self._lean)

    def _lean(self, target: AttitudeTarget) -> None:
        roll, pitch = target.tilt
        thrust = (target.thrust or 0.0) / self.parameters["MPC_THR_HOVER"]
        self.flight.lean_by_thrust(roll, pitch, thrust, target.turn(self.flight))

    def _enter(self, mode: str) -> None:
        """Change the mode. The next heartbeat reports the change."""
        if mode != self.mode:
            self._before, self.mode = self.mode, mode
            self._waiting_at, self._speeds = None, USUAL
            if mode == "AUTO.RTL":
                self._begin_return()

    def _begin_return(self) -> None:
        """Start to return at RTL_RETURN_ALT, or lower within a cone above home, but never below the present height."""
        east, north, up = self.flight.place
        above, distance = up - self.home[2], math.hypot(east - self.home[0], north - self.home[1])
        highest, near = self.parameters["RTL_RETURN_ALT"], self.parameters["NAV_ACC_RAD"]
        height, half_cone = highest, self.parameters["RTL_CONE_ANG"]
        if half_cone > 0:
            if distance <= near:
                height = 2.0 * distance
            elif distance <= self.parameters["RTL_MIN_DIST"]:
                cone = distance / math.tan(math.radians(max(1.0, min(89.0, half_cone))))
                height = max(2.0 * near, min(cone, highest))
            height = min(height, highest)
        self._manoeuvres.begin_return(
            self.home, self.home[2] + max(above, height), wait_s=max(0.0, self.parameters["RTL_LAND_DELAY"])
        )

    def _set_mode(self, mode: str) -> None:
        self._intended, self.failsafe, self._lost_stick_s = mode, False, None
        self._enter(mode)

    def _split(self, custom_mode: int) -> Arguments:
        return float(custom_mode >> 16 & 0xFF), float(custom_mode >> 24 & 0xFF)

    def _change_mode(self, arguments: Arguments) -> int:
        """Change the mode. The command is accepted even if it has no effect."""
        main, sub = whole(arguments[1]), whole(arguments[2]) if len(arguments) > 2 else 0
        mode = PX4_MODES.get((main, sub if main == 4 else 0))
        if mode is None or mode == "AUTO.READY":
            return MavResult.ACCEPTED
        if mode == "OFFBOARD" and not self._fresh:
            self.send_text("Switching to Offboard is currently not available", CRITICAL)
        elif mode in _STICKS and self.armed and not self.remote:
            self.send_text("Switching to Position is currently not available", CRITICAL)
        elif mode == "AUTO.MISSION":
            self.send_text("Switching to Mission is currently not available: no valid mission", CRITICAL)
        else:
            if mode == "AUTO.TAKEOFF":
                self._manoeuvres.begin_rise(self.home[2] + self.parameters["MIS_TAKEOFF_ALT"])
            self._set_mode(mode)
        return MavResult.ACCEPTED

    def _go_by(self, manoeuvre: str) -> int:
        self._set_mode({"land": "AUTO.LAND", "return": "AUTO.RTL"}[manoeuvre])
        return MavResult.ACCEPTED

    def _disarmed(self) -> None:
        if self.mode in ("AUTO.LAND", "AUTO.RTL", "AUTO.TAKEOFF"):
            self._set_mode(self._before)

    # Arming and taking off -------------------------------------------------------------------------------------

    def _refuse_arming(self) -> int | None:
        if self.ready:
            return None
        self.send_text("Arming denied: Resolve system health failures first\t", CRITICAL)
        return MavResult.TEMPORARILY_REJECTED

    def _refuse_disarming(self) -> int:
        self.send_text("Disarming denied: not landed\t", CRITICAL)
        return MavResult.TEMPORARILY_REJECTED

    def _take_off(self, arguments: Arguments) -> int:
        """Take off from the ground or in the air, whether or not the vehicle is armed."""
        amsl = arguments[6]
        above = self.home[2] + self.parameters["MIS_TAKEOFF_ALT"]
        height = amsl - ORIGIN.altitude_m if math.isfinite(amsl) else above
        self._manoeuvres.begin_rise(max(0.5, height))
        self._set_mode("AUTO.TAKEOFF")
        return MavResult.ACCEPTED

    # Set-points ------------------------------------------------------------------------------------------------

    def _set_point(self, message: Message) -> None:
        made: Target | AttitudeTarget
        if message.get_type() == "SET_ATTITUDE_TARGET":
            made = attitude_target_of(message)
            if not isinstance(self._target, AttitudeTarget):
                self.flight.level_thrust()
        elif message.get_type() == "SET_POSITION_TARGET_GLOBAL_INT":
            found = global_target_of(message, self._datum(message.coordinate_frame))
            if found is None:
                self.send_text(
                    f"SET_POSITION_TARGET_GLOBAL_INT invalid coordinate frame {message.coordinate_frame}\t", CRITICAL
                )
                return
            if found.place is None and found.velocity is None:
                return
            made = found
        elif message.coordinate_frame in self.FRAMES:
            made = target_of(message)
        else:
            self.send_text(f"SET_POSITION_TARGET_LOCAL_NED coordinate frame {message.coordinate_frame} unsupported\t")
            return
        self.set_points += 1
        self._target, self._target_s = made, self.time_s

    # Position and speed commands -------------------------------------------------------------------------------

    def _reposition(self, arguments: Arguments, frame: int) -> int:  # noqa: ARG002  always above sea level
        """Enter HOLD at another position. While disarmed, this changes only the mode."""
        if whole(arguments[1]) != 1:
            return MavResult.UNSUPPORTED
        fresh = self.mode != "AUTO.LOITER"
        self._set_mode("AUTO.LOITER")
        if not self.armed:
            return MavResult.ACCEPTED
        speed = arguments[0]
        if speed > 0:
            self._speeds = Speeds(across=speed)
        elif fresh:
            self._speeds = USUAL
        (latitude, longitude, altitude), here = arguments[4:7], self.flight.place
        elsewhere, higher = math.isfinite(latitude) and math.isfinite(longitude), math.isfinite(altitude)
        east, north, up = here
        if elsewhere:
            east, north, _ = place_of(latitude, longitude, up)
        elif self._waiting_at is not None and (higher or math.isfinite(arguments[3])):
            east, north, _ = self._waiting_at.place or here
        if higher:
            up = altitude - ORIGIN.altitude_m
        yaw = yaw_between(arguments[3]) if math.isfinite(arguments[3]) else None
        self._waiting_at = Target((east, north, up), yaw=yaw)
        return MavResult.ACCEPTED

    def _set_home(self, arguments: Arguments, frame: int) -> int:  # noqa: ARG002  always above sea level
        if arguments[0] > 0.5:
            place = self.flight.place
        elif not all(map(math.isfinite, arguments[4:7])):
            return MavResult.DENIED
        else:
            place = place_of(arguments[4], arguments[5], arguments[6] - ORIGIN.altitude_m)
        if not self.has_origin:
            return MavResult.TEMPORARILY_REJECTED
        self._home_at(place)
        return MavResult.ACCEPTED

    def _change_speed(self, arguments: Arguments) -> int:
        """Change the speed. The command is accepted even if it has no effect."""
        self._speeds = Speeds(across=arguments[1]) if 0 < arguments[1] < math.inf else USUAL
        return MavResult.ACCEPTED

    def _own(self, port: Port, message: Message) -> bool:
        if message.get_type() != "PING" or message.target_system or message.target_component:
            return False
        sender = message.get_srcSystem(), message.get_srcComponent()
        port.send(m.MAVLink_ping_message(message.time_usec, message.seq, *sender))
        return True

    # A remote control over MAVLink --------------------------------------------------------------------------------

    def _sticks(self, message: Message) -> None:
        """Read a ground station's joystick. Channel overrides have no effect because no channels are mapped."""
        if message.get_type() != "MANUAL_CONTROL" or message.target not in (0, self.system):
            return
        throttle = 2 * message.z - 1000
        ways = (message.x, -message.y, throttle, -message.r)
        forward, left, up, turn = (each / 1000 if abs(each) <= 1000 else 0.0 for each in ways)  # larger: not sent
        stick = (forward, left, up, turn)
        since_s = self.time_s - self._stick_s
        if not self.remote:
            self._stick_moves = (0.0, 0.0, 0.0, 0.0)
        elif since_s == 0.0:  # two messages in one step: wait for the next one to see how far the stick moved
            return
        else:
            share = since_s / (since_s + STICK_FILTER_S)
            axes = zip(self._stick_moves, self._stick, stick, strict=True)
            a, b, c, d = (was + share * ((now - then) / since_s - was) for was, then, now in axes)
            self._stick_moves = (a, b, c, d)
        self._stick, self._stick_s = stick, self.time_s
        if self.armed and max(map(abs, self._stick_moves)) > self.parameters["COM_RC_STICK_OV"] / 100.0:
            self._take_over()

    def _take_over(self) -> None:
        """Give the pilot control in position mode, unless the present mode ignores the sticks."""
        mode_bit = 2 if self.mode == "OFFBOARD" else 1
        if self.mode not in _STICKS and round(self.parameters["COM_RC_OVERRIDE"]) & mode_bit:
            self._set_mode("POSCTL")
            self.send_text("Pilot took over using sticks\t", INFO)

    def _fly_by_sticks(self) -> None:
        forward, left, up, turn = ((1 - STICK_EXPO) * each + STICK_EXPO * each**3 for each in self._stick)
        if not self.flight.airborne:
            if self._stick[2] > LIFTS_OFF_AT:
                self.flight.lift_off()
            return
        fastest = self.parameters["MPC_Z_VEL_MAX_UP" if up > 0 else "MPC_Z_VEL_MAX_DN"]
        yaw_rate = turn * math.radians(self.parameters["MPC_MAN_Y_MAX"])
        self.flight.move_body(forward * STICK_SPEED_M_S, left * STICK_SPEED_M_S, up * fastest, yaw_rate)

    def _check_sticks(self) -> None:
        """Once a remote control in use is lost, in any mode, hold position, then do what NAV_RCL_ACT says."""
        if self.remote:
            if self._lost_stick_s is not None:  # the remote control came back before the return began
                self.failsafe, self._lost_stick_s = False, None
                self._enter(self._intended)
            return
        if self._stick_s != -math.inf and self.mode not in ("AUTO.LAND", "AUTO.RTL") and not self.flight.standing:
            self.send_text("Failsafe activated", CRITICAL)
            self.failsafe, self._lost_stick_s = True, self.time_s
            self._enter("AUTO.LOITER")
        self._stick_s = -math.inf
        if self._lost_stick_s is not None and self.time_s - self._lost_stick_s > self.parameters["COM_FAIL_ACT_T"]:
            actions = {1: "AUTO.LOITER", 3: "AUTO.LAND"}
            self._intended, self._lost_stick_s = actions.get(round(self.parameters["NAV_RCL_ACT"]), "AUTO.RTL"), None
            self._enter(self._intended)

    # Losing the ground station ---------------------------------------------------------------------------------

    @property
    def _gcs_patience_s(self) -> float:
        return self.parameters["COM_DL_LOSS_T"]

    def _ground_station(self, lost: bool) -> None:
        if lost is self._lost_gcs:
            return
        self._lost_gcs = lost
        if not lost:
            self.send_text("GCS connection regained")
            return
        self.send_text("Preflight Fail: No connection to the GCS\t")
        action = round(self.parameters["NAV_DLL_ACT"])
        if action and self.armed and not self.flight.standing:
            self.send_text("Failsafe activated", CRITICAL)
            self.failsafe = True
            self._intended = {1: "AUTO.LOITER", 2: "AUTO.RTL", 3: "AUTO.LAND"}.get(action, "AUTO.LOITER")
            self._enter(self._intended)

    def _set_interval(self, port: Port, number: int, interval_us: float) -> int:
        if number == m.MAVLINK_MSG_ID_HEARTBEAT:
            return MavResult.FAILED
        return super()._set_interval(port, number, interval_us)
