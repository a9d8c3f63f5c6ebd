"""The loops below an autopilot's modes: places, world velocities and headings, over a simulated vehicle. Pure."""

from __future__ import annotations

import math
from typing import Final

from skyloop.messages import AnyAction, Attitude, EmergencyStop, FlightState, Hover, Land, ResetEmergency, Takeoff
from skyloop.messages import Velocity as VelocityAction
from skyloop.messages.geometry import wrap_angle
from skyloop.sim.firmware.vehicle import Vehicle
from skyloop.sim.host import Report
from skyloop.sim.parameters import GRAVITY_M_S2, Limits
from skyloop.wire.mavlink.axes import Vector, turned

LIFT_M: Final = 0.3  #: what the simulated vehicle's own take-off does, before these loops go on
LIMITS: Final = Limits(
    tilt_rad=0.52, climb_m_s=2.5, yaw_rate_rad_s=2.5, altitude_m=100.0, speed_m_s=8.0, takeoff_altitude_m=LIFT_M
)
PLACE_GAIN_PER_S: Final = 0.9
YAW_GAIN_PER_S: Final = 2.0
YAW_RATE_RAD_S: Final = 1.5
GO_M_S: Final = 3.0
SINK_M_S: Final = 1.5
_CLIMB_LAG_S: Final = 0.33  #: of the simulated vehicle's climb loop
_AIRBORNE: Final = (FlightState.HOVERING, FlightState.FLYING)


class Flyer:
    """World axes east, north, up from where the vehicle stood when it was made; yaw counter-clockwise from east."""

    def __init__(self, vehicle: Vehicle) -> None:
        self.vehicle = vehicle
        self.place: Vector = (0.0, 0.0, 0.0)
        self.velocity: Vector = (0.0, 0.0, 0.0)  #: east, north, up
        self.yaw = 0.0
        self._home: tuple[float, float] | None = None
        self._sinking = 0.0  # climb rate under a collective thrust
        self._time_s = 0.0
        self._step_s = 0.0
        vehicle.set_limits(LIMITS)

    def update(self, report: Report) -> None:
        """What the vehicle believes now."""
        believed, (east, north, _) = report.believed, report.truth.position_m
        if self._home is None:
            self._home = east, north
        self._step_s, self._time_s = max(0.0, believed.time_s - self._time_s), believed.time_s
        self.yaw = believed.yaw_rad
        self.place = (east - self._home[0], north - self._home[1], believed.altitude_m)
        forward, left, up = believed.velocity_m_s
        self.velocity = (*turned(forward, left, self.yaw), up)

    @property
    def state(self) -> FlightState:
        return self.vehicle.state

    @property
    def airborne(self) -> bool:
        """Whether it takes set-points."""
        return self.vehicle.state in _AIRBORNE

    @property
    def standing(self) -> bool:
        return self.vehicle.state in (FlightState.LANDED, FlightState.EMERGENCY)

    # What it does, each to be said again at every tick -----------------------------------------------------------

    def lift_off(self) -> None:
        """From the ground, or out of a landing."""
        if self.vehicle.state in (FlightState.LANDED, FlightState.LANDING):
            self.vehicle.command(Takeoff())

    def hold(self) -> None:
        """Stay where it is."""
        self._fly(Hover())

    def land(self) -> None:
        if self.vehicle.state not in (FlightState.LANDING, FlightState.LANDED):
            self.vehicle.command(Land())

    def cut(self) -> None:
        """The motors stop, wherever it is."""
        self.vehicle.command(EmergencyStop())

    def lie(self) -> None:
        """After :meth:`cut`: once it lies on the ground it may start again."""
        if self.vehicle.state is FlightState.EMERGENCY:
            self.vehicle.command(ResetEmergency())

    def move(self, east: float, north: float, up: float, yaw_rate: float) -> None:
        """World velocity [m/s], yaw rate counter-clockwise [rad/s]."""
        forward, left = turned(east, north, -self.yaw)
        self.move_body(forward, left, up, yaw_rate)

    def move_body(self, forward: float, left: float, up: float, yaw_rate: float) -> None:
        """Velocity in levelled body axes."""
        self._fly(VelocityAction(forward, left, up, yaw_rate))

    def go(self, place: Vector, *, climb: float = SINK_M_S, yaw_rate: float = 0.0) -> None:
        """Towards a place, slower as it comes near."""
        east, north, up = (PLACE_GAIN_PER_S * (to - at) for to, at in zip(place, self.place, strict=True))
        speed = math.hypot(east, north)
        share = min(1.0, GO_M_S / speed) if speed > 0 else 1.0
        self.move(east * share, north * share, max(-climb, min(climb, up)), yaw_rate)

    def lean(self, roll: float, pitch: float, climb: float, yaw_rate: float) -> None:
        """Attitude with climb rate; signs are those of :class:`skyloop.messages.Attitude`."""
        self._sinking = self.velocity[2]
        self._fly(Attitude(roll, pitch, climb, yaw_rate))

    def lean_by_thrust(self, roll: float, pitch: float, thrust: float, yaw_rate: float) -> None:
        """Attitude with a collective thrust, as a share of the weight."""
        upward = GRAVITY_M_S2 * (thrust * math.cos(roll) * math.cos(pitch) - 1.0)
        self._sinking += upward * self._step_s
        self._sinking = max(self.velocity[2] - 1.0, min(self.velocity[2] + 1.0, self._sinking))
        self._fly(Attitude(roll, pitch, self._sinking + upward * _CLIMB_LAG_S, yaw_rate))

    def level_thrust(self) -> None:
        """A thrust set-point begins: from the present climb rate."""
        self._sinking = self.velocity[2]

    def yaw_rate_to(self, yaw: float) -> float:
        """The rate that turns to this heading."""
        return max(-YAW_RATE_RAD_S, min(YAW_RATE_RAD_S, YAW_GAIN_PER_S * wrap_angle(yaw - self.yaw)))

    def _fly(self, action: AnyAction) -> None:
        if not action.finite:
            action = Hover()  # what is no number moves nothing
        if self.vehicle.state is FlightState.LANDING:
            self.lift_off()  # the vehicle's way out of its landing
        if self.airborne:
            self.vehicle.command(action)
