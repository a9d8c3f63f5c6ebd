"""``skyloop fly``: flies a controller loaded from a file, or follows a target, and reports progress and errors."""

from __future__ import annotations

import inspect
import math
import sys
import sysconfig
import threading
import time
import traceback
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Self

import typer

from skyloop.cli import interrupt_by_signals, naming
from skyloop.cli.text import coloured, tell
from skyloop.clock import beats
from skyloop.errors import LinkError, NoAnswerError, SkyloopError, UnknownNameError, UsageError
from skyloop.extend import Known, end_flight, let_go
from skyloop.messages import Failsafe, ReturnPhase

if TYPE_CHECKING:
    from rich.live import Live

    from skyloop.client import Drone
    from skyloop.client.channels import Listener
    from skyloop.control import Controller, FollowTarget
    from skyloop.control.loading import Reloader
    from skyloop.vision import OnnxDetector
    from skyloop.vision.tracking import Box


ADVICE = (
    "wait in the queue with --wait SECONDS, or take over with a higher --priority (a lower number, 0 is the highest)"
)
Make = Callable[[type["Controller"]], "Controller"]
_POLL_S: Final = 0.1  # interval between checks that the drone is still connected, while waiting for a corrected file
REFRESH_HZ: Final = 4  #: of the line on a terminal
LINE_EVERY_S: Final = 5.0  #: used if standard error is not a terminal


def fly(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="Python file with a class derived from skyloop.Controller",
            autocompletion=naming.python_files,
        ),
    ],
    name: naming.OptionalNameArgument = None,
    drone: naming.DroneOption = None,
    on: Annotated[str | None, typer.Option(metavar="NAME", hidden=True)] = None,  # a former name of this option
    class_name: Annotated[
        str | None, typer.Option("--class", metavar="CLASS", help="The class to fly, if the file has several")
    ] = None,
    seconds: naming.SecondsOption = None,
    priority: naming.PriorityOption = 16,
    wait: naming.WaitOption = 0.0,
    takeoff: Annotated[bool, typer.Option(help="Take off first, or leave that to the controller")] = True,
    reload: Annotated[
        bool, typer.Option("--reload", help="Reload the file when saved; after an error, hover until then")
    ] = False,
    network: naming.NetworkOption = None,
    keys: naming.KeysOption = None,
) -> None:
    """Take off, run a controller and land. Without NAME a simulated drone flies.

    If FILE is the word follow, this follows a person, a car or the target in a box: see skyloop fly follow --help.

    Progress is shown as a line on standard error; in a pipe, as a new line every 5 seconds.

    Ctrl-C also lands the drone, as does an error in the controller without --reload.
    """
    from skyloop.cli.listing import connect_pilot
    from skyloop.client import Authority
    from skyloop.control.loading import Reloader, load_controller

    naming.join_network(network, keys)
    target = naming.one_drone(name, drone or on, default="sim://")
    if reload:  # otherwise a module saved twice within a second would be loaded from Python's bytecode cache
        sys.dont_write_bytecode = True
    controller_class = load_controller(file, class_name)
    reloader = Reloader(file, class_name) if reload else None
    interrupt_by_signals()
    authority = Authority(priority=priority, wait_s=wait)
    with connect_pilot(target, ADVICE, name=file.name[:64], authority=authority) as flown:
        controller = make(controller_class, flown)
        worked = run(ControllerFlight(flown, controller, say), flown, seconds, reloader, takeoff=takeoff)
        land(flown)
    if not worked:
        raise typer.Exit(1)


def make(controller_class: type[Controller], drone: Drone) -> Controller:
    """Create the user's controller, and report methods that look like misspelt callbacks."""
    from skyloop.control.controller import misspelt

    name = controller_class.__name__
    try:
        inspect.signature(controller_class).bind(drone)
    except TypeError as error:
        raise UsageError(
            f"{name} can't be created as {name}(drone): {error}; give its other arguments default values"
        ) from None
    controller = controller_class(drone)
    if getattr(controller, "drone", None) is not drone:
        raise UsageError(f"{name}.__init__ must begin with super().__init__(drone)")
    for note in misspelt(controller_class):
        say(f"note: {note}")
    return controller


