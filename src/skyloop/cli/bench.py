"""``skyloop bench``: what a user can know of this machine: its delays, here and over the network, and its simulator."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import msgspec
import typer
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from skyloop.cli.text import console, named
from skyloop.errors import UsageError
from skyloop.files import write as write_file

if TYPE_CHECKING:
    from skyloop.bench import tables
    from skyloop.bench.contenders import Contender
    from skyloop.bench.schedule import Size
    from skyloop.bench.sim import SimResults
    from skyloop.bench.statistics import Spread


class What(StrEnum):
    DELAYS = "delays"
    LOOP = "loop"
    SIM = "sim"
    NETWORK = "network"


LEAST_S: Final = 0.5
_WHAT_HELP: Final = (
    "delays: the paper's experiment, and the same by a bare hand-over; loop: from a frame to its command, by stage; "
    "sim: the simulator; network: as delays, and the same over the network transport on the loopback interface"
)
_ONLY: Final = {"--sizes": (What.DELAYS, What.LOOP)}  # options that mean something for some things only

#: Told the share that is done, 0 to 1, and what comes next.
Report = Callable[..., None]
Seconds = Annotated[
    float | None, typer.Option(min=LEAST_S, help="How long to measure each contender, case or size [default: 30]")
]
Minutes = Annotated[float | None, typer.Option(min=0.01, help="The same in minutes; the paper's were 5")]
Sizes = Annotated[str | None, typer.Option(help="Of the frames, such as 320x240,640x480 [default: 320x240]")]
Output = Annotated[Path | None, typer.Option(help="A folder for the figures as JSON and, of some, the diagrams")]


def bench(
    what: Annotated[What, typer.Argument(help=_WHAT_HELP)],
    seconds: Seconds = None,
    minutes: Minutes = None,
    sizes: Annotated[
        str | None, typer.Option(help="delays, loop: of the frames, such as 320x240,640x480 [default: 320x240]")
    ] = None,
    output: Output = None,
    json: Annotated[bool, typer.Option("--json", help="For programs: the figures as one JSON object")] = False,
) -> None:
    """Measure delays on this machine, as medians and 99th percentiles, or how fast the simulator is.

    Targets stand beside the figures. Example: skyloop bench delays --seconds 60 --output results

    Nothing else should run meanwhile.
    """
    check_options(what, {"--sizes": sizes})
    wanted_s, wanted = duration_s(seconds, minutes), parse_sizes(sizes)
    with measuring(what.value, output) as progress:
        match what:
            case What.DELAYS:
                results, shown = measure_delays(wanted_s, wanted, (), {}, progress)
            case What.NETWORK:
                results, shown = _network(wanted_s, wanted, progress)
            case What.LOOP:
                results, shown = _loop(wanted_s, wanted, progress)
            case What.SIM:
                results, shown = _sim(wanted_s, progress)
    if json:
        typer.echo(msgspec.json.encode(results).decode())
    finish(what.value, results, [] if json else shown, output, _draw if what is What.DELAYS else None)


def check_options(what: What, given: Mapping[str, object]) -> None:
    """Check that the options given belong to this measurement.

    Raises:
        UsageError: One means nothing for it.
    """
    for option, value in given.items():
        if value is not None and what not in _ONLY[option]:
            raise UsageError(f"{option} is for bench {' and '.join(_ONLY[option])}, not for bench {what.value}")


def duration_s(seconds: float | None, minutes: float | None) -> float:
    """Return how long to measure [s].

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
        UsageError: The text is anything else.
    """
    from skyloop.bench.schedule import LARGE, SMALL, Size

    if text is None:
        return [SMALL]
    sizes = []
    for word in text.split(","):
        width, _, height = word.strip().replace("×", "x").partition("x")
        size = Size(int(width), int(height)) if width.isdecimal() and height.isdecimal() else Size(0, 0)
        if not 0 < size.frame_bytes <= LARGE.frame_bytes:
            raise UsageError(
                f"{word!r} is no size of frames: give such as 320x240, at most {LARGE.width}x{LARGE.height}"
            )
        sizes.append(size)
    return list(dict.fromkeys(sizes))


@contextmanager
def measuring(what: str, output: Path | None) -> Iterator[Report]:
    """Make the folder for the results, and show the progress on a terminal."""
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
    """Print the tables, and write the results as JSON and their diagrams into the folder if there is one.

    Raises:
        MissingExtraError: matplotlib is not installed; the JSON is written all the same.
    """
    for table in shown:
        console().print(table)
    if output is None:
        return
    file = output / f"{what}.json"
    write_file(file, msgspec.json.encode(results) + b"\n")
    for written in [file, *(draw(results, output) if draw else [])]:
        typer.echo(f"wrote {written}", err=True)


def _draw(results: Any, folder: Path) -> list[Path]:
    from skyloop.bench.figures import draw

    return draw(results, folder)


def measure_delays(
    seconds: float, sizes: Sequence[Size], others: Sequence[Contender], skipped: dict[str, str], progress: Report
) -> tuple[Any, list[Table]]:
    """Measure Skyloop beside the bare hand-over and ``others``; return results and tables."""
    from skyloop.bench import delays, tables
    from skyloop.bench.targets import judge_delays

    print_skipped(skipped)
    results = delays.measure(seconds, sizes, others, skipped, progress)
    verdicts = tables.verdict_table(judge_delays(results))
    return results, as_rich(
        [tables.paper_table(results), tables.comparison_table(results), verdicts], str(results.machine)
    )


def _network(seconds: float, sizes: Sequence[Size], progress: Report) -> tuple[Any, list[Table]]:
    from skyloop.bench.contenders import NETWORK
    from skyloop.transport.fabric import session

    session.load()  # says what to install, before any process is started
    return measure_delays(seconds, sizes, [NETWORK], {}, progress)


def _loop(seconds: float, sizes: Sequence[Size], progress: Report) -> tuple[Any, list[Table]]:
    from skyloop.bench import loop, tables

    results = loop.measure(seconds, sizes, progress)
    return results, as_rich([tables.loop_table(results)], str(results.machine))


def _sim(seconds: float, progress: Report) -> tuple[Any, list[Table]]:
    from skyloop.bench import sim

    results = sim.measure(seconds, progress)
    return results, [physics_table(results), drawing_table(results)]


def print_skipped(skipped: Mapping[str, str]) -> None:
    """Write to standard error what could not be measured, and why."""
    for name, why in skipped.items():
        typer.echo(f"without {name}: {why}", err=True)


def as_rich(found: Sequence[tables.Table], where: str) -> list[Table]:
    """Return tables for the terminal; those without rows are left out."""
    shown = []
    for one in found:
        if one.rows:
            table = Table(*map(named, one.columns), title=one.title, caption=where, box=None)
            for row in one.rows:
                table.add_row(*row)
            shown.append(table)
    return shown


def physics_table(results: SimResults) -> Table:
    """Return the figures of flying without pictures."""
    title = "Physics alone, µs a step of 4 ms: median (p99)"
    shown = Table(
        "drones", "model", "world", "a step", "real time", "target", title=title, caption=str(results.machine), box=None
    )
    for row in results.physics:
        target = "" if row.target is None else f"≥ {row.target:.3g} ×"
        model = f"{row.model}, by firmware" if row.firmware else row.model
        shown.add_row(str(row.drones), model, row.world, _spread(row.step), f"{row.real_time:.0f} ×", target)
    return shown


def drawing_table(results: SimResults) -> Table:
    """Return the figures of pictures with the flaws of the sensor."""
    shown = Table(
        "cameras",
        "size",
        "time",
        "pictures/s",
        "target",
        "samples",
        title="Drawing on one core, ms for one picture of each camera: median (p99)",
        box=None,
    )
    for row in results.drawing:
        shown.add_row(
            row.cameras,
            f"{row.width}×{row.height}",
            f"{row.round.median_us / 1e3:.1f} ({row.round.p99_us / 1e3:.1f})",
            f"{row.frames_per_s:.0f}",
            "" if row.target is None else f"≥ {row.target:g}",
            str(row.round.samples),
        )
    return shown


def _spread(spread: Spread) -> str:
    return f"{spread.median_us:.0f} ({spread.p99_us:.0f})"
