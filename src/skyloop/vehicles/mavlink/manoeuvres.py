"""Position hold, velocity, position, attitude and take-off as MAVLink messages. Pure."""

from __future__ import annotations

import math
from typing import Final

from skyloop.clock import nanoseconds, seconds
from skyloop.messages import Attitude, Position, Velocity
from skyloop.messages.geometry import quaternion_from_euler, wrap_angle
from skyloop.vehicles.mavlink.autopilots import AutopilotProfile, ThrustModel
from skyloop.vehicles.mavlink.microservices import ACCEPTED, MavlinkCommandSender, VehicleCommand, result_name
from skyloop.vehicles.mavlink.telemetry import VehicleState
from skyloop.vehicles.mavlink.wire.axes import Vector, flip, swap, to_wire, yaw_between
from skyloop.vehicles.mavlink.wire.codec import Landed, Message
from skyloop.vehicles.mavlink.wire.codec import dialect as m

# Frames (MAV_FRAME) that both autopilots accept in SET_POSITION_TARGET_LOCAL_NED, and type masks of ignored fields.
WORLD: Final = 1
BODY: Final = 8  #: levelled body axes
VELOCITY_AND_YAW_RATE: Final = 0x5C7
POSITION: Final = 0xDF8
POSITION_AND_YAW: Final = 0x9F8
ATTITUDE_AND_THRUST: Final = 0x07  #: type mask for an attitude and a thrust without rates
VELOCITY_PERIOD_NS: Final = 40_000_000  #: time between repeats of a velocity or position: 25 Hz
ATTITUDE_PERIOD_NS: Final = 20_000_000  #: time between attitude set-points, each with a new heading in a turn: 50 Hz
MOST_YAW_LEAD_RAD: Final = 0.5  #: maximum lead of the requested heading over a vehicle that can't keep up
STOPPED_M_S: Final = 0.25  #: speed below which a vehicle holds its position instead of following a velocity of zero
STOPPING_S: Final = 3.0  #: time after which the vehicle holds its position in any case
MOST_STEP_S: Final = 0.1  #: longest time step of a set-point, used after a pause in the ticks
WAY_M_S: Final = 1.0  #: default speed to a position
WAY_TURN_RAD_S: Final = 0.8  #: default turn rate on the way to a position
WAY_M_S2: Final = 0.8  #: acceleration at the start, and deceleration at the end, of a flight to a position
LEASH_S: Final = 1.5  #: maximum lead of the sent position over the vehicle, as flight time at the requested speed
LEASH_M: Final = 0.3  #: minimum lead, as a distance

Target = tuple[int, int]  #: system and component


def velocity_message(action: Velocity, target: Target) -> Message:
    """Return a velocity set-point in levelled body axes."""
    x, y, z = flip(action.forward, action.left, action.up)
    return m.MAVLink_set_position_target_local_ned_message(
        0, *target, BODY, VELOCITY_AND_YAW_RATE, 0, 0, 0, x, y, z, 0, 0, 0, 0, 0.0 - action.yaw_rate
    )


def position_message(position: Vector, target: Target) -> Message:
    """Return a position set-point: north, east, down from the origin [m]."""
    return m.MAVLink_set_position_target_local_ned_message(
        0, *target, WORLD, POSITION, *position, 0, 0, 0, 0, 0, 0, 0, 0
    )


class PositionHold:
    """Stops the vehicle, then holds the position where it stopped."""

    period_ns = VELOCITY_PERIOD_NS

    def __init__(self, now_ns: int) -> None:
        self._begun_ns = now_ns
        self._position: Vector | None = None

    def message(self, vehicle: VehicleState, target: Target, now_ns: int) -> Message:
        slow = vehicle.velocity is not None and math.hypot(*vehicle.velocity) < STOPPED_M_S
        late = seconds(now_ns - self._begun_ns) > STOPPING_S
        if self._position is None and vehicle.position is not None and (slow or late):
            self._position = vehicle.position
        return (
            velocity_message(Velocity(), target) if self._position is None else position_message(self._position, target)
        )


