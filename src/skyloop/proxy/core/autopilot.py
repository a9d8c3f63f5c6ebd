"""The software autopilot: take-off, hover, land, velocity and position for vehicles that lack them. Pure.

Stepped from outside.

A vehicle that takes velocities gets velocities; one that takes only attitude with climb rate gets the output of a
velocity loop (proportional and integral, the common cascade of small multirotors: e.g. R. Mahony, V. Kumar, P. Corke,
"Multirotor Aerial Vehicles", IEEE Robotics & Automation Magazine 19(3), 2012). Signs are REP 103's: to accelerate
forward the nose goes down, which is positive pitch; to accelerate left the left side goes down, which is negative roll.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, auto
from typing import Final

from skyloop.clock import NS_PER_S, seconds
from skyloop.messages import Attitude, Feedback, FlightState, Hover, Land, Position, Takeoff, Velocity
from skyloop.messages.geometry import wrap_angle

PERIOD_S: Final = 0.02  #: the pace that it is made for
STALE_NS: Final = NS_PER_S // 2  #: older feedback is not steered by: level out instead
ALTITUDE_GAIN: Final = 1.0  #: climb per metre of altitude error [1/s]
POSITION_GAIN: Final = 0.6  #: speed per metre of position error [1/s]
POSITION_SPEED: Final = 0.5  #: at most [m/s]
GO_GAIN: Final = 0.9  #: on the way to a place: speed per metre that is left [1/s]
GO_SPEED: Final = 1.0  #: at most, where none is given [m/s]
GO_DECELERATION: Final = 0.6  #: towards it [m/s²]
TURN_GAIN: Final = 1.5  #: yaw rate per radian that is left [1/s]
TURN_RATE: Final = 1.2  #: at most, where none is given [rad/s]
SETTLED_SPEED: Final = 0.2  #: below it the place to hold is fixed [m/s]
ARRIVED: Final = 0.1  #: a take-off ends so far below its altitude [m]
TOUCH_ALTITUDE: Final = 0.1  #: below it the vehicle stands on the ground [m]
AIRBORNE_ALTITUDE: Final = 0.3  #: a vehicle first seen above it is taken to be flying [m]
STALL_ALTITUDE: Final = 0.5  #: below it a descent that makes no headway has met the ground [m]
STALL_NS: Final = NS_PER_S
STALL_HEADWAY: Final = 0.02  #: [m]
REFUSED_NS: Final = 15 * NS_PER_S  #: a vehicle that reports to stand so long after the take-off began does not rise
BLIND_LANDING_NS: Final = 15 * NS_PER_S  #: how long a landing takes where the altitude is not known

SOFTWARE: Final = frozenset({"takeoff", "hover", "land", "velocity", "position", "return_to_start"})


def software_actions(native: frozenset[str]) -> frozenset[str]:
    """What the autopilot adds to the actions that a vehicle itself takes."""
    if not native & {"attitude", "velocity"}:
        return frozenset()
    return SOFTWARE - native


@dataclass(frozen=True, slots=True)
class AutopilotSettings:
    """Tuning. Altitude [m], speeds [m/s], ``tilt`` [rad], gains [rad per m/s] and [rad per m]."""

    takeoff_altitude: float = 1.0
    climb: float = 0.5
    descent: float = 0.4
    velocity_p: float = 0.15
    velocity_i: float = 0.05
    tilt: float = 0.35


class Mode(Enum):
    """What the autopilot does now."""

    OFF = auto()
    TAKEOFF = auto()
    HOVER = auto()
    LAND = auto()
    VELOCITY = auto()
    POSITION = auto()


_STATES: Final = {
    Mode.TAKEOFF: FlightState.TAKING_OFF,
    Mode.HOVER: FlightState.HOVERING,
    Mode.LAND: FlightState.LANDING,
    Mode.VELOCITY: FlightState.FLYING,
    Mode.POSITION: FlightState.FLYING,
}
_STANDING: Final = (FlightState.LANDED, FlightState.EMERGENCY)


class Autopilot:
    """Flies one vehicle in software. ``native`` names the actions that the vehicle itself takes."""

    def __init__(self, native: frozenset[str], settings: AutopilotSettings | None = None) -> None:
        self.settings = settings or AutopilotSettings()
        self.mode = Mode.OFF
        #: On the way to a place: the velocity that is allowed instead of the wanted one, by the newest feedback.
        self.guard: Callable[[Velocity, Feedback, int], Velocity] = lambda wanted, _feedback, _now_ns: wanted
        self._state = FlightState.LANDED
        self._takes_velocity = "velocity" in native
        self._owns_state = not native & {"takeoff", "land"}  # such a vehicle has no notion of it
        self._target: Velocity | Position = Velocity()
        self._integral = (0.0, 0.0)  # forward, left [rad]
        self._stepped_ns: int | None = None
        self._begun_ns = 0
        self._was_up = False  # the vehicle reported to be in the air since this began
        self._hold_altitude: float | None = None
        self._hold_position: tuple[float, float] | None = None
        self._hold_yaw: float | None = None
        self._lowest = math.inf
        self._lowest_ns = 0

    def state(self, reported: FlightState) -> FlightState:
        """The flight state, given what the driver ``reported``: the vehicle's own state where it has one."""
        if reported is FlightState.EMERGENCY or (self.mode is Mode.LAND and reported is FlightState.LANDED):
            return reported
        if self._state is FlightState.EMERGENCY and reported.airborne:
            return reported  # the stop was given up, and it flies
        if self._owns_state or self.mode in (Mode.TAKEOFF, Mode.LAND):
            return self._state
        if reported is FlightState.FLYING and self.mode is Mode.HOVER:
            return FlightState.HOVERING
        return reported

    def on_first_feedback(self, feedback: Feedback) -> None:
        """The vehicle's first feedback: a proxy may have been restarted under a flying one."""
        if self.mode is Mode.OFF and (feedback.altitude_m or 0.0) > AIRBORNE_ALTITUDE:
            self._state = FlightState.FLYING

    def start(
        self, action: Takeoff | Hover | Land | Velocity | Position, now_ns: int, feedback: Feedback | None
    ) -> None:
        """Begin to do this; :meth:`step` goes on with it. Repeats of what is being done change nothing."""
        mode = _MODES[type(action)]
        if isinstance(action, Velocity | Position):
            if isinstance(self._target, Position) and self._target.yaw is not None:
                self._hold_yaw = None  # where it was turned to is kept from here on, not where it looked before
            self._target = action
        if mode is self.mode:
            return
        if self.mode is Mode.OFF:
            self._integral, self._stepped_ns = (0.0, 0.0), None
            self._was_up = False
        self.mode, self._state, self._begun_ns = mode, _STATES[mode], now_ns
        self._hold_position = self._hold_yaw = None
        self._hold_altitude = feedback.altitude_m if feedback is not None else None
        self._lowest, self._lowest_ns = math.inf, now_ns

    def stop(self, action_name: str) -> None:
        """The vehicle itself does something now: steer no longer."""
        self.mode = Mode.OFF
        if action_name == "emergency_stop":
            self._state = FlightState.EMERGENCY
        elif action_name == "reset_emergency":
            self._state = FlightState.LANDED
        elif self._state not in _STANDING:
            self._state = FlightState.HOVERING if action_name == "hover" else FlightState.FLYING

    def refused(self, reported: FlightState) -> None:
        """The vehicle refused what it was sent: a take-off of one that ``reported`` to stand is over."""
        if self.mode is Mode.TAKEOFF and reported is FlightState.LANDED:
            self.mode, self._state = Mode.OFF, FlightState.LANDED

    def step(
        self, now_ns: int, feedback: Feedback | None, reported: FlightState = FlightState.UNKNOWN
    ) -> Attitude | Velocity | None:
        """What to send to the vehicle now; None while off. To be called every :data:`PERIOD_S`.

        ``reported``: the flight state as the vehicle's driver reported it, which is not that of the ``feedback``.
        """
        if self.mode is Mode.OFF:
            return None
        known = feedback if feedback is not None and now_ns - feedback.captured_ns <= STALE_NS else None
        if known is not None and self._stands(reported, now_ns):
            self.mode, self._state = Mode.OFF, FlightState.LANDED
            return None
        wanted = self._wanted(now_ns, known)
        dt = PERIOD_S if self._stepped_ns is None else min(0.1, seconds(now_ns - self._stepped_ns))
        self._stepped_ns = now_ns
        if self._takes_velocity:
            return wanted
        roll, pitch = self._tilt(wanted, known, dt)
        return Attitude(roll, pitch, wanted.up, wanted.yaw_rate)

    def _stands(self, reported: FlightState, now_ns: int) -> bool:
        """Whether a vehicle that is flown from here stopped to fly by itself, or never began: it disarmed."""
        self._was_up = self._was_up or reported.airborne
        if reported is not FlightState.LANDED or not self._owns_state or self.mode is Mode.LAND:
            return False
        return self._was_up or (self.mode is Mode.TAKEOFF and now_ns - self._begun_ns >= REFUSED_NS)

    def _wanted(self, now_ns: int, known: Feedback | None) -> Velocity:
        altitude = known.altitude_m if known is not None else None
        if self.mode is Mode.TAKEOFF:
            return self._rise(now_ns, altitude)
        if self.mode is Mode.LAND:
            return self._descend(now_ns, altitude)
        if self.mode is Mode.HOVER:
            return self._hold(known, altitude)
        if isinstance(self._target, Position):
            return self._go(self._target, known, now_ns)
        return self._target

    def _rise(self, now_ns: int, altitude: float | None) -> Velocity:
        settings = self.settings
        if altitude is None:
            arrived = seconds(now_ns - self._begun_ns) >= settings.takeoff_altitude / settings.climb
        else:
            arrived = altitude >= settings.takeoff_altitude - ARRIVED
        if arrived:
            self.mode, self._state = Mode.HOVER, FlightState.HOVERING
            self._hold_altitude = settings.takeoff_altitude if altitude is not None else None
            return Velocity()
        return Velocity(up=settings.climb)

    def _descend(self, now_ns: int, altitude: float | None) -> Velocity:
        if altitude is None:
            touched = now_ns - self._begun_ns >= BLIND_LANDING_NS
        else:
            if altitude < self._lowest - STALL_HEADWAY:
                self._lowest, self._lowest_ns = altitude, now_ns
            stalled = altitude < STALL_ALTITUDE and now_ns - self._lowest_ns >= STALL_NS
            touched = altitude < TOUCH_ALTITUDE or stalled
        if touched:  # the descent stays in force, which keeps the vehicle on the ground
            self.mode, self._state = Mode.OFF, FlightState.LANDED
        return Velocity(up=-self.settings.descent)

    def _hold(self, known: Feedback | None, altitude: float | None) -> Velocity:
        up = 0.0
        if altitude is not None:
            if self._hold_altitude is None:
                self._hold_altitude = altitude
            up = _bound((self._hold_altitude - altitude) * ALTITUDE_GAIN, self.settings.climb)
        if known is None or known.position_m is None or known.yaw_rad is None:
            return Velocity(up=up)
        x, y, _ = known.position_m
        if self._hold_position is None:
            if known.velocity_m_s is None or math.hypot(*known.velocity_m_s[:2]) > SETTLED_SPEED:
                return Velocity(up=up)
            self._hold_position = (x, y)
        east, north = (self._hold_position[0] - x) * POSITION_GAIN, (self._hold_position[1] - y) * POSITION_GAIN
        cos, sin = math.cos(known.yaw_rad), math.sin(known.yaw_rad)
        forward, left = _shorten(cos * east + sin * north, cos * north - sin * east, POSITION_SPEED)
        return Velocity(forward, left, up)

    def _go(self, target: Position, known: Feedback | None, now_ns: int) -> Velocity:
        """Straight towards a place, and slower near it; a speed of zero while position or yaw are not known."""
        if known is None or known.position_m is None or known.yaw_rad is None:
            return Velocity()
        if self._hold_yaw is None:
            self._hold_yaw = known.yaw_rad
        east, north, up = (to - at for to, at in zip(target.place, known.position_m, strict=True))
        away = math.hypot(east, north, up)
        most = GO_SPEED if target.speed is None else target.speed
        speed = min(GO_GAIN * away, most, math.sqrt(2.0 * GO_DECELERATION * away))
        share = speed / away if away > 1e-9 else 0.0
        cos, sin = math.cos(known.yaw_rad), math.sin(known.yaw_rad)
        turn = wrap_angle((self._hold_yaw if target.yaw is None else target.yaw) - known.yaw_rad)
        wanted = Velocity(
            forward=share * (cos * east + sin * north),
            left=share * (cos * north - sin * east),
            up=share * up,
            yaw_rate=_bound(TURN_GAIN * turn, TURN_RATE if target.turn_rate is None else target.turn_rate),
        )
        return self.guard(wanted, known, now_ns)

    def _tilt(self, wanted: Velocity, known: Feedback | None, dt: float) -> tuple[float, float]:
        """Roll and pitch [rad] that bring the velocity to the wanted one; level while the velocity is not known."""
        if known is None or known.velocity_m_s is None:
            return 0.0, 0.0
        settings = self.settings
        forward_error, left_error = wanted.forward - known.velocity_m_s[0], wanted.left - known.velocity_m_s[1]
        integral = _shorten(
            self._integral[0] + settings.velocity_i * forward_error * dt,
            self._integral[1] + settings.velocity_i * left_error * dt,
            settings.tilt,
        )
        forward = settings.velocity_p * forward_error + integral[0]
        left = settings.velocity_p * left_error + integral[1]
        if math.hypot(forward, left) <= settings.tilt:  # else it would wind up
            self._integral = integral
        else:
            forward, left = _shorten(forward, left, settings.tilt)
        return -left, forward


_MODES: Final = {
    Takeoff: Mode.TAKEOFF,
    Hover: Mode.HOVER,
    Land: Mode.LAND,
    Velocity: Mode.VELOCITY,
    Position: Mode.POSITION,
}


def _bound(value: float, most: float) -> float:
    return max(-most, min(most, value))


def _shorten(x: float, y: float, most: float) -> tuple[float, float]:
    length = math.hypot(x, y)
    return (x, y) if length <= most else (x / length * most, y / length * most)
