"""``skyloop bench``: measures this machine's delays next to those of a bare hand-over, and the simulator's speed."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from typing import TYPE_CHECKING, Annotated, Final

import typer
from rich.table import Table

from skyloop.cli.text import console, named, print_json, progress_bar
from skyloop.errors import UsageError

if TYPE_CHECKING:
    from skyloop.bench import DelayResults, SimResults, Spread


class What(StrEnum):
    DELAYS = "delays"
    SIM = "sim"


LEAST_S: Final = 0.5  #: minimum duration of a measurement
_SMALL: Final = (320, 240)


def bench(
    what: Annotated[
        What,
        typer.Argument(help="delays: the channels, next to a bare hand-over of the same bytes; sim: the simulator"),
    ],
    seconds: Annotated[float, typer.Option(min=LEAST_S, help="Duration; for delays, of each of the two runs")] = 30.0,
    sizes: Annotated[
        str | None, typer.Option(help="delays: frame sizes, such as 320x240,640x480 [default: 320x240]")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print the figures as one JSON object")] = False,
) -> None:
    """Measure the delays on this machine (median and 99th percentile) or the speed of the simulator.

    Close all other programs first.
    """
    if sizes is not None and what is not What.DELAYS:
        raise UsageError(f"--sizes is for bench delays, not for bench {what.value}")
    wanted = parse_sizes(sizes)
    from skyloop import bench as measuring

    with progress_bar(f"measuring {what.value}") as progress:
        if what is What.DELAYS:
            delays = measuring.measure_delays(seconds, wanted, progress)
            results: DelayResults | SimResults = delays
            shown = [delay_table(delays)]
        else:
            simulator = measuring.measure_sim(seconds, progress)
            results, shown = simulator, [physics_table(simulator), drawing_table(simulator)]
    if json:
        print_json(results)
    else:
        for table in shown:
            console().print(table)


def parse_sizes(text: str | None, largest: tuple[int, int] = (1920, 1080)) -> list[tuple[int, int]]:
    """Parse frame sizes such as ``320x240,640x480``."""
    sizes = []
    for word in text.split(",") if text is not None else ["x".join(map(str, _SMALL))]:
        width, _, height = word.strip().replace("×", "x").partition("x")
        size = (int(width), int(height)) if width.isdecimal() and height.isdecimal() else (0, 0)
        if not 0 < size[0] * size[1] <= largest[0] * largest[1]:
            raise UsageError(f"{word!r} is not a frame size: give e.g. 320x240, at most {largest[0]}x{largest[1]}")
        sizes.append(size)
    return list(dict.fromkeys(sizes))


def delay_table(results: DelayResults) -> Table:
    """Return a table of the delays, together with those of a bare hand-over for comparison."""
    rows = [
        (
            f"{row.channel} {row.size}" if row.channel == "video" else row.channel,
            _spread(row.skyloop),
            _spread(row.bare),
            f"{row.skyloop.median_us / row.bare.median_us:.1f} ×",
            str(row.skyloop.samples),
            str(row.lost),
        )
        for row in results.rows
    ]
    columns = ("", "Skyloop", "bare hand-over", "ratio", "samples", "lost")
    title = f"Delays in µs over the {results.transport} local transport: median (99th percentile)"
    return _table(title, columns, rows, str(results.machine))


def physics_table(results: SimResults) -> Table:
    """Return a table for flights without images."""
    rows = [
        (
            str(row.drones),
            f"{row.model}, by firmware" if row.firmware else row.model,
            row.world,
            _spread(row.step),
            f"{row.real_time:.0f} ×",
        )
        for row in results.physics
    ]
    columns = ("drones", "model", "world", "a step", "real time")
    return _table("Physics alone, µs a step of 4 ms: median (p99)", columns, rows, str(results.machine))


def drawing_table(results: SimResults) -> Table:
    """Return a table for images that include sensor imperfections."""
    rows = [
        (
            row.cameras,
            f"{row.width}×{row.height}",
            f"{row.round.median_us / 1e3:.1f} ({row.round.p99_us / 1e3:.1f})",
            f"{row.frames_per_s:.0f}",
            str(row.round.samples),
        )
        for row in results.drawing
    ]
    columns = ("cameras", "size", "time", "pictures/s", "samples")
    return _table("Drawing on one core, ms for one picture of each camera: median (p99)", columns, rows)


def _table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], caption: str | None = None) -> Table:
    table = Table(*map(named, columns), title=title, caption=caption, box=None)
    for row in rows:
        table.add_row(*row)
    return table


def _spread(spread: Spread) -> str:
    return f"{spread.median_us:.0f} ({spread.p99_us:.0f})"
