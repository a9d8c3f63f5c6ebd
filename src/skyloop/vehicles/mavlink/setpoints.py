"""Turn the last action into the messages due at each tick. Pure.

Set-points are streamed only while a pilot is at the controls and the vehicle is in, or is changing to, the mode that
follows them. A failsafe, a lost link or another operator's mode change (see
:mod:`~skyloop.vehicles.mavlink.ownership`) ends the stream; then only the vehicle's own safety nets control it.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum, auto
from typing import Final

from skyloop.clock import nanoseconds
from skyloop.drivers.vehicle_session import KEPT_NS, MotorStop, VehicleEvent
from skyloop.errors import DriverError
from skyloop.messages import (
    AnyAction,
    Attitude,
    EmergencyStop,
    EventKind,
    FlightState,
    Hover,
    Idle,
    Land,
    Position,
    ResetEmergency,
    ReturnToStart,
    Severity,
    Takeoff,
    Velocity,
)
from skyloop.vehicles.mavlink.autopilots import AutopilotProfile, ThrustModel
from skyloop.vehicles.mavlink.manoeuvres import (
    ARMED_NS,
    STRAYED_NS,
    AttitudeSetpoint,
    PositionHold,
    PositionSetpoint,
    Setpoint,
    TakeoffSequence,
    VelocitySetpoint,
    velocity_message,
)
from skyloop.vehicles.mavlink.microservices import MavlinkCommandSender, VehicleCommand
from skyloop.vehicles.mavlink.ownership import FlightOwnership
from skyloop.vehicles.mavlink.telemetry import VehicleState
from skyloop.vehicles.mavlink.wire.codec import Landed, Message
from skyloop.vehicles.mavlink.wire.codec import dialect as m

FORCE: Final = 21196.0  #: argument of the disarm command that means "even in flight"
DISARM: Final = VehicleCommand(m.MAV_CMD_COMPONENT_ARM_DISARM, (0.0,))
CUT: Final = VehicleCommand(m.MAV_CMD_COMPONENT_ARM_DISARM, (0.0, FORCE))
SETTLING_NS: Final = nanoseconds(3.0)  #: a take-off counts as complete in any mode after this time at its height
DISARM_NS: Final = nanoseconds(0.5)  #: how long to keep disarming after the vehicle was last seen armed
IDLES_NS: Final = nanoseconds(12.0)  #: time within which an autopilot left armed on the ground disarms itself
STEP_NS: Final = nanoseconds(0.04)  #: time between steps of a take-off or landing while they only wait
HURRY_NS: Final = nanoseconds(0.008)  #: minimum time between a new set-point and the previous one


class Goal(Enum):
    """The vehicle's task."""

    NOTHING = auto()  #: no goal: the vehicle is left to itself or to other operators
    TAKE_OFF = auto()
    FOLLOW = auto()  #: follow streamed set-points, including hovering
    HOLD = auto()  #: hold position without streaming set-points
    LAND = auto()


