"""Puts the commands together, and turns errors that Skyloop raises on purpose into one clear line."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from importlib import import_module
from typing import Annotated, Any, Final, NamedTuple

import typer

from skyloop.errors import ParameterError, SkyloopError

FAILED: Final = 1
USAGE_ERROR: Final = 2
INTERRUPTED: Final = 130  #: 128 + SIGINT, as shells count


class Entry(NamedTuple):
    """One command: where its function is, its line in the list of commands, and how it is called."""

    module: str
    function: str
    summary: str  # up to 60 characters, so that the list fits into 80 columns
    example: str
    settings: Mapping[str, Any] = {}


COMMANDS: Final = {
    "demo": Entry("demo", "demo", "A simulated drone finds a marker and follows it", "demo --seconds 30"),
    "sim": Entry(
        "sim", "sim", "Simulated drones in one world, with a proxy each", "sim --drones 3 --world room --seed 1"
    ),
    "proxy": Entry("proxy", "proxy", "Serve one vehicle under a name", "proxy sim:// --name alpha"),
    "router": Entry(
        "router", "router", "Join proxies and programs of several networks", "router --connect other-site.example:7447"
    ),
    "list": Entry("listing", "list_proxies", "The running proxies and who flies", "list"),
    "fly": Entry("fly", "fly", "Fly a controller from a Python file", "fly my_controller.py --on alpha --seconds 30"),
    "teleop": Entry("teleop", "teleop", "Fly a drone by the keys of the terminal", "teleop alpha --speed 0.5"),
    "watch": Entry("watch", "watch", "What a drone does, live in the terminal", "watch alpha"),
    "param": Entry(
        "param",
        "param",
        "List, show or write a vehicle's parameters",
        "param alpha limits.tilt 0.2",
        {"ignore_unknown_options": True},  # a value may begin with a minus
    ),
    "audit": Entry("audit", "audit", "Who flew which drone when", "audit alpha --last 20"),
    "record": Entry("record", "record", "Record drones to an MCAP file", "record alpha -o flight.mcap"),
    "process": Entry(
        "process",
        "process",
        "Run a class of yours on a drone's frames",
        "process detector.py --drone alpha",
    ),
    "log": Entry("log", "log", "Inspect, export, compare and repair recordings", "log info flight.mcap"),
    "keys": Entry("keys", "keys", "Who may join the network: make, issue, revoke keys", "keys issue jane --role pilot"),
    "camera": Entry("camera", "camera", "Print a board, and calibrate a camera by it", "camera calibrate alpha"),
    "cockpit": Entry("cockpit", "cockpit", "A page in the browser to watch and fly drones", "cockpit --port 8000"),
    "doctor": Entry(
        "doctor", "doctor", "What of this machine works, what to install", "doctor mavlink://tcp:127.0.0.1:5760"
    ),
    "bench": Entry("bench", "bench", "Measure the delays of each channel", "bench delays --seconds 30"),
}


def build(names: Iterable[str] = COMMANDS) -> typer.Typer:
    """Return the command line with these commands; only their modules are imported."""
    app = typer.Typer(
        name="skyloop",
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,  # plain help fits better into 80 columns, and starts faster
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    app.callback()(_skyloop)
    for name in names:
        entry = COMMANDS[name]
        function = getattr(import_module(f"skyloop.cli.{entry.module}"), entry.function)
        example = f"Example: skyloop {entry.example}"
        if isinstance(function, typer.Typer):  # a command with commands of its own
            app.add_typer(function, name=name, short_help=entry.summary, epilog=example)
            continue
        app.command(name, short_help=entry.summary, epilog=example, context_settings=dict(entry.settings))(function)
    return app


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit: with 2 for a wrong word or value, 1 for what failed, 0 for what worked."""
    given = sys.argv[1:] if arguments is None else arguments
    run(build([given[0]] if given and given[0] in COMMANDS else COMMANDS), given or ["--help"])


def run(app: typer.Typer, arguments: list[str], name: str = "skyloop") -> None:
    """Run a command line under its name, and exit as :func:`main` does."""
    try:
        app(arguments, prog_name=name)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    except SkyloopError as error:
        print(f"{name}: {error}", file=sys.stderr)
        sys.exit(USAGE_ERROR if isinstance(error, ValueError | ParameterError) else FAILED)


def _show_version(wanted: bool) -> None:
    if wanted:
        import skyloop

        typer.echo(f"skyloop {skyloop.__version__}")
        raise typer.Exit


def _skyloop(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Fly small drones by their cameras: simulated ones, real ones, several at once.

    skyloop COMMAND --help shows more about a command, with an example.
    """
