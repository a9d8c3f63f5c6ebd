"""Compare the commands of two recordings over time, to show how a modified controller behaves differently."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import NS_PER_S
from skyloop.errors import FileFormatError, MissingExtraError
from skyloop.files import replacing
from skyloop.messages import Applied, Feedback
from skyloop.recording.layout import Channel
from skyloop.recording.reader import Recording
from skyloop.recording.review.charts import Line, Mark, Page, TimeAxis, band_chart, facts, limits, spans, table
from skyloop.recording.review.tables import ACTION_FIELDS, begin_ns

RATE_HZ: Final = 100.0  #: sampling rate of the comparison; a command remains in effect until the next one
PART: Final = 0.01  #: maximum difference at which two set-points are considered equal, in their SI unit
_POSITION: Final = "replay.position_s"
_UNITS: Final = {
    **dict.fromkeys(("roll", "pitch", "yaw"), "rad"),
    **dict.fromkeys(("yaw_rate", "turn_rate"), "rad/s"),
    **dict.fromkeys(("x", "y", "z"), "m"),
}

What = Literal["asked", "applied"]


@dataclass(frozen=True, slots=True)
class RecordedCommands:
    """The commands of one recording: actions and their values, with NaN where an action has no value of that name."""

    times_s: NDArray[np.float64]
    names: NDArray[np.str_]
    numbers: dict[str, NDArray[np.float64]]

    def at(self, times_s: NDArray[np.float64]) -> RecordedCommands:
        """Return the commands in effect at the given times [s]; before the first command, there is none."""
        index = np.searchsorted(self.times_s, times_s, side="right") - 1
        before = index < 0
        index = np.maximum(index, 0)
        if not len(self.times_s):
            empty = np.full(len(times_s), np.nan)
            return RecordedCommands(times_s, np.full(len(times_s), "", "<U16"), dict.fromkeys(self.numbers, empty))
        names = np.where(before, "", self.names[index])
        numbers = {name: np.where(before, np.nan, column[index]) for name, column in self.numbers.items()}
        return RecordedCommands(times_s, names, numbers)


@dataclass(frozen=True, slots=True)
class FieldDifference:
    """The difference in one set-point value, over the time in which both recordings have an action with that value."""

    name: str
    unit: str
    rms: float
    largest: float
    largest_at_s: float
    seconds: float  #: duration of that time


@dataclass(frozen=True, slots=True)
class Comparison:
    """The commands of two flights on a common time axis, which starts with the older recording."""

    aligned: str  #: description of how the times are aligned
    old: RecordedCommands
    new: RecordedCommands
    seconds: float  #: duration of the part that both recordings share
    same_action: float  #: fraction of that duration in which both recordings have the same kind of action
    fields: tuple[FieldDifference, ...]
    part_at_s: float | None  #: time of the first difference, in kind or by more than :data:`PART`; None if none
    counts: tuple[int, int]  #: number of commands in the old and in the new recording


def compare(
    old: Recording,
    new: Recording,
    *,
    drone: str | None = None,
    what: What = "asked",
    part: float = PART,
) -> Comparison:
    """Compare the commands that applications requested (or the applied ones), excluding the proxies' own commands.

    If the recordings overlap in time, their times are used as they are. If the newer one is a replay of the older one,
    its times are mapped to those of the old flight; otherwise the first commands are aligned.

    Args:
        old: The older recording.
        new: The newer recording.
        drone: The drone's name, or None to use the first drone in each recording.
        what: ``"asked"`` or ``"applied"``.
        part: Maximum difference at which two set-points are considered equal, in their SI unit.

    Raises:
        FileFormatError: A recording has no commands.
        UnknownNameError: The older recording has no such drone.
    """
    old_name = old.drone(drone).name
    new_name = new.drone(drone if drone in {one.name for one in new.drones} else None).name
    zero_ns, aligned, offset_ns = _align(old, old_name, new, new_name)
    older = _commands(old, old_name, what, zero_ns, 0)
    newer = _commands(new, new_name, what, zero_ns, offset_ns)
    for recording, commands in ((old, older), (new, newer)):
        if not len(commands.times_s):
            raise FileFormatError(f"{recording.path} contains no commands to compare")
    begin = max(older.times_s[0], newer.times_s[0])
    end = min(older.times_s[-1], newer.times_s[-1])
    grid = np.arange(begin, max(end, begin) + 1e-9, 1.0 / RATE_HZ)
    a, b = older.at(grid), newer.at(grid)
    same = a.names == b.names
    fields, apart = [], ~same
    for name in ACTION_FIELDS:
        difference = np.where(same, b.numbers[name] - a.numbers[name], np.nan)
        both = np.isfinite(difference)
        if not both.any():
            continue
        apart |= both & (np.abs(difference) > part)
        worst = int(np.nanargmax(np.abs(difference)))
        rms = float(np.sqrt(np.mean(difference[both] ** 2)))
        unit = _UNITS.get(name, "m/s")
        fields.append(
            FieldDifference(
                name, unit, rms, float(abs(difference[worst])), float(grid[worst]), float(both.sum() / RATE_HZ)
            )
        )
    return Comparison(
        aligned=aligned,
        old=older,
        new=newer,
        seconds=float(grid[-1] - grid[0]),
        same_action=float(same.mean()),
        fields=tuple(fields),
        part_at_s=float(grid[int(np.argmax(apart))]) if apart.any() else None,
        counts=(len(older.times_s), len(newer.times_s)),
    )


def _commands(recording: Recording, drone: str, what: What, zero_ns: int, offset_ns: int) -> RecordedCommands:
    """Return a recording's commands; ``offset_ns`` converts its times to those of the old recording."""
    times, names = [], []
    numbers: dict[str, list[float]] = {name: [] for name in ACTION_FIELDS}
    for item in recording.items(drone, (Channel.COMMANDS,)):
        applied: Applied = item.value
        if not applied.app_id:
            continue
        action = applied.asked if what == "asked" else applied.applied
        times.append((applied.applied_ns + offset_ns - zero_ns) / NS_PER_S)
        names.append(action.name)
        for name, column in numbers.items():
            value = getattr(action, name, None)
            column.append(np.nan if value is None else float(value))
    order = np.argsort(np.array(times, np.float64), kind="stable")
    return RecordedCommands(
        np.array(times, np.float64)[order],
        np.array(names, "<U16")[order],
        {name: np.array(column, np.float64)[order] for name, column in numbers.items()},
    )


