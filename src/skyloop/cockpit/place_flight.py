"""One page's flight to a place, or back to the start: what is commanded, and when it is over. On the event loop."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from skyloop.client.commands import position_action
from skyloop.client.completion import ReturnWatch
from skyloop.control.waypoint import Waypoint, lacking, reached
from skyloop.errors import RefusedError, SkyloopError
from skyloop.messages import Feedback, FlightState, Position, ReturnPhase, ReturnToStart

if TYPE_CHECKING:
    from skyloop.cockpit.commands import GoTo
    from skyloop.cockpit.pilot_connection import PilotConnection
    from skyloop.cockpit.station import Station

GOTO_M_S: Final = 1.0  #: greatest speed on the way to a place
PERIOD_S: Final = 0.05  #: between looks whether it is there
UP: Final = frozenset({FlightState.HOVERING, FlightState.FLYING})


@dataclass(frozen=True, slots=True)
class Leg:
    """A flight to one place.

    Attributes:
        action: What is commanded.
        goal: Where it leads.
        is_over: Whether it is over, by the newest feedback.
    """

    action: Position | ReturnToStart
    goal: Waypoint
    is_over: Callable[[Feedback], bool]


def to_place(command: GoTo, pilot: PilotConnection) -> Leg:
    """Return the flight to the place of a command.

    Raises:
        RefusedError: The vehicle can't be flown to places now.
        UsageError: A coordinate is out of range.
        LinkError: Nothing is known of the vehicle.
    """
    _fit_for_places(pilot, "it can't be flown to a place")
    goal = Waypoint(command.x, command.y, command.z, command.yaw)
    place = position_action(goal.x, goal.y, goal.z, goal.yaw, GOTO_M_S)
    return Leg(place, goal, lambda feedback: reached(goal, feedback))


def to_start(pilot: PilotConnection) -> Leg:
    """Return the flight back to where the vehicle took off.

    Raises:
        RefusedError: The vehicle can't be flown to places now, or its start is not known.
        LinkError: Nothing is known of the vehicle.
    """
    start = _fit_for_places(pilot, "it can't return to its start").start_position_m
    if start is None:
        raise RefusedError("it can't return to its start: where it took off is not known")
    over = ReturnWatch()
    return Leg(
        ReturnToStart(),
        Waypoint(*start),
        lambda feedback: over(feedback) or feedback.return_phase is ReturnPhase.LANDING,
    )


class PlaceFlight:
    """Watches one flight to a place at a time, and shows its goal.

    It ends there, and with the first thing that goes wrong.

    Args:
        station: The drone.
        app: The name under which the page flies.
        done: Called when it is there, with the command's kind.
        refused: Called when it was ended on the way, with the command's kind and why.
    """

    def __init__(
        self, station: Station, app: str, done: Callable[[str], None], refused: Callable[[str, str], None]
    ) -> None:
        self._station = station
        self._app = app
        self._done = done
        self._refused = refused
        self._job: asyncio.Task[None] | None = None

    @property
    def is_under_way(self) -> bool:
        """Whether it flies there now."""
        return self._job is not None

    def watch(self, do: str, pilot: PilotConnection, leg: Leg) -> None:
        """Watch a flight that was commanded.

        Args:
            do: The command's kind.
            pilot: Holds the authority.
            leg: The flight.
        """
        self.cancel()
        self._station.goals[self._app] = leg.goal
        self._job = asyncio.create_task(self._watch(do, pilot, leg))

    def cancel(self) -> None:
        """End it, as something else is commanded."""
        self._station.goals.pop(self._app, None)
        if self._job is not None:
            self._job.cancel()
            self._job = None

    async def _watch(self, do: str, pilot: PilotConnection, leg: Leg) -> None:
        try:
            while not leg.is_over(feedback := pilot.feedback(max_age_s=1.0)):
                if feedback.others:
                    raise RefusedError(feedback.others)
                if pilot.has_ended(leg.action):
                    raise RefusedError("it was ended on the way, by a failsafe or a lost link")
                await asyncio.sleep(PERIOD_S)
            lands = feedback.return_phase is ReturnPhase.LANDING  # which ends by itself from here on
            if lands or feedback.state in UP:
                pilot.let_go("it is there", land=lands)
            self._done(do)
        except SkyloopError as error:
            self._refused(do, str(error))
            pilot.let_go(str(error))
        finally:
            if self._job is asyncio.current_task():
                self._job = None
                self._station.goals.pop(self._app, None)


def _fit_for_places(pilot: PilotConnection, what: str) -> Feedback:
    """Return the newest feedback of a vehicle that can be flown to places now; :class:`RefusedError` if it can't."""
    feedback = pilot.feedback()
    problem = lacking(feedback)
    if problem:
        raise RefusedError(f"{what}: {problem}")
    if not feedback.state.airborne:
        raise RefusedError(f"{what}: it is not in the air, take off first")
    return feedback