class VelocitySetpoint:
    """Flies a velocity."""

    period_ns = VELOCITY_PERIOD_NS

    def __init__(self, action: Velocity) -> None:
        self.action = action

    def message(self, vehicle: VehicleState, target: Target, now_ns: int) -> Message:  # noqa: ARG002
        return velocity_message(self.action, target)


class PositionSetpoint:
    """Flies straight to a position and stays there.

    Autopilots fly to a position as fast as their own parameters allow. The position sent therefore moves towards the
    goal no faster than the action's speed, and stays near the vehicle.
    """

    period_ns = VELOCITY_PERIOD_NS

    def __init__(self, action: Position) -> None:
        self.action = action
        self._at: Vector | None = None  # position sent to the vehicle: north, east, down
        self._speed_m_s = 0.0
        self._yaw: float | None = None  # clockwise from north
        self._keep_yaw: float | None = None  # heading to keep if the action does not set one
        self._before_ns = 0

    def replace(self, action: Position) -> None:
        """Fly to another position, starting from the position last sent."""
        if self.action.yaw is not None and action.yaw is None:
            self._keep_yaw = None  # keep the vehicle's present heading
        self.action = action

    def hold_back(self) -> None:
        """Restart from the vehicle's present position, because the vehicle is not following yet."""
        self._at = self._yaw = None

    def message(self, vehicle: VehicleState, target: Target, now_ns: int) -> Message:
        """Return the set-point, which is a velocity of zero while the position or heading is unknown."""
        if vehicle.position is None or vehicle.yaw is None:
            self.hold_back()
            return velocity_message(Velocity(), target)
        if self._at is None or self._yaw is None:
            self._at, self._yaw, self._speed_m_s, self._before_ns = vehicle.position, vehicle.yaw, 0.0, now_ns
        step_s = min(MOST_STEP_S, seconds(now_ns - self._before_ns))
        self._before_ns = now_ns
        self._move(self._at, vehicle.position, step_s)
        self._turn(self._yaw, vehicle.yaw, step_s)
        return m.MAVLink_set_position_target_local_ned_message(
            0, *target, WORLD, POSITION_AND_YAW, *self._at, 0, 0, 0, 0, 0, 0, self._yaw, 0
        )

    def _move(self, at: Vector, vehicle: Vector, step_s: float) -> None:
        """Move the sent position towards the goal."""
        goal, most = swap(*self.action.place), self.action.speed or WAY_M_S
        left = math.dist(at, goal)
        self._speed_m_s = min(most, self._speed_m_s + WAY_M_S2 * step_s, math.sqrt(2.0 * WAY_M_S2 * left))
        step = self._speed_m_s * step_s
        at = goal if left <= max(step, 1e-3) else _between(at, goal, step / left)
        leash, ahead = max(LEASH_M, LEASH_S * most), math.dist(vehicle, at)
        self._at = at if ahead <= leash else _between(vehicle, at, leash / ahead)

    def _turn(self, yaw: float, heading: float, step_s: float) -> None:
        if self._keep_yaw is None:
            self._keep_yaw = heading
        goal = self._keep_yaw if self.action.yaw is None else yaw_between(self.action.yaw)
        most = (self.action.turn_rate or WAY_TURN_RAD_S) * step_s
        yaw += max(-most, min(most, wrap_angle(goal - yaw)))
        lead = wrap_angle(yaw - heading)
        self._yaw = wrap_angle(heading + max(-MOST_YAW_LEAD_RAD, min(MOST_YAW_LEAD_RAD, lead)))


def _between(start: Vector, end: Vector, share: float) -> Vector:
    x, y, z = (a + share * (b - a) for a, b in zip(start, end, strict=True))
    return x, y, z


