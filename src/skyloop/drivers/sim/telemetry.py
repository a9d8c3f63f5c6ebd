"""The simulator's report of a drone as feedback. Pure."""

from __future__ import annotations

from skyloop.messages import Feedback, FlightState, Value
from skyloop.sim.host import Report
from skyloop.sim.options import SimOptions


def feedback_of(report: Report, state: FlightState, options: SimOptions) -> Feedback:
    """Return a report as feedback.

    Args:
        report: The drone as it believes to be and as it is, on this host's clock.
        state: The flight state to report, which is less detailed for a vehicle that flies by set-points alone.
        options: Whether the vehicle reports its position and its velocity, and whether the truth is reported too.
    """
    believed = report.believed
    return Feedback(
        captured_ns=report.captured_ns,
        state=state,
        battery=believed.battery,
        battery_v=believed.battery_v,
        roll_rad=believed.roll_rad,
        pitch_rad=believed.pitch_rad,
        yaw_rad=believed.yaw_rad,
        altitude_m=believed.altitude_m,
        velocity_m_s=believed.velocity_m_s if options.velocity else None,
        angular_velocity_rad_s=believed.angular_velocity_rad_s,
        acceleration_m_s2=believed.acceleration_m_s2,
        position_m=report.truth.position_m if options.position else None,
        native=_native(report, options),
    )


def _native(report: Report, options: SimOptions) -> dict[str, Value]:
    native: dict[str, Value] = {"sim.time_s": report.truth.time_s}
    if report.believed.emergency_reason:
        native["emergency_reason"] = report.believed.emergency_reason
    if not options.truth:
        return native
    truth = report.truth
    native["truth.x"], native["truth.y"], native["truth.z"] = truth.position_m
    native["truth.vx"], native["truth.vy"], native["truth.vz"] = truth.velocity_m_s
    native["truth.roll"], native["truth.pitch"], native["truth.yaw"] = truth.roll_rad, truth.pitch_rad, truth.yaw_rad
    for target in report.targets:
        native[f"truth.{target.name}.x"], native[f"truth.{target.name}.y"] = target.position_m[:2]
        native[f"truth.{target.name}.z"] = target.position_m[2]
    for number, target in enumerate(report.targets, 1):
        name = "truth.target" if number == 1 else f"truth.target{number}"
        native[f"{name}.x"], native[f"{name}.y"], native[f"{name}.z"] = target.position_m
        native[f"{name}.yaw"] = target.yaw_rad
    return native
