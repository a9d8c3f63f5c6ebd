"""What ArduCopter and PX4 do differently, each in one class. Pure. ``docs/mavlink.md`` says where each was observed."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import ClassVar, Final

from skyloop.drivers.mavlink.commander import Order
from skyloop.drivers.mavlink.lift import ClimbByShare, ClimbByThrust, Lift
from skyloop.drivers.mavlink.telemetry import SLOW_S, Telemetry, View
from skyloop.wire.mavlink.codec import dialect as m
from skyloop.wire.mavlink.modes import (
    COPTER_NUMBERS,
    PX4_NUMBERS,
    Autopilot,
    Landed,
    copter_mode,
    px4_mode,
)

CUSTOM: Final = 1.0  #: MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
REACHED_M: Final = 0.2  #: a take-off ends so far below its altitude
EKF_PLACE: Final = 0x10  #: absolute horizontal position, of EKF_STATUS_REPORT and ESTIMATOR_STATUS
EKF_RELATIVE_PLACE: Final = 0x08
EKF_CONSTANT: Final = 0x80  #: it does not know where it is
EKF_UNINITIALISED: Final = 0x400
THRUST_AS_THRUST: Final = 8  #: of ArduCopter's GUID_OPTIONS

Values = Mapping[str, float]  #: the autopilot's parameters by its own names


class Dialect(ABC):
    """One autopilot's ways. No state but what belongs to a flight's :class:`Lift`."""

    NAME: ClassVar[str]
    GUIDED: ClassVar[str]  #: the mode that follows set-points
    HOLD: ClassVar[str]  #: the mode that holds the place by itself
    LAND: ClassVar[str]
    ARMING: ClassVar[str]  #: the mode to be in before arming
    HOLDING: ClassVar[frozenset[str]]  #: modes in which it stays where it is by itself
    LANDING: ClassVar[frozenset[str]]
    TAKING_OFF: ClassVar[frozenset[str]]
    STICKS: ClassVar[frozenset[str]]  #: modes that need somebody at a remote control
    LEAD_S: ClassVar[float]  #: set-points must flow for so long before GUIDED is entered
    BYTEWISE: ClassVar[bool]  #: how parameters are written, unless its capabilities say otherwise

    @abstractmethod
    def mode_of(self, custom_mode: int) -> str: ...

    @abstractmethod
    def mode_order(self, mode: str) -> Order: ...

    @abstractmethod
    def takeoff_order(self, height_m: float, view: View) -> Order | None:
        """None while it can't be said yet."""

    @abstractmethod
    def has_taken_off(self, view: View, height_m: float, rose: bool) -> bool:
        """``rose``: it was seen in the air since the take-off was accepted."""

    @abstractmethod
    def ready(self, telemetry: Telemetry, now_ns: int) -> bool | None:
        """Whether it may be armed, None if it does not tell."""

    @abstractmethod
    def rates(self, rate_hz: float) -> dict[str, float]:
        """The messages that are needed, by their names, and how often."""

    @abstractmethod
    def lift(self, values: Values) -> Lift:
        """How a climb rate is asked for beside an attitude."""


class CopterDialect(Dialect):
    """ArduCopter."""

    NAME = "ArduCopter"
    GUIDED = "GUIDED"
    HOLD = "BRAKE"
    LAND = "LAND"
    ARMING = "GUIDED"
    HOLDING = frozenset({"BRAKE"})
    LANDING = frozenset({"LAND"})
    TAKING_OFF: ClassVar[frozenset[str]] = frozenset()
    STICKS = frozenset({"STABILIZE", "ACRO", "ALT_HOLD", "LOITER", "DRIFT", "SPORT", "POSHOLD", "FLOWHOLD"})
    LEAD_S = 0.0
    BYTEWISE = False

    def mode_of(self, custom_mode: int) -> str:
        return copter_mode(custom_mode)

    def mode_order(self, mode: str) -> Order:
        return Order(m.MAV_CMD_DO_SET_MODE, (CUSTOM, float(COPTER_NUMBERS[mode])))

    def takeoff_order(self, height_m: float, view: View) -> Order | None:  # noqa: ARG002
        """The altitude is relative."""
        return Order(m.MAV_CMD_NAV_TAKEOFF, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, height_m))

    def has_taken_off(self, view: View, height_m: float, rose: bool) -> bool:
        """Nothing says so but the altitude."""
        return rose and view.altitude_m is not None and view.altitude_m >= height_m - REACHED_M

    def ready(self, telemetry: Telemetry, now_ns: int) -> bool | None:
        good = telemetry.prearm_good(now_ns)
        ekf = telemetry.newest("EKF_STATUS_REPORT", now_ns, SLOW_S)
        if not good or ekf is None:
            return good
        knows = ekf.flags & (EKF_PLACE | EKF_RELATIVE_PLACE)
        return bool(knows) and not ekf.flags & (EKF_CONSTANT | EKF_UNINITIALISED)

    def rates(self, rate_hz: float) -> dict[str, float]:
        """Nothing comes unasked but a heartbeat a second."""
        return {
            "HEARTBEAT": 5.0,
            "ATTITUDE": rate_hz,
            "LOCAL_POSITION_NED": rate_hz,
            "EXTENDED_SYS_STATE": 5.0,
            "GLOBAL_POSITION_INT": 5.0,
            "SYS_STATUS": 2.0,
            "EKF_STATUS_REPORT": 2.0,
            "GPS_RAW_INT": 1.0,
            "RAW_IMU": rate_hz,
            "DISTANCE_SENSOR": 10.0,
        }

    def lift(self, values: Values) -> Lift:
        if int(values.get("GUID_OPTIONS", 0)) & THRUST_AS_THRUST:
            return ClimbByThrust(hover=values.get("MOT_THST_HOVER", 0.35))
        return ClimbByShare(up_m_s=copter_speed(values, "UP", 2.5), down_m_s=copter_speed(values, "DN", 1.5))