def _align(old: Recording, old_name: str, new: Recording, new_name: str) -> tuple[int, str, int]:
    """Return the old recording's start, how times are aligned, and the offset [ns] to add to the new one's times."""
    zero_ns = begin_ns(old, old_name)
    spans = [_span(recording, name) for recording, name in ((old, old_name), (new, new_name))]
    overlap = min(span[1] for span in spans) - max(span[0] for span in spans)
    if overlap > 0.5 * min(span[1] - span[0] for span in spans):
        return zero_ns, "by their common clock", 0
    offsets = []
    for item in new.items(new_name, (Channel.FEEDBACK,)):
        feedback: Feedback = item.value
        position_s = (feedback.native or {}).get(_POSITION)
        if isinstance(position_s, float) and position_s > 0.0:
            offsets.append(zero_ns + round(position_s * NS_PER_S) - feedback.published_ns)
    if len(offsets) > 1 and np.ptp(offsets) < NS_PER_S:
        return zero_ns, "the new one is a replay of the old one", int(np.median(offsets))
    firsts = [_first_command(recording, name) for recording, name in ((old, old_name), (new, new_name))]
    return zero_ns, "both start at their first command", firsts[0] - firsts[1]


def _span(recording: Recording, drone: str) -> tuple[int, int]:
    """Return the times of the first and last commands, on the proxy's clock [ns]."""
    times = [item.value.applied_ns for item in recording.items(drone, (Channel.COMMANDS,))]
    return (min(times), max(times)) if times else (0, 0)


def _first_command(recording: Recording, drone: str) -> int:
    for item in recording.items(drone, (Channel.COMMANDS,)):
        applied: Applied = item.value
        if applied.app_id and applied.asked.name != "idle":
            return applied.applied_ns
    return begin_ns(recording, drone)


# Drawing --------------------------------------------------------------------------------------------------------


