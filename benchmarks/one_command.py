"""Build the command line of a program with one command."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import typer


def one_command(function: Callable[..., Any]) -> typer.Typer:
    """Return the command line with a function as its only command.

    Args:
        function: Its parameters are the options, and its docstring the help.
    """
    app = typer.Typer(
        add_completion=False,
        pretty_exceptions_enable=False,
        rich_markup_mode=None,
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    app.command()(function)
    return app