def run(
    flight: ControllerFlight,
    drone: Drone,
    seconds: float | None,
    reloader: Reloader | None = None,
    *,
    takeoff: bool,
    progress: FlightProgress | None = None,
) -> bool:
    """Take off if requested, and fly for ``seconds``, or until the controller ends or Ctrl-C is pressed.

    Return whether the flight ended as intended. Errors during take-off are raised; errors in the controller are shown.
    """
    progress = progress or FlightProgress(drone)
    try:
        if takeoff and drone.capabilities.actions and not drone.feedback().state.airborne:
            say(f"taking off with {drone.name}")
            drone.takeoff()
        if reloader is None:
            with progress:
                return flight.run(seconds)
        with reloader, progress:
            return flight.run_reloading(seconds, reloader, lambda found: make(found, drone))
    except KeyboardInterrupt:
        say("stopped by Ctrl-C")
        flight.report_notes()
    return True


def land(drone: Drone) -> None:
    """End the flight: land if in the air and under our control. On a second interrupt, landing is left to the proxy."""
    try:
        problem = end_flight(drone, say)
    except KeyboardInterrupt:
        say("left in the air: its proxy makes it hover, then lands it")
        raise
    if problem is not None:
        raise problem


def say(text: str) -> None:
    """Print a line on standard error."""
    typer.echo("\n".join(coloured(line, sys.stderr) for line in text.splitlines()), err=True)


class ControllerFlight:
    """Runs a connected drone's controller until it ends, and reloads it whenever the file is saved. Use only once."""

    def __init__(self, drone: Drone, controller: Controller, report: Callable[[str], None]) -> None:
        self._drone = drone
        self._controller = controller
        self._report = report

    def run(self, seconds: float | None) -> bool:
        """Run the controller for this duration, or until it ends. After an error, hover and return False."""
        try:
            summary = self._controller.run(seconds=seconds)
        except Exception as error:  # noqa: BLE001  the user's code may raise anything
            self._report(what_failed(error))
            self._report("the controller failed")
            return False
        self._report(str(summary))
        return True

    def report_notes(self) -> None:
        """Report likely mistakes in a run that ended without a summary."""
        checks = self._controller._checks
        for note in () if checks is None else checks.notes():
            self._report(f"note: {note}")

    def run_reloading(self, seconds: float | None, reloader: Reloader, make: Make) -> bool:
        """Run the controller. A saved file takes over in flight; after a failure, hover until the next save."""
        deadline = math.inf if seconds is None else time.monotonic() + seconds
        while True:
            try:
                left = None if seconds is None else max(0.0, deadline - time.monotonic())
                summary = self._controller.run(seconds=left, until=lambda: reloader.waiting)
            except Exception as error:  # noqa: BLE001  the user's code may raise anything
                self._cancel(Known(self._drone).listeners)  # otherwise the old callbacks would keep flying the drone
                let_go(self._drone, "the controller failed")
                self._report(what_failed(error))
                self._report("the controller failed: hovering; save the file to continue, Ctrl-C lands")
                if not self._await_mended(reloader, make, deadline):
                    return False
                continue
            if summary.reason != "until":
                self._report(str(summary))
                return True
            if not self._take(reloader, make):
                self._report("the saved file is not used: the previous one keeps flying")

    def _await_mended(self, reloader: Reloader, make: Make, deadline: float) -> bool:
        """Hover until a usable file is saved; return False if time runs out or the drone disconnects first."""
        while not (reloader.waiting and self._take(reloader, make)):
            if self._drone.closed or time.monotonic() >= deadline:
                return False
            time.sleep(_POLL_S)
        return True

    def _take(self, reloader: Reloader, make: Make) -> bool:
        """Replace the current controller with the loaded one, if possible, and stop the old one's callbacks."""
        found, known = reloader.take(), Known(self._drone)
        older = known.listeners
        try:
            if found is None or isinstance(found, SkyloopError):
                raise found or SkyloopError("nothing was loaded")
            after = make(found)
            after.on_reload(self._controller)
        except Exception as error:  # noqa: BLE001  the user's code may raise anything
            self._cancel([one for one in known.listeners if one not in older])
            self._report(what_failed(error))
            return False
        self._cancel(older)
        self._controller = after
        self._report(f"reloaded {type(after).__name__}, {reloader.age_s:.2f} s after the save was detected")
        return True

    @staticmethod
    def _cancel(listeners: Iterable[Listener[Any]]) -> None:
        for one in list(listeners):
            one.cancel()


