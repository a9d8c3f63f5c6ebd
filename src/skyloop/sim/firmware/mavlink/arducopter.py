"""ArduCopter's behaviour, as observed on 4.7.0-dev. ``docs/mavlink.md`` has it as a table."""

from __future__ import annotations

import math
from typing import ClassVar, Final

from skyloop.sim.firmware.mavlink import parameters
from skyloop.sim.firmware.mavlink.autopilot import (
    ACCEPTED,
    CRITICAL,
    FAILED,
    Arguments,
    Autopilot,
    Manoeuvres,
    whole,
)
from skyloop.sim.firmware.mavlink.parameters import ParameterTable
from skyloop.sim.firmware.mavlink.targets import (
    BODY,
    BODY_OFFSET,
    WORLD,
    WORLD_OFFSET,
    AttitudeTarget,
    Target,
    attitude_target_of,
    target_of,
)
from skyloop.sim.firmware.vehicle import Vehicle
from skyloop.wire.mavlink.codec import Message
from skyloop.wire.mavlink.codec import dialect as m
from skyloop.wire.mavlink.modes import COPTER_MODES, COPTER_NUMBERS
from skyloop.wire.mavlink.modes import Autopilot as Number

SINK_WITHOUT_STICKS_M_S: Final = -2.5
STICK_TIMEOUT_S: Final = 3.0
STICK_SPEED_M_S: Final = 6.0  #: of a stick at its end
_NOT_ARMABLE: Final = ("LAND", "BRAKE", "AUTO", "RTL")
_PILOT: Final = ("LOITER", "ALT_HOLD", "STABILIZE", "POSHOLD")
_WORDS: Final = {
    "armed": "Arming motors",
    "disarmed": "Disarming motors",
    "auto_disarm": "Disarming motors",
    "landed": "Disarming motors",
    "forced": "Disarming motors",
}


