"""What a flight controller reports, in SI units and our axes. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from skyloop.messages import Feedback, FlightState, Value
from skyloop.vehicles.msp.motion import Motion
from skyloop.vehicles.msp.wire.messages import Altitude, Attitude, Battery, CellVoltages, Status


@dataclass(slots=True)
class Reported:
    """The newest of each reply; None: it has not come."""

    attitude: Attitude | None = None
    altitude: Altitude | None = None
    status: Status | None = None
    battery: Battery | None = None
    satellites: int | None = None
    cells: CellVoltages = field(default_factory=CellVoltages)


def charge_left(battery: Battery, cells: CellVoltages) -> float | None:
    """Return the charge that is left, 0 to 1, where it is told, or by the voltage of a cell; None: not known."""
    if battery.left is not None:
        return battery.left
    if battery.cells <= 0 or battery.voltage_v <= 0 or cells.full_v <= cells.empty_v:
        return None
    share = (battery.voltage_v / battery.cells - cells.empty_v) / (cells.full_v - cells.empty_v)
    return max(0.0, min(1.0, share))


def feedback_of(
    reported: Reported, motion: Motion, flight: FlightState, captured_ns: int, native: dict[str, Value]
) -> Feedback:
    """Return the vehicle's state. What is not known is None.

    Args:
        reported: By the flight controller.
        motion: As it was estimated.
        flight: The flight state.
        captured_ns: When the attitude came.
        native: The vehicle's own telemetry.
    """
    attitude, battery = reported.attitude, reported.battery
    velocity = None
    if motion.velocity_m_s is not None and motion.yaw_rad is not None:
        east, north, up = motion.velocity_m_s
        cos, sin = math.cos(motion.yaw_rad), math.sin(motion.yaw_rad)
        velocity = cos * east + sin * north, cos * north - sin * east, up
    return Feedback(
        captured_ns=captured_ns,
        state=flight,
        battery=None if battery is None else charge_left(battery, reported.cells),
        battery_v=None if battery is None or battery.voltage_v <= 0 else battery.voltage_v,
        roll_rad=None if attitude is None else math.radians(attitude.roll_deg),
        pitch_rad=None if attitude is None else math.radians(attitude.pitch_deg),
        yaw_rad=motion.yaw_rad,
        altitude_m=motion.height_m,
        velocity_m_s=velocity,
        position_m=motion.position_m,
        native=native,
    )
