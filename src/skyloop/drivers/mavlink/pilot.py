"""What the vehicle is told at each tick, for the last thing decided. Pure.

Set-points are streamed while somebody is at the controls, and only in the mode that follows them. A failsafe, a lost
link and somebody else's change of mode end the stream: then the vehicle's own safety nets are all that flies it.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import Enum, auto
from typing import Final

from skyloop.clock import nanoseconds
from skyloop.drivers.mavlink.commander import Commander, Order
from skyloop.drivers.mavlink.dialects import Dialect
from skyloop.drivers.mavlink.lift import Lift
from skyloop.drivers.mavlink.set_points import Lean, SetPoint, Stay, Steer, velocity_message
from skyloop.drivers.mavlink.takeoff import STRAYED_NS, TakeOff
from skyloop.drivers.mavlink.telemetry import View
from skyloop.drivers.notices import Notice
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
from skyloop.wire.mavlink.codec import Message
from skyloop.wire.mavlink.codec import dialect as m
from skyloop.wire.mavlink.modes import Landed

FORCE: Final = 21196.0  #: "even in flight", of the command to disarm
DISARM: Final = Order(m.MAV_CMD_COMPONENT_ARM_DISARM, (0.0,))
CUT: Final = Order(m.MAV_CMD_COMPONENT_ARM_DISARM, (0.0, FORCE))
CUT_PACE_S: Final = 0.2
CUT_FOR_NS: Final = nanoseconds(10.0)  #: a stop that could not be said for so long is not said any more
SETTLING_NS: Final = nanoseconds(3.0)  #: a take-off that is up counts as done by then, in whatever mode
LATE_NS: Final = nanoseconds(3.0)  #: an order to change the mode may show its effect so much later
PAUSE_NS: Final = nanoseconds(0.5)  #: an action after such a pause is no repeat
HURRY_NS: Final = nanoseconds(0.008)  #: a new set-point goes out no sooner after the last than this


class Intent(Enum):
    """What is wanted."""

    NOTHING = auto()  #: it is left to itself, and to whoever else flies it
    TAKE_OFF = auto()
    FOLLOW = auto()  #: a stream of set-points, hovering included
    HOLD = auto()  #: it holds its place by itself, without a stream
    LAND = auto()


class Pilot:
    """Remembers the last decision and puts it into messages, tick by tick.

    ``lift`` makes the loop of a flight by attitude. ``takeoff_m``: height of a take-off.
    """

    def __init__(self, dialect: Dialect, commander: Commander, takeoff_m: float, lift: Callable[[], Lift]) -> None:
        self.takeoff_m = takeoff_m
        self.intent = Intent.NOTHING
        self.stopped = False  #: the motors were stopped by us, and not released since
        self.left_to = ""  #: the mode that somebody else chose; empty: we are at the controls, or nobody is
        self._dialect = dialect
        self._commander = commander
        self._lift = lift
        self._takeoff: TakeOff | None = None
        self._set_point: SetPoint | None = None
        self._lead_ns: int | None = None  # since when the stream flows
        self._sent_ns = 0
        self._entered = False  # the mode that is wanted was seen since
        self._strayed_ns: int | None = None  # since when it is another one again
        self._settling_ns: int | None = None  # since when a take-off is up, and waits for the mode that follows
        self._applied: tuple[type[AnyAction] | None, int] = (None, 0)  # the last action's kind, and when
        self._repeated: type[AnyAction] | None = None  # the action whose repeats don't take the vehicle back
        self._asked: dict[str, int] = {}  # modes, and when they were asked for last
        self._cut_ns = 0
        self._notices: list[Notice] = []

    # What is decided ---------------------------------------------------------------------------------------------

    def take(self, action: AnyAction, view: View | None, now_ns: int, *, alone: bool = False) -> AnyAction:
        """Decide; returns what is really applied. ``alone``: nobody is at the controls.

        Raises :class:`DriverError` for what can't be done now.
        """
        if isinstance(action, Idle):
            return action
        if isinstance(action, EmergencyStop):
            self._stop(now_ns)
            return action
        if isinstance(action, ResetEmergency):
            return self._release(action, view)
        if self._belongs_to_others(action, view, now_ns, alone):
            return Idle()
        if isinstance(action, Takeoff):
            self._take_off(view, now_ns)
        elif isinstance(action, Land):
            self._land(view)
        elif isinstance(action, Hover):
            return self._hover(action, view, now_ns, alone=alone)
        else:
            return self._steer(action, view, now_ns)
        return action

    def _belongs_to_others(self, action: AnyAction, view: View | None, now_ns: int, alone: bool) -> bool:
        """Whether somebody else put the vehicle into a mode since, and this is no fresh decision to take it back."""
        (kind, at_ns), self._applied = self._applied, (type(action), now_ns)
        if not self.left_to:
            return False
        if alone and not (view is not None and view.failsafe):
            return True  # nobody is at our controls, and somebody is at theirs
        fresh = type(action) is not self._repeated or now_ns - at_ns > PAUSE_NS
        if not alone and (isinstance(action, Velocity | Attitude) or not fresh):
            raise DriverError(f"the vehicle is in {self.left_to}, which was not chosen here: hover, or land, first")
        if kind is not type(action) or fresh:
            self._repeated = None
        self.left_to = ""
        return False

    def _stop(self, now_ns: int) -> None:
        if not self.stopped:
            self._cut_ns = now_ns
        self.stopped = True
        self._end()

    def _release(self, action: ResetEmergency, view: View | None) -> AnyAction:
        if view is None:
            raise DriverError("the vehicle is not heard: whether it lies still can't be known")
        if view.armed:
            raise DriverError("the motors are still armed: there is nothing to reset yet")
        self.stopped = False
        return action

    def _take_off(self, view: View | None, now_ns: int) -> None:
        if view is None:
            raise DriverError("the vehicle is not heard: it does not take off blindly")
        if self.stopped:
            raise DriverError("the motors were stopped in an emergency: reset it first")
        if self.intent is Intent.TAKE_OFF and self._takeoff is not None:
            self._takeoff.asked_ns = now_ns
            if self._takeoff.refused and not self._takeoff.started:
                raise DriverError(f"the vehicle does not start yet, it is tried again: {self._takeoff.refused}")
        elif view.airborne is None:
            raise DriverError("the vehicle is armed, and does not tell yet whether it is in the air")
        elif not view.airborne:
            self._end()
            self.intent, self._takeoff = Intent.TAKE_OFF, TakeOff(self._dialect, self.takeoff_m, now_ns)
        elif self.intent is not Intent.FOLLOW:
            self._follow(Stay(now_ns))

    def _land(self, view: View | None) -> None:
        started = self._takeoff is not None and self._takeoff.started
        if self.stopped:
            return
        self._end()
        if view is None or view.airborne or view.armed or started:
            self.intent = Intent.LAND

    def _hover(self, action: Hover, view: View | None, now_ns: int, *, alone: bool) -> AnyAction:
        if self.stopped or self.intent is Intent.TAKE_OFF:
            return action  # a take-off ends in a hover
        if view is not None and view.airborne is False:
            self._end()
        elif alone or view is None:
            self._end()
            self.intent = Intent.HOLD
        elif self.intent is not Intent.FOLLOW or not isinstance(self._set_point, Stay):
            self._follow(Stay(now_ns))
        return action

    def _steer(self, action: Velocity | Attitude, view: View | None, now_ns: int) -> AnyAction:
        if view is None:
            raise DriverError("the vehicle is not heard: it takes no set-points")
        if self.stopped or view.airborne is False or self.intent is Intent.TAKE_OFF:
            return Idle()  # a set-point would cancel a take-off
        if view.airborne is None and self.intent is not Intent.FOLLOW:
            return Idle()  # on the ground some would start by it
        if isinstance(action, Velocity):
            if isinstance(self._set_point, Steer) and self.intent is Intent.FOLLOW:
                self._set_point.action = action
            else:
                self._follow(Steer(action))
        else:
            if not (isinstance(self._set_point, Lean) and self.intent is Intent.FOLLOW):
                self._follow(Lean(action, self._lift()))
            assert isinstance(self._set_point, Lean)
            action = self._set_point.within(action)
            self._set_point.action = action
        if now_ns - self._sent_ns >= HURRY_NS:
            self._sent_ns = 0  # at once
        return action

    def _follow(self, set_point: SetPoint) -> None:
        streaming = self.intent is Intent.FOLLOW
        lead_ns, entered = (self._lead_ns, self._entered) if streaming else (None, False)
        self._end()
        self.intent, self._set_point = Intent.FOLLOW, set_point
        self._lead_ns, self._entered = lead_ns, entered
        self._sent_ns = 0

    def _end(self) -> None:
        """Nothing is wanted any more, and nothing is streamed."""
        self.intent, self._takeoff, self._set_point = Intent.NOTHING, None, None
        self._lead_ns, self._entered, self._strayed_ns, self._settling_ns = None, False, None, None

    # What is heard -----------------------------------------------------------------------------------------------

    def lost(self) -> None:
        """The link is lost. A stream does not go on by itself when it comes back: the vehicle is to hold its place."""
        if self.intent is Intent.FOLLOW:
            self._end()
            self.intent = Intent.HOLD
        elif self.intent is Intent.TAKE_OFF:
            started = self._takeoff is not None and self._takeoff.started
            self._end()
            self.intent = Intent.HOLD if started else Intent.NOTHING
        self.left_to, self._repeated = "", None

    def told(self, words: str) -> None:
        """The vehicle said why it can't be armed."""
        if self._takeoff is not None:
            self._takeoff.words = words

    def state(self, view: View | None) -> FlightState:
        """The flight state, as far as it is known."""
        if view is None:
            return FlightState.UNKNOWN
        if self.stopped:
            return FlightState.EMERGENCY
        if self.intent is Intent.TAKE_OFF and self._takeoff is not None and self._takeoff.started:
            return FlightState.TAKING_OFF
        if view.airborne is None:
            return FlightState.UNKNOWN
        if not view.airborne:
            return FlightState.LANDED
        if view.mode in self._dialect.LANDING or view.landed is Landed.LANDING:
            return FlightState.LANDING
        if view.mode in self._dialect.TAKING_OFF or view.landed is Landed.TAKING_OFF:
            return FlightState.TAKING_OFF
        if self._settling_ns is not None:
            return FlightState.TAKING_OFF
        if view.mode in self._dialect.HOLDING:
            return FlightState.HOVERING
        if view.mode != self._dialect.GUIDED:
            return FlightState.FLYING
        return FlightState.FLYING if isinstance(self._set_point, Steer | Lean) else FlightState.HOVERING

    # What is said ------------------------------------------------------------------------------------------------

    def notices(self) -> list[Notice]:
        """What there is to tell since the last call."""
        notices, self._notices = self._notices, []
        return notices

    def step(self, view: View, now_ns: int) -> list[Message]:
        """The messages that are due now; commands go through the commander."""
        if self.stopped:
            if view.armed and now_ns - self._cut_ns < CUT_FOR_NS:
                self._commander.say(CUT, now_ns, CUT_PACE_S)
            return []
        if self.intent is Intent.TAKE_OFF:
            return self._step_takeoff(view, now_ns)
        if self.intent is Intent.FOLLOW:
            return self._step_following(view, now_ns)
        if self.intent is Intent.HOLD:
            return self._step_hold(view, now_ns)
        if self.intent is Intent.LAND:
            self._step_land(view, now_ns)
        return []

    def _step_takeoff(self, view: View, now_ns: int) -> list[Message]:
        takeoff = self._takeoff
        assert takeoff is not None
        messages = takeoff.step(view, self._commander, now_ns)
        if takeoff.done:
            self._follow(Stay(now_ns))
            self._lead_ns, self._settling_ns = takeoff.lead_ns, now_ns
        elif takeoff.taken_over:
            self._leave(view)
        elif takeoff.given_up:
            self._tell(f"the vehicle did not take off: {takeoff.given_up}", reason="no_takeoff")
            armed = view.armed
            self._end()
            self.intent = Intent.LAND if armed else Intent.NOTHING  # an armed one on the ground is disarmed
        return messages

    def _step_following(self, view: View, now_ns: int) -> list[Message]:
        assert self._set_point is not None
        if view.airborne is False:
            self._end()
            return []
        inside = view.mode == self._dialect.GUIDED
        if inside or (self._settling_ns is not None and now_ns - self._settling_ns > SETTLING_NS):
            self._settling_ns = None
        if self._strayed(view.mode, inside, now_ns):
            self._leave(view)
            return []
        if self._lead_ns is None:
            self._lead_ns = now_ns
        if not (inside or self._entered) and now_ns - self._lead_ns >= nanoseconds(self._dialect.LEAD_S):
            self._ask_for(self._dialect.GUIDED, now_ns)
        if now_ns - self._sent_ns < self._set_point.period_ns:
            return []
        self._sent_ns = now_ns
        return [self._set_point.message(view, self._commander.target, now_ns)]

    def _ask_for(self, mode: str, now_ns: int) -> None:
        self._asked[mode] = now_ns
        self._commander.say(self._dialect.mode_order(mode), now_ns)

    def _strayed(self, mode: str, inside: bool, now_ns: int) -> bool:
        """Whether the vehicle left the mode that is wanted, after it was there, and not by an order of ours that came
        late."""
        if inside:
            self._entered, self._strayed_ns = True, None
        elif self._entered and now_ns - self._asked.get(mode, -LATE_NS) < LATE_NS:
            self._entered, self._strayed_ns = False, None
        elif self._entered and self._strayed_ns is None:
            self._strayed_ns = now_ns
        return self._strayed_ns is not None and now_ns - self._strayed_ns >= STRAYED_NS

    def _leave(self, view: View) -> None:
        """Somebody else, or the autopilot itself, chose another mode."""
        self.left_to, self._repeated = view.mode, self._applied[0]
        why = "its own failsafe" if view.failsafe else "not from here"
        self._tell(f"the vehicle went to {view.mode} ({why}): it is not steered any more", reason="mode")
        self._end()
        if view.failsafe and view.mode in self._dialect.STICKS:
            self.intent = Intent.HOLD  # nobody may hold the sticks: without them it sinks

    def _step_hold(self, view: View, now_ns: int) -> list[Message]:
        if view.airborne is False:
            self._end()
            return []
        if view.mode in self._dialect.HOLDING or view.mode in self._dialect.LANDING:
            self._end()
            return []
        self._ask_for(self._dialect.HOLD, now_ns)
        if view.mode == self._dialect.GUIDED and now_ns - self._sent_ns >= Stay.period_ns:
            self._sent_ns = now_ns  # until the mode shows, or if it is refused
            return [velocity_message(Velocity(), self._commander.target)]
        return []

    def _step_land(self, view: View, now_ns: int) -> None:
        inside = view.mode in self._dialect.LANDING
        if not view.armed:
            self._end()
        elif view.airborne is False:
            self._commander.say(DISARM, now_ns)
        elif self._strayed(view.mode, inside, now_ns):
            self._leave(view)
        elif not (inside or self._entered):
            self._ask_for(self._dialect.LAND, now_ns)

    def _tell(self, text: str, *, reason: str) -> None:
        self._notices.append(Notice(EventKind.VEHICLE_MESSAGE, text, Severity.WARNING, {"reason": reason}))
