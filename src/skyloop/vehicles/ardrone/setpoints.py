"""Set-points to ``REF`` and ``PCMD``: what is sent to the drone at each tick. Pure.

``REF`` has take-off, landing and emergency as bits that must be repeated until navdata shows the new state. The
emergency bit toggles when it is set after it was clear. It is set once for what is asked for, and repeated as packets
get lost, until navdata shows the change; again only after navdata that the drone made later showed no effect, as one
toggle too many would undo the first. ``PCMD`` takes roll (positive to the right), pitch (negative nose down), climb
(positive up) and yaw rate (positive clockwise), each from -1 to 1: shares of the limits that the drone is configured
with.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum, auto
from typing import Final

from skyloop.clock import nanoseconds
from skyloop.drivers.motor_stop import MotorStop
from skyloop.drivers.vehicle_session import VehicleEvent
from skyloop.errors import DecodeError, DriverError
from skyloop.messages import (
    AnyAction,
    Attitude,
    EmergencyStop,
    EventKind,
    Hover,
    Idle,
    Land,
    ResetEmergency,
    Severity,
    Takeoff,
)
from skyloop.messages.geometry import clamped
from skyloop.vehicles.ardrone.wire.at import AtMessage, Pcmd, Ref
from skyloop.vehicles.ardrone.wire.configuration import parse_value
from skyloop.vehicles.ardrone.wire.navdata import ControlState, State

HEADING_ACCURACY: Final = 0.1  #: of the reference that goes with ``PCMD_MAG``, as share of half a turn
_KEYS: Final = ("control:euler_angle_max", "control:control_vz_max", "control:control_yaw")


@dataclass(frozen=True, slots=True)
class StickLimits:
    """What a stick value of 1 means."""

    tilt_rad: float
    climb_m_s: float
    yaw_rate_rad_s: float


@dataclass(frozen=True, slots=True)
class Stick:
    """The four values of ``PCMD``, each from -1 to 1, with its signs."""

    roll: float
    pitch: float
    climb: float
    yaw: float


def limits_of(configuration: Mapping[str, str]) -> StickLimits | None:
    """Return the limits in force from the drone's configuration; None if it lacks one or one is not positive."""
    try:
        tilt, climb_mm_s, yaw = (float(str(parse_value(configuration[key], 0.0))) for key in _KEYS)
    except (KeyError, DecodeError):
        return None
    if min(tilt, climb_mm_s, yaw) <= 0:
        return None
    return StickLimits(tilt, climb_mm_s / 1000, yaw)


def stick_of(action: Attitude, limits: StickLimits) -> tuple[Stick, Attitude]:
    """Return the stick values for an attitude, and the attitude that they ask for, within the drone's limits."""
    stick = Stick(
        roll=_share(action.roll, limits.tilt_rad),
        pitch=_share(-action.pitch, limits.tilt_rad),
        climb=_share(action.climb, limits.climb_m_s),
        yaw=_share(-action.yaw_rate, limits.yaw_rate_rad_s),
    )
    applied = Attitude(
        roll=clamped(action.roll, limits.tilt_rad),
        pitch=clamped(action.pitch, limits.tilt_rad),
        climb=clamped(action.climb, limits.climb_m_s),
        yaw_rate=clamped(action.yaw_rate, limits.yaw_rate_rad_s),
    )
    return stick, applied


def motion(stick: Stick | None, reference_rad: float | None = None) -> AtMessage:
    """Return ``PCMD`` for these stick values; None: hover.

    With a reference it is ``PCMD_MAG``: forward and right are then those of somebody who looks along that heading (0
    magnetic north, positive counter-clockwise), wherever the drone's nose points.
    """
    if stick is None:
        return ("PCMD", (int(Pcmd.HOVER), 0.0, 0.0, 0.0, 0.0))
    values = (stick.roll, stick.pitch, stick.climb, stick.yaw)
    if reference_rad is None:
        return ("PCMD", (int(Pcmd.PROGRESSIVE), *values))
    heading = -reference_rad / math.pi + 0.0  # without a negative zero
    return ("PCMD_MAG", (int(Pcmd.PROGRESSIVE | Pcmd.ABSOLUTE), *values, heading, HEADING_ACCURACY))


