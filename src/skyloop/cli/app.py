"""Puts the commands together, and turns errors that Skyloop raises on purpose into one clear line."""

from __future__ import annotations

import logging
import sys
from collections.abc import Iterable, Mapping
from importlib import import_module
from typing import Annotated, Any, Final

import typer
import typer.main

from skyloop.cli import INTERRUPTED, wording
from skyloop.cli.commands import COMMANDS, Entry
from skyloop.cli.naming import with_place
from skyloop.cli.plain_help import Command, Group, WithBehaviours, width
from skyloop.cli.text import coloured, make_printable
from skyloop.errors import ParameterError, SkyloopError, install_command

_log = logging.getLogger(__name__)
VERBOSE: Final = "--verbose"  #: works before and behind any command
FAILED: Final = 1
USAGE_ERROR: Final = 2


class ByTask(Group):
    """All commands in the order of the table, those with commands of their own among them."""

    def list_commands(self, ctx: Any) -> list[str]:  # noqa: ARG002  as Typer calls it
        """Return the names of the commands in the order of the help."""
        return [name for name in COMMANDS if name in self.commands]


def build(names: Iterable[str] = COMMANDS) -> typer.Typer:
    """Return the command line with these commands; only their modules are imported."""
    app = typer.Typer(
        name="skyloop",
        cls=ByTask,
        add_completion=True,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,  # plain help fits narrow terminals and pipes, and starts faster
        context_settings={"help_option_names": ["-h", "--help"], "terminal_width": width()},
    )
    app.callback()(_skyloop)
    for name in names:
        entry = COMMANDS[name]
        function = getattr(import_module(f"skyloop.cli.{entry.module}"), entry.function)
        shown: dict[str, Any] = {
            "short_help": entry.summary,
            "epilog": f"Example: skyloop {entry.example}",
            "rich_help_panel": entry.task.value,
        }
        if isinstance(function, typer.Typer):  # a command with commands of its own
            for info in function.registered_commands:
                info.cls = Command
            app.add_typer(function, name=name, cls=Group, **shown)
            continue
        kind = _with_behaviours(entry.behaviours) if entry.behaviours else Command
        app.command(name, cls=kind, context_settings=dict(entry.settings), **shown)(function)
    return app


def _with_behaviours(entries: Mapping[str, Entry]) -> type[Command]:
    """Return the class of a command that these take the place of, where they are its first word."""
    return type("Behaviours", (WithBehaviours,), {"behaviours": {n: _alone(n, each) for n, each in entries.items()}})


def _alone(name: str, entry: Entry) -> Any:
    """Return one command, of a command line of its own."""
    own = typer.Typer(add_completion=False, rich_markup_mode=None)
    function = getattr(import_module(f"skyloop.cli.{entry.module}"), entry.function)
    own.command(name, cls=Command, short_help=entry.summary, epilog=f"Example: skyloop {entry.example}")(function)
    return typer.main.get_command(own)


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit: with 2 for a wrong word or value, 1 for what failed, 0 for what worked."""
    given = with_place(sys.argv[1:] if arguments is None else arguments)
    if VERBOSE in given:
        given.remove(VERBOSE)
        log_to_stderr()
    run(build([given[0]] if given and given[0] in COMMANDS else COMMANDS), given or ["--help"])


def run(app: typer.Typer, arguments: list[str], name: str = "skyloop") -> None:
    """Run a command line under its name, and exit as :func:`main` does."""
    make_printable()
    try:
        code = app(arguments, prog_name=name, standalone_mode=False)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    except typer.Abort:
        print(f"{name}: nothing was done", file=sys.stderr)
        sys.exit(FAILED)
    except wording.WordError as error:
        print(coloured(wording.of_word(error, name), sys.stderr), file=sys.stderr)
        sys.exit(USAGE_ERROR)
    except SkyloopError as error:
        _log.debug("the command failed", exc_info=error)
        told = wording.of(error)
        if install_command("") in told:  # its own, or of a proxy that it started
            from skyloop.cli.install import with_all_missing

            told = with_all_missing(told, arguments)
        print(coloured(f"{name}: {told}", sys.stderr), file=sys.stderr)
        sys.exit(USAGE_ERROR if isinstance(error, ValueError | ParameterError) else FAILED)
    sys.exit(code if isinstance(code, int) else 0)


def log_to_stderr() -> None:
    """Log all that Skyloop reports of itself to standard error, with the time and the thread."""
    logging.basicConfig(
        level=logging.INFO, format="%(asctime)s %(levelname)s %(name)s [%(threadName)s] %(message)s", stream=sys.stderr
    )
    logging.getLogger("skyloop").setLevel(logging.DEBUG)


def _show_version(wanted: bool) -> None:
    if wanted:
        import skyloop

        typer.echo(f"skyloop {skyloop.__version__}")
        raise typer.Exit


def _skyloop(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit.")
    ] = False,
    verbose: Annotated[
        bool, typer.Option(VERBOSE, help="Log details to standard error; also behind any command.")
    ] = False,
) -> None:
    """Fly small drones by their cameras: simulated ones, real ones, several at once.

    skyloop COMMAND --help shows more about a command, with an example.
    """
