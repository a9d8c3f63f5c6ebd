"""The failsafe ladder: when a flying vehicle that nobody commands hovers, and when it lands. Pure: time is an argument.

Steps go up by themselves (none, hover, land) and are left only by a fresh command or on the ground. The landing may be
one at the start, after a flight back there, where parameters ask for it and nothing is against it. The rules in words
are in ``docs/proxy.md``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

from skyloop.clock import NS_PER_S
from skyloop.messages import Failsafe, FlightState, Hover, Land, ReturnToStart
from skyloop.proxy.core.settings import FailsafeSettings

#: A battery must rise so far above a level before falling below it counts again.
BATTERY_REARM: Final = 0.05

#: Why a step was taken, in words for people.
REASONS: Final = {
    "silent": "the pilot is silent",
    "gone": "the pilot's connection ended",
    "released": "the pilot released the authority",
    "expired": "the pilot's time is over",
    "none": "nobody is in command",
    "vehicle_link": "the link to the vehicle is lost",
    "battery": "the battery is nearly empty",
    "battery_return": "the battery is low",
    "closing": "the proxy is closing",
    "others": "others fly the vehicle",
}

_RANK: Final = {Failsafe.NONE: 0, Failsafe.HOVER: 1, Failsafe.LAND: 2}
_MANOEUVRES: Final = (FlightState.TAKING_OFF, FlightState.LANDING)
_LAND_AT_START: Final = ReturnToStart(land=True)
#: States that show that an action which the driver took did not reach the vehicle.
_CONTRADICTIONS: Final = {
    Hover: frozenset({FlightState.FLYING}),
    Land: frozenset({FlightState.TAKING_OFF, FlightState.HOVERING, FlightState.FLYING, FlightState.UNKNOWN}),
    ReturnToStart: frozenset(),  # it is steered all the way
}


FailsafeTask = Hover | Land | ReturnToStart


@dataclass(frozen=True, slots=True)
class FailsafeInputs:
    """What the ladder decides from."""

    state: FlightState
    airborne: bool
    last_command_ns: int  #: when the last valid command came, whoever held the authority then
    pilot: str  #: ``held``, or why nobody does: ``released``, ``silent``, ``gone``, ``expired``, ``none``
    link_up: bool  #: hop proxy–vehicle
    battery: float | None
    ours: bool = True  #: the flight was begun, or taken, by an application of this proxy
    return_problem: str = ""  #: why it can't return to its start, for a person; empty if it can, or need not
    shown: bool = True  #: its state is what it shows now; else what a vehicle showed last that is not heard


@dataclass(frozen=True, slots=True)
class StepChange:
    """A step was taken or left; to be published."""

    step: Failsafe
    reason: str
    returns: bool = False  #: it lands at its start, after a flight back there
    why: str = ""  #: it does not return although it should, for a person


@dataclass(frozen=True, slots=True)
class BatteryLow:
    """The battery fell below the warning level; published once."""

    battery: float


@dataclass(frozen=True, slots=True)
class FailsafeAction:
    """The vehicle must do this now; report whether it did with :meth:`FailsafeLadder.attempted`."""

    action: FailsafeTask


Effect = StepChange | BatteryLow | FailsafeAction


def due(
    now_ns: int, inputs: FailsafeInputs, settings: FailsafeSettings, *, barred: str, battery_low: bool
) -> tuple[Failsafe, str]:
    """Return the step that is due for a flight of ours, and why, by time, battery and link.

    ``battery_low``: it is below the charge to return at, and the pilot has not taken over for that.
    """
    if barred:
        return Failsafe.LAND, barred
    if battery_low and inputs.state is not FlightState.LANDING:
        return Failsafe.LAND, "battery_return"
    silent_ns = now_ns - inputs.last_command_ns
    silence = "silent" if inputs.pilot == "held" else inputs.pilot
    if silent_ns >= settings.land_after_s * NS_PER_S:
        return Failsafe.LAND, silence
    if inputs.state is FlightState.LANDING:  # better to end a landing than to hang over the place
        return Failsafe.NONE, ""
    if silent_ns >= settings.hover_after_s * NS_PER_S or inputs.pilot == "gone":
        return Failsafe.HOVER, silence
    if not inputs.link_up:
        return Failsafe.HOVER, "vehicle_link"
    return Failsafe.NONE, ""


class FailsafeLadder:
    """The failsafe ladder of one vehicle."""

    def __init__(self, settings: FailsafeSettings | None = None) -> None:
        self.settings = settings or FailsafeSettings()
        self.step = Failsafe.NONE
        self.reason = ""
        self.barred = ""  #: why set-points are refused now: ``battery``, ``closing``, or empty
        self._closing = False
        self._warned = False
        self.battery_low = False  #: it is below the charge to return at, and was not charged since
        self._overruled = False  # the pilot has taken over a return for that, and flies on
        self._wanted: FailsafeTask | None = None
        self.given_up = False  #: a hover or a pilot's landing, of what may do it all the same while it is not heard
        self.wanted_ns = 0  #: when what it wants was begun
        self._taken = False
        self._next_try_ns = 0

    def update(self, now_ns: int, inputs: FailsafeInputs) -> list[Effect]:
        """Take the steps that are due. Call at a steady pace, and at once after anything that matters."""
        effects = self._battery(inputs)
        self.given_up &= inputs.airborne and not inputs.link_up
        if not inputs.airborne:
            self._wanted = None
            return effects + self._move(Failsafe.NONE, inputs.state.value)
        if not inputs.ours:  # what others fly is left alone, whatever is wrong with it
            self._wanted = None
            return effects + self._move(Failsafe.NONE, "others")
        low = self.battery_low and not self._overruled
        told = inputs  # the driver may not show a landing yet that goes on without its pilot
        if isinstance(self._wanted, Land) or self.given_up:  # nothing but a landing comes after that
            told = replace(inputs, state=FlightState.LANDING)
        step, reason = due(now_ns, told, self.settings, barred=self.barred, battery_low=low)
        if _RANK[step] > _RANK[self.step]:
            returns = step is Failsafe.LAND and self._should_return(reason) and told.state is not FlightState.LANDING
            why = inputs.return_problem if returns else ""
            effects += self._begin(StepChange(step, reason, returns and not why, why), now_ns)
        elif self.returning and self.barred:
            effects += self._begin(StepChange(Failsafe.LAND, self.barred), now_ns)
        elif self.returning and inputs.return_problem:
            effects += self._begin(StepChange(Failsafe.LAND, self.reason, why=inputs.return_problem), now_ns)
        unheard = isinstance(self._wanted, Land) and not inputs.shown  # a driver keeps a landing while it is asked for
        return effects + self._try(now_ns, FlightState.UNKNOWN if unheard else inputs.state)

    def fresh_command(self) -> list[Effect]:
        """The pilot sent a fresh command: end the step, unless the vehicle lands for a reason that stays."""
        if self.barred:
            return []
        self._overruled |= self.lands_for_battery
        self._wanted, self.given_up = None, False
        return self._move(Failsafe.NONE, "fresh command")

    @property
    def idle(self) -> bool:
        """Whether no step is in force and nothing is to be done."""
        return self._wanted is None and self.step is Failsafe.NONE and not self.given_up

    @property
    def returning(self) -> bool:
        """Whether the vehicle is to fly back to its start and land there."""
        return type(self._wanted) is ReturnToStart

    @property
    def lands_for_battery(self) -> bool:
        """Whether it returns, or lands, because the battery is low: a decision of the pilot ends it, no set-point."""
        return self.step is Failsafe.LAND and self.reason == "battery_return"

    def hand_over(self, now_ns: int) -> None:
        """The authority changes hands: hover in between, unless the vehicle is landing for a reason."""
        if not self.lands:
            self._want(Hover(), now_ns)

    @property
    def lands_on(self) -> bool:
        """Whether it goes on with a pilot's landing."""
        return isinstance(self._wanted, Land) and self.step is Failsafe.NONE

    @property
    def lands(self) -> bool:
        """Whether it makes the vehicle land, here or at its start, by whoever's wish."""
        return isinstance(self._wanted, Land | ReturnToStart)

    def land_on(self, now_ns: int) -> None:
        """Go on with a landing that is under way: its pilot leaves, or the link to the vehicle is lost."""
        if not self.lands:
            self._want(Land(), now_ns)

    @property
    def acts(self) -> bool:
        """Whether it makes the vehicle hover or land."""
        return self._wanted is not None

    def give_up(self) -> None:
        """Ask for no hover or pilot's landing any more; only the silence of a pilot lands what is not heard."""
        self._wanted, self.given_up = None, True

    def order_landing(self) -> None:
        """Land because the proxy is about to end; from now on only landing and emergency stop are accepted."""
        self._closing = True
        self.barred = "closing"

    def attempted(self, taken: bool) -> None:
        """Record whether the driver took the last :class:`FailsafeAction`; if not, it comes again after ``retry_s``."""
        self._taken = taken

    def _battery(self, inputs: FailsafeInputs) -> list[Effect]:
        level, settings = inputs.battery, self.settings
        critical = level is not None and level < settings.battery_land
        if critical or not (inputs.airborne and self.barred == "battery"):  # in the air a low battery stays low
            self.barred = "closing" if self._closing else "battery" if critical else ""
        if level is None:
            return []
        if level < settings.battery_return:
            self.battery_low = True
        elif not inputs.airborne or level >= settings.battery_return + BATTERY_REARM:
            self.battery_low = False
        if not (self.battery_low and inputs.airborne):
            self._overruled = False
        if level >= settings.battery_warn + BATTERY_REARM:
            self._warned = False
        if level < settings.battery_warn and not self._warned:
            self._warned = True
            return [BatteryLow(level)]
        return []

    def _should_return(self, reason: str) -> bool:
        """Whether a landing for this reason is to be one at the start."""
        return not self.barred and (reason == "battery_return" or self.settings.returns)

    def _begin(self, change: StepChange, now_ns: int) -> list[Effect]:
        """Take a step, or another way to end it."""
        self.step, self.reason = change.step, change.reason
        landing = _LAND_AT_START if change.returns else Land()
        self._want(landing if change.step is Failsafe.LAND else Hover(), now_ns)
        return [change]

    def _move(self, step: Failsafe, reason: str) -> list[Effect]:
        if step is self.step:
            return []
        self.step, self.reason = step, reason
        return [StepChange(step, reason)]

    def _want(self, action: FailsafeTask, now_ns: int) -> None:
        self._wanted, self._taken, self._next_try_ns = action, False, now_ns
        self.wanted_ns = now_ns

    def _try(self, now_ns: int, state: FlightState) -> list[Effect]:
        wanted = self._wanted
        if wanted is None or now_ns < self._next_try_ns:
            return []
        if self._taken and state not in _CONTRADICTIONS[type(wanted)]:
            return []
        if isinstance(wanted, Hover) and state in _MANOEUVRES:  # each ends safely by itself
            return []
        if isinstance(wanted, ReturnToStart) and state is FlightState.TAKING_OFF:
            return []
        self._next_try_ns = now_ns + int(self.settings.retry_s * NS_PER_S)
        return [FailsafeAction(wanted)]
