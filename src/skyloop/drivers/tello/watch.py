"""What the drone is doing, by what its state shows: no field of it says so. Pure.

``time`` grows by one each second while the motors run, and stands still otherwise; the distance sensor tells whether
the ground is near. What was asked for only names what is seen: a climb that was asked for is a take-off.
"""

from __future__ import annotations

from typing import Final

from skyloop.clock import nanoseconds
from skyloop.drivers.tello.feedback import height_m
from skyloop.messages import FlightState
from skyloop.wire.tello.state import State

STILL_NS: Final = nanoseconds(1.6)  #: the count of seconds stands still for so long: the motors are off
GRACE_NS: Final = nanoseconds(2.5)  #: a count that has just ended, or not begun, is waited for so long
LOW_M: Final = 0.15
HIGH_M: Final = 0.25
HOVER_M: Final = 0.4
SLOW_DM_S: Final = 1.0
SETTLED: Final = 3  #: samples in a row that are high and slow end a take-off
RISE_NS: Final = nanoseconds(8.0)  #: the longest that a take-off is taken for one

_S = FlightState


class FlightWatch:
    """Remembers the phase of flight: UNKNOWN, LANDED, TAKING_OFF, HOVERING (in the air), LANDING.

    ``rising`` and ``sinking``: whether a take-off or a landing was asked for and is not done. ``landing_answered``:
    whether the drone said that it landed.
    """

    def __init__(self) -> None:
        self.phase = _S.UNKNOWN
        self.rising = False
        self.sinking = False
        self.landing_answered = False
        self._motor_s: int | None = None
        self._counted_ns: int | None = None  # when the count grew
        self._since_ns = 0  # when it was first seen
        self._phase_ns = 0
        self._settled = 0

    @property
    def in_air(self) -> bool:
        """Whether it follows sticks."""
        return self.phase is _S.HOVERING

    def motors(self, now_ns: int) -> bool | None:
        """Whether they run; None while that can't be known."""
        if self._counted_ns is not None and now_ns - self._counted_ns < STILL_NS:
            return True
        return None if self._motor_s is None or now_ns - self._since_ns < STILL_NS else False

    def heard(self, state: State, now_ns: int) -> None:
        """The newest state."""
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
        """Whether a drone that stood does not any more. Being carried about is no take-off."""
        if self.rising and (high or motors):
            return True
        return bool(high and motors and in_phase_ns > GRACE_NS)
