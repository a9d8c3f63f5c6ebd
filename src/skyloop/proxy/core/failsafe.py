"""The failsafe ladder: when a flying vehicle that nobody commands hovers, and when it lands. Pure: time is an argument.

Steps go up by themselves (none, hover, land) and are left only by a fresh command or on the ground. The rules in
words are in ``docs/proxy.md``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from skyloop.clock import nanoseconds
from skyloop.messages import Failsafe, FlightState, Hover, Land

#: A battery must rise so far above the warning level before it can warn again.
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
    "closing": "the proxy is closing",
    "others": "others fly the vehicle",
}

_RANK: Final = {Failsafe.NONE: 0, Failsafe.HOVER: 1, Failsafe.LAND: 2}
_MANOEUVRES: Final = (FlightState.TAKING_OFF, FlightState.LANDING)
#: States that show that an action which the driver took did not reach the vehicle.
_CONTRADICTIONS: Final = {
    Hover: frozenset({FlightState.FLYING}),
    Land: frozenset({FlightState.TAKING_OFF, FlightState.HOVERING, FlightState.FLYING}),
}


@dataclass(frozen=True, slots=True)
class FailsafeSettings:
    """When each step is taken. Times in s, battery as charge from 0 to 1."""

    hover_after_s: float = 0.5
    land_after_s: float = 5.0
    retry_s: float = 0.25
    battery_warn: float = 0.2
    battery_land: float = 0.1  #: 0: never


@dataclass(frozen=True, slots=True)
class FailsafeInputs:
    """What the ladder decides from."""

    state: FlightState
    airborne: bool
    last_command_ns: int  #: when the last valid command came, or the authority was granted
    pilot: str  #: ``held``, or why nobody holds the authority: ``released``, ``silent``, ``gone``, ``none``
    link_up: bool  #: hop proxy–vehicle
    battery: float | None
    ours: bool = True  #: the flight was begun, or taken, by an application of this proxy


@dataclass(frozen=True, slots=True)
class StepChange:
    """A step was taken or left; to be published."""

    step: Failsafe
    reason: str


@dataclass(frozen=True, slots=True)
class BatteryLow:
    """The battery fell below the warning level; published once."""

    battery: float


@dataclass(frozen=True, slots=True)
class FailsafeAction:
    """The vehicle must do this now; report whether it did with :meth:`FailsafeLadder.attempted`."""

    action: Hover | Land


Effect = StepChange | BatteryLow | FailsafeAction


class FailsafeLadder:
    """The failsafe ladder of one vehicle."""

    def __init__(self, settings: FailsafeSettings | None = None) -> None:
        self.settings = settings or FailsafeSettings()
        self.step = Failsafe.NONE
        self.reason = ""
        self.barred = ""  #: why set-points are refused now: ``battery``, ``closing``, or empty
        self._closing = False
        self._warned = False
        self._wanted: Hover | Land | None = None
        self._taken = False
        self._next_try_ns = 0

    def update(self, now_ns: int, inputs: FailsafeInputs) -> list[Effect]:
        """Take the steps that are due. Call at a steady pace, and at once after anything that matters."""
        effects = self._battery(inputs)
        if not inputs.airborne:
            self._wanted = None
            return effects + self._move(Failsafe.NONE, inputs.state.value)
        if not inputs.ours:  # what others fly is left alone, whatever is wrong with it
            self._wanted = None
            return effects + self._move(Failsafe.NONE, "others")
        step, reason = self._due(now_ns, inputs)
        if _RANK[step] > _RANK[self.step]:
            effects += self._move(step, reason)
            self._want(Land() if step is Failsafe.LAND else Hover(), now_ns)
        return effects + self._try(now_ns, inputs.state)

    def fresh_command(self) -> list[Effect]:
        """The pilot sent a fresh command: end the step, unless the vehicle lands for a reason that stays."""
        if self.barred:
            return []
        self._wanted = None
        return self._move(Failsafe.NONE, "fresh command")

    @property
    def idle(self) -> bool:
        """Whether no step is in force and nothing is to be done."""
        return self._wanted is None and self.step is Failsafe.NONE

    def hand_over(self, now_ns: int) -> None:
        """The authority changes hands: hover in between, unless the vehicle is landing for a reason."""
        if not isinstance(self._wanted, Land):
            self._want(Hover(), now_ns)

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
        if level >= settings.battery_warn + BATTERY_REARM:
            self._warned = False
        if level < settings.battery_warn and not self._warned:
            self._warned = True
            return [BatteryLow(level)]
        return []

    def _due(self, now_ns: int, inputs: FailsafeInputs) -> tuple[Failsafe, str]:
        if self.barred:
            return Failsafe.LAND, self.barred
        silent_ns = now_ns - inputs.last_command_ns
        silence = "silent" if inputs.pilot == "held" else inputs.pilot
        if silent_ns >= nanoseconds(self.settings.land_after_s):
            return Failsafe.LAND, silence
        if inputs.state is FlightState.LANDING:  # better to end a landing than to hang over the place
            return Failsafe.NONE, ""
        if silent_ns >= nanoseconds(self.settings.hover_after_s) or inputs.pilot == "gone":
            return Failsafe.HOVER, silence
        if not inputs.link_up:
            return Failsafe.HOVER, "vehicle_link"
        return Failsafe.NONE, ""

    def _move(self, step: Failsafe, reason: str) -> list[Effect]:
        if step is self.step:
            return []
        self.step, self.reason = step, reason
        return [StepChange(step, reason)]

    def _want(self, action: Hover | Land, now_ns: int) -> None:
        self._wanted, self._taken, self._next_try_ns = action, False, now_ns

    def _try(self, now_ns: int, state: FlightState) -> list[Effect]:
        wanted = self._wanted
        if wanted is None or now_ns < self._next_try_ns:
            return []
        if self._taken and state not in _CONTRADICTIONS[type(wanted)]:
            return []
        if isinstance(wanted, Hover) and state in _MANOEUVRES:  # each ends safely by itself
            return []
        self._next_try_ns = now_ns + nanoseconds(self.settings.retry_s)
        return [FailsafeAction(wanted)]
