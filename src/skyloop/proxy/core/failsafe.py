"""The failsafe ladder. It decides when a flying vehicle without a pilot hovers and lands. Pure: time is an argument.

Steps escalate automatically (none, hover, land). They end only with a fresh command, on the ground, or when others take
the vehicle over. The vehicle may first fly back to its start, if parameters require this and nothing prevents it.
``docs/proxy.md`` has the rules.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

from skyloop.clock import NS_PER_S
from skyloop.messages import Failsafe, FlightState, Hover, Land, ReturnToStart

#: The charge must rise this far above a level before a fall below that level counts again.
BATTERY_REARM: Final = 0.05

#: Reasons for steps, as readable text.
REASONS: Final = {
    "silent": "the pilot is silent",
    "gone": "the pilot's connection ended",
    "released": "the pilot released the authority",
    "expired": "the pilot's time is over",
    "none": "there is no pilot",
    "vehicle_link": "the link to the vehicle is lost",
    "battery": "the battery is nearly empty",
    "battery_return": "the battery is low",
    "closing": "the proxy is closing",
    "others": "others fly the vehicle",
}

_RANK: Final = {Failsafe.NONE: 0, Failsafe.HOVER: 1, Failsafe.LAND: 2}
_MANOEUVRES: Final = (FlightState.TAKING_OFF, FlightState.LANDING)
_LAND_AT_START: Final = ReturnToStart(land=True)
#: States that prove that an action which the driver accepted did not reach the vehicle.
_CONTRADICTIONS: Final = {
    Hover: frozenset({FlightState.FLYING}),
    Land: frozenset({FlightState.TAKING_OFF, FlightState.HOVERING, FlightState.FLYING, FlightState.UNKNOWN}),
    ReturnToStart: frozenset(),  # the proxy itself steers the return
}


FailsafeTask = Hover | Land | ReturnToStart


@dataclass(frozen=True, slots=True)
class FailsafeSettings:
    """The failsafe's thresholds: times in s, battery levels as charge from 0 to 1."""

    hover_after_s: float = 0.5
    land_after_s: float = 5.0
    retry_s: float = 0.25
    battery_warn: float = 0.2
    battery_land: float = 0.1  #: charge at which to land; 0: never
    battery_return: float = 0.0  #: battery charge at which to return; 0: never
    returns: bool = False  #: whether a vehicle without a pilot lands at its start


@dataclass(frozen=True, slots=True)
class FailsafeInputs:
    """What the ladder's decisions are based on."""

    state: FlightState
    airborne: bool
    last_command_ns: int  #: time at which the last valid command arrived from any holder
    pilot: str  #: ``held``, or why there is no holder: ``released``, ``silent``, ``gone``, ``expired``, ``none``
    link_up: bool  #: whether the link from proxy to vehicle is up
    battery: float | None
    ours: bool = True  #: whether an application of this proxy started the flight or took it over
    return_problem: str = ""  #: readable reason why the vehicle can't return to its start; empty if it can or need not
    shown: bool = True  #: whether the state is current; if False, the vehicle is no longer received


@dataclass(frozen=True, slots=True)
class StepChange:
    """The start or end of a failsafe step, ready to be published."""

    step: Failsafe
    reason: str
    returns: bool = False  #: whether the vehicle flies back to its start and lands there
    why: str = ""  #: readable reason why the vehicle does not fly back although it should


@dataclass(frozen=True, slots=True)
class BatteryLow:
    """The battery charge fell below the warning level. Published once."""

    battery: float


@dataclass(frozen=True, slots=True)
class FailsafeAction:
    """An action for the vehicle. Report its result with :meth:`FailsafeLadder.attempted`."""

    action: FailsafeTask


Effect = StepChange | BatteryLow | FailsafeAction


