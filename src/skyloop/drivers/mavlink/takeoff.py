"""A take-off, from a vehicle that stands disarmed in whatever mode to one that hovers. Pure, level-triggered.

Each step asks for what is missing: the mode to arm in, arming, the command. Refusals are told with the vehicle's own
words, and tried again, for as long as somebody asks for the take-off.
"""

from __future__ import annotations

from typing import Final

from skyloop.clock import nanoseconds
from skyloop.drivers.mavlink.commander import ACCEPTED, Commander, Order, result_name
from skyloop.drivers.mavlink.dialects import Dialect
from skyloop.drivers.mavlink.set_points import STEER_NS, place_message, velocity_message
from skyloop.drivers.mavlink.telemetry import View
from skyloop.messages import Velocity
from skyloop.wire.mavlink.axes import Vector
from skyloop.wire.mavlink.codec import Message
from skyloop.wire.mavlink.codec import dialect as m
from skyloop.wire.mavlink.modes import Landed

PATIENCE_NS: Final = nanoseconds(6.0)  #: nobody asked for so long, and it is not armed: it is given up
RISING_NS: Final = nanoseconds(8.0)  #: an armed one that does not leave the ground by then is given up
ARM_PACE_S: Final = 1.0
ARMED_NS: Final = nanoseconds(2.5)  #: what an acknowledgement says of arming, until a heartbeat says it
ARM: Final = Order(m.MAV_CMD_COMPONENT_ARM_DISARM, (1.0,))
LEFT_GROUND_M: Final = 0.3
STRAYED_NS: Final = nanoseconds(0.6)  #: another mode must show for so long: messages may overtake one another
STALLED_NS: Final = nanoseconds(6.0)  #: no higher than before for so long: something cancelled the climb


class TakeOff:
    """One take-off. ``asked_ns``: when it was asked for last."""

    def __init__(self, dialect: Dialect, height_m: float, now_ns: int) -> None:
        self.asked_ns = now_ns
        self.done = False
        self.given_up = ""  #: why, once it is
        self.taken_over = False  #: somebody chose another mode in the air
        self.rose = False  #: it left the ground
        self.lead_ns: int | None = None  #: since when set-points flow
        self.words = ""  #: the vehicle's own, of why it can't be armed
        self._dialect = dialect
        self._height_m = height_m
        self._begun_ns = now_ns
        self._armed_ns: int | None = None  # when it was seen or said to be armed first
        self._order: Order | None = None
        self._best_m = -1.0
        self._best_ns = now_ns
        self._place: Vector | None = None
        self._place_ns: int | None = None
        self._ground_m: float | None = None
        self._other_ns: int | None = None
        self._sent_ns = 0
        self._seen = not dialect.TAKING_OFF  # its mode for taking off, where it has one
        self.refused = ""  #: why it is not armed yet

    @property
    def started(self) -> bool:
        """Whether the motors run for it: from here on it goes on by itself."""
        return self._armed_ns is not None

    def step(self, view: View, commander: Commander, now_ns: int) -> list[Message]:
        """Ask for what is missing; messages besides."""
        self._look(view, commander, now_ns)
        if self.done or self.given_up or self.taken_over:
            return []
        if self.rose:
            return self._climb(view, commander.target, now_ns)
        if not view.armed and view.mode != self._dialect.ARMING and self._order is None:
            commander.say(self._dialect.mode_order(self._dialect.ARMING), now_ns)
        elif self._armed_ns is None:
            commander.say(ARM, now_ns, ARM_PACE_S)
        elif view.mode in (self._dialect.ARMING, *self._dialect.TAKING_OFF) or self._order is not None:
            self._order = self._order or self._dialect.takeoff_order(self._height_m, view)
            if self._order is not None:
                commander.say(self._order, now_ns, ARM_PACE_S)
        else:
            commander.say(self._dialect.mode_order(self._dialect.ARMING), now_ns)
        return []

    def _look(self, view: View, commander: Commander, now_ns: int) -> None:
        """What came of it so far."""
        answer = commander.answer(ARM.command, self._begun_ns)
        if self._armed_ns is None:
            if view.armed or answer == ACCEPTED:
                self._armed_ns = now_ns
            elif answer is not None:
                self.refused = f"arming was {result_name(answer)}" + (f": {self.words}" if self.words else "")
            if self._armed_ns is None and now_ns - self.asked_ns > PATIENCE_NS:
                self.given_up = self.refused or "the vehicle does not answer"
            return
        height = view.altitude_m if view.altitude_m is not None else 0.0
        self._seen = self._seen or view.mode in self._dialect.TAKING_OFF
        told = self._order is not None or view.mode in self._dialect.TAKING_OFF
        self.rose = self.rose or (told and view.armed and self._is_off_ground(view.landed, height))
        self._look_at_mode(view.mode, now_ns)
        if not view.armed and now_ns - self._armed_ns > ARMED_NS:
            self.given_up = "the vehicle disarmed itself"
        elif not self.rose and now_ns - self._armed_ns > RISING_NS:
            result = commander.answer(m.MAV_CMD_NAV_TAKEOFF, self._begun_ns)
            refused = f": the take-off was {result_name(result)}" if result not in (None, ACCEPTED) else ""
            self.given_up = f"it does not leave the ground{refused}"
        elif self._dialect.has_taken_off(view, self._height_m, self.rose and self._seen):
            self.done = True
        elif self._place_ns is not None and now_ns - self._place_ns > STALLED_NS:
            self.done = True  # as high as it gets, by the altitude that it tells
        if height > self._best_m + 0.05:
            self._best_m, self._best_ns = height, now_ns

    def _is_off_ground(self, landed: Landed, height_m: float) -> bool:
        """By its own word, or by its altitude where it has none."""
        if landed is not Landed.UNKNOWN:
            return landed is not Landed.ON_GROUND
        if self._ground_m is None:
            self._ground_m = height_m
        return height_m - self._ground_m > LEFT_GROUND_M

    def _look_at_mode(self, mode: str, now_ns: int) -> None:
        """Somebody may choose another one on the way up."""
        dialect = self._dialect
        ours = mode in dialect.TAKING_OFF or mode in (dialect.ARMING, dialect.GUIDED)
        if ours or not self.rose:
            self._other_ns = None
        elif self._other_ns is None:
            self._other_ns = now_ns
        elif now_ns - self._other_ns >= STRAYED_NS:
            self.taken_over = True

    def _climb(self, view: View, target: tuple[int, int], now_ns: int) -> list[Message]:
        """Set-points for where they must flow before the mode that follows them, which goes on from here.

        If the climb was cancelled: a place to go to, which is all that helps an ArduCopter.
        """
        stalled = now_ns - self._best_ns > STALLED_NS and view.mode == self._dialect.GUIDED
        if self._place is None:
            if not stalled or view.place is None or view.altitude_m is None:
                return self._lead(target, now_ns)
            north, east, down = view.place
            self._place, self._place_ns = (north, east, down + view.altitude_m - self._height_m), now_ns
        if now_ns - self._sent_ns < STEER_NS:
            return []
        self._sent_ns = now_ns
        return [place_message(self._place, target)]

    def _lead(self, target: tuple[int, int], now_ns: int) -> list[Message]:
        if not self._dialect.LEAD_S or now_ns - self._sent_ns < STEER_NS:
            return []
        self._sent_ns = now_ns
        self.lead_ns = self.lead_ns or now_ns
        return [velocity_message(Velocity(), target)]
