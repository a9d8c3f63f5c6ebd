"""Navdata to :class:`skyloop.messages.Feedback`: units, axes and signs. Pure.

The drone's body axes are x forward, y right, z down: a positive ``theta`` is nose up, a positive ``phi`` right side
down, a positive ``psi`` clockwise seen from above, ``vy`` is to the right. That accelerometers and gyros follow the
same axes was checked on a datagram of a real AR.Drone 2 that stood tilted.
"""

from __future__ import annotations

import math
from collections import deque
from typing import Final

from skyloop.clock import nanoseconds, seconds
from skyloop.messages import Feedback, FlightState, Value
from skyloop.messages.geometry import wrap_angle
from skyloop.wire.ardrone.navdata import ControlState, Navdata, State
from skyloop.wire.ardrone.options import Demo, PhysMeasures, RawMeasures

STANDARD_GRAVITY: Final = 9.80665  #: m/s²
CLIMB_WINDOW_NS: Final = nanoseconds(0.3)
Vector = tuple[float, float, float]

_FLIGHT_STATES: Final = {
    ControlState.FLYING: FlightState.FLYING,
    ControlState.HOVERING: FlightState.HOVERING,
    ControlState.TAKING_OFF: FlightState.TAKING_OFF,
    ControlState.GOING_TO_FIX: FlightState.FLYING,
    ControlState.LANDING: FlightState.LANDING,
    ControlState.LOOPING: FlightState.FLYING,
}


def control_state(demo: Demo) -> ControlState | None:
    """What the drone's control does; None for a number that no firmware known to us sends."""
    try:
        return ControlState(demo.ctrl_state >> 16)
    except ValueError:
        return None


def flight_state(state: State, control: ControlState | None) -> FlightState:
    """From the state bits and the control's state."""
    if state & State.EMERGENCY:
        return FlightState.EMERGENCY
    resting = FlightState.FLYING if state & State.FLYING else FlightState.LANDED
    return resting if control is None else _FLIGHT_STATES.get(control, resting)


class ClimbMeter:
    """Climb [m/s] as the slope of the altitude over the last 0.3 s: the firmware leaves ``demo.vz`` at zero."""

    def __init__(self) -> None:
        self._samples: deque[tuple[int, float]] = deque()

    def climb(self, altitude_m: float, at_ns: int) -> float | None:
        """With this newest sample; None while there is none but this."""
        samples = self._samples
        samples.append((at_ns, altitude_m))
        while len(samples) > 2 and at_ns - samples[1][0] >= CLIMB_WINDOW_NS:
            samples.popleft()
        begun_ns, begun_m = samples[0]
        if at_ns - begun_ns > 4 * CLIMB_WINDOW_NS:  # a gap: it says nothing of now
            samples.popleft()
            return None
        return (altitude_m - begun_m) / seconds(at_ns - begun_ns) if at_ns > begun_ns else None


def feedback_of(
    navdata: Navdata, demo: Demo, captured_ns: int, climb_m_s: float | None, native: dict[str, Value]
) -> Feedback:
    """The drone's state. What it does not tell, or tells as a number that can't be, is None."""
    measured, raw = navdata.get(PhysMeasures), navdata.get(RawMeasures)
    yaw = _angle(demo.psi)
    pitch = _angle(demo.theta)
    return Feedback(
        captured_ns=captured_ns,
        state=flight_state(navdata.state, control_state(demo)),
        battery=demo.battery / 100 if demo.battery <= 100 else None,
        battery_v=raw.vbat / 1000 if raw is not None and raw.vbat else None,
        roll=_angle(demo.phi),
        pitch=-pitch if pitch is not None else None,
        yaw=wrap_angle(-yaw) if yaw is not None else None,
        altitude=demo.altitude / 1000,
        velocity=_vector(demo.vx / 1000, -demo.vy / 1000, climb_m_s),
        angular_velocity=_flipped(measured.gyros, math.radians(1.0)) if measured is not None else None,
        acceleration=_flipped(measured.accs, STANDARD_GRAVITY / 1000) if measured is not None else None,
        native=native,
    )


def _angle(millidegrees: float) -> float | None:
    return math.radians(millidegrees / 1000) if abs(millidegrees) <= 180_000 else None


def _flipped(forward_right_down: tuple[float, ...], factor: float) -> Vector | None:
    """Forward, right, down to forward, left, up."""
    x, y, z = forward_right_down
    return _vector(x * factor, -y * factor, -z * factor)


def _vector(x: float, y: float, z: float | None) -> Vector | None:
    if z is None or not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
        return None
    return x, y, z
