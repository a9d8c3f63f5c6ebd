"""Route flights: the control law, the controller for programs, and the photos taken along a route.

Programs, the command line and the cockpit's page all use this law to fly routes. The law is pure: it takes times as
arguments and decides on the next step from the newest feedback.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Final

from skyloop.client.actions import OVERRULED
from skyloop.clock import nanoseconds, seconds
from skyloop.control.controller import Controller
from skyloop.control.route import Action, Look, Photo, Route, RouteCheck, RouteWaypoint, Wait, check_for
from skyloop.control.waypoint import Waypoint, lacking, reached
from skyloop.errors import SkyloopError, UsageError
from skyloop.extend import ask, commands, let_go
from skyloop.files import write
from skyloop.messages import EventKind, Fate, Feedback, Hover, Land, Position, Severity
from skyloop.messages.geometry import wrap_angle
from skyloop.vision.opencv import opencv

if TYPE_CHECKING:
    from skyloop.client import Drone

TURN_S: Final = 15.0  #: maximum time for a turn
PHOTO_S: Final = 5.0  #: maximum time for a photo
SLOWEST: Final = 3.0  #: maximum duration of a leg as a multiple of its duration at full speed
EXTRA_S: Final = 20.0  #: time added to this maximum; after that, the route pauses
_NEAR_RAD: Final = 0.12  # maximum yaw error for a look action to be complete
ENDED: Final = "a failsafe took over: this program sent nothing for a while, or a link was lost"
TAKEN: Final = "another command of this program replaced it"
PHOTOS: Final = "photos"  #: default folder for photos
LOG: Final = "route"  #: log name of the progress
WAYPOINTS: Final = "waypoints"  #: log name of the remaining waypoints, for maps
_QUALITY: Final = 92  # JPEG quality
_LOG_S: Final = 4.0  #: logging interval: maps drop positions logged more than 10 s ago


class RouteState(StrEnum):
    """The state of a flight along a route."""

    READY = "ready"
    FLYING = "flying"  #: flying to the next waypoint
    ACTING = "acting"  #: performing a waypoint's actions
    PAUSED = "paused"
    DONE = "done"
    STOPPED = "stopped"


@dataclass(frozen=True, slots=True)
class RouteCommand:
    """Send this action to the vehicle as a new command."""

    action: Position | Hover | Land


@dataclass(frozen=True, slots=True)
class TakePhoto:
    """Save a frame that was captured after this request, then call :meth:`RouteLaw.photo_done`."""

    waypoint: int  #: number of the waypoint, from 1
    camera: str | None


@dataclass(frozen=True, slots=True)
class Progress:
    """A progress report of kind ``route.started``, ``route.waypoint_reached``, ``route.paused`` and so on."""

    kind: str
    waypoint: int  #: number of the next or current waypoint, from 1
    text: str


Effect = RouteCommand | TakePhoto | Progress


class RouteLaw:
    """The control law for one flight along a route. Its methods return the effects to carry out now, in order."""

    def __init__(self, route: Route) -> None:
        self.route = route
        self.state = RouteState.READY  #: state of the flight
        self.index = 0  #: index of the next or current waypoint, from 0; past the last one on the return flight
        self.problem = ""  #: reason why the law paused or stopped without a request; otherwise empty
        self._goals: list[RouteWaypoint] = list(route.waypoints)
        self._step = 0  # index of the waypoint's current action
        self._arrived = False  # whether the vehicle has reached the waypoint and started the actions there
        self._skipped_all = False  # whether all waypoints were skipped while paused
        self._since_ns: int | None = None  # start of the current action
        self._deadline_ns: int | None = None
        self._photo: str | None = None  # result of the photo: empty if saved, None while pending

    @property
    def over(self) -> bool:
        """Whether the flight has ended."""
        return self.state in (RouteState.DONE, RouteState.STOPPED)

    @property
    def is_under_way(self) -> bool:
        """Whether the law is currently commanding the vehicle."""
        return self.state in (RouteState.FLYING, RouteState.ACTING)

    @property
    def goal(self) -> Waypoint:
        """The next waypoint, or the waypoint that the vehicle is at."""
        return self._goals[self.index].goal

    # Requests ---------------------------------------------------------------------------------------------------

    def start(self, feedback: Feedback) -> list[Effect]:
        """Fly to the first waypoint; raise UsageError if the vehicle is on the ground or its position is unknown."""
        problem = lacking(feedback)
        if problem or feedback.position_m is None:
            raise UsageError(f"the route can't be flown: {problem}")
        if not feedback.state.airborne:
            raise UsageError(f"the route can't be flown: the vehicle is {feedback.state.value}, take off first")
        if self.route.end == "return":
            x, y, _ = feedback.position_m
            self._goals.append(RouteWaypoint(x, y, self._goals[-1].z))
        return [self._report("started", f"{len(self.route.waypoints)} waypoints"), *self._fly()]

    def pause(self, why: str = "") -> list[Effect]:
        """Hover until :meth:`resume` is called; ``why`` is the reason for a pause that was not requested."""
        if not self.is_under_way:
            return []
        self.state, self.problem = RouteState.PAUSED, why
        return [RouteCommand(Hover()), self._report("paused", why or "as requested")]

    def resume(self) -> list[Effect]:
        """Continue straight to the next waypoint, or to the end of the route if all waypoints were skipped."""
        if self.state is not RouteState.PAUSED:
            return []
        if self._skipped_all:
            return [self._report("resumed", "to its end"), *self._finish()]
        return [self._report("resumed", f"to {self._what()}"), *self._fly()]

    def skip(self) -> list[Effect]:
        """Skip the current waypoint; a paused route stays paused, even if no waypoint is left."""
        if self.over or self.state is RouteState.READY or self._skipped_all:
            return []
        skipped = self._report("skipped", self._what())
        return [skipped, *self._next(fly=self.is_under_way)]

    def stop(self) -> list[Effect]:
        """Hover and end the route."""
        if self.over:
            return []
        under_way = self.is_under_way
        self.state = RouteState.STOPPED
        return [*([RouteCommand(Hover())] if under_way else []), self._report("stopped", "as requested")]

    def photo_done(self, problem: str = "") -> None:
        """Report the result of the photo. Can be called from any thread."""
        self._photo = problem

    # The vehicle's progress ---------------------------------------------------------------------------------------

    def update(self, feedback: Feedback, now_ns: int) -> list[Effect]:
        """Take the next step based on the newest feedback; ``now_ns`` is on the same clock as its capture time."""
        if not self.is_under_way:
            return []
        if not feedback.state.airborne:
            self.state, self.problem = RouteState.STOPPED, f"the vehicle is {feedback.state.value}"
            return [self._report("stopped", self.problem)]
        if lacking(feedback):
            return []  # the proxy makes the vehicle hover until its position and yaw are known again
        if self.state is RouteState.FLYING:
            return self._on_the_way(feedback, now_ns)
        return self._act(feedback, now_ns)

    def _on_the_way(self, feedback: Feedback, now_ns: int) -> list[Effect]:
        goal = self._goals[self.index].goal
        assert feedback.position_m is not None
        if self._deadline_ns is None:
            planned_s = math.dist(feedback.position_m, goal.position) / self.route.speed_to(self.index)
            self._deadline_ns = now_ns + nanoseconds(SLOWEST * planned_s + EXTRA_S)
        if not reached(goal, feedback):
            if now_ns <= self._deadline_ns:
                return []
            return self.pause(f"{self._what()} was not reached in time")
        first, self._arrived = not self._arrived, True
        self.state, self._since_ns = RouteState.ACTING, None
        arrived = [self._report("waypoint_reached", self._what())] if first else []
        return [*arrived, *self._act(feedback, now_ns)]

    def _act(self, feedback: Feedback, now_ns: int) -> list[Effect]:
        """Perform the waypoint's actions in sequence."""
        effects: list[Effect] = []
        while self._step < len(self._actions):
            action = self._actions[self._step]
            if self._since_ns is None:
                self._since_ns = now_ns
                effects += self._begin(action)
            done, problem = self._done(action, feedback, seconds(now_ns - self._since_ns))
            if not done:
                return effects
            if isinstance(action, Photo) or problem:
                effects.append(self._report(_name(action), problem or "saved"))
            self._step, self._since_ns = self._step + 1, None
        return [*effects, *self._next()]

    @property
    def _actions(self) -> tuple[Action, ...]:
        return self._goals[self.index].actions

    def _begin(self, action: Action) -> list[Effect]:
        here = self._goals[self.index]
        if isinstance(action, Look):
            return [RouteCommand(Position(*here.position, self._yaw(action), self.route.speed_to(self.index)))]
        if isinstance(action, Photo):
            self._photo = None
            return [TakePhoto(self.index + 1, action.camera)]
        return []

    def _done(self, action: Action, feedback: Feedback, for_s: float) -> tuple[bool, str]:
        """Return whether an action is done, and a description of the problem if it failed."""
        if isinstance(action, Wait):
            return for_s >= action.seconds, ""
        if isinstance(action, Look):
            left = abs(wrap_angle(self._yaw(action) - (feedback.yaw_rad or 0.0)))
            return (True, "") if left <= _NEAR_RAD else (for_s > TURN_S, "the turn took too long")
        if self._photo is not None:
            return True, self._photo
        return for_s > PHOTO_S, "no frame arrived in time"

    def _yaw(self, look: Look) -> float:
        return self._goals[self.index].yaw_to(look.at) if look.at is not None else look.yaw or 0.0

    def _next(self, *, fly: bool = True) -> list[Effect]:
        self.index, self._step, self._arrived, self._since_ns = self.index + 1, 0, False, None
        if self.index < len(self._goals):
            return self._fly() if fly else []
        self.index = len(self._goals) - 1
        self._skipped_all = not fly
        return self._finish() if fly else []

    def _finish(self) -> list[Effect]:
        self.state = RouteState.DONE
        return [RouteCommand(Hover() if self.route.end == "hover" else Land()), self._report("done", self.route.end)]

    def _fly(self) -> list[Effect]:
        goal: Waypoint = self._goals[self.index].goal
        self.state, self.problem, self._deadline_ns, self._since_ns = RouteState.FLYING, "", None, None
        return [RouteCommand(Position(*goal.position, goal.yaw, self.route.speed_to(self.index)))]

    def _what(self) -> str:
        last = len(self.route.waypoints)
        return "the start" if self.index >= last else f"waypoint {self.index + 1} of {last}"

    def _report(self, what: str, text: str) -> Progress:
        return Progress(f"route.{what}", min(self.index + 1, len(self.route.waypoints)), text)


