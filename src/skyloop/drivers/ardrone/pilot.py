"""What the drone is told at each tick: ``REF`` and ``PCMD`` for the last thing decided. Pure.

``REF`` says take-off, landing and emergency as bits that must be repeated until navdata shows the new state, and whose
emergency bit toggles: it is set only while the drone is known to be in the other state, and let go as soon as navdata
shows the change.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto
from typing import Final

from skyloop.clock import nanoseconds
from skyloop.drivers.ardrone.sender import Message
from skyloop.drivers.ardrone.set_points import Stick, StickLimits, motion, stick_of
from skyloop.drivers.notices import Notice
from skyloop.errors import DriverError
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
from skyloop.wire.ardrone.at import Ref
from skyloop.wire.ardrone.navdata import ControlState, State

TAKEOFF_PATIENCE_NS: Final = nanoseconds(5.0)  #: a drone that has not started by then refuses to
TOGGLE_NS: Final = nanoseconds(0.5)  #: the emergency bit is let go and set anew if it showed no effect for so long


@dataclass(frozen=True, slots=True)
class Condition:
    """What the newest navdata say of the flight."""

    state: State
    control: ControlState | None = None

    @property
    def flying(self) -> bool:
        return bool(self.state & State.FLYING)

    @property
    def emergency(self) -> bool:
        return bool(self.state & State.EMERGENCY)


class Decision(Enum):
    """What is wanted of take-off and landing."""

    STAY = auto()  #: as it is: in the air if it flies
    TAKE_OFF = auto()
    LAND = auto()


class Pilot:
    """Remembers the last decision and puts it into commands, tick by tick.

    ``reference_rad`` makes set-points relative to a heading (see :func:`skyloop.drivers.ardrone.set_points.motion`).
    """

    def __init__(self) -> None:
        self.condition: Condition | None = None  #: None while the drone is not heard
        self.limits: StickLimits | None = None  #: None until they were read
        self.reference_rad: float | None = None
        self._decision = Decision.STAY
        self._stick: Stick | None = None
        self._landing_is_ours = False
        self._decided_ns = 0
        self._toggle: bool | None = None  #: whether the motors shall be cut (True) or released (False); None: neither
        self._toggle_ns = 0
        self._heard_ns = 0
        self._told_blind = False
        self._notices: list[Notice] = []

    @property
    def intent(self) -> tuple[object, ...]:
        """Changes when something else is to be said."""
        return self._decision, self._stick, self._toggle

    # What is decided -------------------------------------------------------------------------------------------

    def take(self, action: AnyAction, now_ns: int) -> AnyAction:
        """Decide; returns what is really applied. Raises :class:`DriverError` for what can't be done now."""
        if isinstance(action, Idle):
            return action
        if isinstance(action, EmergencyStop):
            self._stop_motors(now_ns)
        elif isinstance(action, ResetEmergency):
            self._release_motors(now_ns)
        elif isinstance(action, Takeoff):
            self._take_off(now_ns)
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
        if self.condition is not None and self.condition.emergency:
            self._toggle = None
        elif self._toggle is not True:
            self._toggle, self._toggle_ns = True, now_ns

    def _release_motors(self, now_ns: int) -> None:
        if self.condition is None:
            raise DriverError("the drone is not heard: whether there is an emergency to reset can't be known")
        self._decision, self._stick, self._landing_is_ours = Decision.LAND, None, False
        if self.condition.emergency and self._toggle is not False:
            self._toggle, self._toggle_ns = False, now_ns

    def _take_off(self, now_ns: int) -> None:
        if self.condition is None:
            raise DriverError("the drone is not heard: it does not take off blindly")
        if self.condition.emergency or self._toggle is not None:
            raise DriverError("the drone is in emergency: reset it first")
        if self._decision is not Decision.TAKE_OFF:
            self._decided_ns = now_ns
        self._decision, self._stick = Decision.TAKE_OFF, None

    def _steer(self, action: Attitude) -> AnyAction:
        if self.limits is None:
            self._remain(None)
            if not self._told_blind:
                self._told_blind = True
                text = "the drone's limits are not known yet: it hovers instead of following set-points"
                self._notices.append(
                    Notice(EventKind.VEHICLE_MESSAGE, text, Severity.WARNING, {"reason": "limits_unknown"})
                )
            return Hover()
        stick, applied = stick_of(action, self.limits)
        self._remain(stick)
        return applied

    def _remain(self, stick: Stick | None) -> None:
        self._stick = stick
        if self._decision is Decision.LAND:
            self._decision = Decision.STAY

    # What is heard ---------------------------------------------------------------------------------------------

    def heard(self, condition: Condition, now_ns: int) -> None:
        """The newest navdata."""
        if self.condition is not None and self.condition.flying and not condition.flying:
            self._stick = None
        self.condition, self._heard_ns = condition, now_ns
        if self._toggle is condition.emergency:
            self._toggle = None
        if condition.emergency:
            self._decision, self._stick = Decision.LAND, None
        elif self._decision is Decision.TAKE_OFF and condition.flying:
            self._decision, self._landing_is_ours = Decision.STAY, False
        elif not condition.flying and condition.control is not ControlState.LANDING:
            self._landing_is_ours = False

    def lost(self) -> None:
        """The drone is not heard any more: what it does is not known, and a take-off is not wanted any longer."""
        self.condition = None
        self._told_blind = False
        if self._toggle is False:
            self._toggle = None
        if self._decision is Decision.TAKE_OFF:
            self._decision = Decision.STAY

    # What is said ----------------------------------------------------------------------------------------------

    def notices(self) -> list[Notice]:
        """What there is to tell since the last call."""
        notices, self._notices = self._notices, []
        return notices

    def messages(self, now_ns: int) -> list[Message]:
        """``REF``, unless nothing is to be said of take-off and landing, and ``PCMD``."""
        bits = self._emergency_bits(now_ns)
        if bits is None:
            bits = self._flight_bits(now_ns)
        moving = motion(self._stick, self.reference_rad if self._stick is not None else None)
        return [moving] if bits is None else [("REF", (int(Ref.FIXED | bits),)), moving]

    def _emergency_bits(self, now_ns: int) -> Ref | None:
        if self._toggle is None:
            return None
        if self.condition is None or self._heard_ns - self._toggle_ns < TOGGLE_NS:
            return Ref.EMERGENCY
        self._toggle_ns = now_ns  # it was heard since, and shows no effect: let go once, for the next edge
        return Ref(0)

    def _flight_bits(self, now_ns: int) -> Ref | None:
        if self._decision is Decision.TAKE_OFF:
            if now_ns - self._decided_ns < TAKEOFF_PATIENCE_NS:
                return Ref.TAKEOFF
            self._decision = Decision.STAY
            text = "the drone did not take off: it may refuse because of its battery, its tilt or its sensors"
            self._notices.append(Notice(EventKind.VEHICLE_MESSAGE, text, Severity.WARNING, {"reason": "no_takeoff"}))
        if self._decision is Decision.LAND:
            return Ref(0)
        if self.condition is None:
            return None  # whatever it does, it goes on with
        by_itself = self.condition.control is ControlState.LANDING and not self._landing_is_ours
        return Ref.TAKEOFF if self.condition.flying and not by_itself else Ref(0)
