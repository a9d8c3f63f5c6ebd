"""One page's flights to a place, back to the start, or along a route: how they are commanded and how they end.

:class:`skyloop.control.route_law.RouteLaw` determines how a route is flown. Everything runs on the event loop.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from skyloop.client.actions import ReturnWatch, position_action
from skyloop.cockpit.feeds import start_task
from skyloop.control.route_law import Effect, Progress, RouteCommand, RouteLaw, TakePhoto, save_photo
from skyloop.control.waypoint import Waypoint, lacking, reached
from skyloop.errors import LinkError, RefusedError, SkyloopError
from skyloop.messages import Feedback, FlightState, Hover, Land, Position, ReturnPhase, ReturnToStart

if TYPE_CHECKING:
    from skyloop.client import Drone
    from skyloop.cockpit.commands import AnyCommand, GoTo
    from skyloop.cockpit.station import PilotConnection, Station
    from skyloop.control.route import Route

GOTO_M_S: Final = 1.0  #: maximum speed on the way to a place
OLD_S: Final = 1.0  #: a flight to a place ends, and a route is paused, if the feedback is older than this
PERIOD_S: Final = 0.05  #: interval between checks whether the drone has arrived
UP: Final = frozenset({FlightState.HOVERING, FlightState.FLYING})


@dataclass(frozen=True, slots=True)
class Leg:
    """A flight to a single place."""

    action: Position | ReturnToStart  #: the command to send
    goal: Waypoint  #: the place to fly to
    is_over: Callable[[Feedback], bool]  #: returns whether the newest feedback shows that the flight is over


def to_place(command: GoTo, pilot: PilotConnection) -> Leg:
    """Plan a flight to the place specified in a command.

    Raise ``RefusedError`` if the vehicle can't currently be flown to places, ``UsageError`` if a coordinate is out of
    range, and ``LinkError`` if no feedback has been received.
    """
    _fit_for_places(pilot, "it can't be flown to a place")
    goal = Waypoint(command.x, command.y, command.z, command.yaw)
    place = position_action(goal.x, goal.y, goal.z, goal.yaw, GOTO_M_S)
    return Leg(place, goal, lambda feedback: reached(goal, feedback))


def to_start(pilot: PilotConnection) -> Leg:
    """Plan a flight back to the take-off position.

    Raise ``RefusedError`` if the vehicle can't currently be flown to places or its take-off position is unknown, and
    ``LinkError`` if no feedback has been received.
    """
    start = _fit_for_places(pilot, "it can't return to its start").start_position_m
    if start is None:
        raise RefusedError("it can't return to its start: the place of take-off is unknown")
    over = ReturnWatch()
    return Leg(
        ReturnToStart(),
        Waypoint(*start),
        lambda feedback: over(feedback) or feedback.return_phase is ReturnPhase.LANDING,
    )


class PlaceFlight:
    """Monitors flights to a place, one at a time, and shows the goal.

    A flight ends on arrival or when the first problem occurs. ``done``: called on arrival, with the command's kind and
    number. ``refused``: called if the flight ends before arrival, with the command's kind and number, and the reason.
    """

    def __init__(
        self, station: Station, app: str, done: Callable[[str, int], None], refused: Callable[[str, int, str], None]
    ) -> None:
        self._station = station
        self._app = app
        self._done = done
        self._refused = refused
        self._job: asyncio.Task[None] | None = None

    @property
    def is_under_way(self) -> bool:
        return self._job is not None

    def watch(self, command: AnyCommand, pilot: PilotConnection, leg: Leg) -> None:
        """Monitor a commanded flight."""
        self.cancel()
        self._station.goals[self._app] = leg.goal
        self._job = asyncio.create_task(self._watch(command, pilot, leg))

    def cancel(self) -> None:
        """Stop monitoring, because another command has been given."""
        self._station.goals.pop(self._app, None)
        if self._job is not None:
            self._job.cancel()
            self._job = None

    async def _watch(self, command: AnyCommand, pilot: PilotConnection, leg: Leg) -> None:
        try:
            while not leg.is_over(feedback := pilot.feedback(max_age_s=OLD_S)):
                if feedback.others:
                    raise RefusedError(feedback.others)
                if pilot.has_ended(leg.action):
                    raise RefusedError("a failsafe or a lost link ended it on the way")
                await asyncio.sleep(PERIOD_S)
            lands = feedback.return_phase is ReturnPhase.LANDING  # a landing completes without further commands
            if lands or feedback.state in UP:
                pilot.let_go("it has arrived", land=lands)
            self._done(command.do, command.n)
        except SkyloopError as error:
            self._refused(command.do, command.n, str(error))
            pilot.let_go(str(error))
        finally:
            if self._job is asyncio.current_task():
                self._job = None
                self._station.goals.pop(self._app, None)


def _fit_for_places(pilot: PilotConnection, what: str) -> Feedback:
    """Return the newest feedback; raise :class:`RefusedError` if the vehicle can't currently be flown to places."""
    feedback = pilot.feedback()
    problem = lacking(feedback)
    if problem:
        raise RefusedError(f"{what}: {problem}")
    if not feedback.state.airborne:
        raise RefusedError(f"{what}: it is not in the air, take off first")
    return feedback


