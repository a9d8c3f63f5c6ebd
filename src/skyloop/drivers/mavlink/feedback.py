"""What was heard, as :class:`skyloop.messages.Feedback`: units, axes and signs. Pure."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

from skyloop.drivers.mavlink.telemetry import FLOWING_S, SLOW_S, Telemetry, finite
from skyloop.messages import Feedback, FlightState, Value
from skyloop.wire.mavlink.axes import Vector, flip, swap, turned, yaw_between
from skyloop.wire.mavlink.codec import Message

STANDARD_GRAVITY: Final = 9.80665  #: m/s²
_UNKNOWN_16: Final = 0xFFFF


def feedback_of(
    telemetry: Telemetry, state: FlightState, captured_ns: int, now_ns: int, native: Mapping[str, Value]
) -> Feedback:
    """The vehicle's state. What does not flow, or is a number that can't be, is None."""
    attitude = telemetry.attitude(now_ns)
    place = telemetry.place(now_ns)
    roll, pitch, yaw = (None, None, None) if attitude is None else _turned_over(attitude)
    return Feedback(
        captured_ns=captured_ns,
        state=state,
        battery=_charge(telemetry, now_ns),
        battery_v=_volts(telemetry, now_ns),
        roll=roll,
        pitch=pitch,
        yaw=yaw,
        altitude=telemetry.altitude_m(now_ns),
        velocity=_velocity(telemetry.velocity(now_ns), yaw),
        angular_velocity=_rates(telemetry, now_ns),
        acceleration=_force(telemetry, now_ns),
        position=None if place is None else swap(*place),
        native={**native, **_native(telemetry, now_ns)},
    )


def _turned_over(attitude: Vector) -> Vector:
    """Roll right side down, pitch nose down, yaw counter-clockwise from east."""
    roll, pitch, yaw = attitude
    return math.remainder(roll, math.tau), 0.0 - math.remainder(pitch, math.tau), yaw_between(yaw)


def _velocity(world: Vector | None, yaw: float | None) -> Vector | None:
    """Forward, left, up."""
    if world is None or yaw is None:
        return None
    east, north, up = swap(*world)
    return (*turned(east, north, -yaw), up)


def _rates(telemetry: Telemetry, now_ns: int) -> Vector | None:
    message = telemetry.newest("ATTITUDE", now_ns, FLOWING_S)
    found = None if message is None else finite(message.rollspeed, message.pitchspeed, message.yawspeed)
    return None if found is None else flip(*found)


def _force(telemetry: Telemetry, now_ns: int) -> Vector | None:
    """PX4 tells it in m/s², ArduPilot in thousandths of g."""
    message = telemetry.newest("HIGHRES_IMU", now_ns, FLOWING_S)
    if message is not None:
        found = finite(message.xacc, message.yacc, message.zacc)
        return None if found is None else flip(*found)
    message = telemetry.newest("RAW_IMU", now_ns, FLOWING_S)
    if message is None:
        return None
    unit = STANDARD_GRAVITY / 1000.0
    return flip(message.xacc * unit, message.yacc * unit, message.zacc * unit)


def _charge(telemetry: Telemetry, now_ns: int) -> float | None:
    for kind in ("SYS_STATUS", "BATTERY_STATUS"):
        message = telemetry.newest(kind, now_ns, SLOW_S)
        if message is not None and 0 <= message.battery_remaining <= 100:
            return float(message.battery_remaining) / 100.0
    return None


def _volts(telemetry: Telemetry, now_ns: int) -> float | None:
    message = telemetry.newest("SYS_STATUS", now_ns, SLOW_S)
    if message is None or message.voltage_battery in (0, _UNKNOWN_16):
        return None
    return float(message.voltage_battery) / 1000.0


def _native(telemetry: Telemetry, now_ns: int) -> dict[str, Value]:
    native: dict[str, Value] = telemetry.ages(now_ns)
    gps = telemetry.newest("GPS_RAW_INT", now_ns, SLOW_S)
    if gps is not None:
        native["gps.fix"] = int(gps.fix_type)
        if gps.satellites_visible != 0xFF:
            native["gps.satellites"] = int(gps.satellites_visible)
    place = telemetry.newest("GLOBAL_POSITION_INT", now_ns, SLOW_S)
    if place is not None:
        native.update(_geodetic(place))
    return native


def _geodetic(message: Message) -> dict[str, Value]:
    """Degrees, and metres above mean sea level."""
    return {
        "gps.latitude_deg": message.lat / 1e7,
        "gps.longitude_deg": message.lon / 1e7,
        "gps.altitude_amsl_m": message.alt / 1000.0,
    }
