"""Text for terminals and pipes alike."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Column

_PIPE_COLUMNS: Final = 10_000


def columns(rows: Iterable[tuple[str, ...]]) -> list[str]:
    """Return rows of as many cells each as lines with aligned columns."""
    table = list(rows)
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    return ["  ".join(map(str.ljust, row, widths)).rstrip() for row in table]


def named(title: str) -> Column:
    """Return a column of a table whose words are never cut: in a narrow terminal they go on below."""
    from rich.table import Column

    return Column(title, overflow="fold")


def console() -> Console:
    """Return a console for tables on standard output.

    It is as wide as the terminal, and in a pipe as wide as the tables are, so that nothing is cut there. ``COLUMNS``
    overrides both.
    """
    from rich.console import Console

    wide = sys.stdout.isatty() or "COLUMNS" in os.environ
    return Console(highlight=False, width=None if wide else _PIPE_COLUMNS)
