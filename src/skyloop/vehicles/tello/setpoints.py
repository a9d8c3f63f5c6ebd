"""Set-points to sticks and motions: the last action, until the drone's state shows that it is done. Pure.

Answers decide nothing: they come seconds late, or not at all. A take-off or landing is sent again until it shows.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto
from typing import Final

from skyloop.clock import nanoseconds
from skyloop.drivers.motor_stop import MotorStop
from skyloop.drivers.vehicle_session import VehicleEvent, message
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
    Stick,
    is_error,
)

FULL_TILT_RAD: Final = 0.2  #: the attitude that is taken for a full stick: as much as an AR.Drone tilts indoors


@dataclass(frozen=True, slots=True)
class Scale:
    """A number for each stick: what a full one comes to, or the most that is asked for."""

    speed: float = FULL_SPEED_M_S  #: [m/s]
    climb: float = FULL_CLIMB_M_S  #: [m/s]
    yaw_rate: float = FULL_YAW_RATE_RAD_S  #: [rad/s]
    tilt: float = FULL_TILT_RAD  #: [rad]


def sticks_of(action: Velocity | Attitude, full: Scale, limits: Scale) -> tuple[Stick, Velocity | Attitude]:
    """Return the sticks, and what they ask for: each number within its limit, and no more than a full stick.

    The Tello holds a speed, and no attitude: a tilt is taken as a share of the full stick, and so of the full speed.
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


def _stick(right: float, forward: float, up: float, turn: float) -> Stick:
    return Stick(*(round(MAX_STICK * share) for share in (right, forward, up, -turn)))


AGAIN_NS: Final = nanoseconds(1.5)  #: a take-off or landing that does not show is sent again
TAKEOFF_NS: Final = nanoseconds(8.0)  #: a drone that has not started by then refuses to
RISES_NS: Final = nanoseconds(3.0)  #: so long after a take-off was sent what stands may rise: real ones do after 1.1 s

TAKEOFF, LAND, EMERGENCY = "takeoff", "land", "emergency"


class Decision(Enum):
    """What is wanted of take-off and landing."""

    STAY = auto()  #: as it is: in the air if it flies
    TAKE_OFF = auto()
    LAND = auto()


class SetpointController:
    """Remembers the last action and turns it into commands.

    ``full`` is what a full stick comes to, ``limits`` the most that is asked for.
    """

    def __init__(self) -> None:
        self.watch = FlightWatch()
        self.full = Scale()
        self.limits = Scale()
        self.receiving = False  #: whether the drone's state comes
        #: After a stop or landing that was given up, until somebody commands: a Tello lands by itself after 15 s then.
        self.left_alone = False
        self.stop = MotorStop(self._leave_alone)
        self._decision = Decision.STAY
        self._stick = LEVEL
        self._decided_ns = 0
        self._sent_ns: int | None = None  # the take-off or landing
        self._rises_until_ns = 0  # a take-off was sent, and may show until then
        self._state_ns = 0  # when its state came last
        self._was_in_air = False  # when its state came last, or it was to rise just then
        self._steering = False  # this flight was begun, or taken, here: else another program may be flying it
        self._events: list[VehicleEvent] = []

    @property
    def intent(self) -> tuple[object, ...]:
        """Changes when something else is to be sent."""
        return self._decision, self._stick, self.stop.active

    @property
    def flown_by_others(self) -> bool:
        """Whether nothing from here is to keep it in the air: it was given up, or this flight is not ours."""
        return self.left_alone or (self.watch.phase.airborne and not self._steering)

    @property
    def flies_unheard(self) -> bool:
        """Whether it flew or was to rise when it was heard last, and may fly still."""
        return not self.receiving and self._was_in_air

    def flight_state(self) -> FlightState:
        """Return the flight state for feedback."""
        if self.stop.shown:
            return FlightState.EMERGENCY
        if self._decision is Decision.LAND and self.watch.phase is FlightState.LANDED:
            return FlightState.LANDING  # it may be about to rise
        if self.watch.in_air and self._stick != LEVEL:
            return FlightState.FLYING
        return self.watch.phase

    # What is decided -------------------------------------------------------------------------------------------

    def apply(self, action: AnyAction, now_ns: int, *, new: bool = True) -> AnyAction:
        """Accept an action.

        Args:
            action: One of the driver's ``ACTIONS``.
            now_ns: The present time.
            new: Whether an application newly asked for it. What nobody decided, but a landing, does nothing to a drone
                that is :attr:`left_alone`.

        Returns:
            What is applied: a set-point within the limits, or hover after an emergency stop.

        Raises:
            DriverError: A take-off while nothing is received or after an emergency stop, or a reset while it is not
                received or its motors still run.
        """
        if isinstance(action, Idle):
            return action
        if isinstance(action, EmergencyStop):
            self._stop_motors(now_ns)
        elif isinstance(action, ResetEmergency):
            if self.stop.active and not self.receiving:
                raise DriverError("no data from the drone: whether it is on the ground is not known")
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

    def _remain(self, stick: Stick, now_ns: int) -> None:
        if self._decision is Decision.LAND and self.watch.phase is FlightState.LANDED:
            return  # or a take-off that was withdrawn would show after all
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
        """Land no longer; return whether it was to."""
        if self._decision is not Decision.LAND:
            return False
        self._decision, self.watch.sinking = Decision.STAY, False
        self._steering, self.left_alone = False, True
        return True

    def forget_flight(self) -> None:
        """Take it for landed: it was not heard, and sent nothing, for as long as it takes it to land by itself."""
        self._was_in_air = self._steering = False

    # What is received ---------------------------------------------------------------------------------------------

    def on_state(self, now_ns: int) -> None:
        """Handle that the watch has seen a new state."""
        phase, rose = self.watch.phase, self._was_in_air and self._decision is Decision.TAKE_OFF
        self.receiving, self._state_ns = True, now_ns
        self._was_in_air = phase.airborne
        if rose and phase is FlightState.LANDED:  # it fell over, or was stopped: a take-off begins once
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
        """Handle the answer to a take-off or landing. That to an emergency stop shows nothing: the motors do."""
        refused = is_error(reply)
        if motion == LAND:
            self.watch.landing_answered = self._decision is Decision.LAND and not refused
        elif motion == TAKEOFF and refused and self._decision is Decision.TAKE_OFF and not self.watch.phase.airborne:
            self._decide(Decision.STAY, now_ns)
            text = f"the drone refused to take off: {reply!r}"
            self._events.append(message(text, "takeoff_refused", Severity.WARNING, reply=reply))

    def lost(self, now_ns: int) -> None:
        """Cancel a take-off and level the sticks: nothing is received any more. A landing is still sent."""
        self.receiving = False
        self._was_in_air |= now_ns < self._rises_until_ns
        if self._decision is Decision.TAKE_OFF:
            self._decide(Decision.STAY, now_ns)
        self._stick = LEVEL
        self.watch = FlightWatch()
        self.watch.sinking = self._decision is Decision.LAND

    # What is sent ----------------------------------------------------------------------------------------------

    def pop_events(self) -> list[VehicleEvent]:
        """Return the events since the last call."""
        events, self._events = self._events, []
        return events

    def motions(self, now_ns: int) -> list[str]:
        """Return the commands due now that are answered seconds later."""
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

    def stick(self) -> Stick | None:
        """Return the sticks for ``rc``, None if none are to be sent.

        A drone that stands, rises or sinks is left alone, and so is one that another program flies.
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
