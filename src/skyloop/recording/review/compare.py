"""Comparison of two recordings' commands over time: what a changed controller does differently."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from skyloop.clock import NS_PER_S
from skyloop.errors import FileFormatError
from skyloop.messages import Applied, Feedback
from skyloop.recording.layout import Channel
from skyloop.recording.reader import Recording
from skyloop.recording.review.tables import ACTION_FIELDS, begin_ns

RATE_HZ: Final = 100.0  #: rate at which both are compared; a command holds until the next one
PART: Final = 0.01  #: greatest difference of set-points that are equal, in their SI unit
_POSITION: Final = "replay.position_s"
_UNITS: Final = {
    **dict.fromkeys(("roll", "pitch", "yaw"), "rad"),
    **dict.fromkeys(("yaw_rate", "turn_rate"), "rad/s"),
    **dict.fromkeys(("x", "y", "z"), "m"),
}

What = Literal["asked", "applied"]


@dataclass(frozen=True, slots=True)
class Commands:
    """One recording's commands: actions, and their numbers with NaN where an action has none of that name."""

    times_s: NDArray[np.float64]
    names: NDArray[np.str_]
    numbers: dict[str, NDArray[np.float64]]

    def at(self, times_s: NDArray[np.float64]) -> Commands:
        """Return the commands in force at some times [s]: the newest of each; none before the first."""
        index = np.searchsorted(self.times_s, times_s, side="right") - 1
        before = index < 0
        index = np.maximum(index, 0)
        if not len(self.times_s):
            empty = np.full(len(times_s), np.nan)
            return Commands(times_s, np.full(len(times_s), "", "<U16"), dict.fromkeys(self.numbers, empty))
        names = np.where(before, "", self.names[index])
        numbers = {name: np.where(before, np.nan, column[index]) for name, column in self.numbers.items()}
        return Commands(times_s, names, numbers)


@dataclass(frozen=True, slots=True)
class FieldDifference:
    """The difference of one number of the set-points, over the time in which both have it."""

    name: str
    unit: str
    rms: float
    largest: float
    largest_at_s: float
    seconds: float  #: how long both had it


@dataclass(frozen=True, slots=True)
class Comparison:
    """Two flights' commands on one time axis, which starts with the older recording."""

    aligned: str  #: how the times were aligned, in words
    old: Commands
    new: Commands
    seconds: float  #: compared
    same_action: float  #: share of that time in which both did the same kind of thing
    fields: tuple[FieldDifference, ...]
    part_at_s: float | None  #: when they first differ, in kind or by more than :data:`PART`; None: never
    counts: tuple[int, int]


def compare(
    old: Recording,
    new: Recording,
    *,
    drone: str | None = None,
    what: What = "asked",
    part: float = PART,
) -> Comparison:
    """Compare what applications asked for (or what was applied), without the proxies' own commands.

    A recording of a replay knows which moment of the old flight each of its own is; else both start with their first
    command.

    Args:
        old: The older recording.
        new: The newer one.
        drone: The drone's name; None takes the first of each.
        what: ``"asked"`` or ``"applied"``.
        part: Greatest difference of set-points that are equal, in their SI unit.

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
            raise FileFormatError(f"{recording.path} holds no commands: there is nothing to compare")
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


def _commands(recording: Recording, drone: str, what: What, zero_ns: int, offset_ns: int) -> Commands:
    """``offset_ns`` is added to this recording's times to make them the old one's."""
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
    return Commands(
        np.array(times, np.float64)[order],
        np.array(names, "<U16")[order],
        {name: np.array(column, np.float64)[order] for name, column in numbers.items()},
    )


def _align(old: Recording, old_name: str, new: Recording, new_name: str) -> tuple[int, str, int]:
    """The old recording's first moment, how the times fit, and what to add to the new one's times [ns]."""
    zero_ns = begin_ns(old, old_name)
    spans = [_span(recording, name) for recording, name in ((old, old_name), (new, new_name))]
    overlap = min(span[1] for span in spans) - max(span[0] for span in spans)
    if overlap > 0.5 * min(span[1] - span[0] for span in spans):
        return zero_ns, "by their clock, which is the same", 0
    offsets = []
    for item in new.items(new_name, (Channel.FEEDBACK,)):
        feedback: Feedback = item.value
        position_s = (feedback.native or {}).get(_POSITION)
        if isinstance(position_s, float) and position_s > 0.0:
            offsets.append(zero_ns + round(position_s * NS_PER_S) - feedback.published_ns)
    if len(offsets) > 1 and np.ptp(offsets) < NS_PER_S:
        return zero_ns, "the new one is a replay of the old one", int(np.median(offsets))
    firsts = [_first_command(recording, name) for recording, name in ((old, old_name), (new, new_name))]
    return zero_ns, "both begin with their first command", firsts[0] - firsts[1]


def _span(recording: Recording, drone: str) -> tuple[int, int]:
    """First and last command, on the proxy's clock [ns]."""
    times = [item.value.applied_ns for item in recording.items(drone, (Channel.COMMANDS,))]
    return (min(times), max(times)) if times else (0, 0)


def _first_command(recording: Recording, drone: str) -> int:
    for item in recording.items(drone, (Channel.COMMANDS,)):
        applied: Applied = item.value
        if applied.app_id and applied.asked.name != "idle":
            return applied.applied_ns
    return begin_ns(recording, drone)
