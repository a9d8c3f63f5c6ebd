"""An autopilot's state as reported by the simulation, and the MAVLink messages made from it, keyed by number. Pure."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import ClassVar, Final

from skyloop.messages import FlightState
from skyloop.messages.geometry import in_16_bits, quaternion_from_euler
from skyloop.sim.host import Report
from skyloop.sim.parameters import GRAVITY_M_S2
from skyloop.vehicles.emulation.flight import FlightControl, Vehicle
from skyloop.vehicles.mavlink.emulator.manoeuvres import ORIGIN, geodetic
from skyloop.vehicles.mavlink.wire.axes import Vector, flip, swap, to_wire, yaw_between
from skyloop.vehicles.mavlink.wire.codec import Landed, Message, ModeFlag, SystemState
from skyloop.vehicles.mavlink.wire.codec import dialect as m

# Bits of MAV_SYS_STATUS_SENSOR.
PREARM: Final = 0x10000000
REMOTE: Final = 0x10000
_SENSORS: Final = 0x1 | 0x2 | 0x4 | 0x8 | 0x20  #: gyro, accelerometer, magnetometer, pressure, GPS
_BATTERY: Final = 0x2000000
#: Estimator flags for a known position: relative and absolute, each current and predicted for flight. DroneKit waits
#: for the last flag.
_PLACED: Final = 0x8 | 0x10 | 0x100 | 0x200
POSES_S: Final = 1.0  #: how long external poses must arrive before the position is known without GPS
POSE_GAP_S: Final = 0.5  #: time without external poses after which the position is lost
_WRAP_MS: Final = 1 << 32  #: stamps wrap around at this value
_LANDED: Final = {
    FlightState.LANDED: Landed.ON_GROUND,
    FlightState.EMERGENCY: Landed.ON_GROUND,
    FlightState.TAKING_OFF: Landed.TAKING_OFF,
    FlightState.LANDING: Landed.LANDING,
}


class AutopilotState(ABC):
    """An autopilot's state, from which messages are made. Times are on the autopilot's own clock [s]."""

    AUTOPILOT: ClassVar[int]  #: MAV_AUTOPILOT
    REPORTS_PREARM: ClassVar[bool] = True  #: whether SYS_STATUS marks the pre-arm check as present

    def __init__(self, vehicle: Vehicle, boot_s: float, gps: bool) -> None:
        self.flight = FlightControl(vehicle)
        self.gps = gps
        self.report: Report
        self.armed = False
        self.failsafe = False
        self.home: Vector = (0.0, 0.0, 0.0)  #: east, north, up from the flight's origin [m]
        self._boot_s = boot_s
        self._begun_s: float | None = None
        self._pose_s = -math.inf
        self._posing_s = math.inf

    @property
    def time_s(self) -> float:
        """Time since power-on [s]."""
        return 0.0 if self._begun_s is None else self.report.believed.time_s - self._begun_s

    @property
    def boot_ms(self) -> int:
        """Time since power-on, as in 32-bit message fields [ms]."""
        return round(self.time_s * 1000) % _WRAP_MS

    @property
    def boot_ns(self) -> int:
        """Time since power-on [ns]."""
        return round(self.time_s * 1e9)

    @property
    def has_origin(self) -> bool:
        """Whether the autopilot has a position."""
        if self.gps:
            return self.time_s >= self._boot_s / 2
        return self.time_s - self._posing_s >= POSES_S and self.time_s - self._pose_s < POSE_GAP_S

    @property
    def settled(self) -> bool:
        """Whether the autopilot's estimator reports a good position, which is the last step of booting."""
        return self.time_s >= self._boot_s and self.has_origin

    @property
    def ready(self) -> bool:
        """Whether the autopilot can be armed."""
        return self.settled and self.mode_allows_arming

    @property
    def mode_allows_arming(self) -> bool:
        """Whether the autopilot can be armed in its present mode."""
        return True

    @property
    def remote(self) -> bool:
        """Whether the autopilot reports that it receives a remote control."""
        return False

    @property
    def base_mode(self) -> int:
        """The heartbeat's ``MAV_MODE_FLAG`` bits."""
        return int(ModeFlag.CUSTOM | (ModeFlag.ARMED if self.armed else 0))

    @property
    def system_status(self) -> int:
        """The heartbeat's ``MAV_STATE``."""
        if self.failsafe:
            return SystemState.CRITICAL
        return SystemState.ACTIVE if self.armed else SystemState.STANDBY

    @property
    @abstractmethod
    def custom_mode(self) -> int: ...

    @property
    def channels(self) -> list[int] | None:
        """The remote control's pulse widths [µs]; None if none are reported."""
        return None