def _share(value: float, limit: float) -> float:
    return clamped(value / limit, 1.0) + 0.0  # without a negative zero


TAKEOFF_PATIENCE_NS: Final = nanoseconds(5.0)  #: a drone that has not started by then refuses to
RISES_NS: Final = nanoseconds(3.0)  #: so long after a take-off was sent what rises is no other program's flight
#: So long after the emergency bit changed, by the clocks of both ends, navdata show what that did.
TOGGLE_NS: Final = nanoseconds(0.5)


#: A landing is completed below this: navdata are up to 0.25 s old, and what stands by now rises by the take-off bit.
BREAK_OFF_M: Final = 0.5
#: What a landing that goes on shows.
_LANDING_ON: Final = (ControlState.LANDING, ControlState.LANDED, None)


@dataclass(frozen=True, slots=True)
class Condition:
    """What the newest navdata say of the flight."""

    state: State
    control: ControlState | None = None
    altitude_m: float | None = None  #: above what is below; None: not known

    @property
    def flying(self) -> bool:
        """Whether the drone is in the air."""
        return bool(self.state & State.FLYING)

    @property
    def emergency(self) -> bool:
        """Whether the motors are cut."""
        return bool(self.state & State.EMERGENCY)

    @property
    def touches_down(self) -> bool:
        """Whether a landing is at its end, or may be."""
        low = self.altitude_m is None or self.altitude_m < BREAK_OFF_M
        return self.control is ControlState.LANDED or (self.control is ControlState.LANDING and low)


#: After so long without navdata a drone may stand that flew: it lands by itself where it hears nothing for 2 s.
SILENT_NS: Final = nanoseconds(0.25)


class Decision(Enum):
    """What is wanted of take-off and landing."""

    STAY = auto()  #: as it is: in the air if it flies
    TAKE_OFF = auto()
    LAND = auto()


