"""The flying body (one drone of a simulation) and the control loops underneath an autopilot's modes. Pure.

The loops control position, world velocity and heading.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Protocol

from skyloop.messages import AnyAction, Attitude, EmergencyStop, FlightState, Hover, Land, ResetEmergency, Takeoff
from skyloop.messages import Velocity as VelocityAction
from skyloop.messages.geometry import clamped, turned, wrap_angle
from skyloop.sim.host import Report
from skyloop.sim.parameters import GRAVITY_M_S2, Limits
from skyloop.sim.simulation import Simulation
from skyloop.sim.world import Vec3


class Vehicle(Protocol):
    """A body with motors and an autopilot that can hold attitude, velocity and altitude."""

    @property
    def state(self) -> FlightState: ...

    @property
    def ceiling_m(self) -> float:
        """Height of its world [m]."""

    def command(self, action: AnyAction) -> AnyAction:
        """Command the body; return the applied action, or :class:`skyloop.messages.Idle` if it was ignored."""

    def set_limits(self, limits: Limits) -> None: ...


class SimulatedVehicle:
    """A drone in a simulation; see :class:`Vehicle`."""

    def __init__(self, simulation: Simulation, drone: int) -> None:
        self._simulation = simulation
        self._drone = drone

    @property
    def state(self) -> FlightState:
        return self._simulation.state(self._drone)

    @property
    def ceiling_m(self) -> float:
        return self._simulation.world.room.size_m[2]

    def command(self, action: AnyAction) -> AnyAction:
        return self._simulation.command(self._drone, action)

    def set_limits(self, limits: Limits) -> None:
        self._simulation.set_limits(self._drone, limits)


LIFT_M: Final = 0.3  #: height of the simulated vehicle's built-in take-off, after which these loops take over
LIMITS: Final = Limits(
    tilt_rad=0.52, climb_m_s=2.5, yaw_rate_rad_s=2.5, altitude_m=100.0, speed_m_s=8.0, takeoff_altitude_m=LIFT_M
)
PLACE_GAIN_PER_S: Final = 0.9  #: speed per metre of distance from a position
YAW_GAIN_PER_S: Final = 2.0  #: yaw rate per radian of heading error
YAW_RATE_RAD_S: Final = 1.5  #: maximum yaw rate while turning to a heading
GO_M_S: Final = 3.0  #: default horizontal speed towards a position
SINK_M_S: Final = 1.5  #: default rate of climb and descent towards a position
HEADROOM_M: Final = 1.0  #: clearance kept below the ceiling
_CLIMB_LAG_S: Final = 0.33  #: time constant of the simulated vehicle's climb loop
_AIRBORNE: Final = (FlightState.HOVERING, FlightState.FLYING)


@dataclass(frozen=True, slots=True)
class Speeds:
    """Speeds for flying to a position [m/s]."""

    across: float = GO_M_S
    up: float = SINK_M_S
    down: float = SINK_M_S


USUAL: Final = Speeds()


class FlightControl:
    """Flies a simulated vehicle to positions, or with a velocity, an attitude or a thrust.

    World axes are east, north, up from the vehicle's position at construction; yaw is counter-clockwise from east.
    Call one of the commands in every tick.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        self.vehicle = vehicle
        self.place: Vec3 = (0.0, 0.0, 0.0)
        self.velocity: Vec3 = (0.0, 0.0, 0.0)  #: east, north, up [m/s]
        self.yaw = 0.0
        self._home: tuple[float, float] | None = None
        self._sinking = 0.0  # climb rate while flying by collective thrust [m/s]
        self._time_s = 0.0
        self._step_s = 0.0
        vehicle.set_limits(LIMITS)

    def update(self, report: Report) -> None:
        believed, (east, north, _) = report.believed, report.truth.position_m
        if self._home is None:
            self._home = east, north
        self._step_s, self._time_s = max(0.0, believed.time_s - self._time_s), believed.time_s
        self.yaw = believed.yaw_rad
        self.place = (east - self._home[0], north - self._home[1], believed.altitude_m)
        forward, left, up = believed.velocity_m_s
        self.velocity = (*turned(forward, left, self.yaw), up)

    @property
    def time_s(self) -> float:
        """Simulation time at the newest report [s]."""
        return self._time_s

    @property
    def highest_m(self) -> float:
        """The maximum height that the vehicle can reach; a climb beyond it would never end."""
        return min(LIMITS.altitude_m, self.vehicle.ceiling_m) - HEADROOM_M

    @property
    def state(self) -> FlightState:
        return self.vehicle.state

    @property
    def airborne(self) -> bool:
        """Whether the vehicle follows set-points."""
        return self.vehicle.state in _AIRBORNE

    @property
    def standing(self) -> bool:
        """Whether the vehicle is on the ground, or its motors are cut."""
        return self.vehicle.state in (FlightState.LANDED, FlightState.EMERGENCY)

    # Commands; call one in every tick ----------------------------------------------------------------------------

    def lift_off(self) -> None:
        """Take off from the ground, or abort a landing and climb."""
        if self.vehicle.state in (FlightState.LANDED, FlightState.LANDING):
            self.vehicle.command(Takeoff())

    def hold(self) -> None:
        self._fly(Hover())

    def land(self) -> None:
        if self.vehicle.state not in (FlightState.LANDING, FlightState.LANDED):
            self.vehicle.command(Land())

    def cut(self) -> None:
        """Stop the motors, even in the air."""
        self.vehicle.command(EmergencyStop())

    def lie(self) -> None:
        """Allow another start after :meth:`cut`, once the vehicle is on the ground."""
        if self.vehicle.state is FlightState.EMERGENCY:
            self.vehicle.command(ResetEmergency())

    def move(self, east: float, north: float, up: float, yaw_rate: float) -> None:
        """Fly a world velocity [m/s] with a yaw rate, positive counter-clockwise [rad/s]."""
        forward, left = turned(east, north, -self.yaw)
        self.move_body(forward, left, up, yaw_rate)

    def move_body(self, forward: float, left: float, up: float, yaw_rate: float) -> None:
        """Fly at a velocity in levelled body axes [m/s] with a yaw rate, positive counter-clockwise [rad/s]."""
        self._fly(VelocityAction(forward, left, up, yaw_rate))

    def go(self, place: Vec3, speeds: Speeds = USUAL, *, yaw_rate: float = 0.0) -> None:
        """Fly towards a position (east, north, up from the origin [m]), slowing down near it."""
        east, north, up = (PLACE_GAIN_PER_S * (to - at) for to, at in zip(place, self.place, strict=True))
        speed = math.hypot(east, north)
        share = min(1.0, speeds.across / speed) if speed > 0 else 1.0
        self.move(east * share, north * share, max(-speeds.down, min(speeds.up, up)), yaw_rate)

    def lean(self, roll: float, pitch: float, climb: float, yaw_rate: float) -> None:
        """Fly an attitude with a climb rate, with the signs of :class:`skyloop.messages.Attitude`."""
        self._sinking = self.velocity[2]
        self._fly(Attitude(roll, pitch, climb, yaw_rate))

    def lean_by_thrust(self, roll: float, pitch: float, thrust: float, yaw_rate: float) -> None:
        """Fly an attitude with a collective thrust, given as a multiple of the weight."""
        upward = GRAVITY_M_S2 * (thrust * math.cos(roll) * math.cos(pitch) - 1.0)
        self._sinking += upward * self._step_s  # stays within 1 m/s of the real climb rate, so that errors don't add up
        self._sinking = max(self.velocity[2] - 1.0, min(self.velocity[2] + 1.0, self._sinking))
        self._fly(Attitude(roll, pitch, self._sinking + upward * _CLIMB_LAG_S, yaw_rate))

    def level_thrust(self) -> None:
        """Start flying by thrust with the current climb rate."""
        self._sinking = self.velocity[2]

    def yaw_rate_to(self, yaw: float) -> float:
        """Return the yaw rate that turns to this heading [rad/s]."""
        return clamped(YAW_GAIN_PER_S * wrap_angle(yaw - self.yaw), YAW_RATE_RAD_S)

    def _fly(self, action: AnyAction) -> None:
        if not action.finite:
            action = Hover()
        if self.vehicle.state is FlightState.LANDING:
            self.lift_off()  # aborts the landing
        if self.airborne:
            self.vehicle.command(action)
