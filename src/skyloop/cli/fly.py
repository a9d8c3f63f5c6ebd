"""``skyloop fly``: flies a controller loaded from a file, and reports its progress and errors."""

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
from types import TracebackType
from typing import TYPE_CHECKING, Annotated, Any, Final, Self

import typer

from skyloop.cli import interrupt_by_signals
from skyloop.cli.naming import (
    DroneOption,
    KeysOption,
    NetworkOption,
    OptionalNameArgument,
    join_network,
    one_drone,
    python_files,
)
from skyloop.cli.text import coloured, tell
from skyloop.clock import beats
from skyloop.errors import SkyloopError, UsageError
from skyloop.extend import Known, end_flight, let_go
from skyloop.messages import Failsafe, ReturnPhase

if TYPE_CHECKING:
    from rich.live import Live

    from skyloop.client import Drone
    from skyloop.client.channels import Listener
    from skyloop.control import Controller
    from skyloop.control.loading import Reloader

ADVICE = (
    "wait in the queue with --wait SECONDS, or take over with a higher --priority (a lower number, 0 is the highest)"
)
Make = Callable[[type["Controller"]], "Controller"]
_LOOK_S: Final = 0.1  #: interval between checks that the drone is still there, while waiting for a corrected file
REFRESH_HZ: Final = 4
LINE_EVERY_S: Final = 5.0  #: used if standard error is not a terminal


def fly(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="Python file with a class derived from skyloop.Controller",
            autocompletion=python_files,
        ),
    ],
    name: OptionalNameArgument = None,
    drone: DroneOption = None,
    on: Annotated[str | None, typer.Option(metavar="NAME", hidden=True)] = None,  # a former name
    class_name: Annotated[
        str | None, typer.Option("--class", metavar="CLASS", help="The class to fly, if the file has several")
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(metavar="S", min=0.0, help="Duration [default: until Ctrl-C]")
    ] = None,
    priority: Annotated[int, typer.Option(metavar="P", min=0, max=31, help="0 is the highest, 31 the lowest")] = 16,
    wait: Annotated[
        float, typer.Option(metavar="S", min=0.0, help="Longest wait in the queue for the authority")
    ] = 0.0,
    takeoff: Annotated[bool, typer.Option(help="Take off first, or leave that to the controller")] = True,
    reload: Annotated[
        bool, typer.Option("--reload", help="Reload the file when saved; after an error, hover until then")
    ] = False,
    network: NetworkOption = None,
    keys: KeysOption = None,
) -> None:
    """Take off, run a controller, land. Without NAME a simulated drone flies.

    With the word follow for FILE it follows a person, a car or the target in a box: skyloop fly follow --help.

    A line on standard error shows the progress; in a pipe, a new one every 5 seconds.

    Ctrl-C lands too, as does an error in the controller without --reload.
    """
    from skyloop.cli.listing import connect_pilot
    from skyloop.client import Authority
    from skyloop.control.loading import Reloader, load_controller

    join_network(network, keys)
    target = one_drone(name, drone or on, default="sim://")
    if reload:  # otherwise a module saved twice within a second would be loaded from Python's cache
        sys.dont_write_bytecode = True
    controller_class = load_controller(file, class_name)
    reloader = Reloader(file, class_name) if reload else None
    interrupt_by_signals()
    authority = Authority(priority=priority, wait_s=wait)
    with connect_pilot(target, ADVICE, name=file.name[:64], authority=authority) as flown:
        controller = make(controller_class, flown)
        worked = run(Flight(flown, controller, say), flown, seconds, reloader, takeoff=takeoff)
        land(flown)
    if not worked:
        raise typer.Exit(1)


def make(controller_class: type[Controller], drone: Drone) -> Controller:
    """Create the user's controller, and report methods that look like misspelt callbacks.

    Raise ``UsageError`` if the class can't be created with a drone as its only argument.
    """
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
    flight: Flight,
    drone: Drone,
    seconds: float | None,
    reloader: Reloader | None = None,
    *,
    takeoff: bool,
    progress: FlightProgress | None = None,
) -> bool:
    """Take off if requested, and fly.

    Args:
        flight: The flight to run.
        drone: The drone, connected as a pilot.
        seconds: The duration; None: until the controller ends, or Ctrl-C.
        reloader: Reloads the controller's file; None: never reload.
        takeoff: Whether to take off from the ground.
        progress: Shows the progress; None: the default display for flights.

    Returns:
        Whether the flight ended as intended. Errors during take-off are raised; those in the controller are shown.
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
    """End the flight: land if in the air and under our control. A second interrupt leaves that to the proxy."""
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


class Flight:
    """Runs a connected drone's controller to its end, and replaces it whenever the file is saved. Use only once."""

    def __init__(self, drone: Drone, controller: Controller, report: Callable[[str], None]) -> None:
        self._drone = drone
        self._controller = controller
        self._report = report

    def run(self, seconds: float | None) -> bool:
        """Run the controller for this long, or until it ends. After an error, hover and return False."""
        try:
            summary = self._controller.run(seconds=seconds)
        except Exception as error:  # noqa: BLE001  the user's code may raise anything
            self._report(what_failed(error))
            self._report("the controller failed")
            return False
        self._report(str(summary))
        return True

    def report_notes(self) -> None:
        """Report probable mistakes in a run that ended without a summary."""
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
                self._cancel(Known(self._drone).listeners)  # otherwise they would continue to fly
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
        """Hover until a file that can be flown is saved; return False if the time ends or the drone is gone first."""
        while not (reloader.waiting and self._take(reloader, make)):
            if self._drone.closed or time.monotonic() >= deadline:
                return False
            time.sleep(_LOOK_S)
        return True

    def _take(self, reloader: Reloader, make: Make) -> bool:
        """Replace the current controller with the loaded one, if possible. The old one can't command any more."""
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
    """Return what the user needs to fix an error: their own line, then the traceback without Skyloop's lines.

    An error raised deliberately by Skyloop, with no line of the user's, becomes one line; any other is shown in full.
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
    """Return the innermost line outside Skyloop and libraries, or, if there is none, the innermost outside Skyloop."""
    theirs = [line for line in stack if not line.filename.startswith(home)]
    libraries = tuple({sysconfig.get_path(name) for name in ("stdlib", "purelib", "platlib")})
    return next((line for line in reversed(theirs) if not line.filename.startswith(libraries)), theirs[-1])


class FlightProgress:
    """Shows a flight's progress on standard error within a ``with`` block.

    Args:
        drone: The drone.
        live: Whether to update one line in place; None: only if standard error is a terminal.
        what: Returns the state of the flight, shown at the beginning of the line.
        every_s: Interval between lines if standard error is not a terminal; None: :data:`LINE_EVERY_S`.
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
                redirect_stdout=sys.stdout.isatty(),  # so that the controller's output appears above the line
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

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
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