class MavlinkSetpoints:
    """Stores the last action and sends the messages it requires, tick by tick. Not thread-safe.

    ``make_thrust`` creates the thrust model for an attitude-controlled flight; ``stop`` may be active already.
    """

    def __init__(
        self,
        autopilot: AutopilotProfile,
        commands: MavlinkCommandSender,
        takeoff_m: float,
        make_thrust: Callable[[], ThrustModel],
        stop: MotorStop | None = None,
    ) -> None:
        self.takeoff_m = takeoff_m
        self.goal = Goal.NOTHING
        self.stop = stop or MotorStop(lambda event: self._events.append(event))
        self.ownership = FlightOwnership(autopilot)
        self._autopilot = autopilot
        self._commands = commands
        self._make_thrust = make_thrust
        self._takeoff: TakeoffSequence | None = None
        self._setpoint: Setpoint | None = None
        self._lead_ns: int | None = None  # when the stream started
        self._sent_ns = 0
        self._followed: Velocity | None = None  # the velocity sent last; None if something else was sent
        self._entered = False  # whether the required mode has been seen
        self._strayed_ns: int | None = None  # when the vehicle left the required mode again
        self._settling_ns: int | None = None  # when a take-off reached its height and began to wait for the next mode
        self._stepped_ns = 0  # time of the last step; 0 if there was none
        self._arms_until_ns: int | None = None  # time until which a take-off aborted by a landing may arm the vehicle
        self._disarms_until_ns = 0  # time until which a failed or interrupted take-off may arm the vehicle
        self._blind_until_ns = 0
        self._repeats_refused = ""  # why repeats of a take-off are refused
        self._events: list[VehicleEvent] = []

    # Decisions ---------------------------------------------------------------------------------------------------

    def apply(
        self, action: AnyAction, vehicle: VehicleState | None, now_ns: int, *, alone: bool = False, new: bool = True
    ) -> AnyAction:
        """Accept an action; return the action in force, which is idle if the action is ignored.

        While an emergency stop is in force (see :class:`MotorStop`), a take-off is refused and all actions but the stop
        and its reset are ignored. ``alone``: whether a failsafe requested it while no pilot was in command; ``new``:
        whether an application just requested it, as opposed to a repeat by the library. Raises :class:`DriverError` if
        the action is not possible now, or another operator is flying the vehicle.
        """
        if isinstance(action, Idle):
            return action
        if isinstance(action, EmergencyStop):
            self._end()
            self.stop.press(now_ns)
            return action
        if isinstance(action, ResetEmergency):
            if vehicle is None:
                raise DriverError("no data from the vehicle: it may not be at rest")
            self.stop.reset()
            return action
        if self.stop.active:
            if isinstance(action, Takeoff):
                raise DriverError("the motors were stopped in an emergency: reset it first")
            return Idle()
        if alone and self._others_fly(vehicle):
            return Idle()
        if not alone:
            self.ownership.check(action, now_ns, new=new)
        if isinstance(action, Takeoff):
            self._take_off(vehicle, now_ns, new=new)
        elif isinstance(action, Land):
            if not (self.goal is Goal.LAND and self._entered and (alone or not new)):  # repeats respect foreign modes
                self._land(vehicle)
        elif isinstance(action, Hover):
            self._hover(vehicle, now_ns, alone=alone)
        else:
            assert not isinstance(action, ReturnToStart)  # the proxy converts this action to positions
            action = self._steer(action, vehicle, now_ns)
        if vehicle is None and new and not alone and isinstance(action, Hover | Land):
            self._blind_until_ns = now_ns + KEPT_NS
        if self.goal is not Goal.NOTHING and not isinstance(action, Idle):
            self.ownership.take(action, vehicle, alone=alone, new=new)
        return action

    def _others_fly(self, vehicle: VehicleState | None) -> bool:
        """Return whether another operator is flying the vehicle while no pilot is at our controls."""
        if self.ownership.others:
            return True
        if vehicle is None or vehicle.airborne is False or self.goal is Goal.TAKE_OFF:
            return False
        if not self.ownership.is_foreign(vehicle):
            return False
        return not self._leave(vehicle)

    def _take_off(self, vehicle: VehicleState | None, now_ns: int, *, new: bool) -> None:
        if vehicle is None:
            raise DriverError("no data from the vehicle: take-off is refused until the link is up")
        self._repeats_refused = "" if new else self._repeats_refused
        if self._repeats_refused:
            raise DriverError(self._repeats_refused)
        if self.goal is Goal.TAKE_OFF and self._takeoff is not None:
            self._takeoff.asked_ns = now_ns
            if self._takeoff.refused and not self._takeoff.started:
                raise DriverError(f"the vehicle does not start yet, retrying: {self._takeoff.refused}")
        elif vehicle.airborne is None:
            raise DriverError("the vehicle is armed and has not reported yet whether it is in the air")
        elif not vehicle.airborne:
            takeoff = TakeoffSequence(self._autopilot, self.takeoff_m, now_ns, disarms=self.goal is Goal.LAND)
            self._end()
            if now_ns < self._disarms_until_ns:  # the previous take-off has armed the vehicle or may still do so
                takeoff.arm_asked_ns = now_ns
            self.goal, self._takeoff, self._disarms_until_ns = Goal.TAKE_OFF, takeoff, 0
        elif self.goal is not Goal.FOLLOW:
            self._follow(PositionHold(now_ns))

    def _land(self, vehicle: VehicleState | None) -> None:
        arms_until_ns = self._arms_until_ns
        if self._takeoff is not None and self._takeoff.arm_asked_ns is not None:
            arms_until_ns = self._takeoff.arm_asked_ns + ARMED_NS
        self._end()
        if vehicle is None or vehicle.airborne or vehicle.armed or arms_until_ns is not None:
            self.goal, self._arms_until_ns = Goal.LAND, arms_until_ns

    def _hover(self, vehicle: VehicleState | None, now_ns: int, *, alone: bool) -> None:
        if self.goal is Goal.TAKE_OFF and self._takeoff is not None and (alone or not self._takeoff.rose):
            if not alone:
                self._land(vehicle)  # the take-off has been cancelled: stay on the ground
            return  # a take-off ends in a hover
        if vehicle is not None and vehicle.airborne is False:
            if self.goal is not Goal.LAND:  # a landing keeps disarming a vehicle that is armed or may soon be
                self._end()
        elif alone or vehicle is None or (vehicle.airborne is None and self.goal is not Goal.FOLLOW):
            self._end()  # a set-point would start some vehicles on the ground
            self.goal = Goal.HOLD
        elif self.goal is not Goal.FOLLOW or not isinstance(self._setpoint, PositionHold):
            self._follow(PositionHold(now_ns))

    def _steer(self, action: Velocity | Attitude | Position, vehicle: VehicleState | None, now_ns: int) -> AnyAction:
        if vehicle is None:
            raise DriverError("no data from the vehicle: set-points are refused until the link is up")
        if vehicle.airborne is False or self.goal is Goal.TAKE_OFF:
            return Idle()  # a set-point would cancel a take-off
        if vehicle.airborne is None and self.goal is not Goal.FOLLOW:
            return Idle()  # a set-point would start some vehicles on the ground
        if isinstance(action, Velocity):
            if isinstance(self._setpoint, VelocitySetpoint) and self.goal is Goal.FOLLOW:
                self._setpoint.action = action
            else:
                self._follow(VelocitySetpoint(action))
        elif isinstance(action, Position):
            if isinstance(self._setpoint, PositionSetpoint) and self.goal is Goal.FOLLOW:
                self._setpoint.replace(action)
                return action  # not urgent, because the position sent moves step by step
            self._follow(PositionSetpoint(action))
        else:
            if not (isinstance(self._setpoint, AttitudeSetpoint) and self.goal is Goal.FOLLOW):
                self._follow(AttitudeSetpoint(action, self._make_thrust()))
            assert isinstance(self._setpoint, AttitudeSetpoint)
            action = self._setpoint.within(action)
            self._setpoint.action = action
        if now_ns - self._sent_ns >= HURRY_NS:
            self._sent_ns = 0  # send the new set-point at once
        return action

    def _follow(self, setpoint: Setpoint) -> None:
        streaming = self.goal is Goal.FOLLOW
        lead_ns, entered = (self._lead_ns, self._entered) if streaming else (None, False)
        self._end()
        self.goal, self._setpoint = Goal.FOLLOW, setpoint
        self._lead_ns, self._entered = lead_ns, entered
        self._sent_ns = 0

    def _end(self) -> None:
        """Give up the goal and end the stream."""
        self.goal, self._takeoff, self._setpoint = Goal.NOTHING, None, None
        self._stepped_ns = 0
        self._arms_until_ns = None
        self._lead_ns, self._entered, self._strayed_ns, self._settling_ns = None, False, None, None

    # Reports --------------------------------------------------------------------------------------------------------

    def on_link_lost(self) -> None:
        """End the stream, which does not resume when the link returns; the vehicle must hold its position."""
        if self.goal is Goal.FOLLOW:
            self._end()
            self.goal = Goal.HOLD
        elif self.goal is Goal.TAKE_OFF and self._takeoff is not None:
            takeoff = self._takeoff
            self._end()
            self.goal = Goal.HOLD if takeoff.started else Goal.NOTHING
            if takeoff.arm_asked_ns is not None and not takeoff.rose:  # the vehicle may be armed on the ground
                self._disarms_until_ns = takeoff.arm_asked_ns + IDLES_NS
        self._entered, self._strayed_ns = False, None  # mode changes during the outage are the vehicle's own
        self.ownership.on_link_lost()

    def forget_landing(self) -> bool:
        """Abort a landing; return whether one was in progress."""
        lands = self.goal is Goal.LAND
        if lands:
            self._end()
        return lands

    def on_prearm_reason(self, reason: str) -> None:
        """Store the vehicle's own reason for refusing to arm."""
        if self._takeoff is not None:
            self._takeoff.reason = reason

    def state(self, vehicle: VehicleState | None) -> FlightState:
        """Return the flight state as far as it is known."""
        if vehicle is None:
            return FlightState.UNKNOWN
        if self.stop.shown:
            return FlightState.EMERGENCY
        if self._arms_until_ns is not None and not vehicle.airborne:
            return FlightState.LANDING  # the vehicle is armed, or may be at any moment
        if self.goal is Goal.TAKE_OFF and self._takeoff is not None and self._takeoff.started:
            return FlightState.TAKING_OFF
        if vehicle.airborne is None:
            return FlightState.UNKNOWN
        if not vehicle.airborne:
            return FlightState.LANDED
        if vehicle.mode in self._autopilot.LANDING or vehicle.landed is Landed.LANDING:
            return FlightState.LANDING
        if vehicle.mode in self._autopilot.TAKING_OFF or vehicle.landed is Landed.TAKING_OFF:
            return FlightState.TAKING_OFF
        if self._settling_ns is not None:
            return FlightState.TAKING_OFF
        if vehicle.mode in self._autopilot.HOLDING:
            return FlightState.HOVERING
        if vehicle.mode != self._autopilot.GUIDED:
            return FlightState.FLYING
        return (
            FlightState.FLYING
            if isinstance(self._setpoint, VelocitySetpoint | PositionSetpoint | AttitudeSetpoint)
            else FlightState.HOVERING
        )

    # Messages ----------------------------------------------------------------------------------------------------

    def pop_events(self) -> list[VehicleEvent]:
        events, self._events = self._events, []
        return events

    def messages(self, vehicle: VehicleState, now_ns: int, *, read: bool = True) -> list[Message]:
        """Return the set-points that are due, and pass commands to the command sender.

        ``read``: whether the vehicle seems to process commands promptly, judging by its messages. If not, a changed
        velocity might wait in a buffer and take effect late, so zero velocity is sent, which is harmless even if late.
        """
        due, setpoint = self._due_messages(vehicle, now_ns), self._setpoint
        wanted = setpoint.action if isinstance(setpoint, VelocitySetpoint) else None
        if not read and not self._holds:
            if not due or wanted is None or wanted == self._followed:
                return []
            wanted, due = Velocity(), [velocity_message(Velocity(), self._commands.target)]
        if due:
            self._followed = wanted
        return due

    def _due_messages(self, vehicle: VehicleState, now_ns: int) -> list[Message]:
        self._stepped_ns = now_ns
        if self.step_stop(vehicle, now_ns):
            return []
        if self.goal is Goal.TAKE_OFF:
            return self._step_takeoff(vehicle, now_ns)
        if self.goal is Goal.NOTHING and now_ns < self._disarms_until_ns:
            self._undo_arming(vehicle, now_ns)
        if vehicle.airborne is False and self.goal is not Goal.LAND:
            self._flight_is_over()
        elif self.ownership.observe(vehicle, now_ns):
            if self.ownership.is_lost(now_ns):
                self._leave(vehicle)
            return []
        if self.goal is Goal.FOLLOW:
            return self._step_following(vehicle, now_ns)
        if self.goal is Goal.HOLD:
            return self._step_hold(vehicle, now_ns)
        if self.goal is Goal.LAND:
            self._step_land(vehicle, now_ns)
        return []

    @property
    def _holds(self) -> bool:
        """Return whether the vehicle should stay where it is in the air."""
        setpoint = self._setpoint
        stops = isinstance(setpoint, VelocitySetpoint) and setpoint.action == Velocity()
        return self.goal is Goal.HOLD or (self.goal is Goal.FOLLOW and (stops or isinstance(setpoint, PositionHold)))

    def step_stop(self, vehicle: VehicleState | None, now_ns: int) -> bool:
        """Send an emergency stop if one is due, even if nothing is being received; return whether one is in force."""
        if not self.stop.active:
            return False
        shown = None
        if vehicle is not None and self.stop.settled(vehicle.heartbeat_ns):
            shown = not vehicle.armed
        if self.stop.step(shown, now_ns):
            self._commands.request(CUT, now_ns, 0.0)
        return True

    def step_blind(self, now_ns: int) -> bool:
        """Send a new hover or landing while nothing is being received; return whether a command is in progress.

        The vehicle may still receive the command. A failsafe's requests are not sent in this way, because by now
        another operator may be flying the vehicle without our knowing.
        """
        modes = {Goal.HOLD: self._autopilot.HOLD, Goal.LAND: self._autopilot.LAND}
        if self.stop.active or now_ns >= self._blind_until_ns or self.goal not in modes:
            return False
        self._ask_for(modes[self.goal], now_ns)
        return True

    def due_ns(self, now_ns: int) -> int | None:
        """Return when :meth:`messages` will next have something to send; None if unknown."""
        if self.stop.active:
            return None if self.stop.shown else now_ns
        if self.goal in (Goal.TAKE_OFF, Goal.HOLD, Goal.LAND):
            return self._stepped_ns + STEP_NS
        if self.goal is Goal.FOLLOW and self._setpoint is not None:
            return self._sent_ns + self._setpoint.period_ns
        return None

    def _flight_is_over(self) -> None:
        """Discard the state of the flight, so that the vehicle's next pilot starts from scratch."""
        self._end()
        self.ownership.on_flight_over()

    def _step_takeoff(self, vehicle: VehicleState, now_ns: int) -> list[Message]:
        takeoff = self._takeoff
        assert takeoff is not None
        self.ownership.on_mode(vehicle.mode)
        messages = takeoff.step(vehicle, self._commands, now_ns)
        if takeoff.done:
            self._follow(PositionHold(now_ns))
            self._lead_ns, self._settling_ns = takeoff.lead_ns, now_ns
        elif takeoff.taken_over:
            self._leave(vehicle)
        elif takeoff.given_up:
            self._notify(f"the vehicle did not take off: {takeoff.given_up}", reason="no_takeoff")
            self._repeats_refused = takeoff.given_up if takeoff.declined else ""
            self._end()
            if takeoff.arm_asked_ns is not None:
                self.goal = Goal.LAND if vehicle.armed else Goal.NOTHING
                self._disarms_until_ns = takeoff.arm_asked_ns + ARMED_NS
        return messages

    def _undo_arming(self, vehicle: VehicleState, now_ns: int) -> None:
        """Disarm the vehicle after a take-off that failed or was interrupted by a lost link.

        If the vehicle is rising or in another mode, another operator armed it.
        """
        if vehicle.airborne or vehicle.mode not in (self._autopilot.ARMING, self._autopilot.HOLD):
            self._disarms_until_ns = 0
        elif vehicle.armed and vehicle.airborne is False:
            self._disarms_until_ns = max(self._disarms_until_ns, now_ns + DISARM_NS)
            self._commands.request(DISARM, now_ns)

    def _step_following(self, vehicle: VehicleState, now_ns: int) -> list[Message]:
        assert self._setpoint is not None
        inside = vehicle.mode == self._autopilot.GUIDED
        if inside or (self._settling_ns is not None and now_ns - self._settling_ns > SETTLING_NS):
            self._settling_ns = None
        if self._strayed(vehicle.mode, inside, now_ns):
            self._leave(vehicle)
            return []
        if self._lead_ns is None:
            self._lead_ns = now_ns
        if not (inside or self._entered) and now_ns - self._lead_ns >= nanoseconds(self._autopilot.LEAD_S):
            self._ask_for(self._autopilot.GUIDED, now_ns)
        if now_ns - self._sent_ns < self._setpoint.period_ns:
            return []
        self._sent_ns = now_ns
        if not inside and isinstance(self._setpoint, PositionSetpoint):
            self._setpoint.hold_back()
        return [self._setpoint.message(vehicle, self._commands.target, now_ns)]

    def _ask_for(self, mode: str, now_ns: int) -> None:
        self.ownership.on_mode_asked(mode, now_ns)
        self._commands.request(self._autopilot.mode_command(mode), now_ns)

    def _strayed(self, mode: str, inside: bool, now_ns: int) -> bool:
        """Return whether the vehicle left the required mode again more than :data:`STRAYED_NS` ago.

        A mode that may be the delayed effect of our own command does not count.
        """
        if inside:
            self._entered, self._strayed_ns = True, None
        elif self._entered and self.ownership.was_just_asked(mode, now_ns):
            self._entered, self._strayed_ns = False, None
        elif self._entered and self._strayed_ns is None:
            self._strayed_ns = now_ns
        return self._strayed_ns is not None and now_ns - self._strayed_ns >= STRAYED_NS

    def _leave(self, vehicle: VehicleState) -> bool:
        """Leave the vehicle in a mode that someone else chose; return whether we may still hold or land the vehicle."""
        why = "its own failsafe" if vehicle.failsafe else "not chosen here"
        self._notify(f"the vehicle changed to {vehicle.mode} ({why}): no more set-points are sent", reason="mode")
        self._end()
        ours = self.ownership.leave(vehicle)
        if ours:
            self.goal = Goal.HOLD
        return ours

    def _step_hold(self, vehicle: VehicleState, now_ns: int) -> list[Message]:
        if vehicle.mode in self._autopilot.HOLDING or vehicle.mode in self._autopilot.LANDING:
            self._end()
            return []
        self._ask_for(self._autopilot.HOLD, now_ns)
        if vehicle.mode == self._autopilot.GUIDED and now_ns - self._sent_ns >= PositionHold.period_ns:
            self._sent_ns = now_ns  # stop the vehicle until the mode is reported, or if the mode is refused
            return [velocity_message(Velocity(), self._commands.target)]
        return []

    def _step_land(self, vehicle: VehicleState, now_ns: int) -> None:
        inside = vehicle.mode in self._autopilot.LANDING
        arms_until_ns = self._arms_until_ns
        if vehicle.armed and arms_until_ns is not None:
            self._arms_until_ns = 0  # the late arming has happened: once disarmed, the vehicle stays disarmed
        if not vehicle.armed and (arms_until_ns is None or vehicle.heartbeat_ns >= arms_until_ns):
            self._flight_is_over()
        elif vehicle.airborne is False:
            self._commands.request(DISARM, now_ns)
        elif self._strayed(vehicle.mode, inside, now_ns):
            self._leave(vehicle)
        elif not (inside or self._entered):
            self._ask_for(self._autopilot.LAND, now_ns)

    def _notify(self, text: str, *, reason: str) -> None:
        self._events.append(VehicleEvent(EventKind.VEHICLE_MESSAGE, text, Severity.WARNING, {"reason": reason}))
