"""Flies routes: the controller for programs, and the photos of any flight along a route."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Final

from skyloop.client.actions import OVERRULED
from skyloop.clock import nanoseconds
from skyloop.control.controller import Controller
from skyloop.control.route import Route
from skyloop.control.route_check import RouteCheck, check_route, conditions_of
from skyloop.control.route_law import PHOTO_S, Command, Effect, Progress, RouteLaw, RouteState, TakePhoto
from skyloop.errors import LinkError, NoAnswerError, SkyloopError, UsageError
from skyloop.extend import ask, commands, let_go
from skyloop.files import write
from skyloop.messages import EventKind, Fate, Feedback, Land, Position, Severity
from skyloop.vision.opencv import opencv

if TYPE_CHECKING:
    from skyloop.client import Drone

ENDED: Final = "a failsafe took over on the way: this program sent nothing for a while, or a link was lost"
TAKEN: Final = "another command of this program took its place"
PHOTOS: Final = "photos"  #: the folder that photos are saved to where none is named
LOG: Final = "route"  #: under this name the progress is logged on the drone
WAYPOINTS: Final = "waypoints"  #: and under this one the places that are left, for maps
_QUALITY: Final = 92
_LOG_S: Final = 4.0  #: maps forget places that were logged longer than 10 s ago


class FlyRoute(Controller):
    """Flies along a route, does what is to be done at its waypoints, and returns from :meth:`run` at its end.

    The vehicle must be airborne when :meth:`run` is called. Each step is an event of kind ``vehicle_message`` with
    ``data["route"]`` as ``route.waypoint_reached``, and is logged on the drone. When the proxy refuses a leg, or a
    failsafe or another command of this program ends it, the route pauses with the reason, and :meth:`resume` goes on.
    :meth:`pause`, :meth:`resume`, :meth:`skip` and :meth:`end` may be called from any thread; they take effect with the
    next feedback.

    Attributes:
        law: The course: its state, waypoint and problem.
        photos: What was saved.
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
            route: The route; check it first (:meth:`check`).
            folder: Where photos are saved; made when it is needed.
            on_progress: Called with each step, on the thread that runs the controller.
        """
        super().__init__(drone)
        self.law = RouteLaw(route)
        self.photos: list[Path] = []
        self._folder = Path(folder)
        self._on_progress = on_progress
        self._asked: list[Callable[[], list[Effect]]] = []
        self._leg: int | None = None  # number of the intent that flies the present one
        self._logged_ns: int | None = None

    def check(self) -> RouteCheck:
        """Return what speaks against the route now, by the drone's newest feedback and its parameters."""
        return check_for(self.drone, self.law.route)

    def pause(self) -> None:
        """Hover until :meth:`resume`."""
        self._asked.append(self.law.pause)

    def resume(self) -> None:
        """Fly on to the waypoint that comes next."""
        self._asked.append(self.law.resume)

    def skip(self) -> None:
        """Leave the present waypoint out."""
        self._asked.append(self.law.skip)

    def end(self) -> None:
        """Hover, and return from :meth:`run`."""
        self._asked.append(self.law.stop)

    def on_feedback(self, feedback: Feedback) -> None:
        """Take the next step.

        Raises:
            UsageError: The route has not begun, and the vehicle does not report its position or is on the ground.
        """
        law = self.law
        if law.state is RouteState.READY:
            self._carry_out(law.start(feedback))
        while self._asked:
            self._carry_out(self._asked.pop(0)())
        if refused := self._why_ended():
            effects = law.pause(refused)
            if refused == TAKEN:  # which goes on, in place of a hover
                effects = [each for each in effects if not isinstance(each, Command)]
            self._carry_out(effects)
        self._carry_out(law.update(feedback, feedback.captured_ns))
        if law.over:
            self._end()
        elif self._logged_ns is None or feedback.captured_ns - self._logged_ns >= nanoseconds(_LOG_S):
            self._logged_ns = feedback.captured_ns
            self.drone.log.array(WAYPOINTS, [one.position for one in law.route.waypoints[law.index :]])

    def _carry_out(self, effects: list[Effect]) -> None:
        for effect in effects:
            if isinstance(effect, Command):
                self._leg = None
                if isinstance(effect.action, Position):
                    self._leg = ask(self.drone, effect.action)
                else:  # it hovers or lands because of how the route goes, not of a person
                    let_go(self.drone, f"the route is {self.law.state.value}", land=isinstance(effect.action, Land))
            elif isinstance(effect, TakePhoto):
                threading.Thread(target=self._photograph, args=(effect,), name="skyloop-photo", daemon=True).start()
            else:
                self._tell(effect)

    def _photograph(self, wanted: TakePhoto) -> None:
        try:
            self.photos.append(save_photo(self.drone, self._folder, wanted))
        except SkyloopError as error:
            self.law.photo_done(str(error))
        else:
            self.law.photo_done()

    def _tell(self, step: Progress) -> None:
        text = f"{step.kind}: {step.text}"
        bad = step.kind == "route.paused" and bool(self.law.problem)
        self._logged_ns = None  # what is left has changed
        severity = Severity.WARNING if bad else Severity.INFO
        self.drone.emit(EventKind.VEHICLE_MESSAGE, text, severity, route=step.kind, waypoint=str(step.waypoint))
        self.drone.log.text(text, name=LOG)
        if self._on_progress is not None:
            self._on_progress(step)

    def _why_ended(self) -> str:
        """Return why the present leg is not flown any more, once; empty if it is."""
        flown = commands(self.drone)
        outcome = None if self._leg is None else flown.outcome(self._leg)
        if outcome is None or not outcome.failed or not flown.may_ask:
            return ""
        self._leg = None
        if outcome.fate in (Fate.REPLACED, Fate.WITHDRAWN):
            return TAKEN
        return ENDED if outcome.fate in OVERRULED else outcome.text


