"""Conversion of the simulator's reports on a drone to feedback. Pure."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import replace

from skyloop.messages import Feedback, FlightState, Value
from skyloop.messages.geometry import wrap_angle
from skyloop.sim.host import Report
from skyloop.sim.options import SimOptions
from skyloop.sim.world import Vec3


def feedback_of(report: Report, state: FlightState, options: SimOptions) -> Feedback:
    """Convert a report to feedback; the options select whether it includes position, velocity and truth.

    ``state`` is the flight state to report, which is less detailed for a vehicle that flies only by set-points.
    """
    believed = report.believed
    native = native_of(report, options)
    if believed.emergency_reason:
        native["emergency_reason"] = believed.emergency_reason
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
        native=native,
    )


def native_of(report: Report, options: SimOptions) -> dict[str, Value]:
    """Return the simulation time and, if reported, the truth as native telemetry."""
    native: dict[str, Value] = {"sim.time_s": report.truth.time_s}
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


def truth_at(reports: Sequence[Report], captured_ns: int) -> Report:
    """Return a report for the given time, interpolating the drone's true motion between the two nearest reports.

    ``reports`` must be sorted and not empty; for times outside their range, the first or last report is returned.
    """
    after = bisect_right(reports, captured_ns, key=lambda report: report.captured_ns)
    if after == 0:
        return reports[0]
    if after == len(reports):
        return reports[-1]
    a, b = reports[after - 1], reports[after]
    share = (captured_ns - a.captured_ns) / (b.captured_ns - a.captured_ns)
    first, last = a.truth, b.truth
    truth = replace(
        first,
        time_s=first.time_s + share * (last.time_s - first.time_s),
        position_m=_between(first.position_m, last.position_m, share),
        velocity_m_s=_between(first.velocity_m_s, last.velocity_m_s, share),
        roll_rad=_turned(first.roll_rad, last.roll_rad, share),
        pitch_rad=_turned(first.pitch_rad, last.pitch_rad, share),
        yaw_rad=_turned(first.yaw_rad, last.yaw_rad, share),
    )
    return replace(a, truth=truth, captured_ns=captured_ns)


def _between(a: Vec3, b: Vec3, share: float) -> Vec3:
    x, y, z = (p + share * (q - p) for p, q in zip(a, b, strict=True))
    return x, y, z


def _turned(a: float, b: float, share: float) -> float:
    return wrap_angle(a + share * wrap_angle(b - a))