class SetpointController:
    """Remembers the last action and turns it into commands, tick by tick.

    ``reference_rad`` makes set-points relative to a heading (see :func:`skyloop.vehicles.ardrone.setpoints.motion`).
    """

    def __init__(self) -> None:
        self.condition: Condition | None = None  #: None while nothing is received from the drone
        self.limits: StickLimits | None = None  #: None until they were read
        self.reference_rad: float | None = None
        self.stop = MotorStop(self._forget_flight)
        self._decision = Decision.STAY
        self._stick: Stick | None = None
        self._landing_is_ours = False
        self._decided_ns = 0
        self._rises_until_ns = 0  # a take-off was sent, and may show until then
        self._releasing = False  # a reset was asked for, and does not show
        self._emergency = False  # whether the newest navdata showed one, even if it is lost since
        self._bit = False  # whether the emergency bit was sent last
        self._bit_due = False  # it is to be set, whatever navdata show
        self._changed_ns = 0  # when it changed, was asked for, or an emergency was over
        self._passed_ns = 0  # of the drone's time since then, up to the newest navdata
        self._received_ns = 0
        self._late_ns = 0  # so old are navdata that waited, and come in a row after a gap
        self._warned_blind = False
        self._steering = False  # this flight was begun, or taken, here: else another program may be flying it
        self._events: list[VehicleEvent] = []

    @property
    def intent(self) -> tuple[object, ...]:
        """Changes when something else is to be sent."""
        return self._decision, self._stick, self.stop.active, self._releasing

    # What is decided -------------------------------------------------------------------------------------------

    def apply(self, action: AnyAction, now_ns: int) -> AnyAction:
        """Accept an action.

        Args:
            action: One of the driver's ``ACTIONS``.
            now_ns: The present time.

        Returns:
            What is applied: an attitude within the drone's limits, or hover while the limits are not known or an
            emergency stop is in force.

        Raises:
            DriverError: A take-off while nothing is received or in emergency, a reset while nothing is received, or an
                action that the drone does not have.
        """
        if isinstance(action, Idle):
            return action
        self._steering = True
        if isinstance(action, EmergencyStop):
            self._stop_motors(now_ns)
        elif isinstance(action, ResetEmergency):
            self._release_motors(now_ns)
        elif isinstance(action, Takeoff):
            self._take_off(now_ns)
        elif self.stop.active:
            return Hover()
        elif isinstance(action, Land):
            self._decision, self._stick, self._landing_is_ours = Decision.LAND, None, True
        elif isinstance(action, Attitude):
            return self._steer(action)
        elif isinstance(action, Hover):
            self._remain(None)
        else:
            raise DriverError(f"the AR.Drone takes no {action.name}")
        return action

    def _stop_motors(self, now_ns: int) -> None:
        self._decision, self._stick, self._landing_is_ours = Decision.LAND, None, False
        self._releasing = False
        if not self.stop.active:
            self._ask_bit(now_ns)
        self.stop.press(now_ns)

    def _forget_flight(self, given_up: VehicleEvent) -> None:
        self._events.append(given_up)
        self._decision, self._steering = Decision.STAY, False

    def forget_landing(self) -> bool:
        """Land no longer; return whether it was to."""
        if not self._landing_is_ours or self._decision is not Decision.LAND:
            return False
        self._decision, self._steering = Decision.STAY, False
        return True

    def _release_motors(self, now_ns: int) -> None:
        if self.condition is None:
            raise DriverError("no data from the drone: whether there is an emergency to reset is not known")
        self.stop.reset()
        self._decision, self._stick, self._landing_is_ours = Decision.LAND, None, False
        if self.condition.emergency and not self._releasing:
            self._releasing = True
            self._ask_bit(now_ns)

    def _take_off(self, now_ns: int) -> None:
        if self.condition is None:
            raise DriverError("no data from the drone: take-off is refused until the link is up")
        if self.condition.emergency or self.stop.active:
            raise DriverError("the drone is in emergency: reset it first")
        if self._decision is not Decision.TAKE_OFF:
            self._decided_ns = now_ns
        self._decision, self._stick = Decision.TAKE_OFF, None

    def _steer(self, action: Attitude) -> AnyAction:
        if self.limits is None:
            self._remain(None)
            if not self._warned_blind:
                self._warned_blind = True
                text = "the drone's limits are not known yet: it hovers instead of following set-points"
                self._events.append(
                    VehicleEvent(EventKind.VEHICLE_MESSAGE, text, Severity.WARNING, {"reason": "limits_unknown"})
                )
            return Hover()
        stick, applied = stick_of(action, self.limits)
        self._remain(stick)
        return applied

    def _remain(self, stick: Stick | None) -> None:
        if self._landing_is_ours and self.condition is not None and self.condition.touches_down:
            self._decision, stick = Decision.LAND, None
        elif self._decision is Decision.LAND:
            self._decision = Decision.STAY
        self._stick = stick

    # What is received ---------------------------------------------------------------------------------------------

    def on_condition(self, condition: Condition, now_ns: int, passed_ns: int | None = None) -> None:
        """Handle the newest navdata.

        Args:
            condition: What they say.
            now_ns: The present time.
            passed_ns: The drone's own time since the navdata before; None: as much as here. What was on its way for
                long, and comes at once, is no news.
        """
        gap_ns = now_ns - self._received_ns
        passed_ns = gap_ns if passed_ns is None else passed_ns
        self._passed_ns += passed_ns
        in_a_row = 2 * gap_ns < passed_ns  # else nothing waits any more
        if gap_ns >= SILENT_NS and self._received_ns:
            self._late_ns = gap_ns - passed_ns
        elif self._late_ns:
            self._late_ns = max(0, self._late_ns + gap_ns - passed_ns) if in_a_row else 0
        found = self.condition is None and gap_ns >= SILENT_NS
        if found or (self._emergency and not condition.emergency):
            self._changed_ns, self._passed_ns = now_ns, 0  # navdata have to go on saying so: these may be old
        self._emergency = condition.emergency
        if self.condition is not None and self.condition.flying and not condition.flying:
            self._stick = None
        was_landing = self.condition is not None and self.condition.control is ControlState.LANDING
        broken_off = was_landing and self._steering and self._decision is Decision.STAY
        if broken_off and condition.control not in _LANDING_ON:
            self._landing_is_ours = False  # the next one may be the drone's own
        self.condition, self._received_ns = condition, now_ns
        self._releasing &= condition.emergency
        stands = not (condition.flying or condition.emergency)
        if stands and self._decision is not Decision.TAKE_OFF and now_ns >= self._rises_until_ns:
            self._steering = False
        if condition.emergency:
            self._decision, self._stick = Decision.LAND, None
        elif self._decision is Decision.TAKE_OFF and condition.flying:
            self._decision, self._landing_is_ours = Decision.STAY, False
        elif not condition.flying and condition.control is not ControlState.LANDING:
            self._landing_is_ours = False

    def lost(self) -> None:
        """Forget the drone's condition, a take-off that is under way and the sticks: nothing is received any more."""
        self.condition = self._stick = None
        self._warned_blind = False
        self._releasing = False
        if self._decision is Decision.TAKE_OFF:
            self._decision = Decision.STAY

    # What is sent ----------------------------------------------------------------------------------------------

    def pop_events(self) -> list[VehicleEvent]:
        """Return the events since the last call."""
        events, self._events = self._events, []
        return events

    def messages(self, now_ns: int) -> list[AtMessage]:
        """Return the commands of this tick: ``PCMD``, and ``REF`` unless nothing is wanted of take-off and landing.

        While another program flies the drone: only the watchdog's answer. While it is not heard and nobody flies it
        from here: nothing, as it may be another program's, and must land by itself where nobody flies it.
        """
        bits = self._emergency_bits(now_ns)
        if bits is None and not self._steering and (self.condition is None or self.condition.flying):
            return [] if self.condition is None else [("COMWDG", ())]
        if bits is None:
            bits = self._flight_bits(now_ns)
        moving = motion(self._stick, self.reference_rad if self._stick is not None else None)
        return [moving] if bits is None else [("REF", (int(Ref.FIXED | bits),)), moving]

    def _ask_bit(self, now_ns: int) -> None:
        self._bit_due = not self._bit  # where it is set already, an effect is waited for
        self._on_bit(now_ns)

    def _on_bit(self, now_ns: int) -> None:
        self._changed_ns = now_ns
        self._passed_ns = self._received_ns - now_ns  # so old are the newest navdata, or what is on its way after them

    def _emergency_bits(self, now_ns: int) -> Ref | None:
        self.stop.step(None if self.condition is None else self.condition.emergency, now_ns)
        wanted = self._releasing or (self.stop.active and not self.stop.shown)
        waited_ns = min(self._received_ns - self._changed_ns, self._passed_ns)
        without_effect = self.condition is not None and waited_ns >= TOGGLE_NS
        before = self._bit
        if not wanted:
            self._bit = self._bit_due = False
        elif before and without_effect:
            self._bit, self._bit_due = False, True  # cleared for one tick, for the next edge
        elif self._bit_due or without_effect:
            self._bit, self._bit_due = True, False
        if self._bit is not before:
            self._on_bit(now_ns)
        if not wanted:
            return None
        return Ref.EMERGENCY if self._bit else Ref(0)

    def _flight_bits(self, now_ns: int) -> Ref | None:
        if self._decision is Decision.TAKE_OFF:
            if now_ns - self._decided_ns < TAKEOFF_PATIENCE_NS:
                self._rises_until_ns = now_ns + RISES_NS
                return Ref.TAKEOFF
            self._decision = Decision.STAY
            text = "the drone did not take off: it may refuse because of its battery, its tilt or its sensors"
            self._events.append(
                VehicleEvent(EventKind.VEHICLE_MESSAGE, text, Severity.WARNING, {"reason": "no_takeoff"})
            )
        if self._decision is Decision.LAND:
            return Ref(0)
        if self.condition is None:
            return None  # it goes on with whatever it does
        if self.condition.flying and max(self._late_ns, now_ns - self._received_ns) >= SILENT_NS:
            return None  # as one that stands would take off
        by_itself = self.condition.control is ControlState.LANDING and not self._landing_is_ours
        lands = by_itself or (self._landing_is_ours and self.condition.touches_down)
        return Ref.TAKEOFF if self.condition.flying and not lands else Ref(0)