_MOST_CHANNELS: Final = 18  #: number of channel fields in RC_CHANNELS
Maker = Callable[[AutopilotState], Message | None]


def _heartbeat(a: AutopilotState) -> Message:
    return m.MAVLink_heartbeat_message(2, a.AUTOPILOT, a.base_mode, a.custom_mode, a.system_status, 3)


def _angles(a: AutopilotState) -> tuple[float, float, float]:
    believed = a.report.believed
    return believed.roll_rad, 0.0 - believed.pitch_rad, yaw_between(believed.yaw_rad)


def _attitude(a: AutopilotState) -> Message:
    return m.MAVLink_attitude_message(a.boot_ms, *_angles(a), *flip(*a.report.believed.angular_velocity_rad_s))


def _quaternion(a: AutopilotState) -> Message:
    rates = flip(*a.report.believed.angular_velocity_rad_s)
    return m.MAVLink_attitude_quaternion_message(a.boot_ms, *to_wire(quaternion_from_euler(*_angles(a))), *rates)


def _local(a: AutopilotState) -> Message | None:
    if not a.has_origin:
        return None
    return m.MAVLink_local_position_ned_message(a.boot_ms, *swap(*a.flight.place), *swap(*a.flight.velocity))


def _global(a: AutopilotState) -> Message | None:
    if not a.has_origin:
        return None
    north, east, down = (round(each * 100) for each in swap(*a.flight.velocity))
    heading = round(math.degrees(yaw_between(a.flight.yaw)) % 360.0 * 100) % 36000
    relative = round((a.flight.place[2] - a.home[2]) * 1000)
    return m.MAVLink_global_position_int_message(
        a.boot_ms, *geodetic(a.flight.place), relative, north, east, down, heading
    )


def _status(a: AutopilotState) -> Message:
    believed = a.report.believed
    present = _SENSORS | _BATTERY | (PREARM if a.REPORTS_PREARM else 0) | (REMOTE if a.remote else 0)
    health = (present & ~PREARM) | (PREARM if a.ready else 0)
    charge, volts = round(believed.battery * 100), round(believed.battery_v * 1000)
    return m.MAVLink_sys_status_message(present, present, health, 250, volts, 500, charge, 0, 0, 0, 0, 0, 0)


def _battery(a: AutopilotState) -> Message:
    believed = a.report.believed
    cells = [round(believed.battery_v * 1000)] + [0xFFFF] * 9
    return m.MAVLink_battery_status_message(0, 0, 1, 32767, cells, 500, -1, -1, round(believed.battery * 100))


def _extended(a: AutopilotState) -> Message:
    landed = _LANDED.get(a.flight.state, Landed.IN_AIR)
    return m.MAVLink_extended_sys_state_message(0, int(landed))


def _gps(a: AutopilotState) -> Message:
    latitude, longitude, altitude = geodetic(a.flight.place)
    fix, satellites = (3, 10) if a.gps else (0, 0)
    return m.MAVLink_gps_raw_int_message(
        a.boot_ms * 1000, fix, latitude, longitude, altitude, 80, 90, 0, 0xFFFF, satellites
    )


def _ekf(a: AutopilotState) -> Message:
    flags = 0x1 | 0x2 | 0x4 | 0x20 | (_PLACED if a.settled else 0x80)
    return m.MAVLink_ekf_status_report_message(flags, 0.1, 0.1, 0.1, 0.1, 0.0)


def _estimator(a: AutopilotState) -> Message:
    """Report the estimator's state. At rest, it assumes a constant position (0x80), which still counts as known."""
    flags = 0x1 | 0x2 | 0x4 | 0x20 | (_PLACED if a.settled else 0x80)
    flags |= 0x80 if a.flight.standing else 0
    return m.MAVLink_estimator_status_message(a.boot_ms * 1000, flags, 0.1, 0.1, 0.1, 0.1, 0.0, 0.0, 0.1, 0.1)


