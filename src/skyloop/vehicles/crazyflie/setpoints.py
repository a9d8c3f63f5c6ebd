"""Decide what to send for the newest action: flights of the high-level commander, or low-level set-points. Pure.

The high-level commander runs in the vehicle and continues without a client: it finishes a take-off, a landing or a
flight to a place, and hovers. Low-level set-points are followed at once, but without the next one the
vehicle levels after 0.5 s and **cuts its motors after 2 s, in the air**. Therefore all but attitudes goes through the
high-level commander, velocities too: ten times a second a short flight from where its plan is now, which ends at rest.
Without the next one, the vehicle comes to rest and hovers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum, auto
from typing import Final

from skyloop.clock import nanoseconds, seconds
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
    Position,
    ResetEmergency,
    Severity,
    Takeoff,
    Vector,
    Velocity,
)
from skyloop.messages.geometry import clamped, turned, within, wrap_angle
from skyloop.vehicles.crazyflie.options import TAKEOFF_ALTITUDE, VelocityMode
from skyloop.vehicles.crazyflie.telemetry import NO_POSITION, CrazyflieTelemetry
from skyloop.vehicles.crazyflie.wire.commander import (
    Arm,
    EmergencyStopMessage,
    GoTo,
    HighLevelLand,
    HighLevelStop,
    HighLevelTakeoff,
    HoverSetpoint,
    Message,
    NotifySetpointsStop,
    Supervisor,
    ZDistanceSetpoint,
)

LOW_LEVEL_NS: Final = nanoseconds(0.03)  #: time between two low-level set-points
HIGH_LEVEL_NS: Final = nanoseconds(0.1)  #: time between two short flights
HURRY_NS: Final = nanoseconds(0.04)  #: shortest time between two of them, when the velocity changes
LEG_S: Final = 0.5  #: duration of one short flight
#: Length of a short flight at 1 m/s, in units of its duration. The vehicle's planner ends each flight at rest; when
#: repeated every 0.1 s, flights of this length make it fly at 1 m/s. A change of velocity is spread over this time
#: constant, so that the plan reaches 90 % of it in 0.3 s without overshooting.
LEG_GAIN: Final = 0.61
EASE_S: Final = 0.144
BRAKE_GAIN: Final = (
    0.4  #: the same for the last flight, which ends at rest; 0.5 would be the planner's own deceleration
)
#: A smooth flight's greatest speed is this many times its average speed: the planner's polynomial of 7th order.
PEAK: Final = 35 / 16
HOLD_S: Final = 1.0  #: duration of the flight that comes to rest
SHORTEST_S: Final = 0.6  #: shortest duration of a flight to a place
CLIMB_M_S: Final = 0.5  #: average speed of a take-off
SINK_M_S: Final = 0.25  #: average speed of a landing
AGAIN_NS: Final = nanoseconds(0.15)  #: time after which a flight that was not answered is sent again
TRIES: Final = 4  #: how often it is sent
REFUSES_NS: Final = nanoseconds(2.5)  #: time after which a vehicle that doesn't rise refuses to take off
RISES_NS: Final = nanoseconds(1.0)  #: time after the last take-off packet within which it may still rise
FRESH_NS: Final = nanoseconds(0.5)  #: age of the newest state within which a take-off is sent
SILENT_NS: Final = nanoseconds(0.35)  #: silence after which low-level set-points give way to a hover
OFF_NS: Final = nanoseconds(0.5)  #: time without power after which a vehicle no longer flies, whatever it reports
ARM_NS: Final = nanoseconds(0.2)  #: time between two requests to arm
LATE_S: Final = 3.0  #: delay after which a landing is sent again, and a take-off counts as finished
NEAR_M: Final = 0.15
SLOW_M_S: Final = 0.3
#: How often to tell the vehicle that no more low-level set-points follow, plus 1. The message stops the motors at once
#: unless the high-level commander has a flight from after the last set-point, so it follows the flight's answer.
RELAXES: Final = 4
AHEAD_M: Final = 0.4  #: how far the planned position may be ahead of the vehicle's own, beyond 0.6 s of flight


class Decision(Enum):
    """Whether to take off or land."""

    STAY = auto()
    TAKE_OFF = auto()
    LAND = auto()


@dataclass(slots=True)
class _Flight:
    """A flight of the high-level commander that is sent until it is answered."""

    message: Message
    tries: int = TRIES
    due_ns: int = 0


class CrazyflieSetpoints:
    """Stores the last action, and turns it into messages.

    ``limits`` are the driver's own limits by name.
    """

    def __init__(self, telemetry: CrazyflieTelemetry, velocity: VelocityMode, limits: dict[str, float]) -> None:
        self.telemetry = telemetry
        self.limits = limits
        self.receiving = False  #: whether the vehicle's state is arriving
        self.stop = MotorStop(self._leave_alone)
        self.restartable = False  #: whether the link can restart the vehicle
        self.reset_wanted = False  #: whether the vehicle must be restarted, or recover from a crash, to end a stop
        self.left_alone = False  #: after an abandoned stop or landing, until a new action
        self._mode = velocity
        self._decision = Decision.STAY
        self._decided_ns = 0
        self._setpoint: Velocity | Attitude | Position | None = None  # None: hover
        self._steering = False  # whether we started or took over this flight
        self._flight: _Flight | None = None
        #: RELAXES while low-level set-points, from us or others, may fly the vehicle; then counts the messages down.
        self._relaxes = RELAXES
        self._relax_ns = 0
        self._was_flying = False  # whether the last state was in the air
        self._state_ns: int | None = None
        self._sent_ns = 0  # when the last set-point or short flight was sent
        self._moving: Velocity | None = Velocity()  # of the last short flight; None: another flight is under way
        self._wanted = Velocity()  # the velocity that short flights approach
        self._planned: Vector | None = None  # where short flights should have brought it
        self._height_m: float | None = None  # height that low-level set-points hold
        self._ground_m = 0.0  # height of the ground, as far as known
        self._target_m = self._takeoff_s = 0.0  # height at the end of a take-off, and its duration
        self._place: Position | None = None  # the place of the last flight, as requested
        self._heading_rad: float | None = None  # heading to keep on flights to places
        self._rises_until_ns = 0
        self._lands_until_ns = 0
        self._landed = False  # whether the motors are off, after a landing or for a moment
        self._off_ns: int | None = None  # since when the motors are off
        self._armed_ns: int | None = None  # when we last asked to arm, until the vehicle has flown
        self._disarm = False
        self._events: list[VehicleEvent] = []

    # State ----------------------------------------------------------------------------------------------------------

    @property
    def intent(self) -> tuple[object, ...]:
        """A value that changes when what to send changes."""
        return self._decision, self._setpoint, self._steering, self.stop.active

    @property
    def flies_by_setpoints(self) -> bool:
        """Whether low-level set-points are being sent."""
        if self._decision is not Decision.STAY or not self._steering:
            return False
        low = isinstance(self._setpoint, Velocity) and self._mode is VelocityMode.SETPOINT
        return low or isinstance(self._setpoint, Attitude)

    def flight_state(self, now_ns: int) -> FlightState:
        if self.stop.shown:
            return FlightState.EMERGENCY
        flying = self._flies(now_ns)
        if self._decision is Decision.LAND and (flying or now_ns < self._rises_until_ns):
            return FlightState.LANDING
        if not flying:
            return FlightState.UNKNOWN if flying is None else FlightState.LANDED
        if self._decision is Decision.TAKE_OFF:
            return FlightState.TAKING_OFF
        still = self._setpoint is None or self._setpoint == Velocity() or self._arrived()
        return FlightState.HOVERING if still and self.telemetry.estimate.speed_m_s < SLOW_M_S else FlightState.FLYING

    def _flies(self, now_ns: int) -> bool | None:
        """Return whether the vehicle flies; None if unknown.

        Firmware counts a vehicle as flying for seconds after a landing, when its motors are already off.
        """
        if self._landed and self.telemetry.motors_run is False:
            return False
        return self.telemetry.is_flying(now_ns)

    def _arrived(self) -> bool:
        position = self.telemetry.estimate.position_m
        target = self._setpoint
        return isinstance(target, Position) and position is not None and math.dist(position, target.place) < NEAR_M

    def pop_events(self) -> list[VehicleEvent]:
        events, self._events = self._events, []
        return events

    # Actions --------------------------------------------------------------------------------------------------------

    def apply(self, action: AnyAction, now_ns: int, *, new: bool = True) -> AnyAction:
        """Accept an action; return what is applied within the limits. Raises :class:`DriverError`.

        Only a ``new`` request starts a take-off, or takes over a vehicle that is :attr:`left_alone` or flown by others,
        except to land it.
        """
        if isinstance(action, EmergencyStop):
            self._stop_motors(now_ns)
            return action
        others = self.left_alone or (not self._steering and bool(self._flies(now_ns)))
        if isinstance(action, Idle) or (not new and not isinstance(action, Land | ResetEmergency) and others):
            return action
        if isinstance(action, ResetEmergency):
            self._reset()
        elif self.stop.active:
            if isinstance(action, Takeoff):
                raise DriverError("the motors were stopped: reset the emergency first")
            if isinstance(action, Velocity | Attitude | Position):
                return Hover()
        elif isinstance(action, Takeoff):
            if new:
                self._take_off(now_ns)
        elif isinstance(action, Land):
            self._steering, self.left_alone = True, False
            self._decide(Decision.LAND, now_ns)
        elif isinstance(action, Hover):
            self._remain(None, now_ns)
        elif isinstance(action, Velocity | Attitude | Position):
            if not isinstance(action, Attitude) and self.receiving and not self.telemetry.knows_position:
                raise DriverError(NO_POSITION)
            applied = self._limited(action)
            self._remain(applied, now_ns)
            return applied
        return action

    def _limited(self, action: Velocity | Attitude | Position) -> Velocity | Attitude | Position:
        speed, climb = self.limits["limits.speed"], self.limits["limits.climb"]
        turn, tilt = self.limits["limits.yaw_rate"], self.limits["limits.tilt"]
        if isinstance(action, Velocity):
            return Velocity(
                forward=clamped(action.forward, speed),
                left=clamped(action.left, speed),
                up=clamped(action.up, climb),
                yaw_rate=clamped(action.yaw_rate, turn),
            )
        if isinstance(action, Attitude):
            return Attitude(
                roll=clamped(action.roll, tilt),
                pitch=clamped(action.pitch, tilt),
                climb=clamped(action.climb, climb),
                yaw_rate=clamped(action.yaw_rate, turn),
            )
        return Position(
            *action.place,
            yaw=action.yaw,
            speed=min(speed, action.speed or speed),
            turn_rate=min(turn, action.turn_rate or turn),
        )

    def _take_off(self, now_ns: int) -> None:
        if not self.receiving or not self._is_fresh(now_ns):
            raise DriverError("no data from the vehicle: take-off is refused until the link is up")
        flying = self._flies(now_ns)
        if flying is None:
            raise DriverError("the vehicle does not say yet whether it flies: take-off is refused until it does")
        if flying:
            if self._decision is not Decision.TAKE_OFF:
                self._remain(None, now_ns)
            return
        if refusal := self.telemetry.refusal():
            raise DriverError(f"the vehicle can't take off: {refusal}")
        self._steering = True
        self._decide(Decision.TAKE_OFF, now_ns)

    def _remain(self, setpoint: Velocity | Attitude | Position | None, now_ns: int) -> None:
        flying = bool(self._flies(now_ns))
        if self._decision is not Decision.STAY and not flying:
            return  # a take-off ends in a hover; one that a landing withdrew could still happen
        begins = self._decision is not Decision.STAY or not self._steering
        self._steering, self.left_alone = True, False
        self._decide(Decision.STAY, now_ns)
        if setpoint is None and flying and (begins or self._setpoint is not None):
            self._hold(now_ns, here=begins)
        if type(setpoint) is not type(self._setpoint):
            self._planned = self._height_m = self._place = self._heading_rad = None
            if self._setpoint is not None:
                self._moving = None
        if setpoint is not None and setpoint != self._setpoint and self._relaxes != RELAXES:
            self._flight = None  # unless its answer is awaited, to end low-level set-points
        self._setpoint = setpoint

    def _decide(self, decision: Decision, now_ns: int) -> None:
        if decision is self._decision:
            return
        self._decision, self._decided_ns, self._flight = decision, now_ns, None
        self._setpoint = self._moving = self._place = None
        position = self.telemetry.estimate.position_m
        if decision is Decision.TAKE_OFF and position is not None:
            self._ground_m = position[2]
            self._target_m = self._ground_m + self.limits[TAKEOFF_ALTITUDE]
            self._takeoff_s = max(1.0, self.limits[TAKEOFF_ALTITUDE] / CLIMB_M_S)
            self._flight = _Flight(HighLevelTakeoff(0, self._target_m, 0.0, True, self._takeoff_s))
        elif decision is Decision.LAND:
            self._land(now_ns)

    def _land(self, now_ns: int) -> None:
        position, range_m = self.telemetry.estimate.position_m, self.telemetry.range_m
        z = self._ground_m + 1.0 if position is None else position[2]
        if range_m is not None:
            self._ground_m = z - range_m
        duration_s = max(1.0, (z - self._ground_m) / SINK_M_S)
        self._lands_until_ns = now_ns + nanoseconds(duration_s + LATE_S)
        self._flight = _Flight(HighLevelLand(0, self._ground_m, 0.0, True, duration_s))

    def _hold(self, now_ns: int, *, here: bool = False) -> None:
        """Come to rest and hover: near the vehicle (``here``), or at the end of its plan."""
        estimate = self.telemetry.estimate
        if here or self._relaxes == RELAXES or self._moving is None:
            if estimate.position_m is None or estimate.yaw_rad is None:
                return
            x, y, z = (
                at + HOLD_S * BRAKE_GAIN * speed
                for at, speed in zip(estimate.position_m, estimate.velocity_m_s or (0.0, 0.0, 0.0), strict=True)
            )
            self._flight = _Flight(GoTo(0, False, False, x, y, z, wrap_angle(estimate.yaw_rad), HOLD_S))
        elif self._moving != Velocity():
            # A lost packet does no harm: the flight under way ends at rest, too.
            self._flight = _Flight(self._leg(self._moving, BRAKE_GAIN), tries=1)
        self._moving, self._sent_ns = Velocity(), now_ns

    def _stop_motors(self, now_ns: int) -> None:
        self._decide(Decision.STAY, now_ns)
        self._setpoint = self._flight = None
        self.reset_wanted = False
        if not self.stop.active:
            text = "the vehicle was commanded to cut its motors; reset the emergency when it is safe on the ground"
            self._events.append(VehicleEvent(EventKind.EMERGENCY, text, Severity.ERROR, {"reason": "user"}))
        self.stop.press(now_ns)

    def _reset(self) -> None:
        if self.stop.active and not self.receiving:
            raise DriverError("no data from the vehicle: cannot tell whether it is on the ground")
        if self.telemetry.is_locked and not self.restartable:
            raise DriverError("the vehicle is locked: switch it off and on again, then reset the emergency")
        self.stop.reset()
        self._steering = False
        self.reset_wanted = bool(self.telemetry.is_locked or self.telemetry.is_set(Supervisor.IS_CRASHED))

    def _leave_alone(self, given_up: VehicleEvent) -> None:
        self._events.append(given_up)
        self._steering, self.left_alone = False, True

    def forget_landing(self) -> bool:
        """Cancel a pending landing; return whether there was one."""
        if self._decision is not Decision.LAND:
            return False
        self._decision, self._flight, self._steering, self.left_alone = Decision.STAY, None, False, True
        return True

    # The vehicle's reports --------------------------------------------------------------------------------------------

    def on_state(self, now_ns: int) -> None:
        """Handle a new state of the telemetry."""
        self.receiving, self._state_ns = True, now_ns
        self._watch_motors(now_ns)
        flying = bool(self._flies(now_ns))
        rose, self._was_flying = self._was_flying, flying
        estimate = self.telemetry.estimate
        if self._decision is Decision.TAKE_OFF:
            if flying and estimate.position_m is not None:
                up = estimate.position_m[2] >= self._target_m - NEAR_M
                settled = up and abs((estimate.velocity_m_s or (0.0, 0.0, 0.0))[2]) < SLOW_M_S
                if settled or now_ns - self._decided_ns > nanoseconds(self._takeoff_s + LATE_S):
                    self._armed_ns = None
                    self._decide(Decision.STAY, now_ns)
            elif rose and not flying:
                text = "the vehicle began to take off, and its motors stopped: it is not started again"
                self._give_up(text, now_ns, stop=not self.telemetry.motors_run)
        elif self._decision is Decision.LAND:
            if not flying and now_ns >= self._rises_until_ns:
                self._decide(Decision.STAY, now_ns)
                self._disarm_again()
        elif not flying:
            self._setpoint, self._steering = None, False
            if rose:
                self._flight = None
            if self._armed_ns is not None and now_ns >= self._rises_until_ns:  # the take-off did not happen
                self._disarm_again()
        elif self._flight is not None and isinstance(self._flight.message, HighLevelStop):
            self._flight = None  # it flies after all

    def _disarm_again(self) -> None:
        self._armed_ns, self._disarm = None, bool(self.telemetry.is_armed) and self._arms_itself is False

    def _watch_motors(self, now_ns: int) -> None:
        """Notice that the motors are off: at once at the end of a landing, otherwise after a moment."""
        if self.telemetry.motors_run is not False or self._decision is Decision.TAKE_OFF:
            self._landed, self._off_ns = False, None
            return
        if self.telemetry.motors_ns is None or now_ns - self.telemetry.motors_ns > FRESH_NS:
            self._off_ns = None  # they may run by now
            return
        self._off_ns = now_ns if self._off_ns is None else self._off_ns
        landing = self._decision is Decision.LAND and now_ns >= self._rises_until_ns
        self._landed |= landing or now_ns - self._off_ns > OFF_NS

    @property
    def _arms_itself(self) -> bool | None:
        return self.telemetry.is_set(Supervisor.IS_AUTO_ARMED)

    def _give_up(self, text: str, now_ns: int, *, stop: bool) -> None:
        """End a take-off; ``stop``: the vehicle, on the ground, still plans it, and may start when nothing bars it."""
        self._decide(Decision.STAY, now_ns)
        self._steering = False
        self._flight = _Flight(HighLevelStop()) if stop else None
        self._events.append(message(text, "no_takeoff", Severity.WARNING))

    def on_answer(self, kind: int, error: int, now_ns: int) -> None:
        """Handle the high-level commander's answer to its command of this number; an error of 0: accepted."""
        flight = self._flight
        if flight is None or all(layout.number != kind for layout in flight.message.LAYOUTS):
            return
        self._flight = None
        if self._decision is Decision.TAKE_OFF:
            self._relaxes = 0
            if error:
                self._give_up(f"the vehicle refuses to take off (error {error})", now_ns, stop=False)
        elif not error and not isinstance(flight.message, HighLevelStop):
            self._relax(now_ns)

    def _relax(self, now_ns: int) -> None:
        """Begin to hand the vehicle over from low-level set-points to its high-level commander."""
        if self._relaxes == RELAXES:
            self._relaxes, self._relax_ns = RELAXES - 1, now_ns

    def lost(self, now_ns: int) -> None:
        """Forget take-off and set-points after a loss of the link. A landing is still sent."""
        # It may have taken off after the last state that arrived.
        self._was_flying |= self._state_ns is not None and self._state_ns < self._rises_until_ns
        self.receiving, self._state_ns = False, None
        if self._decision is Decision.TAKE_OFF:
            self._decide(Decision.STAY, now_ns)
        self._setpoint, self._moving, self._relaxes = None, None, RELAXES
        if self._decision is not Decision.LAND:
            self._flight = None

    # What to send -------------------------------------------------------------------------------------------------

    def messages(self, now_ns: int) -> list[Message]:
        """Return the messages to send now."""
        if self.stop.active:
            return [EmergencyStopMessage()] if self.stop.step(self._motors_are_off(now_ns), now_ns) else []
        if self._disarm:
            self._disarm = False
            return [Arm(False)]
        if self._decision is Decision.TAKE_OFF:
            return self._starting(now_ns)
        if self._decision is Decision.LAND:
            if not self._may_fly(now_ns):
                return []  # on the ground, a landing would start the motors
            # One that has landed unseen must not start its motors.
            if self._flight is None and now_ns >= self._lands_until_ns and self._is_fresh(now_ns):
                self._land(now_ns)
        told: list[Message] = []
        if 0 < self._relaxes < RELAXES and now_ns >= self._relax_ns:
            self._relaxes, self._relax_ns = self._relaxes - 1, now_ns + AGAIN_NS
            told = [NotifySetpointsStop()]
        steered: list[Message] = []
        if self._decision is Decision.STAY and self._steering and self._was_flying:
            steered = self._steered(now_ns)
        return [*told, *self._flown(now_ns), *steered]

    def _is_fresh(self, now_ns: int) -> bool:
        return self._state_ns is not None and now_ns - self._state_ns <= FRESH_NS

    def _may_fly(self, now_ns: int) -> bool:
        flying = self._flies(now_ns)
        return now_ns < self._rises_until_ns or (self._was_flying if flying is None else flying)

    def _starting(self, now_ns: int) -> list[Message]:
        landed = self._flies(now_ns) is False
        if not landed:
            self._flight = None
            return []
        if not self._is_fresh(now_ns):
            return []  # it may be rising
        if now_ns - self._decided_ns >= REFUSES_NS:
            self._give_up("the vehicle did not take off: it may not be armed, or its battery is low", now_ns, stop=True)
            return []
        if self.telemetry.is_armed is False:
            if self._armed_ns is not None and now_ns - self._armed_ns < ARM_NS:
                return []
            self._armed_ns = now_ns
            return [HighLevelStop(), Arm(True)]  # end an earlier flight first
        sent = self._flown(now_ns)
        if sent:
            self._rises_until_ns = now_ns + RISES_NS
        return sent

    def _flown(self, now_ns: int) -> list[Message]:
        """Return the flight that waits to be sent."""
        flight = self._flight
        if flight is None or now_ns < flight.due_ns:
            return []
        flight.tries -= 1
        flight.due_ns = now_ns + AGAIN_NS
        sent = flight.message
        if flight.tries <= 0:
            self._flight = None
            self._lands_until_ns = min(self._lands_until_ns, flight.due_ns)
            if not isinstance(sent, HighLevelTakeoff | HighLevelStop):
                self._relax(flight.due_ns)  # the answers may be lost; without it, the motors would stop in any case
        # On the ground, low-level set-points must have ended before a take-off; no motor runs that this could stop.
        first = isinstance(sent, HighLevelTakeoff) and self._relaxes
        return [NotifySetpointsStop(), sent] if first else [sent]

    def _steered(self, now_ns: int) -> list[Message]:
        setpoint = self._setpoint
        if self._state_ns is None or now_ns - self._state_ns > SILENT_NS:
            if not self.flies_by_setpoints:
                return []  # if it has landed meanwhile, a flight would start its motors
            self._setpoint = None  # no state arrives: end the vehicle's need for our set-points
            self._hold(now_ns)
            return self._flown(now_ns)
        if self.flies_by_setpoints:
            if now_ns - self._sent_ns < LOW_LEVEL_NS:
                return []
            assert isinstance(setpoint, Velocity | Attitude)
            return [self._low(setpoint, now_ns)]
        if isinstance(setpoint, Velocity):
            return self._short_flights(setpoint, now_ns)
        if isinstance(setpoint, Position):
            return self._to_place(setpoint, now_ns)
        return []

    def _low(self, setpoint: Velocity | Attitude, now_ns: int) -> Message:
        position = self.telemetry.estimate.position_m
        z = position[2] if position is not None else 0.0
        climb = setpoint.up if isinstance(setpoint, Velocity) else setpoint.climb
        since_s = min(0.2, seconds(now_ns - self._sent_ns))
        held = z if self._height_m is None else self._height_m + climb * since_s
        self._height_m = within(held, z - AHEAD_M, z + AHEAD_M)
        self._sent_ns, self._relaxes, self._flight = now_ns, RELAXES, None
        turn = math.degrees(setpoint.yaw_rate)
        if isinstance(setpoint, Velocity):
            return HoverSetpoint(setpoint.forward, setpoint.left, turn, self._height_m)
        # The vehicle's pitch is positive with the nose up.
        return ZDistanceSetpoint(math.degrees(setpoint.roll), -math.degrees(setpoint.pitch), turn, self._height_m)

    def _short_flights(self, velocity: Velocity, now_ns: int) -> list[Message]:
        changed = velocity != self._wanted or self._moving is None
        if now_ns - self._sent_ns < (HURRY_NS if changed else HIGH_LEVEL_NS):
            return []
        if self._relaxes == RELAXES:  # the high-level commander must take over first
            if self._flight is None:
                self._hold(now_ns, here=True)
            return self._flown(now_ns)
        if velocity == Velocity():
            if self._moving != Velocity():
                self._hold(now_ns)
            self._wanted = velocity
            return self._flown(now_ns)
        estimate = self.telemetry.estimate
        if estimate.position_m is None or estimate.yaw_rad is None:
            return []
        since_s = min(0.2, seconds(now_ns - self._sent_ns))
        moving = self._moving or Velocity()
        vx, vy = turned(moving.forward, moving.left, estimate.yaw_rad)
        x, y, z = self._planned or estimate.position_m
        self._planned = x + vx * since_s, y + vy * since_s, z + moving.up * since_s
        eased = _eased(moving, velocity, since_s)
        self._moving, self._wanted, self._sent_ns, self._flight = eased, velocity, now_ns, None
        leg = self._leg(eased, LEG_GAIN)
        speed = math.hypot(velocity.forward, velocity.left, velocity.up)
        if math.dist(self._planned, estimate.position_m) > AHEAD_M + LEG_S * speed:
            # The plan is elsewhere: start from where the vehicle is.
            x, y, z = self._planned = estimate.position_m
            yaw = wrap_angle(estimate.yaw_rad + leg.yaw_rad)
            leg = replace(leg, relative=False, x_m=x + leg.x_m, y_m=y + leg.y_m, z_m=z + leg.z_m, yaw_rad=yaw)
        return [leg]

    def _leg(self, velocity: Velocity, gain: float) -> GoTo:
        """Return a short flight at a velocity, relative to the vehicle's plan."""
        yaw = self.telemetry.estimate.yaw_rad or 0.0
        reach = gain * LEG_S
        x, y = turned(velocity.forward * reach, velocity.left * reach, yaw + velocity.yaw_rate * LEG_S / 4)
        return GoTo(0, True, False, x, y, velocity.up * reach, velocity.yaw_rate * reach, LEG_S)

    def _to_place(self, place: Position, now_ns: int) -> list[Message]:
        estimate = self.telemetry.estimate
        if estimate.position_m is None or estimate.yaw_rad is None or place == self._place:
            return []
        if self._place is not None and now_ns - self._sent_ns < HIGH_LEVEL_NS:
            return []
        if place.yaw is not None or self._heading_rad is None:
            self._heading_rad = wrap_angle(estimate.yaw_rad if place.yaw is None else place.yaw)
        speed, turn = place.speed or 0.5, place.turn_rate or 1.0
        far_s = PEAK * math.dist(estimate.position_m, place.place) / speed
        turned_s = PEAK * abs(wrap_angle(self._heading_rad - estimate.yaw_rad)) / turn
        duration_s = max(SHORTEST_S, far_s, turned_s)
        self._place, self._sent_ns, self._moving = place, now_ns, None
        self._flight = _Flight(GoTo(0, False, False, *place.place, self._heading_rad, duration_s))
        return self._flown(now_ns)

    def _motors_are_off(self, now_ns: int) -> bool | None:
        if not self.receiving or self._state_ns is None:
            return None
        if self.telemetry.is_locked:
            return True
        running = self.telemetry.motors_run
        seen_ns = self._state_ns if running is None else self.telemetry.motors_ns
        if seen_ns is None or not self.stop.settled(seen_ns):
            return None
        running = self._flies(now_ns) if running is None else running
        return None if running is None else not running


def _eased(now: Velocity, wanted: Velocity, since_s: float) -> Velocity:
    """Return the velocity on the way from one to another after a time."""
    part = 1.0 - math.exp(-since_s / EASE_S)
    pairs = (
        (now.forward, wanted.forward),
        (now.left, wanted.left),
        (now.up, wanted.up),
        (now.yaw_rate, wanted.yaw_rate),
    )
    return Velocity(*(goal if abs(goal - at) < 0.01 else at + part * (goal - at) for at, goal in pairs))
