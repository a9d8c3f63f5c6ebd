"""Convert set-points to sticks and motions. The last action is kept until the state confirms that it is complete. Pure.

Replies may arrive seconds late or never, so a take-off or landing is repeated until it takes effect.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto
from typing import Final

from skyloop.clock import nanoseconds
from skyloop.drivers.vehicle_session import MotorStop, VehicleEvent, message
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
    ResetEmergency,
    Severity,
    Takeoff,
    Velocity,
)
from skyloop.messages.geometry import clamped
from skyloop.vehicles.tello.telemetry import FlightWatch
from skyloop.vehicles.tello.wire import (
    FULL_CLIMB_M_S,
    FULL_SPEED_M_S,
    FULL_YAW_RATE_RAD_S,
    LEVEL,
    MAX_STICK,
    TelloStick,
    is_error,
)

FULL_TILT_RAD: Final = 0.2  #: attitude commanded by a full stick; chosen to equal an AR.Drone's tilt indoors


@dataclass(frozen=True, slots=True)
class Scale:
    """One number per stick axis: the effect of a full stick, or the largest set-point."""

    speed: float = FULL_SPEED_M_S  #: [m/s]
    climb: float = FULL_CLIMB_M_S  #: [m/s]
    yaw_rate: float = FULL_YAW_RATE_RAD_S  #: [rad/s]
    tilt: float = FULL_TILT_RAD  #: [rad]


def sticks_of(action: Velocity | Attitude, full: Scale, limits: Scale) -> tuple[TelloStick, Velocity | Attitude]:
    """Return the stick values and the set-point that they command, within the limits and at most a full stick.

    The Tello holds a speed, not an attitude, so a tilt becomes a fraction of the full stick and thus of the full speed.
    """
    climb = min(full.climb, limits.climb)
    yaw = min(full.yaw_rate, limits.yaw_rate)
    if isinstance(action, Velocity):
        speed = min(full.speed, limits.speed)
        applied = Velocity(
            forward=clamped(action.forward, speed),
            left=clamped(action.left, speed),
            up=clamped(action.up, climb),
            yaw_rate=clamped(action.yaw_rate, yaw),
        )
        right, ahead = -applied.left / full.speed, applied.forward / full.speed
        return _stick(right, ahead, applied.up / full.climb, applied.yaw_rate / full.yaw_rate), applied
    tilt = min(full.tilt, limits.tilt)
    level = Attitude(
        roll=clamped(action.roll, tilt),
        pitch=clamped(action.pitch, tilt),
        climb=clamped(action.climb, climb),
        yaw_rate=clamped(action.yaw_rate, yaw),
    )
    right, ahead = level.roll / full.tilt, level.pitch / full.tilt
    return _stick(right, ahead, level.climb / full.climb, level.yaw_rate / full.yaw_rate), level


def _stick(right: float, forward: float, up: float, turn: float) -> TelloStick:
    return TelloStick(*(round(MAX_STICK * share) for share in (right, forward, up, -turn)))


AGAIN_NS: Final = nanoseconds(1.5)  #: time after which a take-off or landing without visible effect is repeated
TAKEOFF_NS: Final = nanoseconds(8.0)  #: time after which a drone still on the ground is refusing to take off
RISES_NS: Final = nanoseconds(3.0)  #: time after sending a take-off within which it may begin; real drones take 1.1 s

TAKEOFF, LAND, EMERGENCY = "takeoff", "land", "emergency"


class Decision(Enum):
    """Whether to take off or land."""

    STAY = auto()  #: stay in the air if flying, on the ground otherwise
    TAKE_OFF = auto()
    LAND = auto()


class TelloSetpoints:
    """Stores the last action and turns it into commands.

    ``full`` is the effect of a full stick, and ``limits`` is the largest set-point.
    """

    def __init__(self) -> None:
        self.watch = FlightWatch()
        self.full = Scale()
        self.limits = Scale()
        self.receiving = False  #: whether the drone's state is arriving
        #: Set after an abandoned stop or landing until the next command: we send nothing; the drone lands after 15 s.
        self.left_alone = False
        self.stop = MotorStop(self._leave_alone)
        self._decision = Decision.STAY
        self._stick = LEVEL
        self._decided_ns = 0
        self._sent_ns: int | None = None  # when the take-off or landing was sent
        self._rises_until_ns = 0  # time until which a rise may result from a take-off that we sent
        self._state_ns = 0  # when the last state arrived
        self._was_in_air = False  # whether the last state was in the air, or we have just sent a take-off
        self._steering = False  # whether we started or took over this flight; otherwise another program may be flying
        self._events: list[VehicleEvent] = []

    @property
    def intent(self) -> tuple[object, ...]:
        """A value that changes when the commands to send change."""
        return self._decision, self._stick, self.stop.active

    @property
    def flown_by_others(self) -> bool:
        """Whether we must not keep the drone in the air, because we abandoned it or the flight is not ours."""
        return self.left_alone or (self.watch.phase.airborne and not self._steering)

    @property
    def flies_unheard(self) -> bool:
        """Whether the drone was flying or taking off when the link was lost, and may still be flying."""
        return not self.receiving and self._was_in_air

    def flight_state(self) -> FlightState:
        """Return the flight state to report in feedback."""
        if self.stop.shown:
            return FlightState.EMERGENCY
        if self._decision is Decision.LAND and self.watch.phase is FlightState.LANDED:
            return FlightState.LANDING  # the drone may be about to rise
        if self.watch.in_air and self._stick != LEVEL:
            return FlightState.FLYING
        return self.watch.phase

    # Decisions -------------------------------------------------------------------------------------------------

    def apply(self, action: AnyAction, now_ns: int, *, new: bool = True) -> AnyAction:
        """Accept one of the driver's ``ACTIONS``.

        While the drone is :attr:`left_alone`, actions other than landings have no effect unless an application has just
        requested them (``new``). Returns the applied action: a set-point within the limits, or hover after an emergency
        stop. Raises :class:`DriverError` for a take-off while the drone is silent or after an emergency stop, and for a
        reset while it is silent or its motors are still running.
        """
        if isinstance(action, Idle):
            return action
        if isinstance(action, EmergencyStop):
            self._stop_motors(now_ns)
        elif isinstance(action, ResetEmergency):
            if self.stop.active and not self.receiving:
                raise DriverError("no data from the drone: cannot tell whether it is on the ground")
            self.stop.reset()
        elif self.stop.active:
            if isinstance(action, Takeoff):
                raise DriverError("the motors were stopped: reset the emergency first")
            if isinstance(action, Velocity | Attitude):
                return Hover()
        elif new or not self.left_alone or isinstance(action, Land):
            return self._fly(action, now_ns)
        return action

    def _fly(self, action: AnyAction, now_ns: int) -> AnyAction:
        self._steering, self.left_alone = True, False
        if isinstance(action, Takeoff):
            self._take_off(now_ns)
        elif isinstance(action, Land):
            self._decide(Decision.LAND, now_ns)
        elif isinstance(action, Velocity | Attitude):
            stick, applied = sticks_of(action, self.full, self.limits)
            self._remain(stick, now_ns)
            return applied
        elif isinstance(action, Hover):
            self._remain(LEVEL, now_ns)
        return action

    def _decide(self, decision: Decision, now_ns: int) -> None:
        self._stick = LEVEL
        if decision is self._decision:
            return
        self._decision, self._decided_ns, self._sent_ns = decision, now_ns, None
        self.watch.rising = decision is Decision.TAKE_OFF
        self.watch.sinking = decision is Decision.LAND
        self.watch.landing_answered = False

    def _remain(self, stick: TelloStick, now_ns: int) -> None:
        if self._decision is Decision.LAND and self.watch.phase is FlightState.LANDED:
            return  # otherwise a cancelled take-off could still happen
        if self._decision is Decision.LAND:
            self._decide(Decision.STAY, now_ns)
        self._stick = stick

    def _take_off(self, now_ns: int) -> None:
        if not self.receiving:
            raise DriverError("no data from the drone: take-off is refused until the link is up")
        if self.watch.in_air:
            self._remain(LEVEL, now_ns)
        else:
            self._decide(Decision.TAKE_OFF, now_ns)

    def _stop_motors(self, now_ns: int) -> None:
        self._decide(Decision.STAY, now_ns)
        self.left_alone = False
        if not self.stop.active:
            text = "the drone was commanded to cut its motors; reset the emergency when it is safe on the ground"
            self._events.append(VehicleEvent(EventKind.EMERGENCY, text, Severity.ERROR, {"reason": "user"}))
        self.stop.press(now_ns)

    def _leave_alone(self, given_up: VehicleEvent) -> None:
        self._events.append(given_up)
        self._steering, self.left_alone = False, True

    def forget_landing(self) -> bool:
        """Cancel a pending landing; return whether there was one."""
        if self._decision is not Decision.LAND:
            return False
        self._decision, self.watch.sinking = Decision.STAY, False
        self._steering, self.left_alone = False, True
        return True

    def forget_flight(self) -> None:
        """Assume that the drone has landed: without contact or commands, it has had time to land automatically."""
        self._was_in_air = self._steering = False

    # Receiving ----------------------------------------------------------------------------------------------------

    def on_state(self, now_ns: int) -> None:
        """Handle a new state after the watch has processed it."""
        phase, rose = self.watch.phase, self._was_in_air and self._decision is Decision.TAKE_OFF
        self.receiving, self._state_ns = True, now_ns
        self._was_in_air = phase.airborne
        if rose and phase is FlightState.LANDED:  # the drone fell over or was stopped: don't start it again
            self._decide(Decision.STAY, now_ns)
            text = "the drone began to take off, and its motors stopped: it is not started again"
            self._events.append(message(text, "no_takeoff", Severity.WARNING))
        shown = {Decision.TAKE_OFF: FlightState.HOVERING, Decision.LAND: FlightState.LANDED}.get(self._decision)
        if phase is shown and not (self._decision is Decision.LAND and now_ns < self._rises_until_ns):
            self._decide(Decision.STAY, now_ns)
        elif phase is FlightState.LANDED:
            self._stick, self.left_alone = LEVEL, False
            self._steering = self._decision is not Decision.STAY

    def on_answer(self, motion: str, reply: str, now_ns: int) -> None:
        """Handle the reply to a take-off or landing. For an emergency stop, only the state of the motors matters."""
        refused = is_error(reply)
        if motion == LAND:
            self.watch.landing_answered = self._decision is Decision.LAND and not refused
        elif motion == TAKEOFF and refused and self._decision is Decision.TAKE_OFF and not self.watch.phase.airborne:
            self._decide(Decision.STAY, now_ns)
            text = f"the drone refused to take off: {reply!r}"
            self._events.append(message(text, "takeoff_refused", Severity.WARNING, reply=reply))

    def lost(self, now_ns: int) -> None:
        """Cancel a take-off and level the sticks after a link loss. A landing command is still sent."""
        self.receiving = False
        self._was_in_air |= now_ns < self._rises_until_ns
        if self._decision is Decision.TAKE_OFF:
            self._decide(Decision.STAY, now_ns)
        self._stick = LEVEL
        self.watch = FlightWatch()
        self.watch.sinking = self._decision is Decision.LAND

    # Sending ---------------------------------------------------------------------------------------------------

    def pop_events(self) -> list[VehicleEvent]:
        events, self._events = self._events, []
        return events

    def motions(self, now_ns: int) -> list[str]:
        """Return the motions to send now; their replies take seconds."""
        if self.stop.active:
            return [EMERGENCY] if self.stop.step(self._motors_are_off(now_ns), now_ns) else []
        if self._decision is Decision.TAKE_OFF and not self.watch.phase.airborne:
            if now_ns - self._decided_ns >= TAKEOFF_NS:
                self._decide(Decision.STAY, now_ns)
                text = "the drone did not take off: it may refuse because of its battery, its heat or its tilt"
                self._events.append(message(text, "no_takeoff", Severity.WARNING))
                return []
            sent = self._again(TAKEOFF, now_ns)
            if sent:
                self._rises_until_ns = now_ns + RISES_NS
            return sent
        stands = self.receiving and self.watch.phase is FlightState.LANDED
        landed = stands and now_ns >= self._rises_until_ns
        if self._decision is Decision.LAND and not landed:
            return self._again(LAND, now_ns)
        return []

    def stick(self) -> TelloStick | None:
        """Return the stick values for ``rc``, or None to send none.

        None is returned if the drone is on the ground, taking off, landing, or flown by another program.
        """
        if self.stop.active or self._decision is not Decision.STAY or not self._steering:
            return None
        if self.receiving:
            return self._stick if self.watch.in_air else None
        return LEVEL if self._was_in_air else None

    def _again(self, text: str, now_ns: int) -> list[str]:
        if self._sent_ns is not None and now_ns - self._sent_ns < AGAIN_NS:
            return []
        self._sent_ns = now_ns
        return [text]

    def _motors_are_off(self, now_ns: int) -> bool | None:
        if not (self.receiving and self.stop.settled(self._state_ns)):
            return None
        running = self.watch.motors(now_ns)
        return None if running is None else not running