class AttitudeSetpoint:
    """Flies an attitude with a climb rate and a yaw rate, turning the requested heading step by step."""

    period_ns = ATTITUDE_PERIOD_NS

    def __init__(self, action: Attitude, thrust: ThrustModel) -> None:
        self.action = action
        self._thrust = thrust
        self._yaw: float | None = None  # clockwise from north
        self._before_ns: int | None = None

    def within(self, action: Attitude) -> Attitude:
        """Return the attitude with the climb rate limited to what the autopilot accepts."""
        return Attitude(action.roll, action.pitch, self._thrust.limit_climb(action.climb), action.yaw_rate)

    def message(self, vehicle: VehicleState, target: Target, now_ns: int) -> Message:
        action = self.action
        step_s = 0.0 if self._before_ns is None else min(MOST_STEP_S, seconds(now_ns - self._before_ns))
        self._before_ns = now_ns
        yaw = self._turned(vehicle.yaw, action.yaw_rate, step_s)
        climbing = None if vehicle.velocity is None else -vehicle.velocity[2]
        tilt = math.hypot(action.roll, action.pitch)
        thrust = self._thrust.thrust(action.climb, climbing, tilt, step_s)
        q = to_wire(quaternion_from_euler(action.roll, -action.pitch, yaw))
        return m.MAVLink_set_attitude_target_message(0, *target, ATTITUDE_AND_THRUST, q, 0, 0, 0, thrust)

    def _turned(self, heading: float | None, yaw_rate: float, step_s: float) -> float:
        if self._yaw is None:
            self._yaw = heading if heading is not None else 0.0
        self._yaw -= yaw_rate * step_s
        if heading is not None:
            lead = wrap_angle(self._yaw - heading)
            self._yaw = heading + max(-MOST_YAW_LEAD_RAD, min(MOST_YAW_LEAD_RAD, lead))
        return self._yaw


Setpoint = PositionHold | VelocitySetpoint | PositionSetpoint | AttitudeSetpoint


PATIENCE_NS: Final = nanoseconds(6.0)  #: time without requests after which an unarmed take-off is given up
RISING_NS: Final = nanoseconds(12.0)  #: time allowed for an armed vehicle to leave the ground; 4.5 s is usual
ARM_PACE_S: Final = 1.0  #: time between repeated commands to arm or take off
ARMED_NS: Final = nanoseconds(2.5)  #: how long acknowledged arming is trusted without a confirming heartbeat
LANDED_NS: Final = nanoseconds(2.5)  #: time within which a landing disarms the vehicle, if at all (PX4: after 2 s)
ARM: Final = VehicleCommand(m.MAV_CMD_COMPONENT_ARM_DISARM, (1.0,))
LEFT_GROUND_M: Final = 0.3  #: climb that counts as a lift-off if the vehicle does not report a lift-off
CUT_SHORT: Final = 0.5  #: a hold below this fraction of the height means that another operator stopped a take-off
CUT_SHORT_M: Final = 1.05  #: and at least this far below: PX4 ends a take-off NAV_MC_ALT_RAD (0.8 m) below its height
STRAYED_NS: Final = nanoseconds(0.6)  #: how long another mode must be reported to count: messages may be reordered
STALLED_NS: Final = nanoseconds(6.0)  #: time without progress after which a climb counts as cancelled