def _home(a: AutopilotState) -> Message | None:
    if not a.has_origin:
        return None
    axes = swap(*a.home)
    return m.MAVLink_home_position_message(*geodetic(a.home), *axes, [1, 0, 0, 0], 0, 0, 0)


def _imu(a: AutopilotState) -> Message:
    rates, force = flip(*a.report.believed.angular_velocity_rad_s), flip(*a.report.believed.acceleration_m_s2)
    return m.MAVLink_highres_imu_message(a.boot_ms * 1000, *force, *rates, 0.2, 0.0, 0.4, 955.0, 0.0, 488.0, 20.0, 63)


def _raw_imu(a: AutopilotState) -> Message:
    force = (in_16_bits(each / GRAVITY_M_S2 * 1000) for each in flip(*a.report.believed.acceleration_m_s2))
    rates = (in_16_bits(each * 1000) for each in flip(*a.report.believed.angular_velocity_rad_s))
    return m.MAVLink_raw_imu_message(a.boot_ms * 1000, *force, *rates, 200, 0, 400)


def _hud(a: AutopilotState) -> Message:
    east, north, up = a.flight.velocity
    heading = round(math.degrees(yaw_between(a.flight.yaw)) % 360.0) % 360
    altitude = ORIGIN.altitude_m + a.flight.place[2]
    return m.MAVLink_vfr_hud_message(0.0, math.hypot(east, north), heading, 50, altitude, up)


def _altitude(a: AutopilotState) -> Message:
    up = a.flight.place[2]
    relative = up - a.home[2]
    return m.MAVLink_altitude_message(a.boot_ms * 1000, up, ORIGIN.altitude_m + up, up, relative, up, math.nan)


def _channels(a: AutopilotState) -> Message | None:
    widths = a.channels
    if widths is None:
        return None
    padded = widths + [0xFFFF] * (_MOST_CHANNELS - len(widths))
    return m.MAVLink_rc_channels_message(a.boot_ms, len(widths), *padded, 255)


def _mission(a: AutopilotState) -> Message | None:
    mission = getattr(a, "mission", None)  # ArduCopter only
    return None if mission is None else m.MAVLink_mission_current_message(mission.current)


MAKERS: Final[dict[int, Maker]] = {
    m.MAVLINK_MSG_ID_HEARTBEAT: _heartbeat,
    m.MAVLINK_MSG_ID_ATTITUDE: _attitude,
    m.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: _quaternion,
    m.MAVLINK_MSG_ID_LOCAL_POSITION_NED: _local,
    m.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: _global,
    m.MAVLINK_MSG_ID_SYS_STATUS: _status,
    m.MAVLINK_MSG_ID_BATTERY_STATUS: _battery,
    m.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: _extended,
    m.MAVLINK_MSG_ID_GPS_RAW_INT: _gps,
    m.MAVLINK_MSG_ID_EKF_STATUS_REPORT: _ekf,
    m.MAVLINK_MSG_ID_ESTIMATOR_STATUS: _estimator,
    m.MAVLINK_MSG_ID_HOME_POSITION: _home,
    m.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN: lambda a: (
        m.MAVLink_gps_global_origin_message(*geodetic((0.0, 0.0, 0.0))) if a.has_origin else None
    ),
    m.MAVLINK_MSG_ID_HIGHRES_IMU: _imu,
    m.MAVLINK_MSG_ID_RAW_IMU: _raw_imu,
    m.MAVLINK_MSG_ID_VFR_HUD: _hud,
    m.MAVLINK_MSG_ID_ALTITUDE: _altitude,
    m.MAVLINK_MSG_ID_SYSTEM_TIME: lambda a: m.MAVLink_system_time_message(0, a.boot_ms),
    m.MAVLINK_MSG_ID_CURRENT_MODE: lambda a: m.MAVLink_current_mode_message(0, a.custom_mode, a.custom_mode),
    m.MAVLINK_MSG_ID_RC_CHANNELS: _channels,
    m.MAVLINK_MSG_ID_MISSION_CURRENT: _mission,
    m.MAVLINK_MSG_ID_TIMESYNC: lambda a: m.MAVLink_timesync_message(0, a.boot_ns),
}
