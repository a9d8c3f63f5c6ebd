"""Convert state strings to feedback: units, axes and signs, the phase of flight, and the drone's health. Pure.

No field in the state gives the phase of flight, so :class:`FlightWatch` infers it: ``time`` increases by one every
second only while the motors run, and the distance sensor detects whether the ground is near. Our own commands serve
only to interpret the observations: a climb after a take-off command is a take-off.
"""

from __future__ import annotations

import math
from typing import Final

from skyloop.clock import nanoseconds
from skyloop.drivers.vehicle_session import VehicleEvent, message
from skyloop.messages import Feedback, FlightState, Severity, Value
from skyloop.messages.geometry import wrap_angle
from skyloop.messages.parameter import Diagnostic
from skyloop.vehicles.tello.options import VelocityAxes
from skyloop.vehicles.tello.wire import GROUND_CM, Pad, TelloState, Vector

# Feedback in SI ------------------------------------------------------------------------------------------------------

STANDARD_GRAVITY: Final = 9.80665  #: [m/s²]


def height_m(state: TelloState) -> float | None:
    """Return the height [m]: as measured above the surface below or, without a measurement, above the take-off point.

    The distance sensor reports 10 cm both on the ground and at a height of 10 cm; the reported height tells them apart.
    """
    if state.distance_cm is not None:
        on_ground = state.distance_cm <= GROUND_CM and (state.height_cm or 0.0) < GROUND_CM
        return 0.0 if on_ground else state.distance_cm / 100
    if state.height_cm is not None and state.height_cm >= 0:
        return state.height_cm / 100
    return None


def velocity_m_s(state: TelloState, axes: VelocityAxes) -> Vector | None:
    """Return the velocity forward, left, up [m/s] from values along ``axes``; None if unknown.

    ``vgx``, ``vgy`` and ``vgz`` are in dm/s: a Tello that moved at 1 m/s reported 7 (DJITelloPy, issue 96).
    """
    if state.speed_dm_s is None or axes is VelocityAxes.NONE:
        return None
    x, y, down = (part / 10 for part in state.speed_dm_s)
    if axes is VelocityAxes.BODY:
        return x, -y, -down
    if state.yaw_deg is None:
        return None
    cos, sin = math.cos(math.radians(state.yaw_deg)), math.sin(math.radians(state.yaw_deg))
    return cos * x + sin * y, sin * x - cos * y, -down


def feedback_of(
    state: TelloState, flight: FlightState, captured_ns: int, axes: VelocityAxes, native: dict[str, Value]
) -> Feedback:
    """Return the drone's state in SI units and our axes. Values that the drone does not report are None."""
    acceleration = state.acceleration_mg
    factor = STANDARD_GRAVITY / 1000
    return Feedback(
        captured_ns=captured_ns,
        state=flight,
        battery=None if state.battery_percent is None else state.battery_percent / 100,
        roll_rad=_angle(state.roll_deg),
        pitch_rad=_angle(None if state.pitch_deg is None else -state.pitch_deg),
        yaw_rad=_angle(None if state.yaw_deg is None else -state.yaw_deg),
        altitude_m=height_m(state),
        velocity_m_s=velocity_m_s(state, axes),
        acceleration_m_s2=None
        if acceleration is None
        else (acceleration[0] * factor, -acceleration[1] * factor, -acceleration[2] * factor),
        native=native,
    )


def _angle(degrees: float | None) -> float | None:
    return None if degrees is None else wrap_angle(math.radians(degrees))


# The phase of flight -------------------------------------------------------------------------------------------------

STILL_NS: Final = nanoseconds(1.6)  #: time without an increase in the count of seconds after which the motors are off
GRACE_NS: Final = nanoseconds(2.5)  #: time to wait for a count that has just stopped or has not begun yet
LOW_M: Final = 0.15  #: maximum height that counts as near the ground
HIGH_M: Final = 0.25  #: minimum height that counts as off the ground
HOVER_M: Final = 0.4  #: minimum height at the end of a take-off
SLOW_DM_S: Final = 1.0  #: maximum vertical speed at the end of a take-off
SETTLED: Final = 3  #: number of consecutive samples within both limits that end a take-off
RISE_NS: Final = nanoseconds(8.0)  #: maximum duration of a take-off

_S = FlightState