class Px4Dialect(Dialect):
    """PX4."""

    NAME = "PX4"
    GUIDED = "OFFBOARD"
    HOLD = "AUTO.LOITER"
    LAND = "AUTO.LAND"
    ARMING = "AUTO.LOITER"
    HOLDING = frozenset({"AUTO.LOITER"})
    LANDING = frozenset({"AUTO.LAND", "AUTO.PRECLAND"})
    TAKING_OFF = frozenset({"AUTO.TAKEOFF"})
    STICKS = frozenset({"MANUAL", "STABILIZED", "ACRO", "ALTCTL", "POSCTL"})
    LEAD_S = 1.0
    BYTEWISE = True

    def mode_of(self, custom_mode: int) -> str:
        return px4_mode(custom_mode)

    def mode_order(self, mode: str) -> Order:
        main, sub = PX4_NUMBERS[mode]
        return Order(m.MAV_CMD_DO_SET_MODE, (CUSTOM, float(main), float(sub)))

    def takeoff_order(self, height_m: float, view: View) -> Order | None:
        """The altitude is above mean sea level."""
        if view.amsl_m is None:
            return None
        nan = math.nan
        amsl_m = view.amsl_m - (view.altitude_m or 0.0) + height_m
        # To the decimetre, so that a repeat says the same and a resting altitude's noise makes no other command of it.
        return Order(m.MAV_CMD_NAV_TAKEOFF, (0.0, 0.0, 0.0, nan, nan, nan, round(amsl_m, 1)))

    def has_taken_off(self, view: View, height_m: float, rose: bool) -> bool:  # noqa: ARG002
        """It holds its place then."""
        return rose and view.mode == self.HOLD and view.landed is not Landed.TAKING_OFF

    def ready(self, telemetry: Telemetry, now_ns: int) -> bool | None:
        return telemetry.prearm_good(now_ns)

    def rates(self, rate_hz: float) -> dict[str, float]:
        """The heartbeat's rate can't be changed; the mode has a message of its own."""
        return {
            "ATTITUDE": rate_hz,
            "LOCAL_POSITION_NED": rate_hz,
            "CURRENT_MODE": 5.0,
            "EXTENDED_SYS_STATE": 5.0,
            "GLOBAL_POSITION_INT": 5.0,
            "SYS_STATUS": 2.0,
            "ESTIMATOR_STATUS": 2.0,
            "GPS_RAW_INT": 1.0,
            "HIGHRES_IMU": rate_hz,
            "DISTANCE_SENSOR": 10.0,
        }

    def lift(self, values: Values) -> Lift:
        return ClimbByThrust(hover=values.get("MPC_THR_HOVER", 0.5))


def copter_speed(values: Values, which: str, usual_m_s: float) -> float:
    """``WPNAV_SPEED_UP`` and the like are in cm/s; newer firmware calls them ``WP_SPD_UP``, in m/s."""
    old, new = values.get(f"WPNAV_SPEED_{which}"), values.get(f"WP_SPD_{which}")
    speed = new if new is not None else old / 100.0 if old is not None else usual_m_s
    return speed if math.isfinite(speed) and speed > 0 else usual_m_s


def dialect_of(autopilot: int) -> Dialect | None:
    """By the heartbeat's ``MAV_AUTOPILOT``; None for one that is not known here."""
    if autopilot == Autopilot.ARDUPILOT:
        return CopterDialect()
    if autopilot == Autopilot.PX4:
        return Px4Dialect()
    return None
