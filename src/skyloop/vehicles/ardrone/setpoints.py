"""Convert set-points to ``REF`` and ``PCMD``, tick by tick. Pure.

``REF`` has bits for take-off, landing and emergency, which must be repeated until navdata reports the new state. The
emergency bit toggles the emergency each time it changes from clear to set. Because packets get lost, a request keeps
the bit set until navdata confirms it. The bit is toggled again only if navdata made later by the drone shows no effect,
because an extra toggle would undo the first. ``PCMD`` has roll (positive to the right), pitch (negative nose down),
climb (positive up) and yaw rate (positive clockwise), each from -1 to 1 as a fraction of the limit set in the drone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum, auto
from typing import Final

from skyloop.clock import nanoseconds
from skyloop.drivers.vehicle_session import MotorStop, VehicleEvent, message
from skyloop.errors import DecodeError, DriverError
from skyloop.messages import (
    AnyAction,
    Attitude,
    EmergencyStop,
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

HEADING_ACCURACY: Final = 0.1  #: accuracy of the reference heading sent with ``PCMD_MAG``, as a fraction of half a turn
_KEYS: Final = ("control:euler_angle_max", "control:control_vz_max", "control:control_yaw")


@dataclass(frozen=True, slots=True)
class StickLimits:
    """The attitude and rates commanded by a stick value of 1."""

    tilt_rad: float
    climb_m_s: float
    yaw_rate_rad_s: float


@dataclass(frozen=True, slots=True)
class ArdroneStick:
    """The four values of ``PCMD``, each from -1 to 1, with that command's signs."""

    roll: float
    pitch: float
    climb: float
    yaw: float


def limits_of(configuration: Mapping[str, str]) -> StickLimits | None:
    """Return the current limits according to the drone's configuration; None if a limit is missing or not positive."""
    try:
        tilt, climb_mm_s, yaw = (float(str(parse_value(configuration[key], 0.0))) for key in _KEYS)
    except (KeyError, DecodeError):
        return None
    if min(tilt, climb_mm_s, yaw) <= 0:
        return None
    return StickLimits(tilt, climb_mm_s / 1000, yaw)


