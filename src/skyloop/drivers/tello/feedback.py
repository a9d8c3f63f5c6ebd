"""State strings to :class:`skyloop.messages.Feedback`: units, axes and signs. Pure."""

from __future__ import annotations

import math
from typing import Final

from skyloop.drivers.tello.options import VelocityAxes
from skyloop.messages import Feedback, FlightState, Value
from skyloop.messages.geometry import wrap_angle
from skyloop.wire.tello.state import GROUND_CM, State, Vector

STANDARD_GRAVITY: Final = 9.80665  #: m/s²


def height_m(state: State) -> float | None:
    """Above what is below: measured if it can be, else above the place of take-off.

    The distance sensor tells 10 cm on the ground; so does a drone that is 10 cm high, and then its height says so.
    """
    if state.distance_cm is not None:
        on_ground = state.distance_cm <= GROUND_CM and (state.height_cm or 0.0) < GROUND_CM
        return 0.0 if on_ground else state.distance_cm / 100
    if state.height_cm is not None and state.height_cm >= 0:
        return state.height_cm / 100
    return None


def velocity_m_s(state: State, axes: VelocityAxes) -> Vector | None:
    """Forward, left, up. ``vgx`` and its like are in dm/s: a Tello on its way by 1 m told 7 (DJITelloPy, issue 96)."""
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
    state: State, flight: FlightState, captured_ns: int, axes: VelocityAxes, native: dict[str, Value]
) -> Feedback:
    """The drone's state. What it does not tell, or tells as a number that can't be, is None."""
    acceleration = state.acceleration_mg
    factor = STANDARD_GRAVITY / 1000
    return Feedback(
        captured_ns=captured_ns,
        state=flight,
        battery=None if state.battery_percent is None else state.battery_percent / 100,
        roll=_angle(state.roll_deg),
        pitch=_angle(None if state.pitch_deg is None else -state.pitch_deg),
        yaw=_angle(None if state.yaw_deg is None else -state.yaw_deg),
        altitude=height_m(state),
        velocity=velocity_m_s(state, axes),
        acceleration=None
        if acceleration is None
        else (acceleration[0] * factor, -acceleration[1] * factor, -acceleration[2] * factor),
        native=native,
    )


def native_of(state: State) -> dict[str, Value]:
    """The state as the drone tells it, by its own names and in its own units."""
    return dict(state.fields)


def _angle(degrees: float | None) -> float | None:
    return None if degrees is None else wrap_angle(math.radians(degrees))