class RouteSession:
    """A page's flight along a route. ``aim``: called with the current goal, or None."""

    def __init__(
        self,
        route: Route,
        pilot: PilotConnection,
        drone: Drone,
        folder: Path,
        send: Callable[[dict[str, Any]], None],
        aim: Callable[[Waypoint | None], None],
    ) -> None:
        self.law = RouteLaw(route)
        self._pilot = pilot
        self._drone = drone
        self._folder = folder
        self._send = send
        self._aim = aim
        self._action: Position | None = None
        self._photos: set[asyncio.Task[None]] = set()
        self._job: asyncio.Task[None] | None = None

    @property
    def is_under_way(self) -> bool:
        """Whether the route currently commands the vehicle."""
        return self.law.is_under_way

    def begin(self) -> None:
        """Fly to the first waypoint, and monitor the flight in a task until :meth:`end`.

        Raise ``SkyloopError`` if the drone is on the ground, its position is unknown, or the command could not be sent.
        """
        self._carry_out(self.law.start(self._pilot.feedback(max_age_s=OLD_S)))
        self._job = asyncio.create_task(self._watch())

    def pause(self, why: str = "", *, hover: bool = True) -> None:
        """Pause. ``hover``: pass False if another command was given or control was lost."""
        self._carry_out(self.law.pause(why), send=hover)

    def resume(self) -> None:
        self._ask(self.law.resume)

    def skip(self) -> None:
        self._ask(self.law.skip)

    def end(self, *, hover: bool = True) -> None:
        """End the route permanently; see :meth:`pause` for ``hover``."""
        if self._job is not None:
            self._job.cancel()
        self._carry_out(self.law.stop(), send=hover)

    def _ask(self, what: Callable[[], list[Effect]]) -> None:
        try:
            self._carry_out(what())
        except SkyloopError as error:
            self.pause(str(error), hover=False)
            raise

    async def _watch(self) -> None:
        while not self.law.over:
            await asyncio.sleep(PERIOD_S)
            if self.is_under_way:
                self._step()

    def _step(self) -> None:
        try:
            if self._action is not None and self._pilot.has_ended(self._action):
                raise RefusedError("a failsafe or a lost link ended it on the way")
            feedback = self._pilot.feedback(max_age_s=OLD_S)
            if feedback.others:
                raise RefusedError(feedback.others)
            self._carry_out(self.law.update(feedback, feedback.captured_ns), automatic=True)
        except SkyloopError as error:
            self.pause(str(error), hover=False)
            self._pilot.let_go(str(error))

    def _carry_out(self, effects: list[Effect], *, send: bool = True, automatic: bool = False) -> None:
        for effect in effects:
            if isinstance(effect, RouteCommand):
                self._action = effect.action if isinstance(effect.action, Position) else None
                if send:
                    self._command(effect.action, automatic=automatic)
            elif isinstance(effect, TakePhoto):
                start_task(self._photograph(effect), self._photos)
            else:
                self._send_progress(effect)
        if effects:
            self._aim(self.law.goal if self.law.is_under_way else None)

    def _command(self, action: Position | Hover | Land, *, automatic: bool) -> None:
        pilot = self._pilot
        if automatic and not isinstance(action, Position):  # the route has ended; no person commanded this
            pilot.let_go("its route ended", land=isinstance(action, Land))
            return
        if pilot.command(action):
            return
        with suppress(SkyloopError):
            pilot.idle()  # otherwise the vehicle would still carry it out if the link came back soon
        raise LinkError(f"{action.name} was not sent: the link to the proxy is {pilot.link.application}")

    def _send_progress(self, step: Progress) -> None:
        law = self.law
        self._send(
            {
                "type": "route",
                "state": str(law.state),
                "kind": step.kind,
                "waypoint": step.waypoint,
                "of": len(law.route.waypoints),
                "text": step.text,
                "problem": law.problem,
            }
        )

    async def _photograph(self, wanted: TakePhoto) -> None:
        try:
            await asyncio.to_thread(save_photo, self._drone, self._folder, wanted)
        except SkyloopError as error:
            self.law.photo_done(str(error))
        else:
            self.law.photo_done()
