"""Assemble the commands, with plain-text help, and print Skyloop's own errors as one clear line."""

from __future__ import annotations

import logging
import re
import shutil
import sys
from collections.abc import Iterable, Mapping
from importlib import import_module
from typing import Annotated, Any, Final, NoReturn

import typer
import typer.main
from typer.core import TyperCommand, TyperGroup

from skyloop.cli import INTERRUPTED
from skyloop.cli.commands import COMMANDS, Entry, Task, entry_of
from skyloop.cli.naming import with_place
from skyloop.cli.text import WordError, coloured, error_text, make_printable, usage_text
from skyloop.errors import MissingExtraError, ParameterError, SkyloopError, install_command

_log = logging.getLogger(__name__)
VERBOSE: Final = "--verbose"  #: accepted before and after any command
FAILED: Final = 1  #: exit code
USAGE_ERROR: Final = 2  #: exit code
_WIDEST: Final = 80  # help uses no more columns of a terminal than this
_NARROWEST: Final = 34  # minimum width of help texts
_COLUMN: Final = 30  # width of the options column; the text of longer options starts on the next line
_NARROW_COLUMN: Final = 8  # the same in narrow terminals
_KINDS: Final = (
    (re.compile(r"<(?:float|int)(?: range)?>"), "N"),
    (re.compile(r"<str>"), "TEXT"),
    (re.compile(r"<path>"), "PATH"),
    (re.compile(r"<(\S+)>"), r"\1"),
)
_RANGES: Final = (
    (re.compile(r"([\d.]+)<=x<=([\d.]+)"), r"\1 to \2"),
    (re.compile(r"x>=([\d.]+)"), r"at least \1"),
    (re.compile(r"x<=([\d.]+)"), r"at most \1"),
)


def build(names: Iterable[str] = COMMANDS) -> typer.Typer:
    """Return the command line. Only the modules of the given commands are imported now; others, on demand."""
    app = typer.Typer(
        name="skyloop",
        cls=ByTask,
        add_completion=True,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,  # plain help fits into narrow terminals and pipes, and starts faster
        context_settings={"help_option_names": ["-h", "--help"], "terminal_width": width()},
    )
    app.callback()(_skyloop)
    for name in names:
        entry = COMMANDS[name]
        function = getattr(import_module(f"skyloop.cli.{entry.module}"), entry.function)
        shown: dict[str, Any] = {"short_help": entry.summary, "epilog": f"Example: skyloop {entry.example}"}
        if isinstance(function, typer.Typer):  # a command with subcommands
            for info in function.registered_commands:
                info.cls = CliCommand
            app.add_typer(function, name=name, cls=CliGroup, **shown)
            continue
        kind = _with_behaviours(entry.behaviours) if entry.behaviours else CliCommand
        app.command(name, cls=kind, context_settings=dict(entry.settings), **shown)(function)
    return app


def _with_behaviours(entries: Mapping[str, Entry]) -> type[CliCommand]:
    """Return a command class that runs one of ``entries`` if that is the first word, as in ``skyloop fly follow``."""
    others = {name: _alone(name, each) for name, each in entries.items()}

    class WithBehaviours(CliCommand):
        def make_context(self, info_name: str | None, args: list[str], parent: Any = None, **extra: Any) -> Any:
            other = others.get(args[0]) if args else None
            if other is None:
                return super().make_context(info_name, args, parent, **extra)
            return other.make_context(f"{info_name} {args[0]}", args[1:], parent, **extra)

    return WithBehaviours


def _alone(name: str, entry: Entry) -> Any:
    """Return one command as a separate command line."""
    own = typer.Typer(add_completion=False, rich_markup_mode=None)
    function = getattr(import_module(f"skyloop.cli.{entry.module}"), entry.function)
    own.command(name, cls=CliCommand, short_help=entry.summary, epilog=f"Example: skyloop {entry.example}")(function)
    return typer.main.get_command(own)


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit with 0 on success, 1 on failure, or 2 for an invalid word or value."""
    given = with_place(sys.argv[1:] if arguments is None else arguments)
    if VERBOSE in given:
        given.remove(VERBOSE)
        log_to_stderr()
    run(build(()), given or ["--help"])


def run(app: typer.Typer, arguments: list[str], name: str = "skyloop") -> None:
    """Run a command line under the given name, and exit like :func:`main`."""
    make_printable()
    try:
        code = app(arguments, prog_name=name, standalone_mode=False)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
    except typer.Abort:
        print(f"{name}: nothing was done", file=sys.stderr)
        sys.exit(FAILED)
    except WordError as error:
        print(coloured(usage_text(error, name), sys.stderr), file=sys.stderr)
        sys.exit(USAGE_ERROR)
    except SkyloopError as error:
        _fail(error, arguments, name)
    except ImportError as error:  # a package is missing, but no module of Skyloop checks for it
        from skyloop.cli.install import missing

        entry = entry_of(arguments)
        lacking = next(missing(entry.extras), None) if entry is not None else None
        if lacking is None:
            raise
        _fail(MissingExtraError(f"{name} {arguments[0]}", lacking, cause=str(error)), arguments, name)
    sys.exit(code if isinstance(code, int) else 0)


def _fail(error: SkyloopError, arguments: list[str], name: str) -> NoReturn:
    _log.debug("the command failed", exc_info=error)
    text, entry = error_text(error), entry_of(arguments)
    if entry is not None and install_command("") in text:  # the command's own error, or that of a proxy it started
        from skyloop.cli.install import with_all_missing

        text = with_all_missing(text, entry.extras)
    print(coloured(f"{name}: {text}", sys.stderr), file=sys.stderr)
    sys.exit(USAGE_ERROR if isinstance(error, ValueError | ParameterError) else FAILED)


def log_to_stderr() -> None:
    """Log Skyloop's own messages to standard error, with time and thread name."""
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
        bool, typer.Option(VERBOSE, help="Log details to standard error; also accepted after any command.")
    ] = False,
) -> None:
    """Fly small drones by their cameras: simulated or real, one or several.

    skyloop COMMAND --help describes a command and gives an example.
    """


