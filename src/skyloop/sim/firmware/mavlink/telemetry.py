"""Reports of the simulation to MAVLink messages, by their numbers. Pure."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from skyloop.messages import FlightState
from skyloop.messages.geometry import quaternion_from_euler
from skyloop.sim.parameters import GRAVITY_M_S2
from skyloop.wire.mavlink.axes import flip, swap, yaw_between
from skyloop.wire.mavlink.codec import Message
from skyloop.wire.mavlink.codec import dialect as m
from skyloop.wire.mavlink.modes import Landed

if TYPE_CHECKING:
    from skyloop.sim.firmware.mavlink.autopilot import Autopilot

HOME_LATITUDE_DEG: Final = 47.397742
HOME_LONGITUDE_DEG: Final = 8.545594
HOME_ALTITUDE_M: Final = 488.0  #: above mean sea level
_METRES_PER_DEG: Final = 111_320.0
PREARM: Final = 0x10000000
_SENSORS: Final = 0x1 | 0x2 | 0x4 | 0x8 | 0x20  #: gyro, accelerometer, magnetometer, pressure, GPS
_BATTERY: Final = 0x2000000
_LANDED: Final = {
    FlightState.LANDED: Landed.ON_GROUND,
    FlightState.EMERGENCY: Landed.ON_GROUND,
    FlightState.TAKING_OFF: Landed.TAKING_OFF,
    FlightState.LANDING: Landed.LANDING,
}
Maker = Callable[["Autopilot"], Message | None]


def geodetic(a: Autopilot) -> tuple[int, int, int]:
    """Latitude and longitude [1e-7 degrees], altitude above mean sea level [mm]."""
    east, north, up = a.flyer.place
    latitude = HOME_LATITUDE_DEG + north / _METRES_PER_DEG
    longitude = HOME_LONGITUDE_DEG + east / (_METRES_PER_DEG * math.cos(math.radians(HOME_LATITUDE_DEG)))
    return round(latitude * 1e7), round(longitude * 1e7), round((HOME_ALTITUDE_M + up) * 1000)


def _heartbeat(a: Autopilot) -> Message:
    return m.MAVLink_heartbeat_message(2, a.AUTOPILOT, a.base_mode, a.custom_mode, a.system_status, 3)


def _angles(a: Autopilot) -> tuple[float, float, float]:
    believed = a.report.believed
    return believed.roll_rad, 0.0 - believed.pitch_rad, yaw_between(believed.yaw_rad)


def _attitude(a: Autopilot) -> Message:
    return m.MAVLink_attitude_message(a.boot_ms, *_angles(a), *flip(*a.report.believed.angular_velocity_rad_s))


def _quaternion(a: Autopilot) -> Message:
    rates = flip(*a.report.believed.angular_velocity_rad_s)
    return m.MAVLink_attitude_quaternion_message(a.boot_ms, *quaternion_from_euler(*_angles(a)), *rates)


def _local(a: Autopilot) -> Message | None:
    if not a.has_origin:
        return None
    return m.MAVLink_local_position_ned_message(a.boot_ms, *swap(*a.flyer.place), *swap(*a.flyer.velocity))


def _global(a: Autopilot) -> Message | None:
    if not a.has_origin:
        return None
    north, east, down = (round(each * 100) for each in swap(*a.flyer.velocity))
    heading = round(math.degrees(yaw_between(a.flyer.yaw)) % 360.0 * 100) % 36000
    relative = round(a.flyer.place[2] * 1000)
    return m.MAVLink_global_position_int_message(a.boot_ms, *geodetic(a), relative, north, east, down, heading)


def _status(a: Autopilot) -> Message:
    believed = a.report.believed
    present = _SENSORS | _BATTERY | PREARM
    health = present if a.ready else present & ~PREARM
    charge, volts = round(believed.battery * 100), round(believed.battery_v * 1000)
    return m.MAVLink_sys_status_message(present, present, health, 250, volts, 500, charge, 0, 0, 0, 0, 0, 0)


def _battery(a: Autopilot) -> Message:
    believed = a.report.believed
    cells = [round(believed.battery_v * 1000)] + [0xFFFF] * 9
    return m.MAVLink_battery_status_message(0, 0, 1, 32767, cells, 500, -1, -1, round(believed.battery * 100))


def _extended(a: Autopilot) -> Message:
    landed = _LANDED.get(a.flyer.state, Landed.IN_AIR)
    return m.MAVLink_extended_sys_state_message(0, int(landed))


def _gps(a: Autopilot) -> Message:
    latitude, longitude, altitude = geodetic(a)
    fix, satellites = (3, 10) if a.gps else (0, 0)
    return m.MAVLink_gps_raw_int_message(
        a.boot_ms * 1000, fix, latitude, longitude, altitude, 80, 90, 0, 0xFFFF, satellites
    )


def _ekf(a: Autopilot) -> Message:
    flags = 0x1 | 0x2 | 0x4 | 0x20 | (0x8 | 0x10 if a.has_origin else 0x80)
    return m.MAVLink_ekf_status_report_message(flags, 0.1, 0.1, 0.1, 0.1, 0.0)


def _estimator(a: Autopilot) -> Message:
    flags = 0x1 | 0x2 | 0x4 | 0x20 | (0x8 | 0x10 if a.has_origin else 0x80)
    return m.MAVLink_estimator_status_message(a.boot_ms * 1000, flags, 0.1, 0.1, 0.1, 0.1, 0.0, 0.0, 0.1, 0.1)


def _home(a: Autopilot) -> Message | None:
    if not a.has_origin:
        return None
    latitude, longitude = round(HOME_LATITUDE_DEG * 1e7), round(HOME_LONGITUDE_DEG * 1e7)
    altitude = round(HOME_ALTITUDE_M * 1000)
    return m.MAVLink_home_position_message(latitude, longitude, altitude, 0, 0, 0, [1, 0, 0, 0], 0, 0, 0)


def _imu(a: Autopilot) -> Message:
    rates, force = flip(*a.report.believed.angular_velocity_rad_s), flip(*a.report.believed.acceleration_m_s2)
    return m.MAVLink_highres_imu_message(a.boot_ms * 1000, *force, *rates, 0.2, 0.0, 0.4, 955.0, 0.0, 488.0, 20.0, 63)


def _raw_imu(a: Autopilot) -> Message:
    force = (round(each / GRAVITY_M_S2 * 1000) for each in flip(*a.report.believed.acceleration_m_s2))
    rates = (round(each * 1000) for each in flip(*a.report.believed.angular_velocity_rad_s))
    return m.MAVLink_raw_imu_message(a.boot_ms * 1000, *force, *rates, 200, 0, 400)


def _hud(a: Autopilot) -> Message:
    east, north, up = a.flyer.velocity
    heading = round(math.degrees(yaw_between(a.flyer.yaw)) % 360.0) % 360
    altitude = HOME_ALTITUDE_M + a.flyer.place[2]
    return m.MAVLink_vfr_hud_message(0.0, math.hypot(east, north), heading, 50, altitude, up)


def _altitude(a: Autopilot) -> Message:
    up = a.flyer.place[2]
    return m.MAVLink_altitude_message(a.boot_ms * 1000, up, HOME_ALTITUDE_M + up, up, up, up, math.nan)


def _time(a: Autopilot) -> Message:
    return m.MAVLink_system_time_message(0, a.boot_ms)


def _current_mode(a: Autopilot) -> Message:
    return m.MAVLink_current_mode_message(0, a.custom_mode, a.custom_mode)


def _sync(a: Autopilot) -> Message:
    return m.MAVLink_timesync_message(0, a.boot_ns)


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
    m.MAVLINK_MSG_ID_HIGHRES_IMU: _imu,
    m.MAVLINK_MSG_ID_RAW_IMU: _raw_imu,
    m.MAVLINK_MSG_ID_VFR_HUD: _hud,
    m.MAVLINK_MSG_ID_ALTITUDE: _altitude,
    m.MAVLINK_MSG_ID_SYSTEM_TIME: _time,
    m.MAVLINK_MSG_ID_CURRENT_MODE: _current_mode,
    m.MAVLINK_MSG_ID_TIMESYNC: _sync,
}
