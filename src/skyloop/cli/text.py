"""Format text for terminals and pipes, and explain errors in terms of the command line."""

from __future__ import annotations

import codecs
import io
import os
import re
import sys
import unicodedata
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Final, TextIO

import typer

from skyloop.errors import Hint, SkyloopError

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Column

_PIPE_COLUMNS: Final = 10_000  # wider than any table
_PLAIN_ERRORS: Final = "skyloop.plain"
#: Replacements for characters missing from a terminal's encoding; other characters lose their accents or become "?".
_PLAIN: Final = {
    **{"✓": "ok", "✗": "x", "→": "->", "←": "<-", "↑": "^", "↓": "v", "–": "-", "−": "-", "─": "-", "│": "|", "·": "."},
    **{"×": "x", "°": " deg", "µ": "u", "μ": "u", "±": "+-", "≤": "<=", "≥": ">=", "π": "pi", "ω": "w", "√": "sqrt"},
}
_RED: Final = 31  # colour codes of ECMA-48 ("ANSI")
_YELLOW: Final = 33
#: Colours of output lines, keyed by their first words.
_COLOURS: Final = {"skyloop: ": _RED, "the controller failed": _RED, "NOT ": _RED, "note: ": _YELLOW}


def make_printable() -> None:
    """Let standard output and standard error accept any text, even if their encoding lacks some characters."""
    codecs.register_error(_PLAIN_ERRORS, _plain)
    if sys.platform == "win32":
        from skyloop.platform import show_escapes

        show_escapes()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and stream.errors in ("strict", "backslashreplace"):
            stream.reconfigure(errors=_PLAIN_ERRORS)


