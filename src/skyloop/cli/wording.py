"""Errors in the words of the command line: one line that says what is wrong, and what to type."""

from __future__ import annotations

import re
from typing import Any, Final

import typer

from skyloop.errors import Hint, SkyloopError

#: The base of what Typer raises for a wrong word; its place differs between Typer's versions, its name does not.
WordError: Final[type[Exception]] = next(one for one in typer.BadParameter.__mro__ if one.__name__ == "ClickException")

_HINTS: Final = {
    Hint.SEARCH_NETWORK: "only this host was searched: --network multicast, or --network HOST:PORT, searches further",
    Hint.NAME_NETWORK: "give --network multicast or --network HOST:PORT as well",
    Hint.REACH_BY_NETWORK: "a program elsewhere may reach it over the network, with --network multicast",
    Hint.OBSERVE: "skyloop watch NAME shows it meanwhile",
    Hint.FLY: "this command only observes",
}
_PLAIN: Final = (
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
    (re.compile(r"^Got unexpected extra arguments?(?:\(s\))? \((.*)\)$"), r"more words than are needed: \1"),
    (re.compile(r"^No such option:? '?(.+?)'?\.?$"), r"no option \1"),
    (re.compile(r"^No such command '(.*?)'\.?"), r"no command \1."),
    (re.compile(r"^Missing command\.?$"), "a command is missing"),
)


def of(error: SkyloopError) -> str:
    """Return what an error says on the command line."""
    hint = _HINTS.get(error.hint) if error.hint is not None else None
    return f"{error.reason}; {hint}" if hint else error.reason


def of_word(error: Any, name: str) -> str:
    """Return what a wrong word or value is, with the usage and an example of its command.

    Args:
        error: As Typer raised it.
        name: Of the program.
    """
    context = getattr(error, "ctx", None)
    if type(error).__name__ == "NoArgsIsHelpError":
        return str(error.message)
    path = context.command_path if context is not None else name
    lines = [f"{path}: {_said(error)}"]
    if context is not None:
        lines.append(context.get_usage())
        if context.command.epilog:
            lines.append(str(context.command.epilog))
        lines.append(f"More: {path} --help")
    return "\n".join(lines)


def _said(error: Any) -> str:
    kind, param = type(error).__name__, getattr(error, "param", None)
    what = _named(param)
    if kind == "MissingParameter":
        return f"{what} is missing"
    text = plain(error.message)
    if kind == "NoSuchOption" and error.possibilities:
        return f"{text}; did you mean {' or '.join(sorted(error.possibilities))}?"
    return f"{what}: {text}" if what else text


def plain(text: str) -> str:
    """Return a library's words about a wrong value in plain ones."""
    for pattern, words in _PLAIN:
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
