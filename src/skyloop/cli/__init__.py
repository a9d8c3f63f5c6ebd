"""The ``skyloop`` command."""

from __future__ import annotations

import sys
from typing import Final

INTERRUPTED: Final = 130  #: 128 + SIGINT, as shells count


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit; see :func:`skyloop.cli.app.main`. Ctrl-C also ends its imports."""
    try:
        from skyloop.cli import app

        app.main(arguments)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)
