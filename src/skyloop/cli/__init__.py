"""The ``skyloop`` command."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Sequence
from typing import Final, NoReturn

INTERRUPTED: Final = 130  #: 128 + SIGINT, the convention of shells


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and exit; see :func:`skyloop.cli.app.main`. Ctrl-C works even while modules are imported."""
    try:
        from skyloop.cli import app

        app.main(arguments)
    except KeyboardInterrupt:
        sys.exit(INTERRUPTED)


def interrupt_by_signals(numbers: Sequence[signal.Signals] = (signal.SIGINT, signal.SIGTERM)) -> None:
    """Raise KeyboardInterrupt on SIGTERM, and also on SIGINT, which shells ignore for background jobs.

    On threads other than the main thread, do nothing.
    """

    def interrupt(*_: object) -> NoReturn:
        raise KeyboardInterrupt

    if threading.current_thread() is threading.main_thread():
        for number in numbers:
            signal.signal(number, interrupt)
