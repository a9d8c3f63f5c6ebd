"""Text for terminals and pipes alike."""

from __future__ import annotations

import codecs
import io
import os
import sys
import unicodedata
from collections.abc import Iterable
from typing import TYPE_CHECKING, Final, TextIO

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Column

_PIPE_COLUMNS: Final = 10_000
_PLAIN_ERRORS: Final = "skyloop.plain"
#: What is written for characters that a terminal's encoding lacks; others lose their accents, or become a "?".
_PLAIN: Final = {
    **{"✓": "ok", "✗": "x", "→": "->", "←": "<-", "↑": "^", "↓": "v", "–": "-", "−": "-", "─": "-", "│": "|", "·": "."},
    **{"×": "x", "°": " deg", "µ": "u", "μ": "u", "±": "+-", "≤": "<=", "≥": ">=", "π": "pi", "ω": "w", "√": "sqrt"},
}
_RED: Final = 31
_YELLOW: Final = 33
#: What is coloured at the beginning of a line.
_COLOURS: Final = {"skyloop: ": _RED, "the controller failed": _RED, "NOT ": _RED, "note: ": _YELLOW}


def make_printable() -> None:
    """Let standard output and standard error take every text, also where their encoding lacks some characters."""
    codecs.register_error(_PLAIN_ERRORS, _plain)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and stream.errors in ("strict", "backslashreplace"):
            stream.reconfigure(errors=_PLAIN_ERRORS)


def _plain(error: UnicodeError) -> tuple[str, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    lacking = error.object[error.start : error.end]
    return "".join(_PLAIN.get(one) or _unaccented(one) or "?" for one in lacking), error.end


def _unaccented(character: str) -> str:
    return unicodedata.normalize("NFKD", character).encode("ascii", "ignore").decode()


def coloured(line: str, stream: TextIO | None) -> str:
    """Return a line with a coloured beginning, if it has one that matters and the stream shows colours.

    That is a terminal which is not dumb, where ``NO_COLOR`` is not set (https://no-color.org).

    Args:
        line: For people.
        stream: Where it is written to; None, as Python has it for one that was closed before it began: nowhere.
    """
    if os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb" or stream is None or not stream.isatty():
        return line
    for beginning, colour in _COLOURS.items():
        if line.startswith(beginning):
            return f"\x1b[{colour}m{beginning}\x1b[0m{line[len(beginning) :]}"
    return line


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
