"""The failsafe ladder: what happens to a flying vehicle that nobody commands. Pure: the time is an argument.

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

_RANK: Final = {Failsafe.NONE: 0, Failsafe.HOVER: 1, Failsafe.LAND: 2}
_MANOEUVRES: Final = (FlightState.TAKING_OFF, FlightState.LANDING)
#: States that show that an action which the driver took did not reach the vehicle.
_CONTRADICTIONS: Final = {
    Hover: frozenset({FlightState.FLYING}),
    Land: frozenset({FlightState.TAKING_OFF, FlightState.HOVERING, FlightState.FLYING}),
}


@dataclass(frozen=True, slots=True)
class LadderSettings:
    """When each step is taken. Times in s, battery as charge from 0 to 1."""

    hover_after_s: float = 0.5
    land_after_s: float = 5.0
    retry_s: float = 0.25
    battery_warn: float = 0.2
    battery_land: float = 0.1  #: 0: never


@dataclass(frozen=True, slots=True)
class View:
    """What the ladder looks at."""

    state: FlightState
    airborne: bool
    heard_ns: int  #: when the last valid command came, or the authority was granted
    pilot: str  #: ``held``, or why nobody holds the authority: ``released``, ``silent``, ``gone``, ``none``
    link_up: bool  #: hop proxy–vehicle
    battery: float | None


@dataclass(frozen=True, slots=True)
class Step:
    """A step was taken or left; to be told."""

    step: Failsafe
    reason: str


@dataclass(frozen=True, slots=True)
class BatteryLow:
    """The battery fell below the warning level; told once."""

    battery: float


@dataclass(frozen=True, slots=True)
class Do:
    """Make the vehicle do this now, and report with :meth:`Ladder.tried`."""

    action: Hover | Land


Effect = Step | BatteryLow | Do


class Ladder:
    """The state of the ladder of one vehicle."""

    def __init__(self, settings: LadderSettings | None = None) -> None:
        self.settings = settings or LadderSettings()
        self.step = Failsafe.NONE
        self.reason = ""
        self.barred = ""  #: why set-points are refused now: ``battery``, ``closing``, or empty
        self._closing = False
        self._warned = False
        self._wanted: Hover | Land | None = None
        self._taken = False
        self._next_try_ns = 0

    def tick(self, now_ns: int, view: View) -> list[Effect]:
        """Take the steps that are due. Call at a steady pace, and at once after whatever matters."""
        effects = self._battery(view)
        if not view.airborne:
            self._wanted = None
            return effects + self._move(Failsafe.NONE, view.state.value)
        step, reason = self._due(now_ns, view)
        if _RANK[step] > _RANK[self.step]:
            effects += self._move(step, reason)
            self._want(Land() if step is Failsafe.LAND else Hover(), now_ns)
        return effects + self._try(now_ns, view.state)

    def fresh_command(self) -> list[Effect]:
        """A pilot came with a fresh command: a step ends, unless landing was ordered for a reason that stays."""
        if self.barred:
            return []
        self._wanted = None
        return self._move(Failsafe.NONE, "fresh command")

    @property
    def idle(self) -> bool:
        """Whether no step is in force and nothing is to be done."""
        return self._wanted is None and self.step is Failsafe.NONE

    def hand_over(self, now_ns: int) -> None:
        """The authority passes from one to another: hover in between, unless the vehicle is landing for a reason."""
        if not isinstance(self._wanted, Land):
            self._want(Hover(), now_ns)

    def order_landing(self) -> None:
        """The proxy is about to end: land, and take nothing but landing and emergency stop from now on."""
        self._closing = True
        self.barred = "closing"

    def tried(self, taken: bool) -> None:
        """Whether the driver took the last :class:`Do`; if not it comes again after ``retry_s``."""
        self._taken = taken

    def _battery(self, view: View) -> list[Effect]:
        level, settings = view.battery, self.settings
        critical = level is not None and level < settings.battery_land
        if critical or not (view.airborne and self.barred == "battery"):  # in the air a low battery stays low
            self.barred = "closing" if self._closing else "battery" if critical else ""
        if level is None:
            return []
        if level >= settings.battery_warn + BATTERY_REARM:
            self._warned = False
        if level < settings.battery_warn and not self._warned:
            self._warned = True
            return [BatteryLow(level)]
        return []

    def _due(self, now_ns: int, view: View) -> tuple[Failsafe, str]:
        if self.barred:
            return Failsafe.LAND, self.barred
        silent_ns = now_ns - view.heard_ns
        silence = "silent" if view.pilot == "held" else view.pilot
        if silent_ns >= nanoseconds(self.settings.land_after_s):
            return Failsafe.LAND, silence
        if view.state is FlightState.LANDING:  # better to end a landing than to hang over the place
            return Failsafe.NONE, ""
        if silent_ns >= nanoseconds(self.settings.hover_after_s) or view.pilot == "gone":
            return Failsafe.HOVER, silence
        if not view.link_up:
            return Failsafe.HOVER, "vehicle_link"
        return Failsafe.NONE, ""

    def _move(self, step: Failsafe, reason: str) -> list[Effect]:
        if step is self.step:
            return []
        self.step, self.reason = step, reason
        return [Step(step, reason)]

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
        return [Do(wanted)]