def due(
    now_ns: int, inputs: FailsafeInputs, settings: FailsafeSettings, *, barred: str, battery_low: bool
) -> tuple[Failsafe, str]:
    """Return the step that is due for a flight of the proxy, and the reason, based on time, battery and link.

    ``battery_low``: whether the charge is too low to continue without a return, unless the pilot has overruled this.
    """
    if barred:
        return Failsafe.LAND, barred
    if battery_low and inputs.state is not FlightState.LANDING:
        return Failsafe.LAND, "battery_return"
    silent_ns = now_ns - inputs.last_command_ns
    silence = "silent" if inputs.pilot == "held" else inputs.pilot
    if silent_ns >= settings.land_after_s * NS_PER_S:
        return Failsafe.LAND, silence
    if inputs.state is FlightState.LANDING:  # completing a landing is better than hovering above the spot
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
        self.barred = ""  #: why set-points are currently refused: ``battery``, ``closing``, or empty if they are not
        self._closing = False
        self._warned = False
        self.battery_low = False  #: whether the charge has fallen below the level for a return and has not recovered
        self._overruled = False  # whether the pilot has overruled a return that began because of the battery
        self._wanted: FailsafeTask | None = None
        self.given_up = False  #: whether a silent vehicle may still execute an abandoned hover or pilot's landing
        self.wanted_ns = 0  #: time at which the current task began
        self._taken = False
        self._next_try_ns = 0

    def update(self, now_ns: int, inputs: FailsafeInputs) -> list[Effect]:
        """Return the effects that are due. Call at a steady pace, and immediately after relevant changes."""
        effects = self._battery(inputs)
        self.given_up &= inputs.airborne and not inputs.link_up
        if not inputs.airborne:
            self._wanted = None
            return effects + self._move(Failsafe.NONE, inputs.state.value)
        if not inputs.ours:  # leave a flight by others alone, whatever problems it has
            self._wanted = None
            return effects + self._move(Failsafe.NONE, "others")
        low = self.battery_low and not self._overruled
        assumed = inputs
        if isinstance(self._wanted, Land) or self.given_up:  # the driver may not report the landing yet
            assumed = replace(inputs, state=FlightState.LANDING)
        step, reason = due(now_ns, assumed, self.settings, barred=self.barred, battery_low=low)
        if _RANK[step] > _RANK[self.step]:
            returns = step is Failsafe.LAND and self._should_return(reason) and assumed.state is not FlightState.LANDING
            why = inputs.return_problem if returns else ""
            effects += self._begin(StepChange(step, reason, returns and not why, why), now_ns)
        elif self.returning and self.barred:
            effects += self._begin(StepChange(Failsafe.LAND, self.barred), now_ns)
        elif self.returning and inputs.return_problem:
            effects += self._begin(StepChange(Failsafe.LAND, self.reason, why=inputs.return_problem), now_ns)
        unheard = isinstance(self._wanted, Land) and not inputs.shown  # drivers keep it only while it is repeated
        return effects + self._try(now_ns, FlightState.UNKNOWN if unheard else inputs.state)

    def fresh_command(self) -> list[Effect]:
        """End the step after a fresh command from the pilot, unless the vehicle is landing for a lasting reason."""
        if self.barred:
            return []
        self._overruled |= self.lands_for_battery
        self._wanted, self.given_up = None, False
        return self._move(Failsafe.NONE, "fresh command")

    @property
    def idle(self) -> bool:
        """Whether no step is active and there is no task."""
        return self._wanted is None and self.step is Failsafe.NONE and not self.given_up

    @property
    def returning(self) -> bool:
        """Whether the task is to fly back to the start and land there."""
        return type(self._wanted) is ReturnToStart

    @property
    def lands_for_battery(self) -> bool:
        """Whether the vehicle returns or lands because its battery is low. A pilot can end this, not by a set-point."""
        return self.step is Failsafe.LAND and self.reason == "battery_return"

    def hand_over(self, now_ns: int) -> None:
        """Hover while the authority changes hands, unless the vehicle is landing."""
        if not self.lands:
            self._want(Hover(), now_ns)

    @property
    def continues_landing(self) -> bool:
        """Whether the ladder is continuing a pilot's landing."""
        return isinstance(self._wanted, Land) and self.step is Failsafe.NONE

    @property
    def lands(self) -> bool:
        """Whether the task makes the vehicle land, here or at its start, no matter who requested the landing."""
        return isinstance(self._wanted, Land | ReturnToStart)

    def continue_landing(self, now_ns: int) -> None:
        """Continue a landing whose pilot has left, or a landing during a loss of the vehicle link."""
        if not self.lands:
            self._want(Land(), now_ns)

    @property
    def acts(self) -> bool:
        """Whether the ladder is making the vehicle hover or land."""
        return self._wanted is not None

    def give_up(self) -> None:
        """Abandon a hover or a pilot's landing. A silent vehicle is made to land only if its pilot is silent, too."""
        self._wanted, self.given_up = None, True

    def order_landing(self) -> None:
        """Land because the proxy is about to end. From now on, accept only landings and emergency stops."""
        self._closing = True
        self.barred = "closing"

    def attempted(self, taken: bool) -> None:
        """Record whether the driver accepted the last :class:`FailsafeAction`. If not, retry after ``retry_s``."""
        self._taken = taken

    def _battery(self, inputs: FailsafeInputs) -> list[Effect]:
        level, settings = inputs.battery, self.settings
        critical = level is not None and level < settings.battery_land
        if critical or not (inputs.airborne and self.barred == "battery"):  # in the air, a low battery stays low
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
        """Return whether a landing for this reason should take place at the starting point."""
        return not self.barred and (reason == "battery_return" or self.settings.returns)

    def _begin(self, change: StepChange, now_ns: int) -> list[Effect]:
        """Begin a step, or change how the step ends."""
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
        if isinstance(wanted, Hover) and state in _MANOEUVRES:  # these manoeuvres end safely without a hover
            return []
        if isinstance(wanted, ReturnToStart) and state is FlightState.TAKING_OFF:
            return []
        self._next_try_ns = now_ns + int(self.settings.retry_s * NS_PER_S)
        return [FailsafeAction(wanted)]
