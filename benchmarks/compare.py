"""Compare a run with the last one on the pages, to detect regressions.

``python -m benchmarks.compare results`` reads the output of ``python -m benchmarks.… --output results`` (and of
``skyloop bench sim --json``, as ``sim.json``), and compares it with ``docs/measured``, or with a second folder. Delays
are compared as multiples of the bare hand-over's delays in their own run, so that the machine's speed cancels out;
the simulator, which has no such floor, is compared as measured, which is only meaningful on one machine.

Figures more than :data:`WORSE` times as slow as before are marked, and the exit status is then 1.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Final, NamedTuple

import typer

from benchmarks.measuring import delays, loop
from benchmarks.measuring.command_line import as_rich
from benchmarks.measuring.contenders import FLOOR, OURS
from benchmarks.measuring.loop import TOTAL
from benchmarks.measuring.schedule import CHANNELS, COMMAND, VIDEO
from benchmarks.measuring.tables import Table
from benchmarks.one_command import one_command
from benchmarks.pages.delays import MEASURED
from skyloop.bench import SimResults
from skyloop.cli.app import run
from skyloop.cli.text import console
from skyloop.errors import UsageError
from skyloop.files import MAX_RESULTS, read_json

WORSE: Final = 1.15  #: medians of one machine vary by less from run to run, as a multiple of the floor's


class Change(NamedTuple):
    """A figure that is in both runs; smaller is better."""

    what: str
    unit: str
    before: float
    now: float
    judged: bool = True  #: whether a large increase counts as worse; 99th percentiles vary too much

    @property
    def ratio(self) -> float:
        """The ratio of now to before."""
        return self.now / self.before

    @property
    def worse(self) -> bool:
        """Whether the figure has become worse."""
        return self.judged and self.ratio > WORSE


def compare(now: Path, before: Path) -> list[Change]:
    """Return all figures present in both folders.

    Args:
        now: Folder with the results of the new run.
        before: Folder with the results to compare with.

    Raises:
        UsageError: The folders have no results in common.
        FileFormatError: A file is not a results file.
    """
    found = [*_delays(now, before), *_loop(now, before), *_sim(now, before)]
    if not found:
        raise UsageError(f"{now} and {before} have no delays.json, loop.json or sim.json in common: nothing to compare")
    return found


def _delays(now: Path, before: Path) -> Iterator[Change]:
    if not _both(now, before, "delays.json"):
        return
    new, old = delays.load(now / "delays.json"), delays.load(before / "delays.json")
    for size in new.sizes:
        for channel in CHANNELS:
            figures = [_to_floor(run, size, channel) for run in (old, new)]
            if figures[0] is not None and figures[1] is not None:
                (median_before, p99_before), (median_now, p99_now) = figures  # type: ignore[misc]
                yield Change(f"{channel}, frames of {size}: median", "× floor", median_before, median_now)
                yield Change(f"{channel}, frames of {size}: 99th percentile", "× floor", p99_before, p99_now, False)


def _to_floor(results: delays.Delays, size: str, channel: str) -> tuple[float, float] | None:
    """Return the median and the 99th percentile as multiples of the floor's."""
    ours, floor = (results.summary(name, size, channel) for name in (OURS.name, FLOOR.name))
    if ours is None or floor is None:
        return None
    return ours.median_us / floor.median_us, ours.p99_us / floor.p99_us


def _loop(now: Path, before: Path) -> Iterator[Change]:
    """Yield the loop, as a multiple of the bare hand-over's time for its frame and its command."""
    if not (_both(now, before, "loop.json") and _both(now, before, "delays.json")):
        return
    new, old = loop.load(now / "loop.json"), loop.load(before / "loop.json")
    floors = [delays.load(folder / "delays.json") for folder in (before, now)]
    for result in new.sizes:
        same = [other for other in old.sizes if other.size == result.size]
        below = [_floor_us(run, result.size) for run in floors]
        if same and below[0] is not None and below[1] is not None:
            was, is_now = same[0].stages[TOTAL].median_us / below[0], result.stages[TOTAL].median_us / below[1]
            yield Change(f"loop, frames of {result.size}: median", "× floor", was, is_now)


def _floor_us(results: delays.Delays, size: str) -> float | None:
    parts = [results.summary(FLOOR.name, size, channel) for channel in (VIDEO, COMMAND)]
    return None if None in parts else sum(part.median_us for part in parts if part is not None)


def _sim(now: Path, before: Path) -> Iterator[Change]:
    if not _both(now, before, "sim.json"):
        return
    new, old = (
        read_json(folder / "sim.json", SimResults, "the results of bench sim", MAX_RESULTS) for folder in (now, before)
    )
    steps = {(row.world, row.drones, row.model): row.step.median_us for row in old.physics}
    for step in new.physics:
        before_us = steps.get((step.world, step.drones, step.model))
        if before_us is not None:
            what = f"simulator, {step.drones} × {step.model} in {step.world}: a step"
            yield Change(what, "µs", before_us, step.step.median_us)
    pictures = {(row.cameras, row.width): 1e6 / row.frames_per_s for row in old.drawing}
    for row in new.drawing:
        if (row.cameras, row.width) in pictures:
            what = f"simulator, {row.cameras} at {row.width}×{row.height}: a picture"
            yield Change(what, "µs", pictures[row.cameras, row.width], 1e6 / row.frames_per_s)


def _both(now: Path, before: Path, name: str) -> bool:
    return (now / name).exists() and (before / name).exists()


def table(changes: list[Change]) -> Table:
    """Return the changes as a table."""
    rows = [
        [
            change.what,
            f"{change.before:.3g} {change.unit}",
            f"{change.now:.3g} {change.unit}",
            f"{change.ratio:.2f}",
            "slower" if change.worse else "",
        ]
        for change in changes
    ]
    return Table("A run and the last one on the pages", ["what", "before", "now", "now to before", ""], rows)


def command(
    folder: Annotated[
        Path, typer.Argument(help="Folder with the JSON files of a run (--output)", exists=True, file_okay=False)
    ],
    before: Annotated[
        Path, typer.Argument(help="Folder with those of another run", exists=True, file_okay=False)
    ] = MEASURED,
) -> None:
    """Compare a run with the last one in docs/measured.

    Exits with 1 if something has become slower. Example: python -m benchmarks.compare results
    """
    changes = compare(folder, before)
    for shown in as_rich([table(changes)], f"{folder} beside {before}"):
        console().print(shown)
    if any(change.worse for change in changes):
        raise typer.Exit(1)


def build() -> typer.Typer:
    """Return the command line."""
    return one_command(command)


if __name__ == "__main__":
    run(build(), sys.argv[1:], "benchmarks.compare")