def what_failed(error: Exception) -> str:
    """Return what the user needs to fix an error: their own line, then the traceback without lines from Skyloop.

    An error that Skyloop raised deliberately outside the user's code becomes one line; others are shown in full.
    """
    home = str(Path(__file__).parents[1])
    trace = traceback.TracebackException.from_exception(error)
    if all(line.filename.startswith(home) for line in trace.stack):
        return f"skyloop: {error}" if isinstance(error, SkyloopError) else "".join(trace.format()).rstrip()
    own = _own_line(trace.stack, home)
    part: traceback.TracebackException | None = trace
    while part is not None:
        theirs = [line for line in part.stack if not line.filename.startswith(home)]
        part.stack = traceback.StackSummary.from_list(theirs)
        part = part.__cause__ or part.__context__
    where = f"{Path(own.filename).name}, line {own.lineno}, in {own.name}: {own.line or ''}".rstrip(": ")
    return f"{where}\n  {''.join(trace.format_exception_only()).rstrip()}\n\n{''.join(trace.format()).rstrip()}"


def _own_line(stack: Iterable[traceback.FrameSummary], home: str) -> traceback.FrameSummary:
    """Return the innermost line outside Skyloop and libraries or, if there is none, the innermost outside Skyloop."""
    theirs = [line for line in stack if not line.filename.startswith(home)]
    libraries = tuple({sysconfig.get_path(name) for name in ("stdlib", "purelib", "platlib")})
    return next((line for line in reversed(theirs) if not line.filename.startswith(libraries)), theirs[-1])


class FlightProgress:
    """Shows a flight's progress on standard error within a ``with`` block.

    ``live``: whether to update one line in place; if None, only if standard error is a terminal. ``what`` returns text
    for the beginning of the line. ``every_s``: interval between lines if not ``live``, by default
    :data:`LINE_EVERY_S`.
    """

    def __init__(
        self,
        drone: Drone,
        *,
        live: bool | None = None,
        what: Callable[[], str] | None = None,
        every_s: float | None = None,
    ) -> None:
        self._drone = drone
        self._what = what
        self._every_s = LINE_EVERY_S if every_s is None else every_s
        self._begun_s = time.monotonic()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._lines, name="skyloop-progress", daemon=True)
        self._live: Live | None = None
        if sys.stderr.isatty() if live is None else live:
            from rich.console import Console
            from rich.live import Live
            from rich.text import Text

            self._live = Live(
                get_renderable=lambda: Text(self.line(), "cyan", no_wrap=True, overflow="ellipsis"),
                console=Console(stderr=True),
                refresh_per_second=REFRESH_HZ,
                transient=True,
                redirect_stdout=sys.stdout.isatty(),  # makes the controller's output appear above the line
            )

    def line(self) -> str:
        """Return the current progress, most important first, because a narrow terminal cuts off the end."""
        line = flight_line(self._drone, time.monotonic() - self._begun_s)
        return line if self._what is None else f"{self._what()}  {line}"

    def __enter__(self) -> Self:
        self._begun_s = time.monotonic()
        if self._live is not None:
            self._live.start()
        else:
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        if self._live is not None:
            self._live.stop()
        else:
            self._thread.join()

    def _lines(self) -> None:
        for _ in beats(self._every_s, self._ended):
            tell(self.line())


