"""How the emulated firmware flies: its supervisor, its watchdogs, set-points, and the high-level commander. Pure.

Times are simulation time. What the watchdogs do was seen on the firmware as a program for simulation.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from skyloop.errors import DecodeError
from skyloop.messages import FlightState
from skyloop.messages.geometry import clamped, turned, wrap_angle
from skyloop.sim.host import Report
from skyloop.sim.parameters import GRAVITY_M_S2, Limits
from skyloop.sim.world import Vec3
from skyloop.vehicles.crazyflie.emulator import trajectories
from skyloop.vehicles.crazyflie.emulator.trajectories import Flight, Place, Sample
from skyloop.vehicles.crazyflie.wire import commander as wire
from skyloop.vehicles.crazyflie.wire.commander import Supervisor
from skyloop.vehicles.crazyflie.wire.contents import CrtpError
from skyloop.vehicles.emulation.flight import FlightControl, Vehicle

LEVEL_S: Final = 0.5  #: time after the last low-level set-point when the vehicle levels …
CUT_S: Final = 2.0  #: … and when it cuts its motors, in the air
FLIES_ON_S: Final = 2.0  #: how long it counts as flying after its motors have stopped
SINK_M_S: Final = 0.1  #: rate of descent while it levels
KEEPALIVE_S: Final = 1.0  #: longest time between two resets of the watchdog for emergency stops
TUMBLED_RAD: Final = math.radians(80)
LIMITS: Final = Limits(
    tilt_rad=0.5, climb_m_s=2.0, yaw_rate_rad_s=5.0, altitude_m=20.0, speed_m_s=3.0, takeoff_altitude_m=0.3
)
_MARGIN_S: Final = 0.05
_START_M: Final = 0.06  # desired height above the ground at which a standing vehicle starts
_PLACE_GAIN_PER_S: Final = 1.3
_SPEED_GAIN_PER_S: Final = 3.0
_DRIFT_GAIN_PER_S3: Final = 0.5  # acceleration against a steady wind, per distance and time
_MOST_DRIFT_M_S2: Final = 1.5
_TILT_RAD: Final = 0.4  # maximum tilt along a path
_AHEAD_S: Final = 0.2  # how far ahead a path's velocity is taken, because attitude and climb lag behind
_HEIGHT_GAIN_PER_S: Final = 1.5
_YAW_GAIN_PER_S: Final = 2.5
_TRAJECTORIES: Final = 10  # number of trajectories that can be defined
_NOT_PERMITTED: Final = 1  # the error's number
_STILL: Final[Place] = (0.0, 0.0, 0.0, 0.0)

Parameter = Callable[[str], float]


@dataclass(slots=True)
class Frame:
    """The axes of the vehicle's own estimate in those of :class:`FlightControl`, which are the world's."""

    origin_m: Vec3 = (0.0, 0.0, 0.0)
    yaw_rad: float = 0.0

    def align(self, flight: FlightControl, place: Place) -> None:
        """Make the vehicle's present pose this one."""
        x, y, z, yaw = place
        self.yaw_rad = wrap_angle(flight.yaw - yaw)
        east, north = turned(x, y, self.yaw_rad)
        at = flight.place
        self.origin_m = (at[0] - east, at[1] - north, at[2] - z)

    def place(self, flight: FlightControl) -> Place:
        east, north, up = (at - origin for at, origin in zip(flight.place, self.origin_m, strict=True))
        return (*turned(east, north, -self.yaw_rad), up, wrap_angle(flight.yaw - self.yaw_rad))


