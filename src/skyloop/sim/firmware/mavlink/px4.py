"""PX4's behaviour, as observed on 1.17-alpha. ``docs/mavlink.md`` has it as a table."""

from __future__ import annotations

import math
from typing import ClassVar, Final

from skyloop.sim.firmware.mavlink import parameters
from skyloop.sim.firmware.mavlink.autopilot import (
    ACCEPTED,
    CRITICAL,
    FAILED,
    TEMPORARILY_REJECTED,
    Arguments,
    Autopilot,
    Manoeuvres,
    above_home,
    whole,
)
from skyloop.sim.firmware.mavlink.links import Port
from skyloop.sim.firmware.mavlink.parameters import ParameterTable
from skyloop.sim.firmware.mavlink.targets import (
    BODY,
    WORLD,
    AttitudeTarget,
    Target,
    attitude_target_of,
    target_of,
)
from skyloop.sim.firmware.vehicle import Vehicle
from skyloop.wire.mavlink.codec import Message
from skyloop.wire.mavlink.codec import dialect as m
from skyloop.wire.mavlink.modes import PX4_MODES, px4_custom
from skyloop.wire.mavlink.modes import Autopilot as Number

SINK_IN_POSCTL_M_S: Final = -0.7  #: without a remote control
_STICKS: Final = ("POSCTL", "ALTCTL", "MANUAL", "STABILIZED", "ACRO")
_WORDS: Final = {
    "armed": "Armed by external command",
    "disarmed": "Disarmed by external command",
    "auto_disarm": "Disarmed by auto preflight disarming",
    "landed": "Disarmed by landing",
    "forced": "Disarmed by external command",
}