def _name(action: Action) -> str:
    return "photo" if isinstance(action, Photo) else "look" if isinstance(action, Look) else "wait"


class FlyRoute(Controller):
    """Flies along a route and performs the actions at its waypoints. :meth:`run` returns at the end of the route.

    The vehicle must be airborne when :meth:`run` is called. Each step is published as an event of kind
    ``vehicle_message`` with ``data["route"]``, for example ``route.waypoint_reached``, and is logged on the drone. If
    the proxy refuses a leg, or a failsafe or another command from this program ends it, the route pauses, giving the
    reason, until :meth:`resume` is called. :meth:`pause`, :meth:`resume`, :meth:`skip` and :meth:`end` can be called
    from any thread and take effect with the next feedback.

    Attributes:
        law: The control law, with the flight's state, waypoint and problem.
        photos: Paths of the saved photos.
    """

    def __init__(
        self,
        drone: Drone,
        route: Route,
        *,
        folder: str | Path = PHOTOS,
        on_progress: Callable[[Progress], None] | None = None,
    ) -> None:
        """Initialise the controller.

        Args:
            drone: The drone to fly.
            route: The route; use :meth:`check` before flying it.
            folder: Folder for photos; it is created when needed.
            on_progress: A function called with each step, on the thread that runs the controller.
        """
        super().__init__(drone)
        self.law = RouteLaw(route)
        self.photos: list[Path] = []
        self._folder = Path(folder)
        self._on_progress = on_progress
        self._asked: list[Callable[[], list[Effect]]] = []
        self._leg: int | None = None  # intent number of the current leg's command
        self._logged_ns: int | None = None

    def check(self) -> RouteCheck:
        """Check the route against the drone's newest feedback and parameters."""
        return check_for(self.drone, self.law.route)

    def pause(self) -> None:
        """Hover until :meth:`resume` is called."""
        self._asked.append(self.law.pause)

    def resume(self) -> None:
        """Continue to the next waypoint."""
        self._asked.append(self.law.resume)

    def skip(self) -> None:
        """Skip the current waypoint."""
        self._asked.append(self.law.skip)

    def end(self) -> None:
        """Hover and return from :meth:`run`."""
        self._asked.append(self.law.stop)

    def on_feedback(self, feedback: Feedback) -> None:
        """Take the next step.

        Raises:
            UsageError: The vehicle is on the ground or does not report its position at the start.
        """
        law = self.law
        if law.state is RouteState.READY:
            self._carry_out(law.start(feedback))
        while self._asked:
            self._carry_out(self._asked.pop(0)())
        if refused := self._why_ended():
            effects = law.pause(refused)
            if refused == TAKEN:  # the other command is still in force, so don't hover
                effects = [each for each in effects if not isinstance(each, RouteCommand)]
            self._carry_out(effects)
        self._carry_out(law.update(feedback, feedback.captured_ns))
        if law.over:
            self._end()
        elif self._logged_ns is None or feedback.captured_ns - self._logged_ns >= nanoseconds(_LOG_S):
            self._logged_ns = feedback.captured_ns
            self.drone.log.array(WAYPOINTS, [one.position for one in law.route.waypoints[law.index :]])

    def _carry_out(self, effects: list[Effect]) -> None:
        for effect in effects:
            if isinstance(effect, RouteCommand):
                self._leg = None
                if isinstance(effect.action, Position):
                    self._leg = ask(self.drone, effect.action)
                else:  # the route, not a person, requested the hover or landing
                    let_go(self.drone, f"the route is {self.law.state.value}", land=isinstance(effect.action, Land))
            elif isinstance(effect, TakePhoto):
                threading.Thread(target=self._photograph, args=(effect,), name="skyloop-photo", daemon=True).start()
            else:
                self._report(effect)

    def _photograph(self, wanted: TakePhoto) -> None:
        try:
            self.photos.append(save_photo(self.drone, self._folder, wanted))
        except SkyloopError as error:
            self.law.photo_done(str(error))
        else:
            self.law.photo_done()

    def _report(self, step: Progress) -> None:
        text = f"{step.kind}: {step.text}"
        bad = step.kind == "route.paused" and bool(self.law.problem)
        self._logged_ns = None  # the remaining waypoints have changed
        severity = Severity.WARNING if bad else Severity.INFO
        self.drone.emit(EventKind.VEHICLE_MESSAGE, text, severity, route=step.kind, waypoint=str(step.waypoint))
        self.drone.log.text(text, name=LOG)
        if self._on_progress is not None:
            self._on_progress(step)

    def _why_ended(self) -> str:
        """Return why the current leg ended early, reporting it only once; empty while the leg is being flown."""
        flown = commands(self.drone)
        outcome = None if self._leg is None else flown.outcome(self._leg)
        if outcome is None or not outcome.failed or not flown.may_ask:
            return ""
        self._leg = None
        if outcome.fate in (Fate.REPLACED, Fate.WITHDRAWN):
            return TAKEN
        return ENDED if outcome.fate in OVERRULED else outcome.text


def save_photo(drone: Drone, folder: Path, wanted: TakePhoto) -> Path:
    """Wait for the next frame and save it as a JPEG file named after time, waypoint and camera.

    Raises:
        SkyloopError: No frame arrived in time, the vehicle has no such camera, or the file can't be written.
    """
    camera = wanted.camera or next((info.name for info in drone.capabilities.cameras), None)
    if camera is None:
        raise UsageError("the vehicle has no camera")
    frame = drone.next_frame(camera, timeout_s=PHOTO_S)
    cv2 = opencv("saving photos")
    done, jpeg = cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    if not done:
        raise UsageError(f"frame {frame.seq} of {camera} can't be encoded as a JPEG")
    moment = datetime.now().astimezone().strftime("%Y%m%dT%H%M%S.%f")[:-3]
    name = f"waypoint{wanted.waypoint}-{camera}.jpg"
    path, number = folder / f"{moment}-{name}", 1
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{folder} can't be created: {error.strerror or error}") from None
    while path.exists():  # times can recur, for example after the clock was set back
        number += 1
        path = folder / f"{moment}-{number}-{name}"
    write(path, jpeg.tobytes())
    return path