def flight_line(drone: Drone, flown_s: float) -> str:
    """Return a flight's progress in one line."""
    feedback, video = drone.feedback(), [value for name, value in drone.stats.items() if name.startswith("video")]
    rate, dropped = sum(channel.rate_hz for channel in video), sum(channel.dropped for channel in video)
    parts = [
        feedback.state.value,
        f"{flown_s:.0f} s",
        "" if feedback.failsafe is Failsafe.NONE else f"failsafe {feedback.failsafe.value}",
        "" if feedback.return_phase is ReturnPhase.NONE else f"return {feedback.return_phase}",
        "" if feedback.altitude_m is None else f"altitude {feedback.altitude_m:.2f} m",
        "" if feedback.battery is None else f"battery {feedback.battery:.0%}",
        f"{rate:.1f} frames/s" if video else "",
        f"{dropped} dropped" if video else "",
    ]
    return "  ".join(part for part in parts if part)


# skyloop fly follow ----------------------------------------------------------------------------------------------


SIMULATED: Final = "sim://?world=park&cameras=front&fps=15"
#: Directions as seen from the target, counter-clockwise from its direction of motion.
SIDES: Final = {"ahead": 0.0, "behind": math.pi, "left": math.pi / 2, "right": -math.pi / 2}
_RESULT_WITHIN_S: Final = 3.0  # time limit for the first result of a processor
_FIRST_FRAME_S: Final = 10.0  # time limit for the first frame
_LINE_EVERY_S: Final = 1.0  # used if standard error is not a terminal


def fly_follow(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="[NAME]",
            help="A running proxy, or a vehicle's address [default: a simulated park]",
            autocompletion=naming.drone_names,
            show_default=False,
        ),
    ] = None,
    drone: naming.DroneOption = None,
    box: Annotated[
        str | None, typer.Option("--box", metavar="X,Y,W,H", help="The target in the first frame in the air, in pixels")
    ] = None,
    class_name: Annotated[
        str | None, typer.Option("--class", metavar="CLASS", help="Follow the largest object of a class, e.g. person")
    ] = None,
    detector: Annotated[
        str | None,
        typer.Option(
            "--detector",
            metavar="FILE.onnx|NAME",
            help="ONNX file, or running processor of detections [in simulation, for --class: Skyloop's own]",
        ),
    ] = None,
    mode: Annotated[str, typer.Option(metavar="MODE", help="follow, orbit or look")] = "follow",
    distance: Annotated[float, typer.Option(metavar="M", help="Distance to keep; above 2")] = 4.0,
    side: Annotated[
        str | None,
        typer.Option(metavar="SIDE", help="Side of the target to stay on: ahead, behind, left or right [default: any]"),
    ] = None,
    leash: Annotated[
        float | None, typer.Option(metavar="M", help="Maximum distance from its start [default: no limit]")
    ] = None,
    camera: Annotated[str | None, typer.Option(metavar="CAMERA", help="Camera to use [default: the first]")] = None,
    seconds: naming.SecondsOption = None,
    priority: naming.PriorityOption = 16,
    wait: naming.WaitOption = 0.0,
    takeoff: Annotated[bool, typer.Option(help="Take off first, if it is on the ground")] = True,
    network: naming.NetworkOption = None,
    keys: naming.KeysOption = None,
) -> None:
    """Take off, follow a target with the camera, and land. Without NAME, a simulated drone follows a person in a park.

    Give --class, --box, or both. The drone does not see walls and trees: fly it where there are none.

    Progress is printed on standard error each second. Ctrl-C lands. Exit code 1 if the target is lost for good.
    """
    from skyloop.cli.listing import connect_pilot
    from skyloop.client import Authority
    from skyloop.control import ChaseSettings, FollowMode, FollowTarget

    if Path("follow").is_file():
        say("follow is the command here, not the file of that name: skyloop fly flies files that end in .py")
    naming.join_network(network, keys)
    target = naming.one_drone(name, drone, default=SIMULATED)
    if box is None and class_name is None:
        raise UsageError("no target given: give --class CLASS, such as person, or --box X,Y,W,H")
    modes = [each.value for each in FollowMode]
    if mode not in modes:
        raise UnknownNameError("mode", mode, modes)
    if side is not None and side not in SIDES:
        raise UnknownNameError("side", side, SIDES)
    settings = ChaseSettings(distance_m=distance, bearing_rad=None if side is None else SIDES[side], leash_m=leash)
    given = None if box is None else _box(box)
    loaded = None if detector is None else _detector(detector, class_name)
    interrupt_by_signals()
    authority = Authority(priority=priority, wait_s=wait)
    with connect_pilot(target, ADVICE, name="follow", authority=authority) as flown:
        if loaded is None and given is None:
            loaded = _packaged(flown, class_name)
        pilot = FollowTarget(
            flown, given, class_name=class_name, mode=mode, detector=loaded, camera=camera, settings=settings
        )
        _check(flown, camera, given, loaded)
        progress = FlightProgress(flown, what=lambda: status_line(pilot), every_s=_LINE_EVERY_S)
        worked = run(ControllerFlight(flown, pilot, say), flown, seconds, takeoff=takeoff, progress=progress)
        if pilot.done:
            say("the target was lost for too long")
        land(flown)
    if not worked or pilot.done:
        raise typer.Exit(1)


