"""A flight with a controller from a file: what runs, in which order, and what happens when it fails or is saved."""

from __future__ import annotations

import math
import sysconfig
import time
import traceback
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from skyloop.errors import SkyloopError
from skyloop.extend import Known, let_go

if TYPE_CHECKING:
    from skyloop.client import Drone
    from skyloop.client.channels import Listener
    from skyloop.control import Controller
    from skyloop.control.loading import Reloader

Make = Callable[[type["Controller"]], "Controller"]
_LOOK_S: Final = 0.1  #: how often a flight that waits for a mended file looks whether the drone is still there


class Flight:
    """Runs a controller to its end, and what takes its place when its file is saved. Use once.

    Args:
        drone: Connected, and in the air if the controller expects that.
        controller: Of that drone.
        report: Shows a line to the user.
    """

    def __init__(self, drone: Drone, controller: Controller, report: Callable[[str], None]) -> None:
        self._drone = drone
        self._controller = controller
        self._report = report

    def run(self, seconds: float | None) -> bool:
        """Run the controller; what it raises is shown, and leaves the vehicle hovering.

        Args:
            seconds: For how long; None until it ends by itself.

        Returns:
            Whether it ended without an error.
        """
        try:
            summary = self._controller.run(seconds=seconds)
        except Exception as error:  # noqa: BLE001  the user's code may raise anything
            self._report(what_failed(error))
            self._report("the controller failed")
            return False
        self._report(str(summary))
        return True

    def report_notes(self) -> None:
        """Show what looks like a mistake in the run, for one that ended without a summary."""
        checks = self._controller._checks
        for note in () if checks is None else checks.notes():
            self._report(f"note: {note}")

    def run_reloading(self, seconds: float | None, reloader: Reloader, make: Make) -> bool:
        """Run the controller; a saved file takes over in flight, and one that failed hovers until it is saved again.

        Args:
            seconds: For how long; None until it ends by itself.
            reloader: Watches the file.
            make: Makes a controller of the loaded class.

        Returns:
            Whether it ended without an error.
        """
        deadline = math.inf if seconds is None else time.monotonic() + seconds
        while True:
            try:
                left = None if seconds is None else max(0.0, deadline - time.monotonic())
                summary = self._controller.run(seconds=left, until=lambda: reloader.waiting)
            except Exception as error:  # noqa: BLE001  the user's code may raise anything
                self._cancel(Known(self._drone).listeners)  # they would fly on
                let_go(self._drone, "the controller failed")
                self._report(what_failed(error))
                self._report("the controller failed: hovering; save the file to continue, Ctrl-C lands")
                if not self._await_mended(reloader, make, deadline):
                    return False
                continue
            if summary.reason != "until":
                self._report(str(summary))
                return True
            if not self._take(reloader, make):
                self._report("the saved file is not flown: the one before keeps flying")

    def _await_mended(self, reloader: Reloader, make: Make, deadline: float) -> bool:
        """Hover until a file was saved that can be flown; False if the time is over or the drone gone before."""
        while not (reloader.waiting and self._take(reloader, make)):
            if self._drone.closed or time.monotonic() >= deadline:
                return False
            time.sleep(_LOOK_S)
        return True

    def _take(self, reloader: Reloader, make: Make) -> bool:
        """Put what was loaded in the place of the present controller, if it can be; whichever goes commands no more."""
        found, known = reloader.take(), Known(self._drone)
        older = known.listeners
        try:
            if found is None or isinstance(found, SkyloopError):
                raise found or SkyloopError("nothing was loaded")
            after = make(found)
            after.on_reload(self._controller)
        except Exception as error:  # noqa: BLE001  the user's code may raise anything
            self._cancel([one for one in known.listeners if one not in older])
            self._report(what_failed(error))
            return False
        self._cancel(older)
        self._controller = after
        self._report(f"reloaded {type(after).__name__}, {reloader.age_s:.2f} s after it was seen to be saved")
        return True

    @staticmethod
    def _cancel(listeners: Iterable[Listener[Any]]) -> None:
        for one in list(listeners):
            one.cancel()


def what_failed(error: Exception) -> str:
    """Return what a person needs to mend an error: their own line, then the traceback without Skyloop's lines.

    An error that Skyloop raised on purpose with no line of the user in it is one line; any other is shown in full.
    """
    home = str(Path(__file__).parents[1])
    trace = traceback.TracebackException.from_exception(error)
    if all(line.filename.startswith(home) for line in trace.stack):
        return f"skyloop: {error}" if isinstance(error, SkyloopError) else "".join(trace.format()).rstrip()
    own = _own_line(trace.stack, home)
    part: traceback.TracebackException | None = trace
    while part is not None:
        theirs = [line for line in part.stack if not line.filename.startswith(home)]
        part.stack = traceback.StackSummary.from_list(theirs)
        part = part.__cause__ or part.__context__
    where = f"{Path(own.filename).name}, line {own.lineno}, in {own.name}: {own.line or ''}".rstrip(": ")
    return f"{where}\n  {''.join(trace.format_exception_only()).rstrip()}\n\n{''.join(trace.format()).rstrip()}"


def _own_line(stack: Iterable[traceback.FrameSummary], home: str) -> traceback.FrameSummary:
    """Return the innermost line that is neither Skyloop's nor a library's, or else the innermost not Skyloop's."""
    theirs = [line for line in stack if not line.filename.startswith(home)]
    libraries = tuple({sysconfig.get_path(name) for name in ("stdlib", "purelib", "platlib")})
    return next((line for line in reversed(theirs) if not line.filename.startswith(libraries)), theirs[-1])