class FlightWatch:
    """Tracks the phase of flight: UNKNOWN, LANDED, TAKING_OFF, HOVERING (in the air), LANDING.

    ``rising`` and ``sinking`` mean that a take-off or landing was requested and is not complete; ``landing_answered``
    means that the drone has replied that it landed.
    """

    def __init__(self) -> None:
        self.phase = _S.UNKNOWN
        self.rising = False
        self.sinking = False
        self.landing_answered = False
        self._motor_s: int | None = None
        self._counted_ns: int | None = None  # when the count last increased
        self._since_ns = 0  # when the count was first seen
        self._phase_ns = 0
        self._settled = 0

    @property
    def in_air(self) -> bool:
        """Whether the drone follows stick commands."""
        return self.phase is _S.HOVERING

    def motors(self, now_ns: int) -> bool | None:
        """Return whether the motors are running; None if unknown."""
        if self._counted_ns is not None and now_ns - self._counted_ns < STILL_NS:
            return True
        return None if self._motor_s is None or now_ns - self._since_ns < STILL_NS else False

    def update(self, state: TelloState, now_ns: int) -> None:
        self._count(state.motor_s, now_ns)
        height = height_m(state)
        slow = state.speed_dm_s is None or abs(state.speed_dm_s[2]) <= SLOW_DM_S
        self._settled = self._settled + 1 if slow and height is not None and height >= HOVER_M else 0
        phase = self._next(height, self.motors(now_ns), now_ns)
        if phase is not self.phase:
            self.phase, self._phase_ns = phase, now_ns

    def _count(self, motor_s: int | None, now_ns: int) -> None:
        if motor_s is None or motor_s == self._motor_s:
            return
        if self._motor_s is None:
            self._since_ns = now_ns
        elif motor_s > self._motor_s:
            self._counted_ns = now_ns
        self._motor_s = motor_s

    def _next(self, height: float | None, motors: bool | None, now_ns: int) -> FlightState:
        in_phase_ns = now_ns - self._phase_ns
        low = height is not None and height <= LOW_M
        high = height is not None and height >= HIGH_M
        if self.phase is _S.UNKNOWN:
            if motors:
                return _S.HOVERING
            return _S.LANDED if low or motors is False else _S.UNKNOWN
        if self.phase is _S.LANDED:
            return _S.TAKING_OFF if self._rises(high, motors, in_phase_ns) else _S.LANDED
        if motors is False and (low or in_phase_ns > GRACE_NS):
            return _S.LANDED
        if self.phase is _S.LANDING and low and self.landing_answered:
            return _S.LANDED
        if self.sinking:
            return _S.LANDING
        if self.phase is _S.TAKING_OFF and self._settled < SETTLED and in_phase_ns < RISE_NS:
            return _S.TAKING_OFF
        return _S.HOVERING

    def _rises(self, high: bool, motors: bool | None, in_phase_ns: int) -> bool:
        """Return whether a landed drone has taken off. Carrying the drone around does not count as a take-off."""
        # A count that increased before the landing says nothing about this take-off.
        begun = self._counted_ns is not None and self._counted_ns > self._phase_ns
        if self.rising and (high or (motors and begun)):
            return True
        return bool(high and motors and in_phase_ns > GRACE_NS)


# Health --------------------------------------------------------------------------------------------------------------

HOT_C: Final = 90.0  #: estimated limit: users report that the drone does not start its motors when somewhat hotter
COOL_C: Final = 85.0  #: temperature below which a hot drone no longer counts as hot
PAD_LOST: Final = 5  #: number of consecutive states without a pad after which the pad counts as out of view


class TelloHealth:
    """Reports changes in overheating and in the visible mission pad, each once."""

    def __init__(self) -> None:
        self._hot = False
        self._celsius: float | None = None
        self._pad = 0
        self._without = 0

    def changes(self, state: TelloState) -> list[VehicleEvent]:
        """Return events for the changes since the last call."""
        return self._temperature(state.temperature_c) + self._mission_pad(state)

    def diagnose(self) -> list[Diagnostic]:
        """Return a finding if the drone is too hot to fly; no finding while its temperature is unknown."""
        if self._celsius is None:
            return []
        if not self._hot:
            return [Diagnostic("temperature", True, f"{self._celsius:g} °C")]
        detail = f"{self._celsius:g} °C: when hotter, it refuses to start its motors or lands"
        return [Diagnostic("temperature", False, detail, "let it cool with its fan free, or fly: moving air cools it")]

    def _temperature(self, range_c: tuple[float, float] | None) -> list[VehicleEvent]:
        if range_c is None:
            return []
        highest = self._celsius = range_c[1]
        hot = highest >= (COOL_C if self._hot else HOT_C)
        if hot is self._hot:
            return []
        self._hot = hot
        text = f"the drone is hot: {highest:g} °C" if hot else "no longer: the drone is hot"
        return [message(text, "hot", Severity.WARNING if hot else Severity.INFO, active=hot, celsius=highest)]

    def _mission_pad(self, state: TelloState) -> list[VehicleEvent]:
        number = state.pad.number if state.pad is not None else 0
        self._without = 0 if number else self._without + 1
        if number == self._pad or (not number and self._without < PAD_LOST):
            return []
        before, self._pad = self._pad, number
        if state.pad is not None:
            return [_seen(state.pad)]
        return [message(f"mission pad m{before} is out of view", "mission_pad", pad=before, in_view=False)]


def _seen(pad: Pad) -> VehicleEvent:
    """Return the event for a pad in view, with the drone's position in the pad's axes [m]."""
    text = f"mission pad m{pad.number} is in view"
    if pad.place_cm is None:
        return message(text, "mission_pad", pad=pad.number, in_view=True)
    x, y, z = (part / 100 for part in pad.place_cm)
    return message(text, "mission_pad", pad=pad.number, in_view=True, place=(x, y, z))