def _box(text: str) -> Box:
    try:
        x, y, width, height = (float(part) for part in text.split(","))
    except ValueError:
        raise UsageError(
            f"--box must be X,Y,W,H: left and upper edge, width and height in pixels, got {text!r}"
        ) from None
    if not all(map(math.isfinite, (x, y, width, height))):
        raise UsageError(f"--box must consist of finite numbers, got {text!r}")
    return x, y, width, height


def _detector(given: str, class_name: str | None) -> OnnxDetector | str:
    """Return the detector loaded from a file, or the name of a processor."""
    from skyloop.vision import OnnxDetector

    if not given.endswith(".onnx") and "/" not in given and not Path(given).is_file():
        return given
    found = OnnxDetector(given)
    _check_class(found, class_name, given)
    return found


def _packaged(drone: Drone, class_name: str | None) -> OnnxDetector:
    from skyloop.vision import simulated_detector

    if drone.capabilities.vehicle != "sim":
        raise UsageError(
            f"following a {class_name!r} needs a detector, and Skyloop's own only knows the simulator's figures: give "
            "--detector FILE.onnx, or the NAME of a running skyloop detect; or --box X,Y,W,H"
        )
    found = simulated_detector()
    _check_class(found, class_name, "Skyloop's detector")
    return found


def _check_class(detector: OnnxDetector, class_name: str | None, where: str) -> None:
    known = detector.names.values()
    if class_name is not None and known and class_name not in known:
        raise UnknownNameError(f"class in {where}", class_name, known)


def _check(drone: Drone, camera: str | None, box: Box | None, detector: OnnxDetector | str | None) -> None:
    """Refuse, while the drone is still on the ground, anything that would end the flight in the air."""
    from skyloop.vision.tracking import checked_box

    if box is not None:
        checked_box(box, drone.next_frame(camera, timeout_s=_FIRST_FRAME_S).shape)
    if isinstance(detector, str):
        try:
            next(iter(drone.results(detector, timeout_s=_RESULT_WITHIN_S)))
        except NoAnswerError as error:
            raise LinkError(
                f"no results from a processor named {detector!r} within {_RESULT_WITHIN_S:g} s: start it with "
                f"skyloop detect FILE.onnx --on {drone.name} --name {detector}, or give an ONNX file"
            ) from error


def status_line(pilot: FollowTarget) -> str:
    """Return the follower's state in one line: the target's phase, its position, and how certain the position is."""
    status = pilot.status
    parts = [
        status.phase,
        "" if status.range_m is None else f"{status.range_m:.1f} m away",
        "" if status.confidence is None else f"confidence {status.confidence:.0%}",
        f"unseen for {status.lost_s:.1f} s" if status.lost_s else "",
        status.problem,
    ]
    return "  ".join(part for part in parts if part)