_ACTIONS: Final = {"idle": "", "emergency_stop": "alarm", "takeoff": "rising", "land": "falling", "*": "flying"}
_OLD: Final[dict[str, Any]] = {"color": "#1f6feb", "lw": 1.8}
_NEW: Final[dict[str, Any]] = {"color": "#d9480f", "lw": 1.4, "ls": "--"}


def write_comparison(found: Comparison, old: str, new: str, path: Path) -> None:
    """Write the comparison of two named recordings as ``.html``, or as ``.png`` (with Matplotlib).

    Raises:
        UsageError: The file can't be written.
        MissingExtraError: Matplotlib is required but is not installed.
    """
    if path.suffix == ".png":
        _picture(found, old, new, path)
    else:
        make_page(found, old, new).write(path)


def make_page(found: Comparison, old: str, new: str) -> Page:
    """Create the page: the actions, each set-point from both recordings, and a table of differences."""
    axis = _axis(found)
    page = Page(f"{new} against {old}", axis)
    page.add(f"<h1>{escape(Path(new).name)} against {escape(Path(old).name)}</h1>")
    page.add(f'<p class="sub">The commands of two recordings, {escape(found.aligned)}</p>')
    parted = "never" if found.part_at_s is None else f"at {found.part_at_s:.2f} s"
    page.add(
        facts(
            [
                ("compared", f"{found.seconds:.1f} s"),
                ("first difference", parted),
                ("same kind of action", f"{found.same_action:.1%}"),
                ("commands, old", str(found.counts[0])),
                ("commands, new", str(found.counts[1])),
            ]
        )
    )
    page.add('<h2>Course <i class="now"></i></h2>')
    rows = [
        (title, spans(commands.times_s, commands.names, _ACTIONS, axis.end_s))
        for title, commands in (("old", found.old), ("new", found.new))
    ]
    marks = [] if found.part_at_s is None else [Mark(found.part_at_s, "first difference", "warning")]
    page.add(f'<section class="panel">{band_chart("bands", rows, marks, axis)}</section>')
    for field in found.fields:
        lines = [_line("old", found.old, field.name, "c1"), _line("new", found.new, field.name, "c2")]
        page.chart(field.name, field.unit, lines, limits(lines, least_span=0.1))
    cells = [
        [
            f"{field.name} [{field.unit}]",
            *(f"{number:.4f}" for number in (field.rms, field.largest)),
            f"{field.largest_at_s:.2f}",
            f"{field.seconds:.1f}",
        ]
        for field in found.fields
    ]
    head = ("set-point", "RMS", "largest", "at [s]", "compared [s]")
    page.add("<h2>Differences</h2>" + table(head, cells, ("", "n", "n", "n", "n")))
    return page


def _axis(found: Comparison) -> TimeAxis:
    ends = [commands.times_s[[0, -1]] for commands in (found.old, found.new)]
    return TimeAxis(float(min(end[0] for end in ends)), float(max(end[1] for end in ends)) + 0.1)


def _line(label: str, commands: RecordedCommands, name: str, style: str) -> Line:
    return Line(label, commands.times_s, commands.numbers[name], style, dashed=label == "new", steps=True)


def _picture(found: Comparison, old: str, new: str, path: Path) -> None:
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingExtraError("drawing a .png (a .html page needs no extra)", "bench", cause=str(error)) from None
    rows = max(1, len(found.fields))
    figure = Figure(figsize=(12, 1.2 + 2.0 * rows), layout="constrained", dpi=120)
    figure.suptitle(f"{Path(new).name} against {Path(old).name}, {found.aligned}")
    places = np.atleast_1d(figure.subplots(rows, 1, sharex=True))
    for field, axes in zip(found.fields, places, strict=False):
        for label, commands, style in (("old", found.old, _OLD), ("new", found.new, _NEW)):
            axes.plot(commands.times_s, commands.numbers[field.name], label=label, drawstyle="steps-post", **style)
        axes.set_ylabel(f"{field.name} [{field.unit}]")
        axes.set_title(f"RMS difference {field.rms:.4f} {field.unit}", loc="right", fontsize="small")
        axes.grid(alpha=0.25)
        if found.part_at_s is not None:
            axes.axvline(found.part_at_s, color="grey", ls=":", lw=1.2)
    places[0].legend(loc="upper left")
    places[-1].set_xlabel("time [s]")
    with replacing(path) as part:
        figure.savefig(part)
