"""Create reports on recordings, one at a time, in a child process that ends with its request and with this process.

A report keeps a core busy for seconds, and any observer may request one. Requests therefore wait in a short queue and
are refused when it is full. If a client disconnects, its request is removed from the queue or its child is ended.

A *timeline*, the data for a replay bar, is created in the same way: events, marks and the thinned course of the flight.

The child runs ``python -m skyloop.cockpit.reports report|timeline FILE TARGET [DRONE]``.
"""

from __future__ import annotations

import asyncio
import os
import sys
import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec

from skyloop.child_process import on_parent_end
from skyloop.clock import seconds
from skyloop.cockpit.telemetry import flat_values, truth_values, vector
from skyloop.errors import LinkError, RefusedError, SkyloopError, UsageError
from skyloop.messages import Event, EventKind, Feedback, LogEntry, Refusal, Severity
from skyloop.recording.layout import Channel
from skyloop.recording.plain import Course

if TYPE_CHECKING:
    from skyloop.recording.reader import Recording

REPORT: Final = "report"
TIMELINE: Final = "timeline"
REPORT_S: Final = 120.0  #: time limit for one report
MAX_WAITING: Final = 4  #: maximum number of waiting requests; a longer queue would take minutes
NICENESS: Final = 10  #: niceness of the child: pages and flights have priority over reports
_TAKEN: Final = 4096  # bytes kept from a child's error output

#: Returns the command that reports on FILE, writing to TARGET, optionally for one DRONE.
Command = Callable[[Path, Path, str | None], Sequence[str]]


def child_command(file: Path, target: Path, drone: str | None) -> Sequence[str]:
    """Return the command for the child that creates a report."""
    return _child(REPORT, file, target, drone)


def timeline_command(file: Path, target: Path, drone: str | None) -> Sequence[str]:
    """Return the command for the child that writes the result of :func:`timeline` as JSON."""
    return _child(TIMELINE, file, target, drone)


def _child(what: str, file: Path, target: Path, drone: str | None) -> Sequence[str]:
    """Return a command that runs this module as a program."""
    return [sys.executable, "-m", "skyloop.cockpit.reports", what, str(file), str(target), *([drone] if drone else [])]


class Reports:
    """Creates reports, or another product of a recording, in a child process. On the event loop.

    Args:
        command: Returns the child's command line; by default :func:`child_command`.
        what: The name of the product in error messages.
    """

    def __init__(self, command: Command | None = None, what: str = "report") -> None:
        self._command = command or child_command
        self._what = what
        self._turn = asyncio.Lock()
        self._wanted = 0  # number of reports in progress or queued

    async def make(self, file: Path, drone: str | None = None) -> str:
        """Create a report; if cancelled, leave nothing behind.

        Args:
            file: The recording.
            drone: The recorded drone; None for the only one.

        Returns:
            The child's output: a page like that of ``skyloop log report``.

        Raises:
            RefusedError: The queue is full.
            UsageError: The child failed; its message is included.
            LinkError: Creating it took longer than :data:`REPORT_S`.
        """
        if self._wanted > MAX_WAITING:
            raise RefusedError(
                f"a {self._what} is being made and {self._wanted - 1} are waiting, the maximum: try again later",
                code=Refusal.BUSY,
            )
        self._wanted += 1
        try:
            async with self._turn:
                return await self._made(file, drone)
        finally:
            self._wanted -= 1

    async def _made(self, file: Path, drone: str | None) -> str:
        with tempfile.TemporaryDirectory(prefix="skyloop-report-") as folder:
            target = Path(folder) / "report.html"
            child = await asyncio.create_subprocess_exec(
                *self._command(file.absolute(), target, drone),
                stdin=asyncio.subprocess.PIPE,  # closed when this process ends
                stdout=asyncio.subprocess.DEVNULL,
                stderr=asyncio.subprocess.PIPE,
            )
            assert child.stderr is not None
            try:
                async with asyncio.timeout(REPORT_S):
                    errors = await child.stderr.read(_TAKEN)
                    while await child.stderr.read(_TAKEN):
                        pass
                    await child.wait()
            except TimeoutError:
                raise LinkError(f"the {self._what} of {file.name} took longer than {REPORT_S:g} s") from None
            finally:
                if child.returncode is None:
                    child.kill()
                    await asyncio.shield(child.wait())
            if child.returncode or not target.exists():
                lines = errors.decode(errors="replace").strip().splitlines()
                raise UsageError(lines[-1] if lines else f"no {self._what} of {file.name} could be made")
            return await asyncio.to_thread(target.read_text, encoding="utf-8")