def width() -> int:
    """Return the width of help texts in columns: 2 less than the terminal's width, from 34 to 78."""
    return max(_NARROWEST, min(_WIDEST, shutil.get_terminal_size().columns) - 2)


class CliCommand(TyperCommand):
    """A command whose help shows its arguments as the user types them: ``NAME``, or ``[NAME]`` if optional.

    An argument's ``metavar`` is shown verbatim: NAME is optional for Typer, because ``--drone`` may be used instead.
    """

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        return [self.options_metavar or "", *argument_words(self, ctx)]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        write_options(self, ctx, formatter)


class CliGroup(TyperGroup):
    """A command with subcommands; they are listed with their full summaries, wrapped if necessary."""

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        return [self.options_metavar or "", *argument_words(self, ctx), self.subcommand_metavar]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        write_options(self, ctx, formatter)
        self.format_commands(ctx, formatter)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        commands = {name: self.get_command(ctx, name) for name in self.list_commands(ctx)}
        summaries = [(name, each.short_help or each.get_short_help_str(200)) for name, each in commands.items() if each]
        write_sections(formatter, {"Commands": summaries})


class ByTask(CliGroup):
    """All commands in the order of the table, each created on demand."""

    def list_commands(self, ctx: Any) -> list[str]:  # noqa: ARG002  Typer's signature
        return list(COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return a command, creating it if necessary, or None if it is unknown."""
        if cmd_name not in COMMANDS:
            for name in COMMANDS:  # Typer searches this list for similar names
                self.get_command(ctx, name)
        elif cmd_name not in self.commands:
            made: Any = typer.main.get_command(build([cmd_name]))
            self.commands[cmd_name] = made.commands[cmd_name]
        return self.commands.get(cmd_name)

    def format_commands(self, ctx: Any, formatter: Any) -> None:  # noqa: ARG002
        """Write the list of commands without creating any of them."""
        write_sections(
            formatter, {task: [(n, e.summary) for n, e in COMMANDS.items() if e.task is task] for task in Task}
        )


def write_sections(formatter: Any, sections: Mapping[str, list[tuple[str, str]]]) -> None:
    """Write commands and their summaries under titles, all in the same columns."""
    longest = max((len(name) for rows in sections.values() for name, _ in rows), default=0)
    for title, rows in sections.items():
        with formatter.section(title):
            formatter.write_dl([(name.ljust(longest), summary) for name, summary in rows])


def argument_words(command: Any, ctx: Any) -> list[str]:
    """Return a command's arguments as shown in its usage line."""
    words = []
    for param in command.get_params(ctx):
        if param.param_type_name != "argument" or getattr(param, "hidden", False):
            continue
        word = _word(param)
        words.append(word if param.required or param.metavar else f"[{word}]")
    return words


def described(command: Any, ctx: Any) -> dict[str, list[tuple[str, str]]]:
    """Return the words of a command with their descriptions, as ``Arguments`` and ``Options`` if it has any."""
    arguments, options = [], []
    for param in command.get_params(ctx):
        if param.param_type_name == "argument":
            if not getattr(param, "hidden", False):
                arguments.append((_word(param).strip("[]"), param.help or ""))
        elif (record := param.get_help_record(ctx)) is not None:
            options.append((_replaced(record[0], _KINDS), _replaced(record[1], _RANGES)))
    return {title: rows for title, rows in (("Arguments", arguments), ("Options", options)) if rows}


def write_options(command: Any, ctx: Any, formatter: Any) -> None:
    for title, rows in described(command, ctx).items():
        with formatter.section(title):
            formatter.write_dl(rows, col_max=_COLUMN if width() >= 2 * _COLUMN else _NARROW_COLUMN)


def _word(param: Any) -> str:
    return str(param.metavar or (param.name or "").upper())


def _replaced(text: str, replacements: tuple[tuple[re.Pattern[str], str], ...]) -> str:
    for pattern, words in replacements:
        text = pattern.sub(words, text)
    return text