class TakeoffSequence:
    """One take-off, from disarmed on the ground in any mode to a hover. Level-triggered.

    Each step requests what is missing: the mode for arming, then arming, then the command. Refusals are reported in the
    vehicle's own words, and refused steps are retried while the take-off is requested. ``asked_ns`` is the time of the
    last request; ``disarms`` is whether our unfinished landing may still disarm the vehicle.
    """

    def __init__(self, autopilot: AutopilotProfile, height_m: float, now_ns: int, *, disarms: bool = False) -> None:
        self.asked_ns = now_ns
        self.done = False
        self.given_up = ""  #: why the take-off was given up; empty if it was not given up
        self.taken_over = False  #: whether another operator chose a mode in the air
        self.declined = False  #: whether the take-off was given up because another operator chose a mode before arming
        self.rose = False  #: whether the vehicle has left the ground
        self.lead_ns: int | None = None  #: when set-points began to be sent
        self.reason = ""  #: the vehicle's own reason for refusing to arm
        self._autopilot = autopilot
        self._height_m = height_m
        self._begun_ns = now_ns
        self._disarms = disarms
        self._armed_ns: int | None = None  # when the vehicle was first seen armed or acknowledged arming
        self._climb_command: VehicleCommand | None = None
        self._best_m = -1.0
        self._best_ns = now_ns
        self._position: Vector | None = None
        self._position_ns: int | None = None
        self._ground_m: float | None = None
        self._other_ns: int | None = None
        self._sent_ns = 0
        self._seen = not autopilot.TAKING_OFF  # whether the take-off mode has been seen, if there is one
        self.refused = ""  #: why the vehicle is not armed yet
        self.arm_asked_ns: int | None = None  #: when arming was last requested; None if the vehicle was already armed
        self._arming_ns: int | None = None  # first arming request; earlier replies are to the landing's disarming
        self._ready = False  # arming was requested, or seen in our mode: another mode is another operator's choice

    @property
    def started(self) -> bool:
        """Whether the vehicle is armed for this take-off and no further requests are needed."""
        return self._armed_ns is not None and (self.rose or not self._disarms)

    def step(self, vehicle: VehicleState, commands: MavlinkCommandSender, now_ns: int) -> list[Message]:
        """Request what is missing and return the set-points that are due."""
        self._observe(vehicle, commands, now_ns)
        if self.done or self.given_up or self.taken_over or self._other_ns is not None:
            return []
        if self.rose:
            return self._climb(vehicle, commands.target, now_ns)
        if not vehicle.armed and vehicle.mode != self._autopilot.ARMING and self._climb_command is None:
            commands.request(self._autopilot.mode_command(self._autopilot.ARMING), now_ns)
        elif self._armed_ns is None:
            self.arm_asked_ns = now_ns
            self._arming_ns = now_ns if self._arming_ns is None else self._arming_ns
            self._ready = True
            commands.request(ARM, now_ns, ARM_PACE_S)
        elif vehicle.mode in (self._autopilot.ARMING, *self._autopilot.TAKING_OFF) or self._climb_command is not None:
            self._climb_command = self._climb_command or self._autopilot.takeoff_command(self._height_m, vehicle)
            if self._climb_command is not None:
                commands.request(self._climb_command, now_ns, ARM_PACE_S)
        else:
            commands.request(self._autopilot.mode_command(self._autopilot.ARMING), now_ns)
        return []

    def _observe(self, vehicle: VehicleState, commands: MavlinkCommandSender, now_ns: int) -> None:
        """Update the take-off's progress from the vehicle's state."""
        answer = None if self._arming_ns is None else commands.result(ARM.number, self._arming_ns)
        if self._armed_ns is None:
            if vehicle.armed or answer == ACCEPTED:
                self._armed_ns = now_ns
                self.refused = ""
                self._disarms = self._disarms and answer != ACCEPTED
            elif answer is not None:
                self.refused = f"arming was {result_name(answer)}" + (f": {self.reason}" if self.reason else "")
            if self._armed_ns is None and now_ns - self.asked_ns > PATIENCE_NS:
                self.given_up = self.refused or "the vehicle does not answer"
            self._observe_mode(vehicle, cut_short=False, now_ns=now_ns)
            if self.taken_over and not self.given_up:  # another pilot has decided otherwise: request nothing more
                self.taken_over, self.declined = False, True
                self.given_up = f"it changed to {vehicle.mode}, which was not chosen here: take off again"
            return
        if vehicle.armed and self._disarms:
            self._disarms = not self._landing_is_over(commands, now_ns)
        height = vehicle.altitude_m if vehicle.altitude_m is not None else 0.0
        self._seen = self._seen or vehicle.mode in self._autopilot.TAKING_OFF
        commanded = self._climb_command is not None or vehicle.mode in self._autopilot.TAKING_OFF
        self.rose = self.rose or (commanded and vehicle.armed and self._is_off_ground(vehicle.landed, height))
        cut_short = self._is_cut_short(vehicle)
        self._observe_mode(vehicle, cut_short, now_ns)
        if not vehicle.armed and not self.started:  # our previous landing disarmed the vehicle before this flight began
            self._armed_ns, self._climb_command, self._disarms = None, None, False
        elif not vehicle.armed and now_ns - self._armed_ns > ARMED_NS:
            self.given_up = "the vehicle disarmed itself"
        elif not self.rose and now_ns - self._armed_ns > RISING_NS:
            result = commands.result(m.MAV_CMD_NAV_TAKEOFF, self._begun_ns)
            refused = f": the take-off was {result_name(result)}" if result not in (None, ACCEPTED) else ""
            self.given_up = f"it does not leave the ground{refused}"
        elif self._other_ns is not None:
            pass  # a mode chosen by another operator never completes a take-off, whatever the height
        elif not cut_short and self._autopilot.has_taken_off(vehicle, self._height_m, self.rose and self._seen):
            self.done = True
        elif self._position_ns is not None and now_ns - self._position_ns > STALLED_NS:
            self.done = True  # the vehicle's reported altitude has stopped rising
        if height > self._best_m + 0.05:
            self._best_m, self._best_ns = height, now_ns

    def _landing_is_over(self, commands: MavlinkCommandSender, now_ns: int) -> bool:
        """Return whether our last landing can no longer disarm the vehicle, so a later disarming has another cause."""
        accepted = commands.result(m.MAV_CMD_NAV_TAKEOFF, self._begun_ns) == ACCEPTED
        return (accepted and not self._autopilot.TAKING_OFF) or now_ns - self._begun_ns > LANDED_NS

    def _is_off_ground(self, landed: Landed, height_m: float) -> bool:
        """Return whether the vehicle is off the ground according to its report or, if there is none, its altitude."""
        if landed is not Landed.UNKNOWN:
            return landed is not Landed.ON_GROUND
        if self._ground_m is None:
            self._ground_m = height_m
        return height_m - self._ground_m > LEFT_GROUND_M

    def _is_cut_short(self, vehicle: VehicleState) -> bool:
        """Return whether another operator chose position hold (in which take-offs also end) during the climb."""
        if not (self._autopilot.TAKING_OFF and self.rose and self._seen and vehicle.mode == self._autopilot.HOLD):
            return False
        below_m = None if vehicle.altitude_m is None else self._height_m - vehicle.altitude_m
        if self._climb_command is not None and vehicle.amsl_m is not None:
            below_m = self._climb_command.arguments[6] - vehicle.amsl_m  # home may move during the climb
        return below_m is not None and below_m > max(CUT_SHORT * self._height_m, CUT_SHORT_M)

    def _observe_mode(self, vehicle: VehicleState, cut_short: bool, now_ns: int) -> None:
        """Detect a mode chosen by another operator, on the ground or in the air."""
        autopilot, mode = self._autopilot, vehicle.mode
        ours = mode in autopilot.TAKING_OFF or (mode in (autopilot.ARMING, autopilot.GUIDED) and not cut_short)
        self._ready = self._ready or (ours and vehicle.armed)
        if ours or not (self.rose or self._ready):
            self._other_ns = None
        elif self._other_ns is None:
            self._other_ns = now_ns
        elif now_ns - self._other_ns >= STRAYED_NS:
            self.taken_over = True

    def _climb(self, vehicle: VehicleState, target: tuple[int, int], now_ns: int) -> list[Message]:
        """Return set-points if the guided mode requires them to be arriving before it starts.

        If the climb was cancelled, return a position to fly to, because nothing else restarts ArduCopter's climb.
        """
        stalled = now_ns - self._best_ns > STALLED_NS and vehicle.mode == self._autopilot.GUIDED
        if self._position is None:
            if not stalled or vehicle.position is None or vehicle.altitude_m is None:
                return self._lead(target, now_ns)
            north, east, down = vehicle.position
            self._position, self._position_ns = (north, east, down + vehicle.altitude_m - self._height_m), now_ns
        if now_ns - self._sent_ns < VELOCITY_PERIOD_NS:
            return []
        self._sent_ns = now_ns
        return [position_message(self._position, target)]

    def _lead(self, target: tuple[int, int], now_ns: int) -> list[Message]:
        if not self._autopilot.LEAD_S or now_ns - self._sent_ns < VELOCITY_PERIOD_NS:
            return []
        self._sent_ns = now_ns
        self.lead_ns = self.lead_ns or now_ns
        return [velocity_message(Velocity(), target)]
