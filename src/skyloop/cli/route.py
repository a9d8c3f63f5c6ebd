"""``skyloop route``: checks and flies routes of waypoints."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from skyloop.cli.naming import PriorityOption, WaitOption
from skyloop.cli.text import print_json, tell
from skyloop.errors import UsageError

if TYPE_CHECKING:
    from skyloop.control import FlyRoute, Route, RouteCheck
    from skyloop.control.route_law import Progress

KEYS = "P pauses, R resumes, S skips the waypoint, Ctrl-C lands"

route = typer.Typer(help="Check and fly routes of waypoints (NAME.route.json).", rich_markup_mode=None)

FileArgument = Annotated[Path, typer.Argument(metavar="FILE", help="Route: NAME.route.json")]
DroneOption = Annotated[
    str, typer.Option("--drone", metavar="NAME", help="Running proxy, or a vehicle's address such as sim://")
]


@route.command()
def check(
    file: FileArgument,
    drone: DroneOption = "sim://",
    as_json: Annotated[bool, typer.Option("--json", help="Print the findings as JSON")] = False,
) -> None:
    """Show the problems with a route: legs, heights, speeds, zones and battery. Exit code 1 if it can't be flown."""
    from skyloop.client import connect
    from skyloop.control import load_route
    from skyloop.control.route import check_for

    plan = load_route(file)
    with connect(drone, access="observe") as watched:
        found = check_for(watched, plan)
    if as_json:
        print_json(found)
    else:
        typer.echo(_summary(plan, found))
    if not found.ok:
        raise typer.Exit(1)


@route.command()
def fly(
    file: FileArgument,
    drone: DroneOption = "sim://",
    photos: Annotated[Path, typer.Option(metavar="DIR", help="Folder for photos")] = Path("photos"),
    priority: PriorityOption = 16,
    wait: WaitOption = 0.0,
    land: Annotated[bool, typer.Option(help="Land at the end, or hover until this program has ended")] = True,
) -> None:
    """Check a route, take off, fly it, land. Ctrl-C lands. In a terminal, P pauses, R resumes and S skips."""
    from skyloop.cli import interrupt_by_signals
    from skyloop.cli.fly import ADVICE
    from skyloop.cli.fly import land as put_down
    from skyloop.cli.listing import connect_pilot
    from skyloop.client import Authority
    from skyloop.control import FlyRoute, load_route

    plan = load_route(file)
    interrupt_by_signals()
    authority = Authority(priority=priority, wait_s=wait)
    with connect_pilot(drone, ADVICE, name=file.name[:64], authority=authority) as flown:
        flight = FlyRoute(flown, plan, folder=photos, on_progress=lambda step: _show(plan, step))
        found = flight.check()
        tell(_summary(plan, found))
        if not found.ok:
            raise UsageError(f"{file} can't be flown like this: see above")
        try:
            if not flown.feedback().state.airborne:
                tell(f"taking off with {flown.name}")
                flown.takeoff()
            _run(flight)
        except KeyboardInterrupt:
            tell("stopped by Ctrl-C")
            land = True
        if land:
            put_down(flown)
    for path in flight.photos:
        tell(f"photo {path}")
    if flight.law.state != "done":
        raise typer.Exit(1)


def _run(flight: FlyRoute) -> None:
    """Fly the route, using the terminal's keys if there is a terminal."""
    with ExitStack() as stack:
        pressed = None
        if sys.stdin.isatty():
            from skyloop.cli.keyboard import Keyboard

            keyboard = stack.enter_context(Keyboard())
            pressed = keyboard.keys
            tell(KEYS)
        acts = {"p": flight.pause, "r": flight.resume, "s": flight.skip}

        def read_keys() -> bool:
            for key in pressed(0.0) if pressed is not None else ():
                if key.lower() in acts:
                    acts[key.lower()]()
            return pressed is None and flight.law.state == "paused"  # without a keyboard, the route can't be resumed

        flight.run(until=read_keys)
    if flight.law.state == "paused":
        tell(f"paused: {flight.law.problem or 'as asked'}")


def _show(plan: Route, step: Progress) -> None:
    tell(f"{step.waypoint}/{len(plan.waypoints)} {step.kind.removeprefix('route.').replace('_', ' ')}: {step.text}")


def _summary(plan: Route, found: RouteCheck) -> str:
    left = "" if found.battery_left is None else f", battery {found.battery_left:.0%} at the end"
    lines = [
        f"{plan.name or 'route'}: {len(plan.waypoints)} waypoints, {found.length_m:.1f} m, "
        f"about {found.seconds:.0f} s{left}"
    ]
    for one in found.findings:
        where = "route" if one.waypoint is None else f"waypoint {one.waypoint}"
        lines.append(f"{one.severity}: {where}: {one.reason}")
    return "\n".join(lines)
