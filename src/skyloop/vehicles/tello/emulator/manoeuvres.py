"""Tello commands that take time and are answered when they end. Pure: driven by reports."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, Protocol

from skyloop.messages import AnyAction, FlightState, Hover, Land, Takeoff, Velocity
from skyloop.messages.geometry import clamped, turned, wrap_angle
from skyloop.sim.host import Report
from skyloop.sim.world import Vec3

OK: Final = "ok"
SPIN_UP_S: Final = 0.8  #: time before a take-off leaves the ground; a recorded flight was airborne after 1.1 s
RISES_WITHIN_S: Final = 0.5  #: if it has not risen within this simulated time, take-off was refused for a low battery
TAKEOFF_ANSWER_S: Final = 8.7  #: time from command to reply in the same flight, although it hovered long before
FLIP_S: Final = 1.5  #: duration of a flip, an estimate; the simulated vehicle does not turn over
TURN_RAD_S: Final = 1.0  #: yaw rate of a turn, an estimate
PATIENCE_S: Final = 30.0  #: a command that takes longer than this fails
_NEAR_M: Final = 0.06  # a move ends within this distance …
_SLOW_M_S: Final = 0.12  # … and below this speed
_NEAR_RAD: Final = 0.03  # a turn ends within this angle
_FLYING: Final = (FlightState.HOVERING, FlightState.FLYING)

#: The vehicle's next command, and the reply if the job is over.
Step = tuple[AnyAction | None, str | None]


class Job(Protocol):
    """The execution of one command."""

    def step(self, report: Report) -> Step: ...


class Rising:
    """``takeoff``."""

    def __init__(self, report: Report) -> None:
        self._begun_s = report.truth.time_s
        self._commanded_s: float | None = None

    def step(self, report: Report) -> Step:
        """Return the next command, and the reply at the end."""
        now_s, state = report.truth.time_s, report.truth.state
        elapsed_s = now_s - self._begun_s
        if self._commanded_s is None:
            if elapsed_s < SPIN_UP_S:
                return None, None
            self._commanded_s = now_s
            return Takeoff(), None
        if state in (FlightState.LANDED, FlightState.EMERGENCY):
            # Measured from the command, because this step may run late on a busy machine.
            return None, "error" if now_s - self._commanded_s > RISES_WITHIN_S else None
        return None, OK if state in _FLYING and elapsed_s >= TAKEOFF_ANSWER_S else None


class Landing:
    """``land``, and the Tello's automatic landing if it receives no commands."""

    def step(self, report: Report) -> Step:
        """Return the next command, and the reply at the end."""
        if report.truth.state in (FlightState.LANDED, FlightState.EMERGENCY):
            return None, OK
        return (None if report.truth.state is FlightState.LANDING else Land()), None


class Flipping:
    """``flip``; only its duration is simulated."""

    def __init__(self, report: Report) -> None:
        self._until_s = report.truth.time_s + FLIP_S

    def step(self, report: Report) -> Step:
        """Return the reply at the end."""
        return None, OK if report.truth.time_s >= self._until_s else None


class Turning:
    """``cw`` and ``ccw``.

    Args:
        report: The present report.
        by_rad: Angle, positive counter-clockwise; may be several turns.
    """

    def __init__(self, report: Report, by_rad: float) -> None:
        self._left_rad = by_rad
        self._yaw_rad = report.truth.yaw_rad

    def step(self, report: Report) -> Step:
        """Return the next command, and the reply at the end."""
        self._left_rad -= wrap_angle(report.truth.yaw_rad - self._yaw_rad)
        self._yaw_rad = report.truth.yaw_rad
        if abs(self._left_rad) < _NEAR_RAD:
            return Hover(), OK
        return Velocity(yaw_rate=clamped(2.5 * self._left_rad, TURN_RAD_S)), None


class Going:
    """Moves, ``go`` and ``curve``.

    Args:
        report: The present report.
        places: Waypoints in world axes [m].
        speed_m_s: Speed along the way.
    """

    def __init__(self, report: Report, places: Sequence[Vec3], speed_m_s: float) -> None:
        self._places = list(places)
        self._speed_m_s = speed_m_s
        self._until_s = report.truth.time_s + PATIENCE_S

    def step(self, report: Report) -> Step:
        """Return the next command, and the reply at the end."""
        truth = report.truth
        if truth.time_s > self._until_s:
            return Hover(), "error"
        offset = [goal - here for goal, here in zip(self._places[0], truth.position_m, strict=True)]
        distance_m = math.hypot(*offset)
        last = len(self._places) == 1
        if distance_m < (_NEAR_M if last else 0.15) and (not last or math.hypot(*truth.velocity_m_s) < _SLOW_M_S):
            if last:
                return Hover(), OK
            del self._places[0]
            return None, None
        share = min(self._speed_m_s, 1.6 * distance_m) / max(distance_m, 1e-6)
        east, north, up = (part * share for part in offset)
        return Velocity(*turned(east, north, -truth.yaw_rad), up), None
