"""How a flight goes, in one line: kept up to date at the bottom of a terminal, or now and then in a pipe."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import TYPE_CHECKING, Final, Self

from skyloop.messages import Failsafe, ReturnPhase

if TYPE_CHECKING:
    from rich.live import Live

    from skyloop.client import Drone

REFRESH_HZ: Final = 4
LINE_EVERY_S: Final = 5.0  #: where standard error is no terminal


class FlightProgress:
    """Shows a flight's progress on standard error for as long as its ``with`` block lasts.

    Args:
        drone: Who flies.
        live: Whether to keep one line up to date; None: if standard error is a terminal.
        what: Returns what comes first in the line: how that which flies goes.
        every_s: How often to print a line where standard error is no terminal; None: :data:`LINE_EVERY_S`.
    """

    def __init__(
        self,
        drone: Drone,
        *,
        live: bool | None = None,
        what: Callable[[], str] | None = None,
        every_s: float | None = None,
    ) -> None:
        self._drone = drone
        self._what = what
        self._every_s = LINE_EVERY_S if every_s is None else every_s
        self._begun_s = time.monotonic()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._lines, name="skyloop-progress", daemon=True)
        self._live: Live | None = None
        if sys.stderr.isatty() if live is None else live:
            from rich.console import Console
            from rich.live import Live
            from rich.text import Text

            self._live = Live(
                get_renderable=lambda: Text(self.line(), "cyan", no_wrap=True, overflow="ellipsis"),
                console=Console(stderr=True),
                refresh_per_second=REFRESH_HZ,
                transient=True,
                redirect_stdout=sys.stdout.isatty(),  # what the controller prints appears above the line
            )

    def line(self) -> str:
        """Return the progress now, what matters most first: a narrow terminal cuts the end."""
        line = flight_line(self._drone, time.monotonic() - self._begun_s)
        return line if self._what is None else f"{self._what()}  {line}"

    def __enter__(self) -> Self:
        self._begun_s = time.monotonic()
        if self._live is not None:
            self._live.start()
        else:
            self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._ended.set()
        if self._live is not None:
            self._live.stop()
        else:
            self._thread.join()

    def _lines(self) -> None:
        while not self._ended.wait(self._every_s):
            print(self.line(), file=sys.stderr, flush=True)


def flight_line(drone: Drone, flown_s: float) -> str:
    """Return how a flight goes in one line.

    Args:
        drone: Who flies.
        flown_s: For how long [s].
    """
    feedback, video = drone.feedback(), [value for name, value in drone.stats.items() if name.startswith("video")]
    rate, dropped = sum(channel.rate_hz for channel in video), sum(channel.dropped for channel in video)
    parts = [
        feedback.state.value,
        f"{flown_s:.0f} s",
        "" if feedback.failsafe is Failsafe.NONE else f"failsafe {feedback.failsafe.value}",
        "" if feedback.return_phase is ReturnPhase.NONE else f"return {feedback.return_phase}",
        "" if feedback.altitude_m is None else f"altitude {feedback.altitude_m:.2f} m",
        "" if feedback.battery is None else f"battery {feedback.battery:.0%}",
        f"{rate:.1f} frames/s" if video else "",
        f"{dropped} dropped" if video else "",
    ]
    return "  ".join(part for part in parts if part)
