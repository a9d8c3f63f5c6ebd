"""What a replay's bar shows of a recording: its events and marks, and how the flight went, thinned out.

Making it reads the whole file: a child process does it, as for :mod:`skyloop.cockpit.reports`.
``python -m skyloop.cockpit.timeline FILE TARGET [DRONE]`` is the child.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec

from skyloop.clock import seconds
from skyloop.cockpit.reports import run_child
from skyloop.cockpit.values import flat_values, truth_values, vector
from skyloop.messages import Event, EventKind, Feedback, LogEntry, Severity
from skyloop.recording.layout import Channel
from skyloop.recording.plain import Course

if TYPE_CHECKING:
    from skyloop.recording.reader import Recording

MARK: Final = "mark"  #: name of a logged text that is a mark
MAX_EVENTS: Final = 300  #: the most severe ones
MAX_MARKS: Final = 300
MAX_SAMPLES: Final = 1200
PERIOD_S: Final = 0.1  #: between samples, at least
MAX_TEXT: Final = 200
_SEVERITIES: Final = (Severity.ERROR, Severity.WARNING)
#: Events that tell nothing about the flight.
_LEFT_OUT: Final = frozenset({EventKind.PARAMETER_CHANGED})


def child_command(file: Path, target: Path, drone: str | None) -> Sequence[str]:
    """Return the command that runs this module as a program."""
    return [sys.executable, "-m", "skyloop.cockpit.timeline", str(file), str(target), *([drone] if drone else [])]


def timeline(recording: Recording, drone: str) -> dict[str, Any]:
    """Return what happened in a recording, with positions as ``replay.position_s``, as JSON values.

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
            continue  # replays don't play logs: they begin with another sample
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


def _write(recording: Recording, drone: str, target: Path) -> None:
    target.write_bytes(msgspec.json.encode(timeline(recording, drone)))


if __name__ == "__main__":
    sys.exit(run_child(sys.argv[1:], _write))
