"""Help as plain text, for terminals of any width and for pipes: commands by task, arguments as they are typed."""

from __future__ import annotations

import re
import shutil
from collections.abc import Mapping
from typing import Any, ClassVar, Final

from typer.core import TyperCommand, TyperGroup

_OTHERS: Final = "Commands"
_WIDEST: Final = 80
_NARROWEST: Final = 34
_COLUMN: Final = 30  #: of the options; a longer one has its text on the next line
_NARROW_COLUMN: Final = 8
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


def width() -> int:
    """Return how many columns help may take: those of the terminal, at most 80."""
    return max(_NARROWEST, min(_WIDEST, shutil.get_terminal_size().columns) - 2)


class Command(TyperCommand):
    """A command whose help names its arguments as they are typed: ``NAME``, ``[NAME]`` where it may be left out.

    An argument's ``metavar`` is shown as it is: NAME is optional for Typer, as ``--drone`` may take its place.
    """

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Return the parts of the usage line."""
        return [self.options_metavar or "", *argument_words(self, ctx)]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the arguments and options."""
        write_options(self, ctx, formatter)


class WithBehaviours(Command):
    """A command whose first word may be the name of another one, with options of its own: ``skyloop fly follow``.

    Attributes:
        behaviours: These commands by name.
    """

    behaviours: ClassVar[Mapping[str, Any]] = {}

    def make_context(self, info_name: str | None, args: list[str], parent: Any = None, **extra: Any) -> Any:
        """Parse the words of whichever command they are for."""
        other = self.behaviours.get(args[0]) if args else None
        if other is None:
            return super().make_context(info_name, args, parent, **extra)
        return other.make_context(f"{info_name} {args[0]}", args[1:], parent, **extra)


class Group(TyperGroup):
    """Commands listed under what one wants to do, each with its whole summary, wrapped where it does not fit."""

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Return the parts of the usage line."""
        return [self.options_metavar or "", *argument_words(self, ctx), self.subcommand_metavar]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the options, and the list of commands."""
        write_options(self, ctx, formatter)
        self.format_commands(ctx, formatter)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the list of commands."""
        sections: dict[str, list[tuple[str, str]]] = {}
        for name in self.list_commands(ctx):
            command = self.get_command(ctx, name)
            if command is None or command.hidden:
                continue
            panel = getattr(command, "rich_help_panel", None)
            summary = command.short_help or command.get_short_help_str(limit=200)
            sections.setdefault(panel if isinstance(panel, str) else _OTHERS, []).append((name, summary))
        longest = max((len(name) for rows in sections.values() for name, _ in rows), default=0)
        for title, rows in sections.items():
            with formatter.section(title):
                formatter.write_dl([(name.ljust(longest), summary) for name, summary in rows])


def argument_words(command: Any, ctx: Any) -> list[str]:
    """Return a command's arguments as its usage line shows them."""
    words = []
    for param in command.get_params(ctx):
        if param.param_type_name != "argument" or getattr(param, "hidden", False):
            continue
        word = _word(param)
        words.append(word if param.required or param.metavar else f"[{word}]")
    return words


def described(command: Any, ctx: Any) -> dict[str, list[tuple[str, str]]]:
    """Return the words that a command takes, and what each means, as ``Arguments`` and ``Options`` if there are any."""
    arguments, options = [], []
    for param in command.get_params(ctx):
        if param.param_type_name == "argument":
            if not getattr(param, "hidden", False):
                arguments.append((_word(param).strip("[]"), param.help or ""))
        elif (record := param.get_help_record(ctx)) is not None:
            options.append((_replaced(record[0], _KINDS), _replaced(record[1], _RANGES)))
    return {title: rows for title, rows in (("Arguments", arguments), ("Options", options)) if rows}


def write_options(command: Any, ctx: Any, formatter: Any) -> None:
    """Write arguments by their words alone, and options with what they take."""
    for title, rows in described(command, ctx).items():
        with formatter.section(title):
            formatter.write_dl(rows, col_max=_COLUMN if width() >= 2 * _COLUMN else _NARROW_COLUMN)


def _word(param: Any) -> str:
    return str(param.metavar or (param.name or "").upper())


def _replaced(text: str, replacements: tuple[tuple[re.Pattern[str], str], ...]) -> str:
    for pattern, words in replacements:
        text = pattern.sub(words, text)
    return text
