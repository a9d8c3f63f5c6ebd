"""Options, progress and output shared by the benchmarks' command lines."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Final

import msgspec
import typer
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from benchmarks.measuring import delays, tables
from benchmarks.measuring.contenders import Contender
from benchmarks.measuring.schedule import Size
from benchmarks.measuring.targets import judge_delays
from skyloop.cli import bench
from skyloop.cli.text import console, named
from skyloop.errors import UsageError
from skyloop.files import write as write_file

LEAST_S: Final = 0.5

#: Called with the fraction done, 0 to 1, and the next step.
Report = Callable[..., None]
Seconds = Annotated[
    float | None, typer.Option(min=LEAST_S, help="Duration for each contender, case or size [default: 30]")
]
Minutes = Annotated[float | None, typer.Option(min=0.01, help="The same in minutes; the paper's were 5")]
Sizes = Annotated[str | None, typer.Option(help="Frame sizes, such as 320x240,640x480 [default: 320x240]")]
Output = Annotated[Path | None, typer.Option(help="Folder for the figures as JSON and, for some, the diagrams")]


def duration_s(seconds: float | None, minutes: float | None) -> float:
    """Return the duration of a measurement [s].

    Raises:
        UsageError: Both options are given.
    """
    if seconds is not None and minutes is not None:
        raise UsageError("--seconds and --minutes exclude each other: give one of them")
    if minutes is not None:
        return max(LEAST_S, minutes * 60.0)
    return 30.0 if seconds is None else seconds


def parse_sizes(text: str | None) -> list[Size]:
    """Parse sizes of frames such as ``320x240,640x480``.

    Raises:
        UsageError: The text is not a list of sizes.
    """
    return [Size(width, height) for width, height in bench.parse_sizes(text)]


@contextmanager
def measuring(what: str, output: Path | None) -> Iterator[Report]:
    """Create the folder for the results, and show progress on a terminal."""
    if output is not None:
        output.mkdir(parents=True, exist_ok=True)
    with Progress(transient=True, disable=not sys.stderr.isatty(), console=Console(stderr=True)) as bar:
        task = bar.add_task(f"measuring {what}", total=1.0)

        def progress(share: float, doing: str = "") -> None:
            bar.update(task, completed=share, description=doing or f"measuring {what}")

        yield progress


def finish(
    what: str,
    results: Any,
    shown: Sequence[Table],
    output: Path | None,
    draw: Callable[[Any, Path], list[Path]] | None = None,
) -> None:
    """Print the tables and, if there is a folder, write the results to it as JSON, with diagrams.

    Raises:
        MissingExtraError: matplotlib is not installed; the JSON is written anyway.
    """
    for table in shown:
        console().print(table)
    if output is None:
        return
    file = output / f"{what}.json"
    write_file(file, msgspec.json.encode(results) + b"\n")
    for written in [file, *(draw(results, output) if draw else [])]:
        typer.echo(f"wrote {written}", err=True)


def measure_delays(
    seconds: float, sizes: Sequence[Size], others: Sequence[Contender], skipped: dict[str, str], progress: Report
) -> tuple[Any, list[Table]]:
    """Measure Skyloop beside the bare hand-over and ``others``; return results and tables."""
    print_skipped(skipped)
    results = delays.measure(seconds, sizes, others, skipped, progress)
    verdicts = tables.verdict_table(judge_delays(results))
    return results, as_rich(
        [tables.paper_table(results), tables.comparison_table(results), verdicts], str(results.machine)
    )


def print_skipped(skipped: Mapping[str, str]) -> None:
    """Print what could not be measured, and why, to standard error."""
    for name, why in skipped.items():
        typer.echo(f"without {name}: {why}", err=True)


def as_rich(found: Sequence[tables.Table], where: str) -> list[Table]:
    """Return tables for the terminal, without empty ones."""
    shown = []
    for one in found:
        if one.rows:
            table = Table(*map(named, one.columns), title=one.title, caption=where, box=None)
            for row in one.rows:
                table.add_row(*row)
            shown.append(table)
    return shown