def _plain(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    lacking = error.object[error.start : error.end]
    bare = (unicodedata.normalize("NFKD", one).encode("ascii", "ignore").decode() for one in lacking)
    return "".join(_PLAIN.get(one) or letter or "?" for one, letter in zip(lacking, bare, strict=True)), error.end


def tell(text: str) -> None:
    """Print a line for users on standard error."""
    typer.echo(text, err=True)


def print_json(value: Any) -> None:
    """Print a value as one JSON document on standard output."""
    typer.echo(json_text(value))


def json_text(value: Any) -> str:
    """Return a value as JSON; a value that JSON can't represent, such as a path, becomes text."""
    import msgspec

    return msgspec.json.encode(value, enc_hook=str).decode()


def coloured(line: str, stream: TextIO | None) -> str:
    """Return a line with its beginning coloured, if it has a known meaning and the stream shows colours.

    A stream shows colours if it is a terminal that is not dumb and ``NO_COLOR`` is not set (https://no-color.org).
    ``stream``: the stream that the line is printed to, or None if it was closed before Python started.
    """
    if os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb" or stream is None or not stream.isatty():
        return line
    for beginning, colour in _COLOURS.items():
        if line.startswith(beginning):
            return f"\x1b[{colour}m{beginning}\x1b[0m{line[len(beginning) :]}"
    return line


def columns(rows: Iterable[tuple[str, ...]]) -> list[str]:
    """Align rows that have the same number of cells, and return them as lines."""
    table = list(rows)
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    return ["  ".join(map(str.ljust, row, widths)).rstrip() for row in table]


def named(title: str) -> Column:
    """Return a table column whose words are never truncated; in a narrow terminal, they wrap."""
    from rich.table import Column

    return Column(title, overflow="fold")


def console() -> Console:
    """Return a console for tables on standard output.

    It is as wide as the terminal or, in a pipe, as wide as the tables, so that nothing is truncated. ``COLUMNS``
    overrides both.
    """
    from rich.console import Console

    wide = sys.stdout.isatty() or "COLUMNS" in os.environ
    return Console(highlight=False, width=None if wide else _PIPE_COLUMNS)


@contextmanager
def progress_bar(what: str) -> Iterator[Callable[..., None]]:
    """Show a progress bar on standard error if that is a terminal, and remove it at the end.

    Yield a function that updates the bar, given the fraction done (0 to 1) and optionally a new description.
    """
    if not sys.stderr.isatty():
        yield lambda *_: None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(transient=True, console=Console(stderr=True)) as bar:
        task = bar.add_task(what, total=1.0)
        yield lambda share, doing=what: bar.update(task, completed=share, description=doing)


# Errors ---------------------------------------------------------------------------------------------------------


#: The base class of Typer's errors for invalid words. Its module varies between versions of Typer, its name does not.
WordError: Final[type[Exception]] = next(one for one in typer.BadParameter.__mro__ if one.__name__ == "ClickException")

_HINTS: Final = {
    Hint.SEARCH_NETWORK: "only this host was searched: --network multicast, or --network HOST:PORT, searches further",
    Hint.NAME_NETWORK: "give --network multicast or --network HOST:PORT as well",
    Hint.REACH_BY_NETWORK: "a program elsewhere may reach it over the network, with --network multicast",
    Hint.OBSERVE: "skyloop watch NAME shows it meanwhile",
    Hint.FLY: "this command only observes",
}
_PLAIN_WORDS: Final = (
    (re.compile(r"^Input should be a valid integer.*"), "must be a whole number"),
    (re.compile(r"^Input should be a valid (?:number|float).*"), "must be a number"),
    (re.compile(r"^'?(.*?)'? is not a valid (?:int(?:eger)?)(?: range)?\.?$"), r"\1 is not a whole number"),
    (re.compile(r"^'?(.*?)'? is not a valid float(?: range)?\.?$"), r"\1 is not a number"),
    (re.compile(r"^Input should be greater than or equal to "), "must be at least "),
    (re.compile(r"^Input should be less than or equal to "), "must be at most "),
    (re.compile(r"^Input should be greater than "), "must be more than "),
    (re.compile(r"^Input should be less than "), "must be less than "),
    (re.compile(r"^Input should be "), "must be "),
    (re.compile(r"^Value error, "), ""),
    (re.compile(r"^(.*) is not one of (?!any)(.*)\.?$"), r"\1 is none of \2"),
    (re.compile(r"^Option '?(.+?)'? requires an argument\.?$"), r"\1 needs a value"),
    (re.compile(r"^Option '?(.+?)'? does not take a value\.?$"), r"\1 takes no value"),
    (re.compile(r"^Got unexpected extra arguments?(?:\(s\))? \((.*)\)$"), r"too many words: \1"),
    (re.compile(r"^No such option:? '?(.+?)'?\.?$"), r"no option \1"),
    (re.compile(r"^No such command '(.*?)'\.?"), r"no command \1."),
    (re.compile(r"^Missing command\.?$"), "a command is missing"),
)


def error_text(error: SkyloopError) -> str:
    hint = _HINTS.get(error.hint) if error.hint is not None else None
    return f"{error.reason}; {hint}" if hint else error.reason


def usage_text(error: Any, name: str) -> str:
    """Return the message for an invalid word or value raised by Typer, with the command's usage and an example."""
    context = getattr(error, "ctx", None)
    if type(error).__name__ == "NoArgsIsHelpError":
        return str(error.message)
    path = context.command_path if context is not None else name
    lines = [f"{path}: {_message(error)}"]
    if context is not None:
        lines.append(context.get_usage())
        if context.command.epilog:
            lines.append(str(context.command.epilog))
        lines.append(f"More: {path} --help")
    return "\n".join(lines)


def _message(error: Any) -> str:
    kind, param = type(error).__name__, getattr(error, "param", None)
    what = _named(param)
    if kind == "MissingParameter":
        return f"{what} is missing"
    text = plain(error.message)
    if kind == "NoSuchOption" and error.possibilities:
        return f"{text}; did you mean {' or '.join(sorted(error.possibilities))}?"
    return f"{what}: {text}" if what else text


def plain(text: str) -> str:
    """Rephrase a library's message about an invalid value in plain words."""
    for pattern, words in _PLAIN_WORDS:
        text, count = pattern.subn(words, text)
        if count and words:
            break
    return text.replace(". Did you mean", "; did you mean").rstrip(".")


def _named(param: Any) -> str:
    if param is None:
        return ""
    if param.param_type_name == "option":
        return str(max(param.opts, key=len))
    return str(param.metavar or param.name.upper()).strip("[]")