def stick_of(action: Attitude, limits: StickLimits) -> tuple[ArdroneStick, Attitude]:
    """Return the stick values for an attitude, and the attitude that they command within the drone's limits."""
    stick = ArdroneStick(
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


def motion(stick: ArdroneStick | None, reference_rad: float | None = None) -> AtMessage:
    """Return ``PCMD`` for these stick values; None means hover.

    With a reference, return ``PCMD_MAG``, in which forward and right are relative to that heading (0 magnetic north,
    positive counter-clockwise) rather than to the drone's nose.
    """
    if stick is None:
        return ("PCMD", (int(Pcmd.HOVER), 0.0, 0.0, 0.0, 0.0))
    values = (stick.roll, stick.pitch, stick.climb, stick.yaw)
    if reference_rad is None:
        return ("PCMD", (int(Pcmd.PROGRESSIVE), *values))
    heading = -reference_rad / math.pi + 0.0  # avoids a negative zero
    return ("PCMD_MAG", (int(Pcmd.PROGRESSIVE | Pcmd.ABSOLUTE), *values, heading, HEADING_ACCURACY))


def _share(value: float, limit: float) -> float:
    return clamped(value / limit, 1.0) + 0.0  # avoids a negative zero


TAKEOFF_PATIENCE_NS: Final = nanoseconds(5.0)  #: time after which a drone still on the ground is refusing to take off
RISES_NS: Final = nanoseconds(3.0)  #: a rise within this time after sending a take-off is ours, not another program's
#: Navdata reports the effect of the emergency bit within this time, both by the drone's clock and by ours.
TOGGLE_NS: Final = nanoseconds(0.5)
#: Below this height, complete a landing: navdata may be 0.25 s old, and the take-off bit would restart a landed drone.
BREAK_OFF_M: Final = 0.5
#: Control states in which a landing may still be in progress.
_LANDING_ON: Final = (ControlState.LANDING, ControlState.LANDED, None)


@dataclass(frozen=True, slots=True)
class Condition:
    """The state of the flight according to the newest navdata."""

    state: State
    control: ControlState | None = None
    altitude_m: float | None = None  #: height above the surface below; None if unknown

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
        """Whether a landing is over, or may be over at any moment."""
        low = self.altitude_m is None or self.altitude_m < BREAK_OFF_M
        return self.control is ControlState.LANDED or (self.control is ControlState.LANDING and low)


#: After this long without contact a flying drone may have landed, because it lands after 2 s without commands.
SILENT_NS: Final = nanoseconds(0.25)


class ArdroneDecision(Enum):
    """Whether to take off or land."""

    STAY = auto()  #: stay in the air if flying, on the ground otherwise
    TAKE_OFF = auto()
    LAND = auto()


class ArdroneSetpoints:
    """Stores the last action and turns it into commands, tick by tick.

    ``reference_rad`` makes set-points relative to a heading (see :func:`skyloop.vehicles.ardrone.setpoints.motion`).
    """

    def __init__(self) -> None:
        self.condition: Condition | None = None  #: according to the newest navdata; None while the drone is silent
        self.limits: StickLimits | None = None  #: None until the limits have been read
        self.reference_rad: float | None = None
        self.stop = MotorStop(self._forget_flight)
        self._decision = ArdroneDecision.STAY
        self._stick: ArdroneStick | None = None
        self._landing_is_ours = False
        self._decided_ns = 0
        self._rises_until_ns = 0  # time until which a rise may result from a take-off that we sent
        self._releasing = False  # whether a requested reset is not visible in navdata yet
        self._emergency = False  # whether the newest navdata reports an emergency, kept after a link loss
        self._bit = False  # the emergency bit as last sent
        self._bit_due = False  # whether to set the bit next, regardless of navdata
        self._changed_ns = 0  # when the bit last changed or was requested, or an emergency ended
        self._passed_ns = 0  # drone's own time from then until the newest navdata
        self._received_ns = 0
        self._late_ns = 0  # age of the delayed navdata that arrives in a burst after a gap
        self._warned_blind = False
        self._steering = False  # whether we started or took over this flight; otherwise another program may be flying
        self._events: list[VehicleEvent] = []

    @property
    def intent(self) -> tuple[object, ...]:
        """A value that changes when the commands to send change."""
        return self._decision, self._stick, self.stop.active, self._releasing

    # Decisions -------------------------------------------------------------------------------------------------

    def apply(self, action: AnyAction, now_ns: int) -> AnyAction:
        """Accept one of the driver's ``ACTIONS`` and return the applied action.

        This is an attitude within the drone's limits, or hover while the limits are unknown or an emergency stop is in
        force. Raises :class:`DriverError` for a take-off while the drone is silent, or in an emergency or stopped, and
        for a reset while the drone is silent or has not confirmed the stop.
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
            self._decision, self._stick, self._landing_is_ours = ArdroneDecision.LAND, None, True
        elif isinstance(action, Attitude):
            return self._steer(action)
        elif isinstance(action, Hover):
            self._remain(None)
        else:
            raise DriverError(f"the AR.Drone does not support {action.name}")
        return action

    def _stop_motors(self, now_ns: int) -> None:
        self._decision, self._stick, self._landing_is_ours = ArdroneDecision.LAND, None, False
        self._releasing = False
        if not self.stop.active:
            self._ask_bit(now_ns)
        self.stop.press(now_ns)

    def _forget_flight(self, given_up: VehicleEvent) -> None:
        self._events.append(given_up)
        self._decision, self._steering = ArdroneDecision.STAY, False

    def forget_landing(self) -> bool:
        """Cancel a pending landing; return whether there was one."""
        if not self._landing_is_ours or self._decision is not ArdroneDecision.LAND:
            return False
        self._decision, self._steering = ArdroneDecision.STAY, False
        return True

    def _release_motors(self, now_ns: int) -> None:
        if self.condition is None:
            raise DriverError("no data from the drone: cannot tell whether there is an emergency to reset")
        self.stop.reset()
        self._decision, self._stick, self._landing_is_ours = ArdroneDecision.LAND, None, False
        if self.condition.emergency and not self._releasing:
            self._releasing = True
            self._ask_bit(now_ns)

    def _take_off(self, now_ns: int) -> None:
        if self.condition is None:
            raise DriverError("no data from the drone: take-off is refused until the link is up")
        if self.condition.emergency or self.stop.active:
            raise DriverError("the drone is in emergency: reset it first")
        if self._decision is not ArdroneDecision.TAKE_OFF:
            self._decided_ns = now_ns
        self._decision, self._stick = ArdroneDecision.TAKE_OFF, None

    def _steer(self, action: Attitude) -> AnyAction:
        if self.limits is None:
            self._remain(None)
            if not self._warned_blind:
                self._warned_blind = True
                text = "the drone's limits are not known yet: it hovers instead of following set-points"
                self._events.append(message(text, "limits_unknown", Severity.WARNING))
            return Hover()
        stick, applied = stick_of(action, self.limits)
        self._remain(stick)
        return applied

    def _remain(self, stick: ArdroneStick | None) -> None:
        if self._landing_is_ours and self.condition is not None and self.condition.touches_down:
            self._decision, stick = ArdroneDecision.LAND, None
        elif self._decision is ArdroneDecision.LAND:
            self._decision = ArdroneDecision.STAY
        self._stick = stick

    # Receiving ----------------------------------------------------------------------------------------------------

    def on_condition(self, condition: Condition, now_ns: int, passed_ns: int | None = None) -> None:
        """Handle the newest navdata.

        ``passed_ns`` is the drone's own time since the previous navdata; None if it equals the time that passed on this
        host. This distinguishes delayed navdata, which arrives in a burst, from new navdata.
        """
        gap_ns = now_ns - self._received_ns
        passed_ns = gap_ns if passed_ns is None else passed_ns
        self._passed_ns += passed_ns
        in_a_row = 2 * gap_ns < passed_ns  # arrives over twice as fast as it was sent: a burst of delayed navdata
        if gap_ns >= SILENT_NS and self._received_ns:
            self._late_ns = gap_ns - passed_ns
        elif self._late_ns:
            self._late_ns = max(0, self._late_ns + gap_ns - passed_ns) if in_a_row else 0
        found = self.condition is None and gap_ns >= SILENT_NS
        if found or (self._emergency and not condition.emergency):
            self._changed_ns, self._passed_ns = now_ns, 0  # this state may be old: wait for more navdata to confirm it
        self._emergency = condition.emergency
        if self.condition is not None and self.condition.flying and not condition.flying:
            self._stick = None
        was_landing = self.condition is not None and self.condition.control is ControlState.LANDING
        broken_off = was_landing and self._steering and self._decision is ArdroneDecision.STAY
        if broken_off and condition.control not in _LANDING_ON:
            self._landing_is_ours = False  # the drone may start the next landing itself
        self.condition, self._received_ns = condition, now_ns
        self._releasing &= condition.emergency
        stands = not (condition.flying or condition.emergency)
        if stands and self._decision is not ArdroneDecision.TAKE_OFF and now_ns >= self._rises_until_ns:
            self._steering = False
        if condition.emergency:
            self._decision, self._stick = ArdroneDecision.LAND, None
        elif self._decision is ArdroneDecision.TAKE_OFF and condition.flying:
            self._decision, self._landing_is_ours = ArdroneDecision.STAY, False
        elif not condition.flying and condition.control is not ControlState.LANDING:
            self._landing_is_ours = False

    def lost(self) -> None:
        """Discard the condition, any take-off under way and the sticks, because the drone is silent."""
        self.condition = self._stick = None
        self._warned_blind = False
        self._releasing = False
        if self._decision is ArdroneDecision.TAKE_OFF:
            self._decision = ArdroneDecision.STAY

    # Sending ---------------------------------------------------------------------------------------------------

    def pop_events(self) -> list[VehicleEvent]:
        events, self._events = self._events, []
        return events

    def messages(self, now_ns: int) -> list[AtMessage]:
        """Return this tick's commands: ``PCMD``, and ``REF`` if a take-off, landing or emergency needs it.

        While another program is flying the drone, return only the reply to the watchdog. While the drone is silent and
        we are not flying it, return nothing: another program may be flying, and without a pilot the drone must land.
        """
        bits = self._emergency_bits(now_ns)
        if bits is None and not self._steering and (self.condition is None or self.condition.flying):
            return [] if self.condition is None else [("COMWDG", ())]
        if bits is None:
            bits = self._flight_bits(now_ns)
        moving = motion(self._stick, self.reference_rad if self._stick is not None else None)
        return [moving] if bits is None else [("REF", (int(Ref.FIXED | bits),)), moving]

    def _ask_bit(self, now_ns: int) -> None:
        self._bit_due = not self._bit  # if the bit is already set, wait for its effect
        self._on_bit(now_ns)

    def _on_bit(self, now_ns: int) -> None:
        self._changed_ns = now_ns
        self._passed_ns = self._received_ns - now_ns  # negative age of the newest navdata; more may be on its way

    def _emergency_bits(self, now_ns: int) -> Ref | None:
        self.stop.step(None if self.condition is None else self.condition.emergency, now_ns)
        wanted = self._releasing or (self.stop.active and not self.stop.shown)
        waited_ns = min(self._received_ns - self._changed_ns, self._passed_ns)
        without_effect = self.condition is not None and waited_ns >= TOGGLE_NS
        before = self._bit
        if not wanted:
            self._bit = self._bit_due = False
        elif before and without_effect:
            self._bit, self._bit_due = False, True  # clear it for one tick, so that setting it creates another edge
        elif self._bit_due or without_effect:
            self._bit, self._bit_due = True, False
        if self._bit is not before:
            self._on_bit(now_ns)
        if not wanted:
            return None
        return Ref.EMERGENCY if self._bit else Ref(0)

    def _flight_bits(self, now_ns: int) -> Ref | None:
        if self._decision is ArdroneDecision.TAKE_OFF:
            if now_ns - self._decided_ns < TAKEOFF_PATIENCE_NS:
                self._rises_until_ns = now_ns + RISES_NS
                return Ref.TAKEOFF
            self._decision = ArdroneDecision.STAY
            text = "the drone did not take off: it may refuse because of its battery, its tilt or its sensors"
            self._events.append(message(text, "no_takeoff", Severity.WARNING))
        if self._decision is ArdroneDecision.LAND:
            return Ref(0)
        if self.condition is None:
            return None  # leave the drone as it is
        if self.condition.flying and max(self._late_ns, now_ns - self._received_ns) >= SILENT_NS:
            return None  # the drone may have landed and would take off again
        by_itself = self.condition.control is ControlState.LANDING and not self._landing_is_ours
        lands = by_itself or (self._landing_is_ours and self.condition.touches_down)
        return Ref.TAKEOFF if self.condition.flying and not lands else Ref(0)