class Px4(Autopilot):
    """One PX4."""

    AUTOPILOT = Number.PX4
    CAPABILITIES = 0xE8FF & ~0x20  # files over MAVLink are not emulated
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
    BYTEWISE = True
    DISARM_S = 11.1

    def __init__(self, vehicle: Vehicle, system: int, boot_s: float, gps: bool) -> None:
        super().__init__(vehicle, system, boot_s, gps)
        self.parameters = ParameterTable(parameters.PX4, bytewise=True)
        self.mode = "AUTO.LOITER"
        self._intended = self.mode  # what the user asked for; kept under failsafes
        self._before = self.mode  # the mode before a manoeuvre
        self._manoeuvres = Manoeuvres(self.flyer)
        self._target: Target | AttitudeTarget | None = None
        self._target_s = -math.inf
        self._lost_gcs = False

    @property
    def custom_mode(self) -> int:
        return px4_custom(self.mode)

    @property
    def mode_allows_arming(self) -> bool:
        return self.mode != "OFFBOARD" or self._fresh

    def _counts(self, heartbeat: Message) -> bool:  # noqa: ARG002  of any ground station
        return True

    def _words(self, occasion: str) -> str:
        return _WORDS[occasion]

    @property
    def _fresh(self) -> bool:
        """Whether set-points come."""
        return self.time_s - self._target_s <= self.parameters["COM_OF_LOSS_T"]

    # Modes -----------------------------------------------------------------------------------------------------

    def _fly(self) -> None:
        self._look_at_set_points()
        if self.mode == "OFFBOARD":
            self._fly_offboard()
        elif self.mode == "AUTO.TAKEOFF":
            if self._manoeuvres.rise():
                self._set_mode("AUTO.LOITER")
        elif self.mode == "AUTO.LAND":
            self.flyer.land()
        elif self.mode == "AUTO.RTL":
            self._manoeuvres.return_home()
        elif self.mode in _STICKS:
            self.flyer.move_body(0.0, 0.0, SINK_IN_POSCTL_M_S, 0.0)
            if self.flyer.place[2] < 0.1:
                self.flyer.land()
        elif self.flyer.airborne:
            self.flyer.hold()

    def _look_at_set_points(self) -> None:
        if self.mode == "OFFBOARD" and not self._fresh:
            self.failsafe = True
            self.say("Failsafe activated", CRITICAL)
            self._enter("AUTO.LOITER" if round(self.parameters["COM_OBL_RC_ACT"]) == 5 else "POSCTL")
        elif self.failsafe and self._intended == "OFFBOARD" and self._fresh and not self._lost_gcs:
            self.failsafe = False  # back by itself: the user wanted it
            self._enter("OFFBOARD")

    def _fly_offboard(self) -> None:
        target = self._target
        if not self.flyer.airborne:
            climbs = isinstance(target, Target) and target.velocity is not None and target.velocity[2] > 0
            rises = isinstance(target, Target) and target.place is not None and target.place[2] > 0.3
            if climbs or rises:
                self.flyer.lift_off()
            return
        self._manoeuvres.follow(target, self._lean)

    def _lean(self, target: AttitudeTarget) -> None:
        roll, pitch = target.tilt
        thrust = (target.thrust or 0.0) / self.parameters["MPC_THR_HOVER"]
        self.flyer.lean_by_thrust(roll, pitch, thrust, target.turn(self.flyer))

    def _enter(self, mode: str) -> None:
        """The next heartbeat tells it, and not before."""
        if mode != self.mode:
            self._before, self.mode = self.mode, mode

    def _set_mode(self, mode: str) -> None:
        self._intended, self.failsafe = mode, False
        self._enter(mode)

    def _split(self, custom_mode: int) -> Arguments:
        return float(custom_mode >> 16 & 0xFF), float(custom_mode >> 24 & 0xFF)

    def _change_mode(self, arguments: Arguments) -> int:
        """Accepted, whatever becomes of it."""
        main, sub = whole(arguments[1]), whole(arguments[2]) if len(arguments) > 2 else 0
        mode = PX4_MODES.get((main, sub if main == 4 else 0))
        if mode is None or mode == "AUTO.READY":
            return ACCEPTED
        if mode == "OFFBOARD" and not self._fresh:
            self.say("Switching to Offboard is currently not available", CRITICAL)
        elif mode in _STICKS and self.armed:
            self.say("Switching to Position is currently not available", CRITICAL)
        elif mode == "AUTO.MISSION":
            self.say("Switching to Mission is currently not available: no valid mission", CRITICAL)
        else:
            if mode == "AUTO.TAKEOFF":
                self._manoeuvres.begin_rise(self.parameters["MIS_TAKEOFF_ALT"])
            self._set_mode(mode)
        return ACCEPTED

    def _go_by(self, manoeuvre: str) -> int:
        self._set_mode({"land": "AUTO.LAND", "return": "AUTO.RTL"}[manoeuvre])
        return ACCEPTED

    def _disarmed(self) -> None:
        if self.mode in ("AUTO.LAND", "AUTO.RTL", "AUTO.TAKEOFF"):
            self._set_mode(self._before)

    # Arming and taking off -------------------------------------------------------------------------------------

    def _refuse_arming(self) -> int | None:
        if self.ready:
            return None
        self.say("Arming denied: Resolve system health failures first\t", CRITICAL)
        return TEMPORARILY_REJECTED

    def _refuse_disarming(self) -> int:
        self.say("Disarming denied: not landed\t", CRITICAL)
        return TEMPORARILY_REJECTED

    def _take_off(self, arguments: Arguments) -> int:
        """Armed or not, standing or flying."""
        amsl = arguments[6]
        height = above_home(amsl) if math.isfinite(amsl) else self.parameters["MIS_TAKEOFF_ALT"]
        self._manoeuvres.begin_rise(max(0.5, height))
        self._set_mode("AUTO.TAKEOFF")
        return ACCEPTED

    # Set-points ------------------------------------------------------------------------------------------------

    def _set_point(self, message: Message) -> None:
        made: Target | AttitudeTarget
        if message.get_type() == "SET_ATTITUDE_TARGET":
            made = attitude_target_of(message)
            if not isinstance(self._target, AttitudeTarget):
                self.flyer.level_thrust()
        elif message.coordinate_frame in self.FRAMES:
            made = target_of(message)
        else:
            self.say(f"SET_POSITION_TARGET_LOCAL_NED coordinate frame {message.coordinate_frame} unsupported\t")
            return
        self.set_points += 1
        self._target, self._target_s = made, self.time_s

    def _sticks(self, message: Message) -> None:
        """Not obeyed."""

    # Losing the ground station ---------------------------------------------------------------------------------

    @property
    def _gcs_patience_s(self) -> float:
        return self.parameters["COM_DL_LOSS_T"]

    def _ground_station(self, lost: bool) -> None:
        if lost is self._lost_gcs:
            return
        self._lost_gcs = lost
        if not lost:
            self.say("GCS connection regained")
            return
        self.say("Preflight Fail: No connection to the GCS\t")
        action = round(self.parameters["NAV_DLL_ACT"])
        if action and self.armed and not self.flyer.standing:
            self.say("Failsafe activated", CRITICAL)
            self.failsafe = True
            self._intended = {1: "AUTO.LOITER", 2: "AUTO.RTL", 3: "AUTO.LAND"}.get(action, "AUTO.LOITER")
            self._enter(self._intended)

    def _set_interval(self, port: Port, number: int, interval_us: float) -> int:
        if number == m.MAVLINK_MSG_ID_HEARTBEAT:
            return FAILED
        return super()._set_interval(port, number, interval_us)
