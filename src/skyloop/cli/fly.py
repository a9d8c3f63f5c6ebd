"""``skyloop fly``: flies a controller from a file."""

from __future__ import annotations

import inspect
import signal
import sys
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from skyloop.cli.completion import python_files
from skyloop.cli.flight import Flight
from skyloop.cli.flight_progress import FlightProgress
from skyloop.cli.naming import DroneOption, KeysOption, NetworkOption, OptionalNameArgument, join_network, one_drone
from skyloop.cli.text import coloured
from skyloop.errors import UsageError
from skyloop.extend import end_flight

if TYPE_CHECKING:
    from skyloop.client import Drone
    from skyloop.control import Controller
    from skyloop.control.loading import Reloader

ADVICE = (
    "wait in the queue with --wait SECONDS, or take over with a higher --priority (a lower number, 0 is the highest)"
)


def fly(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="A Python file with a class derived from skyloop.Controller",
            autocompletion=python_files,
        ),
    ],
    name: OptionalNameArgument = None,
    drone: DroneOption = None,
    on: Annotated[str | None, typer.Option(metavar="NAME", hidden=True)] = None,  # as it was named before
    class_name: Annotated[
        str | None, typer.Option("--class", metavar="CLASS", help="Which one, if the file has several")
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(metavar="S", min=0.0, help="How long; until Ctrl-C if not given")
    ] = None,
    priority: Annotated[int, typer.Option(metavar="P", min=0, max=31, help="0 is the highest, 31 the lowest")] = 16,
    wait: Annotated[
        float, typer.Option(metavar="S", min=0.0, help="Longest wait in the queue for the authority")
    ] = 0.0,
    takeoff: Annotated[bool, typer.Option(help="Take off first, or leave that to the controller")] = True,
    reload: Annotated[
        bool, typer.Option("--reload", help="Reload the file when it is saved; after an error hover until then")
    ] = False,
    network: NetworkOption = None,
    keys: KeysOption = None,
) -> None:
    """Take off, run a controller, land. Without NAME a simulated drone flies.

    With the word follow for FILE it follows a person, a car or what is in a box: skyloop fly follow --help.

    One line on standard error shows how it goes, in a pipe one every 5 seconds.

    Ctrl-C lands too, and so does an error in the controller without --reload.
    """
    from skyloop.cli.piloting import connect_pilot
    from skyloop.client import Authority
    from skyloop.control.loading import Reloader, load_controller

    join_network(network, keys)
    target = one_drone(name, drone or on, default="sim://")
    if reload:  # a neighbour saved twice within a second would come from Python's cache
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
    """Make the user's controller, and say which of its methods looks like a misspelt callback.

    Raises:
        UsageError: The class can't be made as one is here.
    """
    from skyloop.control.controller import misspelt

    name = controller_class.__name__
    try:
        inspect.signature(controller_class).bind(drone)
    except TypeError as error:
        raise UsageError(
            f"{name} can't be made as {name}(drone): {error}; give its other arguments default values"
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
    """Take off if that is wanted, and fly.

    Args:
        flight: What flies.
        drone: Connected as a pilot.
        seconds: For how long; None until it ends by itself, or Ctrl-C.
        reloader: Of its file; None: it is not loaded again.
        takeoff: Whether to take off what is on the ground.
        progress: Shows how it goes; None: as of any flight.

    Returns:
        Whether it ended as it should. Errors of the take-off come out; those of the controller are shown.
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
    """End the flight: land what is in the air and in our hands. Who interrupts that too leaves it to the proxy."""
    try:
        problem = end_flight(drone, say)
    except KeyboardInterrupt:
        say("left in the air: its proxy lets it hover, then lands it")
        raise
    if problem is not None:
        raise problem


def interrupt_by_signals() -> None:
    """Raise KeyboardInterrupt on SIGINT, which a shell ignores for what it runs in the background, and on SIGTERM."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _interrupt)


def _interrupt(number: int, frame: FrameType | None) -> NoReturn:  # noqa: ARG001  as signal handlers are called
    raise KeyboardInterrupt


def say(text: str) -> None:
    """Print a line on standard error."""
    typer.echo("\n".join(coloured(line, sys.stderr) for line in text.splitlines()), err=True)