class CrazyflieFlight:
    """The part of the firmware that may turn the motors. Not thread-safe."""

    def __init__(self, vehicle: Vehicle, parameter: Parameter, hover_thrust: float, *, auto_arm: bool = True) -> None:
        self._flight = FlightControl(vehicle)
        vehicle.set_limits(LIMITS)
        self._parameter = parameter
        self._full = 1.0 / hover_thrust  # full thrust as a multiple of the weight
        self.frame = Frame()
        self.target = Sample(_STILL, _STILL)  #: the desired place and velocity, in the frame
        self.external_m: Vec3 = (0.0, 0.0, 0.0)  #: newest position from outside
        self.memory = bytearray(4096)  #: uploaded trajectories
        self._trajectories: dict[int, wire.DefineTrajectory] = {}
        self._groups = 0
        self._auto_arm = auto_arm
        self._armed = auto_arm
        self._locked = False
        self._crashed = False
        self._keepalive_s: float | None = None  # newest reset of the watchdog; None until the first
        self._setpoint: wire.Message | None = None
        self._setpoint_s = 0.0
        self._low_level = False  # whether low-level set-points disable the high-level commander
        self._thrust_locked = True  # until the oldest set-point has been sent with thrust 0
        self._plan: Flight | None = None
        self._plan_s = 0.0
        self._lands = False
        self._ground_m = 0.0
        self._begun = False
        self._time_s = self._step_s = 0.0
        self._ran_s = -math.inf  # when the motors last ran
        self._drift = (0.0, 0.0)  # acceleration against a steady wind, in the frame [m/s²]
        self._tumbled = False

    # State -----------------------------------------------------------------------------------------------------------

    @property
    def place(self) -> Place:
        """Position and yaw of the vehicle's own estimate."""
        return self.frame.place(self._flight)

    @property
    def flying(self) -> bool:
        """Whether it counts as flying."""
        return self._time_s - self._ran_s < FLIES_ON_S

    @property
    def supervisor(self) -> int:
        """Bits of :class:`Supervisor`."""
        may = not (self._locked or self._crashed or self._tumbled)
        bits = {
            Supervisor.CAN_BE_ARMED: may and not self._armed,
            Supervisor.IS_ARMED: self._armed and not self._locked,
            Supervisor.IS_AUTO_ARMED: self._auto_arm,
            Supervisor.CAN_FLY: may and self._armed,
            Supervisor.IS_FLYING: self.flying,
            Supervisor.IS_TUMBLED: self._tumbled,
            Supervisor.IS_LOCKED: self._locked,
            Supervisor.IS_CRASHED: self._crashed,
            Supervisor.HIGH_LEVEL_ACTIVE: self._plan is not None and not self._low_level,
            Supervisor.TRAJECTORY_FINISHED: self._plan is None or self._elapsed_s >= self._plan.duration_s,
            Supervisor.HIGH_LEVEL_DISABLED: self._low_level,
        }
        return sum(bit for bit, on in bits.items() if on)

    @property
    def _elapsed_s(self) -> float:
        return self._time_s - self._plan_s

    # Messages --------------------------------------------------------------------------------------------------------

    def arm(self, wanted: bool) -> bool:
        """Arm or disarm, which stops the motors even in the air; return whether it was done.

        A vehicle that arms itself stays armed, in the air as well.
        """
        if wanted and (self._locked or self._crashed or self._tumbled):
            return False
        if wanted is not self._armed and not self._auto_arm:
            self._armed = wanted
            self._forget()  # an earlier set-point must not start the motors
        return True

    def recover(self) -> bool:
        """Leave the state "crashed" while the vehicle stands; return whether it was done."""
        if self._tumbled or not self._flight.standing:
            return False
        if self._crashed:
            self._crashed = False
            self._forget()  # an earlier set-point must not start the motors
        return True

    def crash(self) -> None:
        """Stop the motors until :meth:`recover`, because the vehicle hit something hard."""
        self._crashed = True
        self._forget()

    def lock(self) -> None:
        """Stop the motors until the firmware is restarted."""
        self._locked = True
        self._forget()

    def reset_estimate(self) -> None:
        """Begin at the place that the parameters give; in the air, the Flow deck still measures the height."""
        x, y, z, yaw = (self._parameter(f"kalman.initial{name}") for name in ("X", "Y", "Z", "Yaw"))
        self.frame.align(self._flight, (x, y, self.place[2] if self._flight.airborne else z, yaw))

    def correct(self, position_m: Vec3, yaw_rad: float | None = None) -> None:
        """Take a position from outside, and a yaw if it is known, as the estimate."""
        if not all(map(math.isfinite, (*position_m, yaw_rad or 0.0))):
            return
        self.external_m = position_m
        self.frame.align(self._flight, (*position_m, self.place[3] if yaw_rad is None else yaw_rad))

    def handle(self, message: wire.Message) -> int:
        """Handle a message except those about arming; return 0 or an error's number."""
        if not wire.is_finite(message):
            return CrtpError.INVALID
        match message:
            case wire.EmergencyStopMessage():
                self.lock()
            case wire.EmergencyWatchdog():
                self._keepalive_s = self._time_s
            case wire.ExternalPosition(x, y, z):
                self.correct((x, y, z))
            case wire.ExternalPoseMessage(x, y, z, qx, qy, qz, qw):
                self.correct((x, y, z), yaw_of((qx, qy, qz, qw)))
            case wire.NotifySetpointsStop():
                self._low_level = False  # without a new flight of the high-level commander, the motors stop
                self._setpoint = None
            case wire.SetGroupMask(mask):
                self._groups = mask
            case _ if hasattr(message, "groups") or isinstance(message, wire.DefineTrajectory):
                return self._high_level(message)
            case _:
                self._set(message)
        return CrtpError.NONE

    def _set(self, message: wire.Message) -> None:
        if isinstance(message, wire.RollPitchThrust):
            self._thrust_locked = self._thrust_locked and message.thrust > 0
            if self._thrust_locked:
                return
        self._plan = None
        self._low_level = True
        self._setpoint, self._setpoint_s = message, self._time_s

    def _high_level(self, message: wire.Message) -> int:
        groups = getattr(message, "groups", 0)
        if groups and not groups & self._groups:
            return CrtpError.NONE
        if isinstance(message, wire.DefineTrajectory):
            if message.trajectory >= _TRAJECTORIES:
                return CrtpError.NOT_EXECUTABLE
            self._trajectories[message.trajectory] = message
            return CrtpError.NONE
        if isinstance(message, wire.HighLevelStop):
            self._plan = None
            if not self._low_level:
                self._setpoint = None
            return CrtpError.NONE
        if isinstance(message, wire.HighLevelTakeoff) and self._plan is not None and not self._lands:
            return _NOT_PERMITTED
        try:
            plan = self._planned(message, self._start())
        except DecodeError:
            plan = None
        if plan is None or self._locked or self._crashed:
            return CrtpError.NONE  # the firmware does not say that it won't fly
        self._plan, self._plan_s = plan, self._time_s
        self._lands = isinstance(message, wire.HighLevelLand)
        if not self._low_level:
            self._setpoint = None
        return CrtpError.NONE

    def _start(self) -> Sample:
        """Return where the next flight of the high-level commander begins: where the present one is, if any."""
        if self._plan is not None and self._flight.airborne and not self._low_level:
            return self._plan.sample(self._elapsed_s)
        east, north, up = self._flight.velocity
        moving = (*turned(east, north, -self.frame.yaw_rad), up, 0.0)
        return Sample(self.place, moving if self._flight.airborne else _STILL)

    def _planned(self, message: wire.Message, start: Sample) -> Flight | None:
        x, y, z, yaw = start.place
        match message:
            case wire.HighLevelTakeoff(_, height, heading, keep, duration_s) | wire.HighLevelLand(
                _, height, heading, keep, duration_s
            ):
                return trajectories.move(start, (x, y, height, yaw if keep else heading), duration_s)
            case wire.GoTo():
                end = (message.x_m, message.y_m, message.z_m, message.yaw_rad)
                if message.relative:
                    end = (x + end[0], y + end[1], z + end[2], yaw + end[3])
                return trajectories.move(start, end, message.duration_s, linear=message.linear)
            case wire.Spiral():
                angle = math.copysign(message.angle_rad, -1 if message.clockwise else 1)
                radii = message.start_radius_m, message.end_radius_m
                if message.duration_s <= 0:
                    return None
                return trajectories.spiral(
                    start.place, angle, radii, message.ascent_m, message.duration_s, sideways=message.sideways
                )
            case wire.StartTrajectory():
                return self._uploaded(message, start.place)
        return None

    def _uploaded(self, message: wire.StartTrajectory, start: Place) -> Flight | None:
        defined = self._trajectories.get(message.trajectory)
        if defined is None or not defined.pieces or message.time_scale <= 0:
            return None
        read = trajectories.compressed_pieces if defined.kind else trajectories.polynomials
        return trajectories.trajectory(
            read(bytes(self.memory), defined.offset, defined.pieces),
            start,
            message.time_scale,
            relative=message.relative,
            relative_yaw=message.relative_yaw,
            backwards=message.reversed,
        )

    def _forget(self) -> None:
        self._setpoint = self._plan = None
        self._low_level = False

    # Flying ----------------------------------------------------------------------------------------------------------

    def update(self, report: Report) -> None:
        """Handle the vehicle's newest report, and fly. Called regularly."""
        flight, now_s = self._flight, report.believed.time_s
        self._step_s, self._time_s = min(0.1, now_s - self._time_s), now_s
        flight.update(report)
        if not self._begun:
            self._begun = True
            self.reset_estimate()
        if flight.standing:
            self._ground_m = self.place[2]
        tilt = max(abs(report.truth.roll_rad), abs(report.truth.pitch_rad))
        self._tumbled = flight.state is not FlightState.FLYING and tilt > TUMBLED_RAD
        if self._keepalive_s is not None and self._time_s - self._keepalive_s > KEEPALIVE_S:
            self.lock()
        if self._locked or self._crashed or not self._armed or self._parameter("stabilizer.stop"):
            self._off()
        elif self._plan is not None and not self._low_level:
            self._follow_plan(self._plan)
        else:
            self._follow_setpoint()
        if flight.state.airborne:
            self._ran_s = self._time_s

    def _follow_plan(self, plan: Flight) -> None:
        self.target = plan.sample(self._elapsed_s)
        if self._lands and self._elapsed_s >= plan.duration_s:
            if self._flight.standing or self.place[2] > self._ground_m + 0.3:
                self._plan = None  # the motors stop at the end of a landing, at any height
                self._setpoint = None
            else:
                self._flight.land()
            return
        self._track(self.target, plan.sample(self._elapsed_s + _AHEAD_S))

    def _follow_setpoint(self) -> None:
        message, age_s = self._setpoint, self._time_s - self._setpoint_s
        if message is not None and age_s > CUT_S - _MARGIN_S and self.flying and not self._flight.airborne:
            self.lock()  # the last set-point stopped the motors in flight
        elif age_s > LEVEL_S and not self.flying:
            self._forget()  # on the ground, the high-level commander may fly again
        if message is None or _stops(message):
            self._off()
        elif age_s > CUT_S and self._flight.airborne:
            self.lock()
        elif age_s > LEVEL_S:
            if self._flight.airborne:
                self._flight.lean(0.0, 0.0, -SINK_M_S, 0.0)
        else:
            self._apply(message)

    def _off(self) -> None:
        if self._flight.state.airborne:
            self._flight.cut()
        else:
            self._flight.lie()

    def _apply(self, message: wire.Message) -> None:
        x, y, z, yaw = self.place
        turn = math.radians(getattr(message, "yaw_rate_deg_s", 0.0))
        match message:
            case wire.RollPitchThrust(roll, pitch, _, thrust):
                lift = thrust / 65535 * self._full
                if self._parameter("flightmode.althold"):
                    climb = (thrust - 32767) / 32767 * self._parameter("posCtlPid.zVelMax")
                    self._lean(roll, pitch, climb, turn, starts=climb > 0)
                elif self._started(lift > 1.02):
                    self._flight.lean_by_thrust(math.radians(roll), math.radians(-pitch), lift, turn)
            case wire.VelocityWorldSetpoint(vx, vy, vz, _):
                self.target = Sample((x, y, z, yaw), (vx, vy, vz, turn))
                if self._started(vz > 0):
                    self._flight.move(*turned(vx, vy, self.frame.yaw_rad), vz, turn)
            case wire.ZDistanceSetpoint(roll, pitch, _, height):
                self._lean(roll, pitch, self._climb(height), turn, starts=self._rises(height))
            case wire.AltitudeHoldSetpoint(roll, pitch, _, climb):
                self._lean(roll, pitch, climb, turn, starts=climb > 0)
            case wire.HoverSetpoint(vx, vy, _, height):
                self.target = Sample((x, y, height, yaw), (vx, vy, 0.0, turn))
                if self._started(self._rises(height)):
                    self._flight.move_body(vx, vy, self._climb(height), turn)
            case wire.PositionSetpoint(px, py, pz, heading):
                self._track(Sample((px, py, pz, math.radians(heading)), _STILL))
            case wire.FullStateSetpoint():
                place = message.x_mm / 1000, message.y_mm / 1000, message.z_mm / 1000
                velocity = message.vx_mm_s / 1000, message.vy_mm_s / 1000, message.vz_mm_s / 1000
                heading = yaw_of(wire.decompressed(message.quaternion))
                self._track(Sample((*place, heading), (*velocity, message.yaw_rate_mrad_s / 1000)))

    def _rises(self, height: float) -> bool:
        return height > self._ground_m + _START_M

    def _started(self, starts: bool) -> bool:
        """Return whether the vehicle follows set-points; a standing one starts if ``starts``."""
        if self._flight.standing:
            self._flight.lie()
            if starts:
                self._flight.lift_off()
        return self._flight.airborne or self._flight.state is FlightState.LANDING

    def _climb(self, height: float) -> float:
        return clamped(_HEIGHT_GAIN_PER_S * (height - self.place[2]), self._parameter("posCtlPid.zVelMax"))

    def _lean(self, roll_deg: float, pitch_deg: float, climb: float, turn: float, *, starts: bool) -> None:
        if self._started(starts):
            self._flight.lean(math.radians(roll_deg), math.radians(-pitch_deg), climb, turn)

    def _track(self, wanted: Sample, ahead: Sample | None = None) -> None:
        """Fly along a path: by its acceleration, and towards its velocity and place.

        ``ahead`` is the path :data:`_AHEAD_S` later; None: the path is a single place.
        """
        self.target = wanted
        ahead = ahead or wanted
        if not self._started(self._rises(ahead.place[2])) or not self._flight.airborne:
            self._drift = (0.0, 0.0)
            return
        x, y, _, yaw = self.place
        ex, ey = wanted.place[0] - x, wanted.place[1] - y
        share = min(1.0, self._parameter("posCtlPid.xVelMax") / max(1e-9, _PLACE_GAIN_PER_S * math.hypot(ex, ey)))
        east, north, _ = self._flight.velocity
        vx, vy = turned(east, north, -self.frame.yaw_rad)
        step = _DRIFT_GAIN_PER_S3 * share * self._step_s
        self._drift = (
            clamped(self._drift[0] + step * ex, _MOST_DRIFT_M_S2),
            clamped(self._drift[1] + step * ey, _MOST_DRIFT_M_S2),
        )
        accelerations = [
            (later - now) / _AHEAD_S + drift + _SPEED_GAIN_PER_S * (now + _PLACE_GAIN_PER_S * share * error - speed)
            for now, later, drift, error, speed in zip(
                wanted.velocity[:2], ahead.velocity[:2], self._drift, (ex, ey), (vx, vy), strict=True
            )
        ]
        forward, left = turned(accelerations[0], accelerations[1], -yaw)
        rate = wanted.velocity[3] + _YAW_GAIN_PER_S * wrap_angle(wanted.place[3] - yaw)
        self._flight.lean(
            clamped(math.atan(-left / GRAVITY_M_S2), _TILT_RAD),
            clamped(math.atan(forward / GRAVITY_M_S2), _TILT_RAD),
            ahead.velocity[2] + self._climb(wanted.place[2]),
            clamped(rate, LIMITS.yaw_rate_rad_s),
        )


def _stops(message: wire.Message) -> bool:
    """Return whether a set-point turns the motors off."""
    least = 1000  # thrust below which the motors are off
    return isinstance(message, wire.StopSetpoint) or (
        isinstance(message, wire.RollPitchThrust) and message.thrust < least
    )


def yaw_of(quaternion: tuple[float, float, float, float]) -> float:
    """Return the yaw of a rotation x, y, z, w [rad]."""
    x, y, z, w = quaternion
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