def run_child(arguments: Sequence[str]) -> int:
    """Write a report or timeline, unless standard input closes first, which means that the requester is gone.

    Args:
        arguments: ``report`` or ``timeline``, FILE TARGET [DRONE], from the command line.

    Returns:
        The exit code: 0, or 2 with a line of explanation.
    """
    os.nice(NICENESS)
    on_parent_end(partial(os._exit, 1))
    from skyloop.recording.reader import Recording

    what, file, target, *drone = arguments
    make = _report if what == REPORT else _write_timeline
    try:
        recording = Recording.open(Path(file))
        make(recording, recording.drone(drone[0] if drone else None).name, Path(target))
    except SkyloopError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


def _report(recording: Recording, drone: str, target: Path) -> None:
    from skyloop.recording.review.report import write_report

    write_report(recording, drone, target, pictures=8)


MARK: Final = "mark"  #: name under which marks are logged
MAX_EVENTS: Final = 300  #: if there are more, the most severe are kept
MAX_MARKS: Final = 300
MAX_SAMPLES: Final = 1200
PERIOD_S: Final = 0.1  #: minimum time between samples
MAX_TEXT: Final = 200
_SEVERITIES: Final = (Severity.ERROR, Severity.WARNING)
#: Events that are irrelevant to the flight.
_LEFT_OUT: Final = frozenset({EventKind.PARAMETER_CHANGED})


def timeline(recording: Recording, drone: str) -> dict[str, Any]:
    """Return a recording's events and course as JSON values, with positions like ``replay.position_s``.

    Args:
        recording: The recording.
        drone: The name of one of its drones.
    """
    course = Course()
    events: list[dict[str, Any]] = []
    marks: list[dict[str, Any]] = []
    times: list[float] = []
    track: list[Any] = []
    values: dict[str, list[float | None]] = {}
    period_s = max(PERIOD_S, recording.seconds / MAX_SAMPLES)
    channels = (Channel.FEEDBACK, Channel.FRAMES, Channel.EVENTS, Channel.COMMANDS, Channel.LOGS)
    for item in recording.items(drone, channels):
        if isinstance(item.value, LogEntry) and course.first_ns is None:
            continue  # replays don't play logs, so a replay does not start with one
        at_s = round(seconds(course.follow(item.value, item.entry.log_ns) - (course.first_ns or 0)), 3)
        value = item.value
        if isinstance(value, Event) and value.kind not in _LEFT_OUT:
            text = value.text[:MAX_TEXT]
            events.append({"at_s": at_s, "kind": value.kind, "severity": value.severity, "text": text})
        elif isinstance(value, LogEntry) and value.name == MARK and value.text is not None:
            marks.append({"at_s": at_s, "text": value.text[:MAX_TEXT]})
        elif isinstance(value, Feedback) and (not times or at_s >= times[-1] + period_s):
            for name, one in flat_values(msgspec.structs.replace(value, native=None), {}, None).items():
                values.setdefault(name, [None] * len(times)).append(None if one is None else float(f"{one:.5g}"))
            times.append(at_s)
            for column in values.values():
                column += [None] * (len(times) - len(column))
            truth = truth_values(value.native)
            place = vector(value.position_m) or (truth and truth["position"])
            track.append(place)
    events.sort(key=lambda event: event["severity"] not in _SEVERITIES)
    shown = sorted(events[:MAX_EVENTS], key=lambda event: float(event["at_s"]))
    return {"events": shown, "marks": marks[:MAX_MARKS], "times": times, "track": track, "values": values}


def _write_timeline(recording: Recording, drone: str, target: Path) -> None:
    target.write_bytes(msgspec.json.encode(timeline(recording, drone)))


if __name__ == "__main__":
    sys.exit(run_child(sys.argv[1:]))
