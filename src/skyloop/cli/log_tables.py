"""Format recordings as tables for the terminal."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import msgspec
from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from skyloop.cli.text import named
from skyloop.clock import NS_PER_S
from skyloop.recording.reader import Described, Recording, shown_name
from skyloop.recording.review.compare import Comparison
from skyloop.recording.review.summary import Delay, Recovered, Row, Summary
from skyloop.recording.review.video import Videos


def info(recording: Recording, summary: Summary) -> Iterator[RenderableType]:
    """Yield the output of ``skyloop log info``."""
    yield _head(recording, summary)
    yield _channels(summary)
    for words in _losses(summary):
        yield Text(words, "yellow")
    for note in summary.notes:
        yield Text(note, "bold yellow")


def listing(rows: Sequence[tuple[Path, Described]]) -> Table:
    """Return the recordings in a folder as a table."""
    table = Table(box=None)
    for title in ("recording", "begun", "lasts", "drones", "problem"):
        table.add_column(title, overflow="fold")
    for path, summary in rows:
        table.add_row(
            Text(shown_name(path)),
            "" if summary.started is None else time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(summary.started)),
            "" if summary.seconds is None else f"{summary.seconds:.1f} s",
            Text(", ".join(summary.drones)),
            Text(summary.problem),
        )
    return table


def as_json(recording: Recording, summary: Summary) -> str:
    """Return the output of ``skyloop log info --json``."""
    head = {"file": str(recording.path), "drones": recording.drones, "started_unix_ns": recording.start.started_unix_ns}
    return msgspec.json.encode(head | {"summary": summary}, enc_hook=str).decode()


def _head(recording: Recording, summary: Summary) -> Table:
    table = Table.grid(padding=(0, 2))
    start = recording.start
    began = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(start.started_unix_ns / NS_PER_S))
    size = recording.found.size / 1e6
    table.add_row("file", Text(f"{recording.path}" + (f", number {start.file}" if start.file > 1 else ""), "bold"))
    table.add_row("recorded", f"{began}, {summary.seconds:.1f} s, {size:.1f} MB, by Skyloop {start.skyloop}")
    for drone in recording.drones:
        what = drone.described
        cameras = ", ".join(f"{one.name} {one.width}×{one.height}" for one in what.cameras) or "none"
        table.add_row("drone", f"{drone.name}: {what.vehicle}, {drone.uri or 'no address'}; cameras: {cameras}")
    events = ", ".join(f"{count} {severity}" for severity, count in sorted(summary.events.items()))
    table.add_row("events", events or "none")
    return table


def _channels(summary: Summary) -> Table:
    table = Table(box=None)
    table.add_column("topic", overflow="fold")  # never cut, because it identifies the rows
    for title in ("count", "rate", "gaps", "longest", "missing", "size"):
        table.add_column(title, justify="right", no_wrap=True)
    table.add_column("delay [ms]: median (p99)")
    for row in summary.rows:
        table.add_row(
            row.topic,
            str(row.count),
            _rate(row),
            str(row.gaps) if row.gaps else "",
            f"{row.longest_s:.3g} s" if row.steady and row.longest_s is not None else "",
            str(row.missing) if row.missing else "",
            _size(row.bytes),
            "\n".join(map(_delay, row.delays)),
        )
    return table


def _rate(row: Row) -> str:
    return f"{row.rate_hz:.3g} Hz" if row.steady and row.rate_hz is not None else ""


def _size(number: int) -> str:
    return f"{number / 1e6:.1f} MB" if number >= 1e5 else f"{number / 1e3:.1f} kB"


def _delay(delay: Delay) -> str:
    return f"{delay.median_s * 1e3:.2f} ({delay.p99_s * 1e3:.2f}) {delay.what}"


def _losses(summary: Summary) -> Iterator[str]:
    for what, counts in (("left out by the recorder", summary.dropped), ("never reached the recorder", summary.missed)):
        for drone, channels in counts.items():
            words = ", ".join(f"{count} of {channel}" for channel, count in channels.items() if count)
            if words:
                yield f"{drone}: {words} {what}"


def recovered_json(file: Path, saved: Recovered | None) -> str:
    """Return the output of ``skyloop log recover --json``; ``saved`` is null if the recording was complete."""
    return msgspec.json.encode({"file": str(file), "saved": saved}, enc_hook=str).decode()


def exported(found: Videos, camera: str) -> Iterator[str]:
    """Yield a line for each exported video, and one about missing frames."""
    for video in found.videos:
        since = f", from {video.begin_s:.3f} s on" if video is not found.videos[0] else ""
        how = "as it was recorded" if video.copied else "encoded"
        yield f"{video.path}: {video.frames} frames of {camera}{since}, {video.width}×{video.height}, {how}"
    if found.left_out:
        why = "of another size" if not found.videos[0].copied else "without the frames they depend on"
        yield f"{found.left_out} frames were skipped: damaged, or {why}"


def comparison_json(found: Comparison) -> str:
    """Return the output of ``skyloop log compare --json``."""
    shown = {
        name: getattr(found, name) for name in ("aligned", "seconds", "same_action", "fields", "part_at_s", "counts")
    }
    return msgspec.json.encode(shown).decode()


def comparison(found: Comparison, old: str, new: str) -> list[str | Table]:
    """Return the differences between two recordings, as parts to print."""
    parts = "they never diverge" if found.part_at_s is None else f"they diverge at {found.part_at_s:.2f} s"
    table = Table(named("set-point"), "RMS", "largest", "at", "compared", box=None)
    for field in found.fields:
        table.add_row(
            field.name,
            f"{field.rms:.4f} {field.unit}",
            f"{field.largest:.4f} {field.unit}",
            f"{field.largest_at_s:.2f} s",
            f"{field.seconds:.1f} s",
        )
    return [
        f"{new} against {old}",
        table if found.fields else "no set-point is in both at one time",
        f"{found.seconds:.1f} s compared, {found.aligned}; {found.counts[0]} and {found.counts[1]} commands; "
        f"the same kind of action {found.same_action:.1%} of the time; {parts}",
    ]