def check_for(drone: Drone, route: Route, *, wait_s: float = 2.0) -> RouteCheck:
    """Check a route against a drone's newest feedback and its parameters. Waits for the proxy's answer.

    Args:
        drone: The drone; connected as an observer is enough.
        route: The route.
        wait_s: How long a position is waited for, as after connecting.

    Raises:
        LinkError: The proxy does not answer.
    """
    feedback = None
    with suppress(LinkError):  # nothing came yet: that is a finding
        if wait_s > 0.0:
            with suppress(NoAnswerError):
                drone.wait(lambda newest: newest.position_m is not None, wait_s)
        feedback = drone.feedback()
    values = {parameter.name: parameter.value for parameter in drone.config.parameters()}
    return check_route(route, conditions_of(feedback, values))


def save_photo(drone: Drone, folder: Path, wanted: TakePhoto) -> Path:
    """Save the next frame as a JPEG named by the time, the waypoint and the camera. Waits for it.

    Raises:
        SkyloopError: No frame came in time, the vehicle has no such camera, or the file can't be written.
    """
    camera = wanted.camera or next((info.name for info in drone.capabilities.cameras), None)
    if camera is None:
        raise UsageError("the vehicle has no camera")
    frame = drone.next_frame(camera, timeout_s=PHOTO_S)
    cv2 = opencv("saving photos")
    done, jpeg = cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    if not done:
        raise UsageError(f"frame {frame.seq} of {camera} could not be made a JPEG")
    moment = datetime.now().astimezone().strftime("%Y%m%dT%H%M%S.%f")[:-3]
    name = f"waypoint{wanted.waypoint}-{camera}.jpg"
    path, number = folder / f"{moment}-{name}", 1
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{folder} can't be made: {error.strerror or error}") from None
    while path.exists():  # of the same moment, as after a clock was set back
        number += 1
        path = folder / f"{moment}-{number}-{name}"
    write(path, jpeg.tobytes())
    return path