class ArduCopter(Autopilot):
    """One ArduCopter."""

    AUTOPILOT = Number.ARDUPILOT
    CAPABILITIES = 0xFBEF & ~0x20  # files over MAVLink are not emulated
    VERSION = 4 << 24 | 7 << 16
    RATES: ClassVar[dict[int, float]] = {m.MAVLINK_MSG_ID_HEARTBEAT: 1.0, m.MAVLINK_MSG_ID_TIMESYNC: 0.2}
    FRAMES = frozenset({WORLD, WORLD_OFFSET, BODY, BODY_OFFSET})
    BYTEWISE = False
    DISARM_S = 10.2

    def __init__(self, vehicle: Vehicle, system: int, boot_s: float, gps: bool) -> None:
        super().__init__(vehicle, system, boot_s, gps)
        self.parameters = ParameterTable(parameters.ARDUCOPTER, bytewise=False)
        self.mode = "STABILIZE"
        self._manoeuvres = Manoeuvres(self.flyer)
        self._rising = False
        self._target: Target | AttitudeTarget | None = None
        self._target_s = 0.0
        self._stick: tuple[float, float, float, float] | None = None  # forward, left, up, yaw
        self._stick_s = 0.0

    @property
    def custom_mode(self) -> int:
        return COPTER_NUMBERS[self.mode]

    def _counts(self, heartbeat: Message) -> bool:
        return bool(heartbeat.get_srcSystem() == round(self.parameters["MAV_GCS_SYSID"]))

    def _words(self, occasion: str) -> str:
        return _WORDS[occasion]

    # Modes -----------------------------------------------------------------------------------------------------

    def _fly(self) -> None:
        if self.mode == "GUIDED":
            self._fly_guided()
        elif self.mode == "BRAKE":
            self.flyer.hold()
        elif self.mode == "LAND":
            self.flyer.land()
        elif self.mode == "RTL":
            self._manoeuvres.return_home()
        elif self.mode in _PILOT:
            self._fly_by_sticks()

    def _fly_guided(self) -> None:
        if self._rising:
            self._rising = not self._manoeuvres.rise()
            return
        if not self.flyer.airborne:
            return  # only the command takes off
        if self._target is not None and self.time_s - self._target_s > self.parameters["GUID_TIMEOUT"]:
            if isinstance(self._target, AttitudeTarget):
                self.flyer.lean(0.0, 0.0, 0.0, 0.0)  # level, and on it drifts
                return
            if self._target.place is None:
                self._target = None
        self._manoeuvres.follow(self._target, self._lean)

    def _lean(self, target: AttitudeTarget) -> None:
        assert target.thrust is not None
        roll, pitch = target.tilt
        share = (target.thrust - 0.5) * 2.0
        fastest = self.parameters["WPNAV_SPEED_UP" if share > 0 else "WPNAV_SPEED_DN"] / 100.0
        self.flyer.lean(roll, pitch, share * fastest, target.turn(self.flyer))

    def _fly_by_sticks(self) -> None:
        """Without a remote control the simulated one's throttle stick is low."""
        if self._stick is not None and self.time_s - self._stick_s < STICK_TIMEOUT_S:
            self.flyer.move_body(*self._stick)
        elif self.flyer.place[2] > 0.3:
            self.flyer.move_body(0.0, 0.0, SINK_WITHOUT_STICKS_M_S, 0.0)
        else:
            self.flyer.land()

    def _sticks(self, message: Message) -> None:
        if message.get_srcSystem() != round(self.parameters["MAV_GCS_SYSID"]):
            return
        if message.get_type() == "MANUAL_CONTROL":
            shares = (message.x / 1000, -message.y / 1000, (message.z - 500) / 500, -message.r / 1000)
        else:
            raw = (message.chan2_raw, message.chan1_raw, message.chan3_raw, message.chan4_raw)
            forward, right, throttle, turn = ((each - 1500) / 500 if 900 < each < 2200 else 0.0 for each in raw)
            shares = (-forward, -right, throttle, -turn)
        self._stick_s = self.time_s
        self._stick = (shares[0] * STICK_SPEED_M_S, shares[1] * STICK_SPEED_M_S, shares[2] * 2.5, shares[3])

    def _set_mode(self, mode: str) -> None:
        if mode != self.mode:
            self.mode, self._target, self._rising = mode, None, False
            self.tell_heartbeat()

    def _split(self, custom_mode: int) -> Arguments:
        return (float(custom_mode),)

    def _change_mode(self, arguments: Arguments) -> int:
        number = whole(arguments[1])
        mode = COPTER_MODES.get(number)
        if mode is None:
            self.say(f"No such mode {number}")
            return FAILED
        needs_place = mode in ("GUIDED", "LOITER", "RTL", "BRAKE", "POSHOLD")
        if mode == "AUTO" or (needs_place and not self.has_origin):
            why = "init failed" if mode == "AUTO" else "requires position"
            self.say(f"Mode change to {mode} failed: {why}")
            return FAILED
        self._set_mode(mode)
        return ACCEPTED

    def _go_by(self, manoeuvre: str) -> int:
        self._set_mode({"land": "LAND", "return": "RTL"}[manoeuvre])
        return ACCEPTED

    def _disarmed(self) -> None:
        """The mode stays: after a landing LAND, which can't be armed in."""

    # Arming and taking off -------------------------------------------------------------------------------------

    def _refuse_arming(self) -> int | None:
        if self.time_s < self._boot_s:
            self.say("Arm: Gyros inconsistent", CRITICAL)
            self.say("Arm: Need Position Estimate", CRITICAL)
            return FAILED
        if self.mode in _NOT_ARMABLE:
            self.say(f"Arm: {self.mode} mode not armable", CRITICAL)
            return FAILED
        if self.mode == "GUIDED" and not self.has_origin:
            self.say("Arm: Need Position Estimate", CRITICAL)
            return FAILED
        return None

    def _refuse_disarming(self) -> int:
        return FAILED

    def _take_off(self, arguments: Arguments) -> int:
        height = arguments[6]
        if self.mode != "GUIDED" or not self.armed or not self.flyer.standing or not height > 0:
            return FAILED
        self._manoeuvres.begin_rise(height)
        self._rising, self._target = True, None
        return ACCEPTED

    # Set-points ------------------------------------------------------------------------------------------------

    def _set_point(self, message: Message) -> None:
        if self.mode != "GUIDED" or not self.armed:
            return  # dropped without a word
        self.set_points += 1
        made: Target | AttitudeTarget | None
        if message.get_type() == "SET_ATTITUDE_TARGET":
            lean = attitude_target_of(message)
            made = lean if lean.thrust is not None and (lean.unit or lean.attitude is None) else None
        else:
            target = target_of(message)
            numbers = (*(target.velocity or ()), *(target.place or ()))
            good = message.coordinate_frame in self.FRAMES and all(map(math.isfinite, numbers))
            made = target if good else None  # anything else is a silent stop
        self._target, self._target_s = made, self.time_s
        if not (isinstance(made, Target) and made.place is None and made.velocity is None):
            self._rising = False  # even while it takes off

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
            self.say("GCS Failsafe Cleared")
            return
        self.say("GCS Failsafe")
        if self.armed and self.flyer.standing:
            self._disarm("")
        elif self.armed:
            self._set_mode({5: "LAND", 7: "BRAKE"}.get(enabled, "RTL"))
